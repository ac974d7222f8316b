"""One character on the stage: where it stands, what it plays.

An `Actor` is a handle: its animation lives in a row of its model's `Mixer`, its place in its own `transform`.
Letters in shapes: A actors, J joints, N nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.bounds import JointBoxes
from runtime.animation.clip import Clip
from runtime.animation.mixer import Mixer
from runtime.errors import NotCopied
from runtime.validation import describe, numbers

Floats = NDArray[np.floating[Any]]


class ModelLike(Protocol):
    """What an actor needs of its model."""

    mixer: Mixer
    joint_boxes: JointBoxes


class HasTransform(Protocol):
    """Anything that can be attached to a joint."""

    transform: Any


def _matrix(value: ArrayLike, what: str) -> NDArray[np.float64]:
    """A finite 4×4 matrix, copied; ValueError that names it for anything else."""
    matrix = numbers(value, f"the entries of {what}, a finite 4×4 matrix,")
    if matrix.shape != (4, 4):
        raise ValueError(f"{what} must be a 4×4 matrix, not of shape {matrix.shape}: {describe(value)}")
    return matrix


class Actor(NotCopied):
    """A character that stands somewhere and plays clips.

    Made by ``model.actor(...)``; needs no OpenGL of its own.

    Parameters
    ----------
    model : Model
    clip : name or number of a clip, or a Clip, optional
        The rest pose without.
    transform : (4, 4) float, optional
        Object space to world; identity by default.
    tint : (3,) or (4,) float
        Multiplies the base colour, linear.
    root_motion : bool or "turn"
        Let the clip carry the actor over the ground: `update` moves `transform` rather than the root joint. With
        "turn" it turns the actor about +Y as well.
    time_s, speed, loop
        As for `play`.
    """

    def __init__(
        self,
        model: ModelLike,
        clip: str | int | Clip | None = None,
        *,
        transform: ArrayLike | None = None,
        tint: ArrayLike = (1.0, 1.0, 1.0, 1.0),
        root_motion: bool | str = False,
        time_s: float = 0.0,
        speed: float = 1.0,
        loop: bool = True,
    ) -> None:
        self.model = model
        self.visible = True
        self._mixer = model.mixer
        self._row: int | None = self._mixer.add_row()
        self._transform: NDArray[np.float64] = np.eye(4)
        self._tint: NDArray[np.float32] = np.ones(4, dtype=np.float32)
        self._attached: list[tuple[HasTransform, int, NDArray[np.float64]]] = []
        self._endings: dict[int, Callable[[], object]] = {}
        self._root_motion = bool(root_motion)
        try:
            self.tint = tint
            if transform is not None:
                self.transform = transform
            if root_motion not in (False, True, "turn"):
                raise ValueError(f"root_motion {describe(root_motion)} is unknown: use False, True or 'turn'")
            if root_motion:
                self._mixer.moves_root(self._row, True, turns=root_motion == "turn")
            if clip is not None:
                self.play(clip, time_s=time_s, speed=speed, loop=loop)
        except BaseException:
            self.release()
            raise

    def __repr__(self) -> str:
        if self._row is None:
            return "<Actor, released>"
        playing, time_s = self._mixer.playing(self._row)
        at = ", ".join(f"{number:.3g}" for number in self._transform[:3, 3])
        return f"<Actor at ({at}) {f'playing {playing.name!r} at {time_s:.3g} s' if playing else 'at rest'}>"

    # Place and looks

    @property
    def transform(self) -> NDArray[np.float64]:
        """Object space to world, (4, 4) float64 acting on column vectors. May be written to in place."""
        return self._transform

    @transform.setter
    def transform(self, value: ArrayLike) -> None:
        self._transform = _matrix(value, "an actor's transform")

    @property
    def tint(self) -> NDArray[np.float32]:
        """Factor of the base colour, (4,) float32 linear RGBA."""
        return self._tint

    @tint.setter
    def tint(self, value: ArrayLike) -> None:
        color = numbers(value, "a tint").astype(np.float32)
        if color.shape not in ((3,), (4,)):
            raise ValueError(f"a tint is three or four finite numbers, not {describe(value)}")
        self._tint = np.append(color, np.float32(1)) if len(color) == 3 else color

    # Animation

    @property
    def row(self) -> int:
        """Row in the model's mixer; ValueError when the actor was released."""
        if self._row is None:
            raise ValueError("this actor was released; make a new one with model.actor()")
        return self._row

    @property
    def released(self) -> bool:
        """Whether the actor is gone. Drawing skips it."""
        return self._row is None

    def play(
        self,
        clip: str | int | Clip,
        *,
        fade_s: float = 0.0,
        speed: float = 1.0,
        time_s: float = 0.0,
        loop: bool = True,
        layer: str | int = 0,
        on_end: Callable[[], object] | None = None,
    ) -> None:
        """Start a clip on a layer, fading from what plays there.

        Parameters
        ----------
        clip : name or number of a clip, or a Clip of the same skeleton
        fade_s : seconds until the new clip has it all; 0 cuts
        speed : factor; negative plays backwards
        time_s : where in the clip to start
        loop : over and over, or once and hold the end
        layer : name or number
        on_end : function without arguments, optional
            Called once by the `update` that brings a clip played once (``loop=False``) to its end, unless something
            else was played on the layer before. It may play the next clip.

        Raises
        ------
        ValueError
            When there is no such clip or layer, a number is not finite, or a loop is to have an end.
        """
        if on_end is not None and (loop or not callable(on_end)):
            raise ValueError("on_end needs loop=False and a function: a clip that loops has no end")
        self._mixer.play(self.row, clip, fade_s=fade_s, speed=speed, time_s=time_s, loop=loop, layer=layer)
        number = self._mixer.layer_index(layer)
        self._endings.pop(number, None)
        if on_end is not None:
            self._endings[number] = on_end

    @property
    def finished(self) -> bool:
        """Whether the clip of the body, played once (``loop=False``), has come to its end."""
        return self._mixer.finished(self.row)

    def stop(self, layer: str | int, *, fade_s: float = 0.0) -> None:
        """Silence a layer, within `fade_s` seconds."""
        self._mixer.stop(self.row, layer, fade_s=fade_s)
        self._endings.pop(self._mixer.layer_index(layer), None)

    def set_layer_weight(self, layer: str | int, weight: float) -> None:
        """Set how much a layer counts, 0 to 1."""
        self._mixer.set_layer_weight(self.row, layer, weight)

    @property
    def clip(self) -> str | None:
        """Name of the clip that plays now."""
        clip, _ = self._mixer.playing(self.row)
        return None if clip is None else clip.name

    @property
    def time_s(self) -> float:
        """Time inside the clip that plays now, seconds. Set it to seek."""
        return self._mixer.playing(self.row)[1]

    @time_s.setter
    def time_s(self, value: float) -> None:
        self._mixer.seek(self.row, value)

    def set_speed(self, speed: float) -> None:
        """Set the speed of the clip that plays now."""
        self._mixer.set_speed(self.row, speed)

    def update(self, dt_s: float) -> None:
        """Let time run on.

        Parameters
        ----------
        dt_s : float, seconds

        Notes
        -----
        Costs a fraction of a microsecond: the work is done for all actors of a model together when they are drawn.
        Root motion and attached objects are carried out at once.
        """
        self._mixer.note_time(self.row, dt_s)
        if self._root_motion:
            self._transform[:] = self._transform @ self._mixer.take_root_step(self.row)
        if self._attached:
            self._place_attached()
        if self._endings:
            self._tell_endings()

    def _tell_endings(self) -> None:
        """Call who wants to know that a clip has come to its end."""
        ended = [layer for layer in self._endings if self._mixer.finished(self.row, layer)]
        for tell in [self._endings.pop(layer) for layer in ended]:
            tell()

    # Joints

    @property
    def joint_rows(self) -> Floats:
        """Skinning matrices of the current pose, (J, 3, 4) float32."""
        result: Floats = self._mixer.joint_rows(self.row)[0]
        return result

    def joint_transform(self, joint: str | int) -> NDArray[np.float64]:
        """Matrix of a node (a joint or a socket below one) in the world, (4, 4) float64.

        Parameters
        ----------
        joint : name or number of a node of the skeleton
        """
        node = self._mixer.skeleton.node(joint)
        matrix = np.eye(4)
        matrix[:3] = self._mixer.node_rows(self.row)[node]
        return self._transform @ matrix

    def attach(self, thing: HasTransform, joint: str | int, offset: ArrayLike | None = None) -> None:
        """Let a thing's `transform` follow a joint from now on.

        Parameters
        ----------
        thing : anything with a `transform` attribute, another actor for instance
        joint : name or number of a node
        offset : (4, 4) float, optional
            From the thing's space to the joint's.
        """
        node = self._mixer.skeleton.node(joint)
        place = np.eye(4) if offset is None else _matrix(offset, "an offset")
        if not hasattr(thing, "transform"):
            raise ValueError(f"only what has a transform can be attached, not {describe(thing)}")
        if thing is self or (isinstance(thing, Actor) and thing._carries(self)):
            raise ValueError("an actor cannot hang on itself, not by way of others either: detach one of them first")
        _ = self.row
        self.detach(thing)
        self._attached.append((thing, node, place))
        self._place_attached()

    def detach(self, thing: HasTransform) -> None:
        """Let go of a thing; nothing happens when it was not attached."""
        self._attached = [entry for entry in self._attached if entry[0] is not thing]

    def _carries(self, other: Actor) -> bool:
        """Whether another actor hangs on this one, by way of others too."""
        carried = [thing for thing, _, _ in self._attached if isinstance(thing, Actor)]
        return other in carried or any(actor._carries(other) for actor in carried)

    def _place_attached(self) -> None:
        for thing, node, offset in self._attached:
            thing.transform = self.joint_transform(node) @ offset

    def set_joints(self, matrices: ArrayLike | None) -> None:
        """Set joints from code (physics), in object space: (J, 4, 4), NaN where one keeps its own; None undoes."""
        self._mixer.set_matrices(self.row, matrices)

    def set_joint_rotations(self, rotations: ArrayLike | None) -> None:
        """Set local rotations from code (IK, looking at): (J, 4) xyzw, NaN where one keeps its own; None undoes."""
        self._mixer.set_rotations(self.row, rotations)

    # Morphs

    def set_morph_weights(self, weights: Mapping[str, float | None] | ArrayLike | None) -> None:
        """Set morph targets (blend shapes) from code, over what clips say of them.

        Parameters
        ----------
        weights : mapping of names to weights, (M,) float, or None
            Morphs that a mapping does not name stay as they were. None for a name, NaN in an array, gives a morph back
            to the clips; None for all gives all back. Weights below 0 and above 1 are taken as they are, up to 100.

        Raises
        ------
        ValueError
            When there is no such morph (`asset.morph_names` has them), or a weight is not finite or too large.
        """
        self._mixer.set_morph_weights(self.row, weights)

    @property
    def morph_weights(self) -> dict[str, float]:
        """Weight of each morph as it is drawn now, by name."""
        if not self._mixer.skeleton.morphs:
            return {}
        return dict(zip(self._mixer.skeleton.morphs, self._mixer.morph_weights(self.row)[0].tolist()))

    @property
    def bounds(self) -> Floats:
        """Box that holds the current pose, (2, 3) float32, object space, metres."""
        weights = self._mixer.morph_weights(self.row) if self._mixer.skeleton.morphs else None
        result: Floats = self.model.joint_boxes.around(self._mixer.joint_rows(self.row), weights)[0]
        return result

    def release(self) -> None:
        """Take the actor off the stage. May be called again, and while a list that holds it is drawn."""
        if self._row is not None:
            self._mixer.remove_row(self._row)
            self._row = None
            self._attached, self._endings = [], {}

    def __del__(self) -> None:
        """An actor that nobody holds any more leaves the stage by itself."""
        if getattr(self, "_row", None) is not None:
            self.release()
