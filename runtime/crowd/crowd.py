"""Thousands of actors of one character: clips baked into a texture, one instanced draw a level of detail.

The CPU culls, chooses levels and fills one instance buffer for all actors at once; the vertex shader finds each
actor's pose in a texture by its row.

``crowd = Crowd(ctx, model, 10_000); crowd.place(transforms); crowd.play("walk", phases_s=…)``, then each frame
``crowd.update(dt)`` and ``renderer.draw([hero, crowd], camera)``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.clip import Clip
from runtime.animation.mixer import given_weights
from runtime.crowd.animation_texture import MAX_ROWS, bake_clips
from runtime.crowd.lod_buffers import CrowdLevel, LevelMesh, bake_level_animations, model_meshes, upload_level
from runtime.crowd.morphs import CrowdMorphs
from runtime.crowd.passes import CrowdPasses
from runtime.crowd.state import CrowdState
from runtime.errors import NotCopied, RenderError
from runtime.gpu import gl_state
from runtime.gpu.context import can_free, require_current
from runtime.gpu.model import Model, require_alive
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.render.views import Drawable, Frame
from runtime.validation import FASTEST, LONGEST_S, describe, is_integer, numbers, step_s, unknown_name

Floats = NDArray[np.floating[Any]]

VERTEX_ANIMATION_BYTES = 8 << 20
MOST_ACTORS = 10_000_000


class Crowd(NotCopied, Drawable):
    """Many actors of one model.

    Parameters
    ----------
    ctx : moderngl.Context
        The model's.
    model : Model
    count : int
        Number of actors. All stand at the origin in the rest pose at first.
    clips : sequence of clip names, numbers or Clips, optional
        Those that the crowd can play; by default all of the model's.
    vertex_animation_bytes : int
        GPU memory for ready-made poses of the coarsest levels, which draw several times as fast; 0 for none.

    Raises
    ------
    ValueError
        For a negative count or an unknown clip.
    RenderError
        When the context was released or is another than the model's.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        model: Model,
        count: int,
        *,
        clips: Sequence[str | int | Clip] | None = None,
        vertex_animation_bytes: int = VERTEX_ANIMATION_BYTES,
    ) -> None:
        if not isinstance(ctx, moderngl.Context) or not isinstance(model, Model):
            raise RenderError(
                f"a crowd is made of a context, a model and a number, not {describe(ctx)}, {describe(model)}"
            )
        require_alive(ctx, "crowd")
        model.require_usable()
        if ctx is not model.ctx:
            raise RenderError(f"the model {model.asset.name} belongs to another context than the crowd")
        require_current(ctx, "crowd")
        if not is_integer(count) or not 0 <= count <= MOST_ACTORS:
            raise ValueError(f"a crowd has 0 to {MOST_ACTORS:,} actors, not {describe(count)}")
        if isinstance(clips, str) or (clips is not None and not isinstance(clips, Sequence)):
            raise ValueError(f"clips must be a list of names, numbers or Clips, not {describe(clips)}")
        if not is_integer(vertex_animation_bytes) or vertex_animation_bytes < 0:
            raise ValueError(
                f"vertex_animation_bytes must be a whole number of bytes, not {describe(vertex_animation_bytes)}"
            )
        self.ctx = ctx
        self.model = model
        mixer = model.mixer
        chosen = mixer.clips if clips is None else [mixer.clips[mixer.clip_index(clip)] for clip in clips]
        self._texture_limit = int(ctx.info["GL_MAX_TEXTURE_SIZE"])
        self.baked = bake_clips(mixer.skeleton, chosen, model.joint_boxes.boxes, min(MAX_ROWS, self._texture_limit))
        self.state = CrowdState(self.baked, model.joint_boxes, int(count))
        self.visible = True
        self.last_counts: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._released = False
        self._passes = CrowdPasses(model, self._seam_lines)
        self._owned: list[Any] = []
        self._morphs: CrowdMorphs | None = None
        try:
            units = (*range(len(TEXTURE_UNITS)), ctx.default_texture_unit)
            with gl_state.saved_state(units, (), False):
                self._rows_texture = self._upload_rows()
                if "MORPHS" in model.shader_defines and self._draws_the_model:
                    boxes = model.joint_boxes.boxes
                    self._morphs = CrowdMorphs(ctx, model.asset, chosen, self.baked, boxes, self.count)
                    self._passes.morphs = self._morphs
                    self._bound_morphs()
                    vertex_animation_bytes = 0  # ready-made positions know no weights of single actors
                self._levels = self._upload_levels(vertex_animation_bytes)
        except BaseException:
            self.release()
            raise
        self._passes.levels = self._levels
        self.errors_m = np.array([one.error_m for one in self._levels])

    def __repr__(self) -> str:
        return f"<Crowd of {self.count:,} {self.model.asset.name!r}{', released' if self._released else ''}>"

    # The actors

    @property
    def count(self) -> int:
        """Number of actors."""
        return self.state.count

    def place(self, transforms: ArrayLike, which: Any = None) -> None:
        """Put actors somewhere.

        Parameters
        ----------
        transforms : (A, 4, 4) or (4, 4) float
            Object space to world.
        which : slice, mask or numbers of actors, optional
            All by default.

        Raises
        ------
        ValueError
            When a matrix is not finite or the shape is wrong; nobody is moved then.
        """
        self.state.place(transforms, which)

    def place_on_ground(self, positions: ArrayLike, headings: ArrayLike = 0.0, which: Any = None) -> None:
        """Put actors at (A, 3) positions, metres, turned by (A,) headings about +Y, radians."""
        self.state.place_upright(positions, headings, which)

    def play(
        self,
        clip: str | int | Clip | ArrayLike,
        *,
        which: Any = None,
        phases_s: ArrayLike = 0.0,
        speeds: ArrayLike = 1.0,
        loop: bool = True,
    ) -> None:
        """Let actors play clips.

        Parameters
        ----------
        clip : a name, a number or a Clip, or (A,) names or numbers into `clip_names`
        which : slice, mask or numbers of actors, optional
        phases_s : where in the clip each is now, seconds
        speeds : factors
        loop : over and over, or once and hold the end
        """
        state, actors = self.state, self.state.index(which)
        values = {
            "clips": self._clip_numbers(clip),
            "speeds": numbers(speeds, "speeds", FASTEST),
            "phases_s": numbers(phases_s, "phases_s", LONGEST_S),
        }
        for name, value in values.items():
            if value.shape not in ((), (len(actors),)):
                raise ValueError(f"{len(actors)} actors need one of {name} each, or one for all, not {value.shape}")
        state.clips[actors] = values["clips"]
        state.speeds[actors] = values["speeds"]
        state.phases_s[actors] = values["phases_s"] - state.clock_s * state.speeds[actors]
        state.loops[actors] = loop
        state.place_spheres(actors)

    def _clip_numbers(self, clip: str | int | Clip | ArrayLike) -> NDArray[np.int64]:
        """Numbers of clips from what a caller may give."""
        names = self.clip_names
        if isinstance(clip, Clip):
            clip = clip.name
        given = np.asarray(clip)
        if given.dtype.kind in "US":
            known = {name: number for number, name in reversed(list(enumerate(names)))}
            for name in np.unique(given).astype(str):
                if name not in known:
                    raise unknown_name("clip", str(name), names, "crowd")
            return np.array([known[name] for name in given.ravel().astype(str)], dtype=np.int64).reshape(given.shape)
        wrong = given.dtype.kind not in "iu" or (given < 0) | (given >= len(names))
        if given.size and np.any(wrong):
            first = describe(clip if wrong is True else int(given[wrong].flat[0]))
            raise ValueError(f"no clip {first}; the crowd has {len(names)}, counted from 0")
        return given.astype(np.int64)

    @property
    def clip_names(self) -> tuple[str, ...]:
        """Names of the clips the crowd can play; the last is the rest pose."""
        return self.baked.names

    def set_morph_weights(self, weights: Mapping[str, Any] | ArrayLike | None, which: Any = None) -> None:
        """Set morph targets (blend shapes) of actors, over what their clips say.

        Parameters
        ----------
        weights : mapping of names to a weight or (A,) weights, (M,) or (A, M) float, or None
            As for `Actor.set_morph_weights`.
        which : slice, mask or numbers of actors, optional
            All by default.

        Raises
        ------
        ValueError
            When there is no such morph, or a weight is not finite or too large.
        """
        actors = self.state.index(which)
        if self._morphs is None:
            given_weights(self.model.mixer.skeleton, np.zeros((len(actors), 0), np.float32), weights)
            return
        self._require_usable()
        with gl_state.saved_state((self.ctx.default_texture_unit,), (), False):
            grown = self._morphs.set_weights(weights, actors)
        if grown:
            self._bound_morphs()

    def _bound_morphs(self) -> None:
        """Let bounds hold what morphs do."""
        assert self._morphs is not None
        self.baked, boxes = self._morphs.bound(self.baked)
        self.state.set_bounds(self.baked, boxes)

    def tint(self, colors: ArrayLike, which: Any = None) -> None:
        """Set factors of the base colour: (A, 3), (A, 4), (3,) or (4,) float, linear, 0 to 1."""
        actors, given = self.state.index(which), numbers(colors, "tints")
        if given.shape[-1:] not in ((3,), (4,)) or given.shape[:-1] not in ((), (len(actors),)):
            raise ValueError(f"{len(actors)} actors need tints (A, 3) or (A, 4), or one for all, not {given.shape}")
        bytes_ = np.rint(np.clip(given, 0, 1) * 255).astype(np.uint8)
        self.state.tints[actors, : given.shape[-1]] = bytes_

    def show(self, shown: ArrayLike, which: Any = None) -> None:
        """Show or hide actors: bool or (A,) bool."""
        actors, given = self.state.index(which), np.asarray(shown)
        if given.dtype.kind != "b" or given.shape not in ((), (len(actors),)):
            raise ValueError(f"{len(actors)} actors need True or False each, or one for all, not {describe(shown)}")
        self.state.visible[actors] = given

    def update(self, dt_s: float) -> None:
        """Let time run on for everybody. Costs nothing: places in clips are computed for those in view only."""
        self.state.clock_s += step_s(dt_s, "a crowd")

    # Buffers

    @property
    def textures(self) -> Mapping[str, moderngl.Texture]:
        """Textures by the name of their sampler."""
        return self.model.textures

    @property
    def gpu_bytes(self) -> dict[str, int]:
        """Bytes in GPU memory by purpose, besides the model's."""
        animations = [level.animation for level in self._levels if level.animation is not None]
        return {
            "animation_texture": int(self.baked.matrices.nbytes),
            "vertex_animation_textures": sum(4 * texture.width * texture.height for texture in animations),
            "vertices": sum(int(level.vertices.size) for level in self._levels),
            "morphs": 0 if self._morphs is None else self._morphs.nbytes,
            "instances": self._passes.instance_bytes,
        }

    def _upload_rows(self) -> moderngl.Texture:
        """The texture of baked poses: three texels a joint, one pose a row."""
        matrices = self.baked.matrices
        size = (3 * matrices.shape[1], matrices.shape[0])
        texture = self.ctx.texture(size, 4, np.ascontiguousarray(matrices).tobytes(), dtype="f4")
        self._owned.append(texture)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        texture.repeat_x = texture.repeat_y = False
        return texture

    @property
    def _draws_the_model(self) -> bool:
        """Whether the levels are the model's own, vertex by vertex."""
        return type(self)._meshes is Crowd._meshes

    def _meshes(self) -> list[LevelMesh]:
        """The levels to draw, the finest first."""
        return model_meshes(self.ctx, self.model)

    def _seam_lines(self, level: int) -> moderngl.Buffer | None:
        """Index buffer of a level's seams, None where it has none."""
        return self.model.levels.seam_lines(level)

    def _upload_levels(self, vertex_animation_bytes: int) -> tuple[CrowdLevel, ...]:
        """Buffers and textures of every level."""
        meshes, matrices = self._meshes(), self.baked.matrices
        levels = []
        animations = bake_level_animations(meshes, matrices, vertex_animation_bytes, self._texture_limit)
        for mesh, animation in zip(meshes, animations):
            level = upload_level(self.ctx, mesh, animation, matrices)
            self._owned += [thing for thing in (level.vertices, level.animation) if thing is not None]
            levels.append(level)
        return tuple(levels)

    # Drawing

    def draw_in(self, frame: Frame) -> None:
        """Draw everybody in view into a renderer's picture. Called by `Renderer.draw`."""
        if not self.visible or not self.count:
            return
        self._require_usable()
        if frame.level is not None and not 0 <= frame.level < len(self._levels):
            raise RenderError(f"the crowd has no level of detail {frame.level}: auto or 0 to {len(self._levels) - 1}")
        selection = self.state.select(frame.camera, frame.size_px, self.errors_m, frame.threshold_px, frame.level)
        self.last_counts = selection.counts + selection.mirrored
        if not len(selection.records):
            return
        self._passes.write(selection.records)
        for name, texture in self.textures.items():
            texture.use(TEXTURE_UNITS[name])
        self._rows_texture.use(TEXTURE_UNITS["joint_texture"])
        if self._morphs is not None:
            self._morphs.bind()
        self._passes.draw(frame, selection, self.model.constants)

    # The end

    def _require_usable(self) -> None:
        if self._released:
            raise RenderError("the crowd was released: make a new one")
        self.model.require_usable()

    def release(self) -> None:
        """Free what the crowd made. May be called more than once; the model stays."""
        if self._released:
            return
        can_free_now = can_free(self.ctx, "crowd")
        self._released = True
        if not can_free_now:
            return
        self._passes.release()
        for thing in (*self._owned, *([] if self._morphs is None else [self._morphs])):
            thing.release()
        self._owned.clear()
