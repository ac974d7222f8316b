"""The GL calls of a crowd in one picture: one instanced draw a level and material.

Solid parts come first, then blended ones, then lines over both, as for single actors (runtime/render/passes.py).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.crowd.lod_buffers import CrowdLevel
from runtime.crowd.state import INSTANCE_WORDS, Selection
from runtime.gpu import gl_state
from runtime.gpu.lod_buffers import NORMAL_ATTRIBUTES
from runtime.gpu.model import Model
from runtime.gpu.programs import build_program, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.render.passes import face_runs, set_material, start_lines, what_it_lacks
from runtime.render.views import LINE_COLORS, LINES, CrowdFrame

if TYPE_CHECKING:
    from runtime.asset.asset import MaterialData

PLACE_UNIT = TEXTURE_UNITS["position_texture"]  # crowds do not read that one
_INSTANCE_ATTRIBUTES = (
    # name, components, type, normalised, byte offset, moderngl's format
    ("in_world_row0", 4, gl_state.FLOAT, 0, 0, "4f4"),
    ("in_world_row1", 4, gl_state.FLOAT, 0, 16, "4f4"),
    ("in_world_row2", 4, gl_state.FLOAT, 0, 32, "4f4"),
    ("in_row", 1, gl_state.FLOAT, 0, 48, "1f4"),
    ("in_tint", 4, gl_state.UNSIGNED_BYTE, 1, 52, "4f1"),
)


@dataclass(frozen=True)
class _Part:
    """Actors that are drawn with one call: of one level, mirrored or not, `count` instance records from `first` on."""

    level: int
    first: int
    count: int
    mirrored: bool


def _parts(selection: Selection) -> list[_Part]:
    """What to draw, the finest level first."""
    parts = []
    for level, start in enumerate(selection.first.tolist()):
        counts = int(selection.counts[level]), int(selection.mirrored[level])
        parts += [_Part(level, start, counts[0], False), _Part(level, start + counts[0], counts[1], True)]
    return [part for part in parts if part.count]


class CrowdPasses:
    """Programs, vertex arrays and the instance buffer of one crowd.

    Parameters
    ----------
    model : Model
    levels : sequence of CrowdLevel
    seam_lines : function from a level to the index buffer of its seams, None where it has none
    """

    def __init__(
        self,
        model: Model,
        levels: Sequence[CrowdLevel],
        seam_lines: Callable[[int], moderngl.Buffer | None],
    ) -> None:
        self.ctx, self._model, self.levels = model.ctx, model, levels
        self._seam_lines = seam_lines
        self._programs: dict[tuple[Any, ...], moderngl.Program] = {}
        self._vertex_arrays: dict[tuple[Any, ...], moderngl.VertexArray] = {}
        self._instances: moderngl.Buffer | None = None

    # Buffers

    def write(self, records: NDArray[np.float32]) -> None:
        """Fill the instance buffer."""
        size = max(records.nbytes, 4 * INSTANCE_WORDS)
        if self._instances is None or self._instances.size < size:
            capacity = size if self._instances is None else max(size, 2 * self._instances.size)
            if self._instances is not None:
                self._instances.release()
            self._instances = self.ctx.buffer(reserve=capacity, dynamic=True)
            self._release_arrays()
        self._instances.orphan()
        self._instances.write(records)

    @property
    def instance_bytes(self) -> int:
        """Size of the instance buffer."""
        return 0 if self._instances is None else int(self._instances.size)

    # Drawing

    def draw(self, frame: CrowdFrame, selection: Selection, constants: Mapping[str, Any]) -> None:
        """Draw what was selected and written. Textures are bound already.

        Parameters
        ----------
        frame : CrowdFrame
        selection : Selection
        constants : mapping
            Uniforms that the model gives all its programs.
        """
        parts, view = _parts(selection), frame.view
        for blended in face_runs(frame.gl, view):
            for part in parts:
                self._draw_faces(frame, part, constants, blended)
        if view.lines:
            start_lines(frame.gl)
            colors = {"flat_color": LINE_COLORS[view.lines]}
            over = replace(frame, view_name="lines", view=LINES, uniforms=colors)
            for part in parts:
                self._draw_lines(over, part, constants, view.lines)

    def _draw_faces(self, frame: CrowdFrame, part: _Part, constants: Mapping[str, Any], blended: bool | None) -> None:
        """Draw the ranges of a level: all of them, or those that are blended, or those that are not."""
        level = self.levels[part.level]
        ranges = [one for one in level.groups if blended is None or (one.material.alpha_mode == "BLEND") == blended]
        for one in ranges:
            array = self._prepare(frame, part, constants, "triangles", one.material)
            frame.gl.switch(gl_state.CULL_FACE, not (one.material.double_sided or frame.view.two_sided))
            array.render(moderngl.TRIANGLES, vertices=3 * one.count, first=3 * one.first, instances=part.count)

    def _draw_lines(self, frame: CrowdFrame, part: _Part, constants: Mapping[str, Any], lines: str) -> None:
        if lines == "wireframe":
            frame.gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.LINE)
            self._draw_faces(frame, part, constants, None)
            frame.gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
        elif self._seam_lines(part.level) is not None:
            material = self.levels[part.level].groups[0].material
            array = self._prepare(frame, part, constants, "seams", material)
            array.render(moderngl.LINES, instances=part.count)

    def _prepare(
        self, frame: CrowdFrame, part: _Part, constants: Mapping[str, Any], kind: str, material: MaterialData
    ) -> moderngl.VertexArray:
        """The vertex array of a part, its program set for a material."""
        level = self.levels[part.level]
        defines = self._defines(frame, level, material)
        program = self._program(frame, defines)
        placing = {"crowd_level": part.level, "place_scale": level.place_scale, "place_offset": level.place_offset}
        for values in (constants, frame.view.uniforms, frame.uniforms, placing):
            set_uniforms(program, values)
        set_material(program, material, frame.view.blends)
        if level.places is not None:
            level.places.use(PLACE_UNIT)
        array = self._vertex_array(frame, defines, program, part.level, kind)
        self._point_instances(frame.gl, array, program, part.first)
        frame.gl.glFrontFace(gl_state.CW if part.mirrored else gl_state.CCW)
        return array

    def _defines(self, frame: CrowdFrame, level: CrowdLevel, material: MaterialData) -> tuple[str, ...]:
        """Preprocessor definitions that a level and a material ask for."""
        return (
            *(("PLACED",) if level.places is not None else ()),
            *(("EIGHT_JOINTS",) if level.eight_joints else ()),
            *(("NORMAL_UV",) if level.normal_uvs is not None else ()),
            *(("COLOR_AT_NORMAL_UV",) if self._model.asset.colors_moved else ()),
            *what_it_lacks(self._model, material),
        )

    def _program(self, frame: CrowdFrame, own: tuple[str, ...]) -> moderngl.Program:
        key = (*_view_key(frame), own)
        if key not in self._programs:
            defines: dict[str, str | int] = {**frame.defines, **frame.view.defines, **dict.fromkeys(own, 1)}
            stages = ["crowd.vert", *([frame.view.fragment] if frame.view.fragment else [])]
            program = build_program(self.ctx, stages, defines, frame.view.text, frame.view.folder)
            set_uniforms(program, {**TEXTURE_UNITS, "place_texture": PLACE_UNIT})
            self._programs[key] = program
        return self._programs[key]

    def _vertex_array(
        self, frame: CrowdFrame, own: tuple[str, ...], program: moderngl.Program, number: int, kind: str
    ) -> moderngl.VertexArray:
        key = (*_view_key(frame), own, number, kind)
        if key not in self._vertex_arrays:
            level = self.levels[number]
            assert self._instances is not None
            layout = [("3f4", "in_position"), ("2f4", "in_uv"), ("4u2", "in_joints")]
            layout += [("4u2", "in_more_joints")] if level.eight_joints else []
            layout += [("4f2", "in_weights")] + ([("4f2", "in_more_weights")] if level.eight_joints else [])
            layout += [("1u2", "in_place"), ("1u2", "")]
            instance_layout = [(form, name) for name, *_, form in _INSTANCE_ATTRIBUTES]
            content = []
            buffers = [(level.vertices, layout, ""), (self._instances, instance_layout, " /i")]
            if level.normal_uvs is not None and "in_normal_uv" in program:
                buffers.append((level.normal_uvs, list(NORMAL_ATTRIBUTES), ""))
            for buffer, attributes, ending in buffers:
                formats = " ".join(form if name in program else _skipped(form) for form, name in attributes)
                content.append((buffer, formats + ending, *(name for _, name in attributes if name in program)))
            indices = level.indices if kind == "triangles" else self._seam_lines(number)
            self._vertex_arrays[key] = self.ctx.vertex_array(
                program, content, indices, index_element_size=level.index_size
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
        for name, components, kind, normalised, offset, _ in _INSTANCE_ATTRIBUTES:
            if name in program:
                location = program[name].location  # type: ignore[union-attr]
                place = ctypes.c_void_p(first * stride + offset)
                gl.glVertexAttribPointer(location, components, kind, normalised, stride, place)

    # The end

    def _release_arrays(self) -> None:
        for array in self._vertex_arrays.values():
            array.release()
        self._vertex_arrays.clear()

    def release(self) -> None:
        """Free programs, vertex arrays and the instance buffer; levels are not released."""
        self._release_arrays()
        for thing in (*self._programs.values(), self._instances):
            if thing is not None:
                thing.release()
        self._programs.clear()


def _view_key(frame: CrowdFrame) -> tuple[str, str | None]:
    """What tells views apart: a caller may give another shader to a name of its own."""
    return frame.view_name, frame.view.text


def _skipped(form: str) -> str:
    """The buffer format that skips what `form` describes (an attribute that a program does not use)."""
    components, kind = int(form[0]), form[1:]
    return f"{components * int(kind[-1])}x"
