"""Thousands of actors of one character: clips baked into a texture, one instanced draw a level of detail.

The CPU culls, chooses levels and fills one instance buffer for all actors at once; the vertex shader finds each
actor's pose in a texture by its row. An actor far away takes the nearest baked row instead of a blend of two, and so
shares its pose with others, but only at levels whose own error is well above what the rounding moves.

``crowd = Crowd(ctx, model, 10_000); crowd.place(transforms); crowd.play("walk", phases_s=…)``, then each frame
``crowd.update(dt)`` and ``renderer.draw([hero, crowd], camera)``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime import gl_state
from runtime.actor import joint_boxes_of
from runtime.clip import Clip
from runtime.crowd_bake import MAX_ROWS, bake_clips, dropped_shift, pick_joints
from runtime.crowd_levels import CrowdLevel, expand_levels, vertex_bytes
from runtime.crowd_stage import INSTANCE_WORDS, Selection, Stage
from runtime.errors import RenderError
from runtime.gpu_asset import Model, require_alive
from runtime.gpu_textures import TEXTURE_UNITS
from runtime.programs import build_program
from runtime.views import CrowdFrame

Floats = NDArray[np.floating[Any]]
_ViewKey = tuple[str, str | None]

# The nearest row is taken at levels whose error is so many times what the rounding in time may move a point.
ROUNDING_MARGIN = 4.0
# Four joints a vertex rather than eight where that moves nothing by more than this part of the level's own error.
DROPPED_SHARE = 0.25
_INSTANCE_ATTRIBUTES = (
    # name, components, type, normalised, byte offset
    ("in_world_row0", 4, gl_state.FLOAT, 0, 0),
    ("in_world_row1", 4, gl_state.FLOAT, 0, 16),
    ("in_world_row2", 4, gl_state.FLOAT, 0, 32),
    ("in_row", 1, gl_state.FLOAT, 0, 48),
    ("in_tint", 4, gl_state.UNSIGNED_BYTE, 1, 52),
)


class Crowd:
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

    Raises
    ------
    ValueError
        For a negative count or an unknown clip.
    RenderError
        When the context was released or is another than the model's.
    """

    def __init__(
        self, ctx: moderngl.Context, model: Model, count: int, *, clips: Sequence[str | int | Clip] | None = None
    ) -> None:
        require_alive(ctx, "crowd")
        model.require_usable()
        if ctx is not model.ctx:
            raise RenderError(f"the model {model.asset.name} belongs to another context than the crowd")
        if count < 0:
            raise ValueError(f"a crowd of {count} actors makes no sense")
        self.ctx = ctx
        self.model = model
        mixer = model.mixer
        chosen = mixer.clips if clips is None else [mixer.clips[mixer.clip_index(clip)] for clip in clips]
        boxes = joint_boxes_of(model)
        self.baked = bake_clips(mixer.skeleton, chosen, boxes, min(MAX_ROWS, int(ctx.info["GL_MAX_TEXTURE_SIZE"])))
        self.stage = Stage(self.baked, count)
        self.visible = True
        self.last_counts: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._released = False
        self._owned: list[Any] = []
        self._programs: dict[tuple[_ViewKey, bool, bool], moderngl.Program] = {}
        self._vertex_arrays: dict[tuple[_ViewKey, int], moderngl.VertexArray] = {}
        self._instances: moderngl.Buffer | None = None
        try:
            units = (*range(len(TEXTURE_UNITS)), ctx.default_texture_unit)
            with gl_state.saved_state(units, (), False):
                self._rows_texture = self._upload_rows()
                self._levels = self._upload_levels()
        except BaseException:
            self.release()
            raise
        self.errors_m = self._level_errors()
        self._nearest_row = np.array([level.nearest_row for level in self._levels])

    # The actors

    @property
    def count(self) -> int:
        """Number of actors."""
        return self.stage.count

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
        self.stage.place(transforms, which)

    def place_on_ground(self, positions: ArrayLike, headings: ArrayLike = 0.0, which: Any = None) -> None:
        """Put actors at (A, 3) positions, metres, turned by (A,) headings about +Y, radians."""
        self.stage.place_upright(positions, headings, which)

    def play(
        self,
        clip: str | int | ArrayLike,
        *,
        which: Any = None,
        phases_s: ArrayLike = 0.0,
        speeds: ArrayLike = 1.0,
        loop: bool = True,
    ) -> None:
        """Let actors play clips.

        Parameters
        ----------
        clip : a name, a number, or (A,) numbers into `clip_names`
        which : slice, mask or numbers of actors, optional
        phases_s : where in the clip each is now, seconds
        speeds : factors
        loop : over and over, or once and hold the end
        """
        stage, numbers = self.stage, self.stage.index(which)
        phases, factors = np.asarray(phases_s, dtype=np.float64), np.asarray(speeds, dtype=np.float64)
        if not (np.isfinite(phases).all() and np.isfinite(factors).all()):
            raise ValueError("phases and speeds must be finite numbers")
        stage.clips[numbers] = self._clip_numbers(clip)
        stage.speeds[numbers] = factors
        stage.phases_s[numbers] = phases - stage.clock_s * stage.speeds[numbers]
        stage.loops[numbers] = loop
        stage.place_spheres(numbers)

    def _clip_numbers(self, clip: str | int | ArrayLike) -> NDArray[np.int64]:
        """Numbers of clips from what a caller may give."""
        names = self.clip_names
        if isinstance(clip, str):
            if clip not in names:
                raise ValueError(f"no clip {clip!r}; the crowd has {', '.join(map(repr, names))}")
            return np.array(names.index(clip))
        numbers = np.asarray(clip, dtype=np.int64)
        if numbers.size and not (0 <= numbers.min() and numbers.max() < len(names)):
            raise ValueError(f"no clip {int(numbers.max())}; the crowd has {len(names)}, counted from 0")
        return numbers

    @property
    def clip_names(self) -> tuple[str, ...]:
        """Names of the clips the crowd can play; the last is the rest pose."""
        return self.baked.names

    def tint(self, colors: ArrayLike, which: Any = None) -> None:
        """Set factors of the base colour: (A, 3), (A, 4), (3,) or (4,) float, linear, 0 to 1."""
        numbers = self.stage.index(which)
        given = np.asarray(colors, dtype=np.float64)
        if given.shape[-1:] not in ((3,), (4,)) or not np.isfinite(given).all():
            raise ValueError("tints need three or four finite numbers each")
        bytes_ = np.rint(np.clip(given, 0, 1) * 255).astype(np.uint8)
        self.stage.tints[numbers, : given.shape[-1]] = bytes_

    def show(self, shown: ArrayLike, which: Any = None) -> None:
        """Show or hide actors: bool or (A,) bool."""
        self.stage.visible[self.stage.index(which)] = shown

    def update(self, dt_s: float) -> None:
        """Let time run on for everybody. Costs nothing: places in clips are computed for those in view only."""
        if not np.isfinite(dt_s):
            raise ValueError(f"a crowd cannot be updated by {dt_s} seconds; check the frame clock")
        self.stage.clock_s += dt_s

    # Buffers

    @property
    def textures(self) -> Mapping[str, moderngl.Texture]:
        """Textures by the name of their sampler."""
        return self.model.textures

    def _keep(self, thing: Any) -> Any:
        self._owned.append(thing)
        return thing

    def _upload_rows(self) -> moderngl.Texture:
        """The texture of baked poses: three texels a joint, one pose a row."""
        matrices = self.baked.matrices
        size = (3 * matrices.shape[1], matrices.shape[0])
        texture = self._keep(self.ctx.texture(size, 4, np.ascontiguousarray(matrices).tobytes(), dtype="f4"))
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        texture.repeat_x = texture.repeat_y = False
        return texture

    def _upload_levels(self) -> tuple[CrowdLevel, ...]:
        """Buffers of every level."""
        levels = []
        for lod, (positions, joints, weights) in zip(self.model.lods, expand_levels(self.ctx, self.model)):
            error_m = lod.mesh.error_m
            shifts = [dropped_shift(self.baked.matrices, positions, joints, weights, width) for width in (4, 8)]
            eight = shifts[0] > DROPPED_SHARE * error_m and shifts[0] > shifts[1]
            few_joints, few_weights = pick_joints(joints, weights, 8 if eight else 4)
            vertices = vertex_bytes(positions, lod.mesh.uvs, few_joints, few_weights)
            levels.append(
                CrowdLevel(
                    vertices=self._keep(self.ctx.buffer(vertices)),
                    indices=lod.indices,
                    index_size=lod.index_size,
                    groups=lod.groups,
                    eight_joints=eight,
                    nearest_row=error_m >= ROUNDING_MARGIN * self.baked.shift_m,
                    error_m=error_m + shifts[int(eight)],
                )
            )
        return tuple(levels)

    def _level_errors(self) -> NDArray[np.float64]:
        """Error of each level, metres: of its shape, and of the rounding in time."""
        errors = np.array([level.error_m for level in self._levels])
        rounded = np.array([level.nearest_row for level in self._levels])
        return errors + np.where(rounded, self.baked.shift_m, 0.0)

    def _write_instances(self, selection: Selection) -> None:
        size = max(selection.records.nbytes, 4 * INSTANCE_WORDS)
        if self._instances is None or self._instances.size < size:
            capacity = size if self._instances is None else max(size, 2 * self._instances.size)
            if self._instances is not None:
                self._instances.release()
            self._instances = self.ctx.buffer(reserve=capacity, dynamic=True)
            self._release_arrays()
        self._instances.orphan()
        self._instances.write(selection.records)

    # Drawing

    def draw_in(self, frame: CrowdFrame) -> None:
        """Draw everybody in view into a renderer's picture. Called by `Renderer.draw`."""
        if not self.visible or not self.count:
            return
        self._require_usable()
        if frame.level is not None and not 0 <= frame.level < len(self._levels):
            raise RenderError(f"the crowd has no level of detail {frame.level}: auto or 0 to {len(self._levels) - 1}")
        selection = self.stage.select(
            frame.camera, frame.height_px, self.errors_m, self._nearest_row, frame.threshold_px, frame.level
        )
        self.last_counts = selection.counts + selection.mirrored
        if not len(selection.records):
            return
        self._write_instances(selection)
        for name, texture in self.textures.items():
            texture.use(TEXTURE_UNITS[name])
        self._rows_texture.use(TEXTURE_UNITS["joint_texture"])
        for blended in (False, True) if frame.view.blends else (False,):
            frame.gl.switch(gl_state.BLEND, blended)
            frame.gl.glDepthMask(not blended)
            for level in range(len(self._levels)):
                first = int(selection.first[level])
                for mirrored, count in ((False, selection.counts[level]), (True, selection.mirrored[level])):
                    if count:
                        only = blended if frame.view.blends else None
                        self._draw_level(frame, level, first, int(count), mirrored, only)
                    first += int(count)

    def _draw_level(
        self, frame: CrowdFrame, number: int, first: int, count: int, mirrored: bool, blended: bool | None
    ) -> None:
        """Draw the actors of one level: `count` instances from `first` on."""
        from runtime.passes import set_material

        level = self._levels[number]
        groups = [one for one in level.groups if blended is None or (one.material.alpha_mode == "BLEND") == blended]
        if not groups:
            return
        program = self._program(frame, level)
        array = self._vertex_array(frame, program, number)
        self._point_instances(frame.gl, array, program, first)
        if "crowd_level" in program:
            program["crowd_level"].value = number  # type: ignore[union-attr]
        frame.gl.glFrontFace(gl_state.CW if mirrored else gl_state.CCW)
        for group in groups:
            frame.gl.switch(gl_state.CULL_FACE, not group.material.double_sided)
            set_material(program, group.material, frame.view.blends)
            array.render(moderngl.TRIANGLES, vertices=3 * group.count, first=3 * group.first, instances=count)

    def _program(self, frame: CrowdFrame, level: CrowdLevel) -> moderngl.Program:
        key = (view_key(frame), level.nearest_row, level.eight_joints)
        if key not in self._programs:
            defines: dict[str, str | int] = {**frame.defines, **frame.view.defines}
            if level.nearest_row:
                defines["NEAREST_FRAME"] = 1
            if level.eight_joints:
                defines["EIGHT_JOINTS"] = 1
            stages = ["crowd.vert", *([frame.view.fragment] if frame.view.fragment else [])]
            program = build_program(self.ctx, stages, defines, frame.view.text, frame.view.folder)
            for sampler, unit in TEXTURE_UNITS.items():
                if sampler in program:
                    program[sampler].value = unit  # type: ignore[union-attr]
            self._programs[key] = program
        program = self._programs[key]
        for name, value in {**self.model.constants, **frame.view.uniforms, **frame.uniforms}.items():
            if name in program:
                program[name].value = value  # type: ignore[union-attr]
        return program

    def _vertex_array(self, frame: CrowdFrame, program: moderngl.Program, number: int) -> moderngl.VertexArray:
        key = (view_key(frame), number)
        if key not in self._vertex_arrays:
            level = self._levels[number]
            assert self._instances is not None
            layout = [("3f4", "in_position"), ("2f4", "in_uv"), ("4u2", "in_joints")]
            layout += [("4u2", "in_more_joints")] if level.eight_joints else []
            layout += [("4f2", "in_weights")] + ([("4f2", "in_more_weights")] if level.eight_joints else [])
            formats = " ".join(form if name in program else _skipped(form) for form, name in layout)
            names = [name for _, name in layout if name in program]
            instance_formats = {"in_world_row0": "4f4", "in_world_row1": "4f4", "in_world_row2": "4f4"}
            instance_formats |= {"in_row": "1f4", "in_tint": "4f1"}
            shown = [(form if name in program else _skipped(form)) for name, form in instance_formats.items()]
            instance_names = [name for name in instance_formats if name in program]
            self._vertex_arrays[key] = self.ctx.vertex_array(
                program,
                [(level.vertices, formats, *names), (self._instances, " ".join(shown) + " /i", *instance_names)],
                level.indices,
                index_element_size=level.index_size,
            )
        return self._vertex_arrays[key]

    def _point_instances(
        self, gl: gl_state.Functions, array: moderngl.VertexArray, program: moderngl.Program, first: int
    ) -> None:
        """Let instance 0 of the next draw be record `first`: OpenGL 4.1 has no base instance."""
        assert self._instances is not None
        stride = 4 * INSTANCE_WORDS
        gl.glBindVertexArray(array.glo)
        gl.glBindBuffer(gl_state.ARRAY_BUFFER, self._instances.glo)
        for name, components, kind, normalised, offset in _INSTANCE_ATTRIBUTES:
            if name in program:
                location = program[name].location  # type: ignore[union-attr]
                place = ctypes.c_void_p(first * stride + offset)
                gl.glVertexAttribPointer(location, components, kind, normalised, stride, place)

    # The end

    def _require_usable(self) -> None:
        if self._released:
            raise RenderError("the crowd was released: make a new one")
        self.model.require_usable()

    def _release_arrays(self) -> None:
        for array in self._vertex_arrays.values():
            array.release()
        self._vertex_arrays.clear()

    def release(self) -> None:
        """Free what the crowd made. May be called more than once; the model stays."""
        if self._released:
            return
        self._released = True
        if type(self.ctx.mglo).__name__ == "InvalidObject":
            return
        self._release_arrays()
        for thing in (*self._programs.values(), *self._owned, self._instances):
            if thing is not None:
                thing.release()
        self._programs.clear()
        self._owned.clear()


def view_key(frame: CrowdFrame) -> _ViewKey:
    """What tells views apart: a caller may give another shader to a name of its own."""
    return frame.view_name, frame.view.text


def _skipped(form: str) -> str:
    """The buffer format that skips what `form` describes (an attribute that a program does not use)."""
    components, kind = int(form[0]), form[1:]
    return f"{components * int(kind[-1])}x"
