"""The GL calls of a crowd in one picture: one instanced draw a level and material.

Solid parts come first, then blended ones, then lines over both, as for single actors (runtime/render/passes.py).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import moderngl
from numpy.typing import NDArray

from runtime.crowd.lod_buffers import CrowdLevel
from runtime.crowd.morphs import UNITS, CrowdMorphs
from runtime.crowd.state import Selection
from runtime.gpu import gl_state
from runtime.gpu.lod_buffers import MaterialRange
from runtime.gpu.model import Model
from runtime.gpu.programs import build_program, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.gpu.vertex_layout import (
    CROWD_ATTRIBUTES,
    CROWD_INSTANCE,
    MORPH_LISTS,
    NORMAL_UVS,
    attribute_offsets,
    bind_buffer,
)
from runtime.render.passes import Faces, face_runs, set_material, start_lines
from runtime.render.views import LINE_COLORS, LINES, VIEWS, Frame

VERTEX_ANIMATION_UNIT = TEXTURE_UNITS["position_texture"]  # crowds do not read that one


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
    seam_lines : function from a level to the index buffer of its seams, None where it has none
    """

    def __init__(self, model: Model, seam_lines: Callable[[int], moderngl.Buffer | None]) -> None:
        self.ctx, self._model = model.ctx, model
        self.levels: Sequence[CrowdLevel] = ()
        self.morphs: CrowdMorphs | None = None
        self._seam_lines = seam_lines
        self._programs: dict[tuple[Any, ...], moderngl.Program] = {}
        self._vertex_arrays: dict[tuple[Any, ...], moderngl.VertexArray] = {}
        self._instances: moderngl.Buffer | None = None

    # Buffers

    def write(self, records: NDArray[Any]) -> None:
        """Fill the instance buffer."""
        size = max(records.nbytes, CROWD_INSTANCE.itemsize)
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

    def draw(self, frame: Frame, selection: Selection, constants: Mapping[str, Any]) -> None:
        """Draw what was selected and written. Textures are bound already.

        Parameters
        ----------
        frame : Frame
        selection : Selection
        constants : mapping
            Uniforms that the model gives all its programs.
        """
        parts, view = _parts(selection), frame.view
        for faces in face_runs(frame.gl, view, frame.blend_prepass):
            how = replace(frame, view_name="depth", view=VIEWS["depth"], uniforms={}) if faces is Faces.DEPTH else frame
            for part in parts[::-1] if faces is Faces.BLENDED else parts:  # coarse levels are far away
                self._draw_faces(how, part, constants, faces)
        if view.lines:
            start_lines(frame.gl)
            colors = {"flat_color": LINE_COLORS[view.lines]}
            over = replace(frame, view_name="lines", view=LINES, uniforms=colors)
            for part in parts:
                self._draw_lines(over, part, constants, view.lines)

    def _draw_faces(self, frame: Frame, part: _Part, constants: Mapping[str, Any], faces: Faces) -> None:
        """Draw those ranges of a level that are meant."""
        level = self.levels[part.level]
        for one in faces.of(level.ranges):
            array = self._prepare(frame, part, constants, "triangles", one)
            frame.gl.switch(gl_state.CULL_FACE, not (one.material.double_sided or frame.view.two_sided))
            array.render(moderngl.TRIANGLES, vertices=3 * one.count, first=3 * one.first, instances=part.count)

    def _draw_lines(self, frame: Frame, part: _Part, constants: Mapping[str, Any], lines: str) -> None:
        if lines == "wireframe":
            frame.gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.LINE)
            self._draw_faces(frame, part, constants, Faces.ALL)
            frame.gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
        elif self._seam_lines(part.level) is not None:
            array = self._prepare(frame, part, constants, "seams", self.levels[part.level].ranges[0])
            array.render(moderngl.LINES, instances=part.count)

    def _prepare(
        self, frame: Frame, part: _Part, constants: Mapping[str, Any], kind: str, faces: MaterialRange
    ) -> moderngl.VertexArray:
        """The vertex array of a part, its program set for a material."""
        level = self.levels[part.level]
        key = (frame.view_name, frame.view.text, part.level, faces.defines)
        program = self._programs.get(key) or self._build(key, frame, level, faces)
        for values in (constants, level.uniforms, frame.view.uniforms, frame.uniforms, {"crowd_level": part.level}):
            set_uniforms(program, values)
        if self.morphs is not None:
            set_uniforms(program, self.morphs.uniforms)
        set_material(program, faces.material, frame.view.blends)
        if level.animation is not None:
            level.animation.use(VERTEX_ANIMATION_UNIT)
        if (*key, kind) not in self._vertex_arrays:
            self._vertex_arrays[(*key, kind)] = self._vertex_array(program, part.level, kind)
        array = self._vertex_arrays[(*key, kind)]
        self._point_instances(frame.gl, array, program, part.first)
        frame.gl.glFrontFace(gl_state.CW if part.mirrored else gl_state.CCW)
        return array

    def _build(self, key: tuple[Any, ...], frame: Frame, level: CrowdLevel, faces: MaterialRange) -> moderngl.Program:
        """The program for a material of a level in a view; a caller may give another shader to a name of its own."""
        defines: dict[str, str | int] = {**frame.defines, **frame.view.defines, **level.defines}
        defines |= dict.fromkeys(faces.defines, 1)
        if self._model.asset.colors_moved:
            defines["COLOR_AT_NORMAL_UV"] = 1
        if self.morphs is not None:
            defines["MORPHS"] = 1
        stages = ["crowd.vert", *([frame.view.fragment] if frame.view.fragment else [])]
        program = build_program(self.ctx, stages, defines, frame.view.text, frame.view.folder)
        set_uniforms(program, {**TEXTURE_UNITS, **UNITS, "vertex_animation_texture": VERTEX_ANIMATION_UNIT})
        self._programs[key] = program
        return program

    def _vertex_array(self, program: moderngl.Program, number: int, kind: str) -> moderngl.VertexArray:
        level = self.levels[number]
        assert self._instances is not None
        content = [
            bind_buffer(program, level.vertices, level.attributes),
            bind_buffer(program, self._instances, CROWD_ATTRIBUTES, per_instance=True),
            None if level.normal_uvs is None else bind_buffer(program, level.normal_uvs, NORMAL_UVS),
            None if self.morphs is None else bind_buffer(program, self.morphs.lists[number], MORPH_LISTS),
        ]
        indices = level.indices if kind == "triangles" else self._seam_lines(number)
        used = [entry for entry in content if entry is not None]
        return self.ctx.vertex_array(program, used, indices, index_element_size=level.index_size)

    def _point_instances(
        self, gl: gl_state.Functions, array: moderngl.VertexArray, program: moderngl.Program, first: int
    ) -> None:
        """Let instance 0 of the next draw be record `first`: OpenGL 4.1 has no base instance."""
        assert self._instances is not None
        stride = CROWD_INSTANCE.itemsize
        gl.glBindVertexArray(array.glo)
        gl.glBindBuffer(gl_state.ARRAY_BUFFER, self._instances.glo)
        for one, offset in attribute_offsets(CROWD_ATTRIBUTES):
            if one.name in program:
                location = program[one.name].location  # type: ignore[union-attr]
                place = ctypes.c_void_p(first * stride + offset)
                gl.glVertexAttribPointer(location, one.components, *one.gl_type, stride, place)

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
