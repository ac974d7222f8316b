"""What every actor of one character plays: clips, fades, layers, all actors in one set of arrays.

A *row* is one actor. A row has a few *layers* (full body, upper body, a breathing added on top), and a layer a few
*slots*: the clip that plays now and those it is fading from. Advancing and posing work on all rows at once; nothing
loops over actors. Updates are cheap notes of time that are carried out when somebody asks for a pose.

Letters in shapes: R rows (capacity), A the actors asked for, L layers, P slots, N nodes, J joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.blending import add_pose, mix_poses, overlay_pose
from runtime.animation.clip import Clip
from runtime.animation.joint_overrides import JointsFromCode
from runtime.animation.layers import Layer, make_layer
from runtime.animation.pose import Pose, rest_pose, sample, skinning_rows, wrap_times
from runtime.animation.root_motion import RootMotion, compose, motion_matrix
from runtime.animation.skeleton import Skeleton
from runtime.validation import FASTEST, LONGEST_S, describe, is_integer, numbers, step_s, unknown_name

Floats = NDArray[np.floating[Any]]
Rows = NDArray[np.int64]

# A fade may be interrupted by the next one; the oldest of more than this many clips is dropped (its weight is small).
_SLOTS = 6
_FIRST_CAPACITY = 8
# In place of a clip's number: the slot is heard as silence.
_SILENCE = -1
_DTYPE = np.float32
LARGEST_WEIGHT = 100.0  # of a morph, either sign: glTF allows weights beyond one, and a mistake is a thousand


def given_weights(skeleton: Skeleton, before: Floats, weights: Mapping[str, Any] | ArrayLike | None) -> Floats:
    """Morph weights that code gives A actors, (A, M), NaN where a morph is the clips'; see `Mixer.set_morph_weights`.

    before : (A, M)
        What was given until now.
    """
    given = before.copy()
    if weights is None:
        given[:] = np.nan
    elif isinstance(weights, Mapping):
        for name, value in weights.items():
            morph = skeleton.morph(name)
            amount = np.nan if value is None else numbers(value, f"weights of {name!r}", LARGEST_WEIGHT)
            if np.ndim(amount) and np.shape(amount) != (len(given),):
                raise ValueError(f"{len(given)} actors need a weight of {name!r} each, or one for all")
            given[:, morph] = amount
    else:
        given[:] = _checked_weights(weights, *given.shape)
    return given


def _checked_weights(weights: ArrayLike, num_actors: int, num_morphs: int) -> NDArray[np.float64]:
    """Weights for actors, (M,) or (A, M), NaN where a morph is the clips'."""
    try:
        array = np.asarray(weights, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(())
    if array.shape not in ((num_morphs,), (num_actors, num_morphs)):
        raise ValueError(
            f"morph weights of {num_actors} actors are ({num_morphs},) or ({num_actors}, {num_morphs}) numbers, or a "
            f"mapping of names to weights, not {describe(weights)}"
        )
    numbers(np.where(np.isnan(array), 0.0, array), "morph weights", LARGEST_WEIGHT)
    return array


class Mixer:
    """The state of all actors of one character.

    Parameters
    ----------
    skeleton : Skeleton
    clips : sequence of Clip
    """

    def __init__(self, skeleton: Skeleton, clips: Sequence[Clip]) -> None:
        self.skeleton = skeleton
        self.clips: list[Clip] = list(clips)
        self.layers: list[Layer] = [Layer("base")]
        self._root = RootMotion(skeleton)
        self._free: list[int] = []
        self._capacity = 0
        self._clip = np.zeros((0, 1, _SLOTS), dtype=np.int32)
        self._time = np.zeros((0, 1, _SLOTS))
        self._speed = np.zeros((0, 1, _SLOTS))
        self._loop = np.zeros((0, 1, _SLOTS), dtype=bool)
        self._weight = np.zeros((0, 1, _SLOTS))
        self._newest = np.zeros((0, 1), dtype=np.int64)
        self._fade_rate = np.zeros((0, 1))
        self._layer_weight = np.zeros((0, 1))
        self._pending = np.zeros(0)
        self._dirty = np.zeros(0, dtype=bool)
        self._moves_root = np.zeros(0, dtype=bool)
        self._turns_root = np.zeros(0, dtype=bool)
        self._root_step = np.zeros((0, 3))
        self._joint_rows: Floats = np.zeros((0, skeleton.num_joints, 3, 4), dtype=_DTYPE)
        self._node_rows: Floats = np.zeros((0, skeleton.num_nodes, 3, 4), dtype=_DTYPE)
        self._morphs: Floats = np.zeros((0, len(skeleton.morphs)), dtype=_DTYPE)
        self._given_morphs: Floats = np.zeros((0, len(skeleton.morphs)), dtype=_DTYPE)  # NaN: the clip's
        self._given = JointsFromCode(skeleton)

    # Rows

    @property
    def num_rows(self) -> int:
        """Rows in use."""
        return self._capacity - len(self._free)

    def add_row(self) -> int:
        """Take a row, at rest: no clip, no code-set joints."""
        if not self._free:
            self._grow(max(_FIRST_CAPACITY, 2 * self._capacity))
        row = self._free.pop()
        self._clip[row], self._weight[row], self._time[row] = _SILENCE, 0.0, 0.0
        self._layer_weight[row], self._fade_rate[row], self._newest[row] = 1.0, 0.0, 0
        self._pending[row], self._root_step[row] = 0.0, 0.0
        self._dirty[row], self._moves_root[row], self._turns_root[row] = True, False, False
        self._given_morphs[row] = np.nan
        self._given.clear(row)
        return row

    def remove_row(self, row: int) -> None:
        """Give a row back."""
        self._free.append(row)

    def _grow(self, capacity: int) -> None:
        """Make room for more rows."""
        added = capacity - self._capacity

        def longer(array: Any) -> Any:
            return np.concatenate([array, np.zeros((added, *array.shape[1:]), dtype=array.dtype)])

        for name in (
            *("_clip", "_time", "_speed", "_loop", "_weight", "_newest", "_fade_rate", "_layer_weight", "_pending"),
            *("_dirty", "_moves_root", "_turns_root", "_root_step", "_joint_rows", "_node_rows"),
            *("_morphs", "_given_morphs"),
        ):
            setattr(self, name, longer(getattr(self, name)))
        self._given.grow(capacity)
        self._free.extend(range(capacity - 1, self._capacity - 1, -1))
        self._capacity = capacity

    # Clips and layers

    def clip_index(self, clip: str | int | Clip) -> int:
        """Number of a clip given by name, number, or itself (a clip from elsewhere joins the list).

        Raises
        ------
        ValueError
            When there is none of that name or number.
        """
        if isinstance(clip, Clip):
            for index, known in enumerate(self.clips):
                if known is clip:
                    return index
            self.clips.append(clip)
            return len(self.clips) - 1
        if isinstance(clip, str):
            for index, known in enumerate(self.clips):
                if known.name == clip:
                    return index
        elif is_integer(clip) and 0 <= clip < len(self.clips):
            return int(clip)
        raise unknown_name("clip", clip, [known.name for known in self.clips], "character")

    def add_layer(self, name: str, mode: str = "override", nodes: ArrayLike | None = None) -> int:
        """Add a layer on top of the others, for every row; its weight starts at 1.

        Parameters
        ----------
        name : str
        mode : "override" or "additive"
        nodes : (N,) float or bool mask, or a list of node names whose subtrees take part; all by default

        Returns
        -------
        The layer's number

        Raises
        ------
        ValueError
            For an unknown mode, a layer name in use, a mask of the wrong length or an unknown node.
        """
        if any(layer.name == name for layer in self.layers):
            raise ValueError(f"there already is a layer {name!r}")
        self.layers.append(make_layer(self.skeleton, name, mode, nodes))
        for attribute in ("_clip", "_time", "_speed", "_loop", "_weight", "_newest", "_fade_rate", "_layer_weight"):
            array = getattr(self, attribute)
            setattr(self, attribute, np.concatenate([array, np.zeros_like(array[:, :1])], axis=1))
        self._clip[:, -1] = _SILENCE
        self._layer_weight[:, -1] = 1.0
        return len(self.layers) - 1

    def layer_index(self, layer: str | int) -> int:
        """Number of a layer given by name or number; ValueError when there is none."""
        for index, known in enumerate(self.layers):
            if layer == known.name or (is_integer(layer) and layer == index):
                return index
        raise unknown_name("layer", layer, [known.name for known in self.layers], "character")

    def play(
        self,
        rows: ArrayLike,
        clip: str | int | Clip,
        *,
        fade_s: float = 0.0,
        speed: float | Floats = 1.0,
        time_s: float | Floats = 0.0,
        loop: bool = True,
        layer: str | int = 0,
    ) -> None:
        """Start a clip, fading from whatever the layer plays.

        Parameters
        ----------
        rows : (A,) int
        clip : name, number, or a Clip of the same skeleton
        fade_s : seconds until the new clip has it all; 0 cuts
        speed : factor, or (A,) of them; negative plays backwards
        time_s : where in the clip to start, or (A,) of them
        loop : over and over, or once and hold the end
        layer : name or number
        """
        fade_s = float(numbers(fade_s, "fade_s"))
        speed, time_s = numbers(speed, "speed", FASTEST), numbers(time_s, "time_s", LONGEST_S)
        rows = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        which, index = self.layer_index(layer), self.clip_index(clip)
        slot = self._start_fade(rows, which, fade_s)
        self._clip[rows, which, slot] = index
        self._time[rows, which, slot] = time_s
        self._speed[rows, which, slot] = speed
        self._loop[rows, which, slot] = loop

    def stop(self, rows: ArrayLike, layer: str | int, *, fade_s: float = 0.0) -> None:
        """Silence a layer, within `fade_s` seconds."""
        fade_s = float(numbers(fade_s, "fade_s"))
        rows, which = np.atleast_1d(np.asarray(rows, dtype=np.int64)), self.layer_index(layer)
        slot = self._start_fade(rows, which, fade_s)
        self._clip[rows, which, slot] = _SILENCE

    def _start_fade(self, rows: Rows, which: int, fade_s: float) -> Rows:
        """Make room in a layer for what comes in, within `fade_s`, and say in which slot of each row, (A,)."""
        self.flush(rows)
        index = np.arange(len(rows))
        weights = self._weight[rows, which]
        slot: Rows = np.argmin(weights, axis=1)
        weights[index, slot] = 0.0
        totals = weights.sum(axis=1, keepdims=True)
        nothing = totals[:, 0] <= 0
        weights = np.where(totals > 0, weights / np.where(totals > 0, totals, 1.0), 0.0)
        # The body has nothing to fade from when nothing plays; a layer above fades in over what is below it.
        at_once = np.full(len(rows), fade_s <= 0) | (nothing & (which == 0))
        weights[at_once] = 0.0
        weights[index, slot] = at_once
        from_silence = nothing & ~at_once
        other = (slot + 1) % _SLOTS
        weights[index[from_silence], other[from_silence]] = 1.0
        self._clip[rows[from_silence], which, other[from_silence]] = _SILENCE
        self._weight[rows, which] = weights
        self._newest[rows, which] = slot
        self._fade_rate[rows, which] = 1.0 / fade_s if fade_s > 0 else 0.0
        self._dirty[rows] = True
        return slot

    def seek(self, rows: ArrayLike, time_s: float | Floats, layer: str | int = 0) -> None:
        """Move the clip of a layer that plays now to a time, seconds."""
        time_s = numbers(time_s, "time_s", LONGEST_S)
        rows, which = np.atleast_1d(np.asarray(rows, dtype=np.int64)), self.layer_index(layer)
        self.flush(rows)
        self._time[rows, which, self._newest[rows, which]] = time_s
        self._dirty[rows] = True

    def set_speed(self, rows: ArrayLike, speed: float | Floats, layer: str | int = 0) -> None:
        """Set the speed of the clip of a layer that plays now."""
        speed = numbers(speed, "speed", FASTEST)
        rows, which = np.atleast_1d(np.asarray(rows, dtype=np.int64)), self.layer_index(layer)
        self.flush(rows)
        self._speed[rows, which, self._newest[rows, which]] = speed

    def set_layer_weight(self, rows: ArrayLike, layer: str | int, weight: float | Floats) -> None:
        """Set how much a layer counts, 0 to 1. The base layer always counts fully."""
        weight = numbers(weight, "a layer's weight")
        rows = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        self._layer_weight[rows, self.layer_index(layer)] = np.clip(weight, 0, 1)
        self._dirty[rows] = True

    def playing(self, row: int, layer: str | int = 0) -> tuple[Clip | None, float]:
        """The clip that a layer of a row plays now, and the time inside it, seconds."""
        self.flush(np.array([row]))
        which = self.layer_index(layer)
        slot = self._newest[row, which]
        index = int(self._clip[row, which, slot])
        if index < 0 or self._weight[row, which].sum() <= 0:
            return None, 0.0
        clip = self.clips[index]
        times = wrap_times(self._time[row, which, [slot]], clip.duration_s, bool(self._loop[row, which, slot]))
        return clip, float(times[0])

    def finished(self, row: int, layer: str | int = 0) -> bool:
        """Whether the clip that a layer of a row plays, once and not over and over, has come to its end."""
        self.flush(np.array([row]))
        which = self.layer_index(layer)
        slot = self._newest[row, which]
        index = int(self._clip[row, which, slot])
        if index < 0 or self._loop[row, which, slot] or self._weight[row, which].sum() <= 0:
            return False
        time_s, speed = self._time[row, which, slot], self._speed[row, which, slot]
        return bool(time_s <= 0.0 if speed < 0 else time_s >= self.clips[index].duration_s)

    # Joints from code

    def set_matrices(self, row: int, matrices: ArrayLike | None) -> None:
        """Set joints from code in object space: (J, 4, 4) float, NaN where a joint keeps its own; None undoes.

        What hangs below a joint so set follows it.
        """
        self._given.set_matrices(row, self._capacity, matrices)
        self._dirty[row] = True

    def set_rotations(self, row: int, rotations: ArrayLike | None) -> None:
        """Set local rotations from code: (J, 4) quaternions, NaN where a joint keeps its own; None undoes."""
        self._given.set_rotations(row, self._capacity, rotations)
        self._dirty[row] = True

    # Morphs

    def set_morph_weights(self, rows: ArrayLike, weights: Mapping[str, Any] | ArrayLike | None) -> None:
        """Set morph weights from code, over what the clips say; None gives them back to the clips.

        Parameters
        ----------
        rows : (A,) int
        weights : mapping of names to a number or (A,) numbers, or (M,) or (A, M) numbers
            NaN in an array, and None in a mapping, where a morph is the clips'.

        Raises
        ------
        ValueError
            When there is no such morph, or a number is not finite or larger than `LARGEST_WEIGHT`.
        """
        rows = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        self._given_morphs[rows] = given_weights(self.skeleton, self._given_morphs[rows], weights)
        self._dirty[rows] = True

    def morph_weights(self, rows: ArrayLike) -> Floats:
        """Weights of the morphs of some rows, (A, M) float32."""
        rows = np.array(rows, dtype=np.int64, ndmin=1)
        self._refresh(rows)
        return self._morphs.take(rows, axis=0)

    # Time

    def note_time(self, row: int, dt_s: float) -> None:
        """Let a row's clock run on by `dt_s`. Carried out when its state is next asked for."""
        self._pending[row] += step_s(dt_s, "an actor")
        self._dirty[row] = True

    def note_time_all(self, dt_s: float) -> None:
        """Let every row's clock run on by `dt_s`."""
        self._pending += step_s(dt_s, "actors")
        self._dirty[:] = True

    def moves_root(self, row: int, enabled: bool, turns: bool = False) -> None:
        """Whether a row's clip moves its actor rather than its root joint, and whether it turns it too."""
        self.flush(np.array([row]))
        self._moves_root[row], self._turns_root[row] = enabled, enabled and turns
        self._dirty[row] = True

    def take_root_step(self, row: int) -> NDArray[np.float64]:
        """How the root has moved over the ground since last asked, for rows that move their root.

        Returns
        -------
        (4, 4) float64
            In object space: to be applied before the actor's own transform.
        """
        self.flush(np.array([row]))
        step = motion_matrix(self._root_step[row])
        self._root_step[row] = 0.0
        return step

    def flush(self, rows: Rows) -> None:
        """Carry out the time noted for some rows: clocks, fades, root motion."""
        rows = rows[self._pending[rows] != 0]
        if not len(rows):
            return
        elapsed = self._pending[rows]
        self._pending[rows] = 0.0
        before = self._time[rows]
        after = before + elapsed[:, None, None] * self._speed[rows]
        self._time[rows] = after
        if self._moves_root[rows].any():
            self._note_root(rows[self._moves_root[rows]], before[self._moves_root[rows]])
        index = np.arange(len(rows))[:, None], np.arange(len(self.layers))[None], self._newest[rows]
        weights = self._weight[rows]
        old = weights[index]
        new = np.minimum(1.0, old + np.abs(elapsed)[:, None] * self._fade_rate[rows])
        left = np.where(old < 1.0, (1.0 - new) / np.where(old < 1.0, 1.0 - old, 1.0), 0.0)
        weights *= left[:, :, None]
        weights[index] = new
        self._weight[rows] = weights

    def _note_root(self, rows: Rows, before: NDArray[np.float64]) -> None:
        """Add up how the root of some rows has moved."""
        after, clips, weights = self._time[rows, 0], self._clip[rows, 0], self._weight[rows, 0]
        heard = (weights > 0) & (clips != _SILENCE)
        totals = np.maximum(weights.sum(axis=1), 1e-30)
        steps = np.zeros((len(rows), 3))
        for number in np.unique(clips[heard]):
            at, slot = np.nonzero(heard & (clips == number))
            loops, turns = self._loop[rows[at], 0, slot], self._turns_root[rows[at]]
            moved = self._root.step(self.clips[number], before[at, 0, slot], after[at, slot], loops, turns)
            np.add.at(steps, at, moved * (weights[at, slot] / totals[at])[:, None])
        self._root_step[rows] = compose(self._root_step[rows], steps)

    # Poses

    def pose(self, rows: ArrayLike) -> Pose:
        """Blended local pose of some rows: Pose of A actors, float32."""
        rows = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        self.flush(rows)
        pose = self._layer_pose(rows, 0) or rest_pose(self.skeleton, len(rows), _DTYPE)
        for which, layer in enumerate(self.layers[1:], start=1):
            amount = self._layer_weight[rows, which] * self._loudness(rows, which)
            active = np.flatnonzero(amount > 0)
            above = self._layer_pose(rows[active], which) if len(active) else None
            if above is None:
                continue
            if layer.mode == "override":
                overlay_pose(pose, above, active, amount[active], layer.mask)
            else:
                reference = self._layer_pose(rows[active], which, first_frame=True) or above
                add_pose(pose, above, reference, active, amount[active], layer.mask)
        given = self._given.rotations(rows)
        if given is not None:
            np.copyto(pose.rotation, given, where=~np.isnan(given))
        if pose.weights is not None:
            set_here = self._given_morphs[rows]
            np.copyto(pose.weights, set_here, where=~np.isnan(set_here))
        return pose

    def _loudness(self, rows: Rows, which: int) -> NDArray[np.float64]:
        """How much of a layer is a clip rather than silence, (A,) 0 to 1."""
        heard = np.where(self._clip[rows, which] != _SILENCE, self._weight[rows, which], 0.0)
        return np.asarray(np.minimum(heard.sum(axis=1), 1.0))

    def _layer_pose(self, rows: Rows, which: int, first_frame: bool = False) -> Pose | None:
        """What one layer's clips say, blended by their weights; None where nothing plays at all."""
        weights, clips = self._weight[rows, which], self._clip[rows, which]
        times, loops = self._time[rows, which], self._loop[rows, which]
        heard = (weights > 0) & (clips != _SILENCE)
        parts: list[tuple[Rows, NDArray[np.float64], Pose]] = []
        for number in np.unique(clips[heard]):
            at, slot = np.nonzero(heard & (clips == number))
            clip = self.clips[number]
            wrapped = wrap_times(times[at, slot], clip.duration_s, loops[at, slot])
            part = sample(clip, self.skeleton, np.zeros_like(wrapped) if first_frame else wrapped, dtype=_DTYPE)
            if which == 0 and self._moves_root[rows[at]].any():
                self._root.hold(clip, part, self._moves_root[rows[at]], self._turns_root[rows[at]])
            parts.append((at, weights[at, slot], part))
        if not parts:
            return None
        if len(parts) == 1 and len(parts[0][0]) == len(rows) and len(np.unique(parts[0][0])) == len(rows):
            return parts[0][2]
        return mix_poses(self.skeleton, len(rows), parts, _DTYPE)

    def _refresh(self, rows: Rows) -> None:
        """Bring the matrices of some rows up to date."""
        dirty = self._dirty[rows]
        if not np.count_nonzero(dirty):
            return
        stale = np.unique(rows[dirty])
        given = self._given.matrices(stale)
        nodes = np.empty((len(stale), self.skeleton.num_nodes, 3, 4), dtype=_DTYPE)
        pose = self.pose(stale)
        self._joint_rows[stale] = skinning_rows(self.skeleton, pose, given, nodes)
        if pose.weights is not None:
            self._morphs[stale] = pose.weights
        self._node_rows[stale] = nodes
        self._dirty[stale] = False

    def joint_rows(self, rows: ArrayLike) -> Floats:
        """Skinning matrices of some rows, (A, J, 3, 4) float32. Computed once until a row changes."""
        rows = np.array(rows, dtype=np.int64, ndmin=1)
        self._refresh(rows)
        return self._joint_rows.take(rows, axis=0)

    def node_rows(self, row: int) -> Floats:
        """Object-space matrices of the nodes of one row, (N, 3, 4) float32."""
        self._refresh(np.array([row]))
        result: Floats = self._node_rows[row]
        return result
