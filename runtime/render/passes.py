"""The GL calls of one picture: which state, which program, and what of each level in which order.

Solid parts come first, then blended ones, then lines over both. State is saved around it by the caller.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from runtime.gpu import gl_state
from runtime.gpu.frame_uniforms import MAX_FACTOR
from runtime.gpu.gl_state import Functions
from runtime.gpu.model import Model
from runtime.gpu.patches import PATCH_VERTICES
from runtime.gpu.programs import build_program, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.render.draw_batches import Group
from runtime.render.views import LINE_COLORS, LINES, View

if TYPE_CHECKING:
    from runtime.asset.asset import MaterialData

# Mesa's software rasteriser numbers the vertices that one call tessellates with 16 bits, and drops what is beyond.
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe")
SOFTWARE_VERTICES_A_CALL = 60_000
PATCH_STAGES = ("patch.vert", "patch.tesc", "patch.tese")


@dataclass(frozen=True)
class Look:
    """How a picture looks: the same for all that is drawn in it.

    Attributes
    ----------
    name, view : the view, and its name
    uniforms : mapping
        Of a caller's own fragment shader.
    factor : float
        Divides every tessellated edge, 0 for as its length on the screen asks.
    texels_a_segment : float
        Shortest piece of an edge then, texels of the position texture.
    """

    name: str
    view: View
    uniforms: Mapping[str, Any]
    factor: float = 0.0
    texels_a_segment: float = 1.0


class Passes:
    """Programs of one renderer, and how they are used.

    Parameters
    ----------
    ctx : moderngl.Context
    defines : mapping
        Preprocessor definitions of all programs.
    """

    def __init__(self, ctx: moderngl.Context, defines: Mapping[str, str | int]) -> None:
        self.ctx = ctx
        self._defines = defines
        self._programs: dict[tuple[str | bool, ...], moderngl.Program] = {}
        self._models: weakref.WeakSet[Model] = weakref.WeakSet()
        self._is_software = any(name in ctx.info["GL_RENDERER"] for name in SOFTWARE_RENDERERS)

    # Programs

    def forget(self, name: str) -> None:
        """Free the programs of a view."""
        for key in [key for key in self._programs if key[0] == name]:
            self._forget_vertex_arrays()
            self._programs.pop(key).release()

    def _forget_vertex_arrays(self) -> None:
        for model in self._models:
            model.levels.forget_programs(id(self))

    def adopt(self, program: moderngl.Program, name: str, tessellated: bool, model: Model) -> None:
        """Draw a view of a model with a program that was made elsewhere; it is released with the others."""
        for level, lod in enumerate(model.lods):
            for part in lod.groups:
                self._programs[_program_key(name, tessellated, model, level, part.material)] = program

    def _program(
        self, look: Look, tessellated: bool, model: Model, level: int, material: MaterialData
    ) -> moderngl.Program:
        key = _program_key(look.name, tessellated, model, level, material)
        program = self._programs.get(key)
        if program is None:
            view = look.view
            stages = [*(PATCH_STAGES if tessellated else ("static.vert",))]
            if view.fragment:
                stages.append(view.fragment)
            defines = {
                **self._defines,
                **view.defines,
                **model.shader_defines,
                **model.lods[level].shader_defines,
                **dict.fromkeys(what_it_lacks(model, material), 1),
            }
            program = build_program(self.ctx, stages, defines, view.text, view.folder)
            set_uniforms(program, TEXTURE_UNITS)
            set_uniforms(program, view.uniforms)
            self._programs[key] = program
        return program

    def _prepare(
        self, look: Look, tessellated: bool, model: Model, level: int, material: MaterialData
    ) -> moderngl.Program:
        """The program for a material of a level, with all its uniforms."""
        program = self._program(look, tessellated, model, level, material)
        wanted = model.number, material, look.view.blends
        if program.extra.prepared_for != wanted:
            set_uniforms(program, model.constants)
            set_material(program, material, look.view.blends)
            program.extra.prepared_for = wanted
        if look.uniforms:
            set_uniforms(program, look.uniforms)
            program.extra.prepared_for = None  # they may be anything
        return program

    # Drawing

    def draw(self, gl: Functions, groups: Sequence[Group], look: Look) -> None:
        """Draw groups of actors into the bound framebuffer. Poses and the frame are bound already."""
        _set_state(gl, look.view)
        for group in groups:
            self._models.add(group.model)
            group.model.levels.instance_buffer(group.key, group.records)
        for blended in face_runs(gl, look.view):
            for group in groups:
                self._draw_faces(gl, group, look, blended)
        if look.view.lines:
            start_lines(gl)
            for group in groups:
                self._draw_lines(gl, group, look)

    def _draw_faces(self, gl: Functions, group: Group, look: Look, blended: bool | None) -> None:
        """Draw the ranges of a level: all of them, or those that are blended, or those that are not."""
        model, view = group.model, look.view
        lod = model.lods[group.level]
        ranges = [part for part in lod.groups if blended is None or (part.material.alpha_mode == "BLEND") == blended]
        if not ranges:
            return
        model.bind_textures()
        kind = "patches" if group.tessellated else "triangles"
        per_face = PATCH_VERTICES if group.tessellated else 3
        if group.tessellated:
            self.ctx.patch_vertices = PATCH_VERTICES
        mode = moderngl.PATCHES if group.tessellated else moderngl.TRIANGLES
        at_most = self._patches_a_call(group, look) if group.tessellated and self._is_software else None
        gl.glFrontFace(gl_state.CW if group.mirrored else gl_state.CCW)
        for part in ranges:
            gl.switch(gl_state.CULL_FACE, not (part.material.double_sided or view.two_sided))
            program = self._prepare(look, group.tessellated, model, group.level, part.material)
            array = model.levels.vertex_array((id(self), program.glo), group.key, program, group.level, kind)
            for first in range(0, part.count, at_most or part.count):
                faces = min(at_most or part.count, part.count - first)
                start = (part.first + first) * per_face
                array.render(mode, vertices=faces * per_face, first=start, instances=len(group.records))

    def _patches_a_call(self, group: Group, look: Look) -> int:
        """How many patches a software rasteriser takes in one call, whatever their factors turn out to be."""
        longest = group.model.levels.longest_edge_texels(group.level) / look.texels_a_segment
        segments = int(np.ceil(look.factor or min(MAX_FACTOR, longest))) + 1  # fractional spacing rounds up to odd
        vertices = 3 * (segments // 2 + 1) ** 2  # rings of 3 n, 3 (n - 2) ... vertices
        return max(1, SOFTWARE_VERTICES_A_CALL // vertices)

    def _draw_lines(self, gl: Functions, group: Group, look: Look) -> None:
        lines = look.view.lines
        over = Look("lines", LINES, {"flat_color": LINE_COLORS[lines]}, look.factor, look.texels_a_segment)
        if lines == "wireframe":
            gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.LINE)
            self._draw_faces(gl, group, over, None)
            gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
            return
        levels = group.model.levels
        if levels.seam_lines(group.level) is None:
            return
        group.model.bind_textures()
        material = group.model.lods[group.level].groups[0].material
        program = self._prepare(over, False, group.model, group.level, material)
        array = levels.vertex_array((id(self), program.glo), group.key, program, group.level, "seams")
        array.render(moderngl.LINES, instances=len(group.records))

    def release(self) -> None:
        """Free all programs, and the vertex arrays that models made for them."""
        self._forget_vertex_arrays()
        for program in self._programs.values():
            program.release()
        self._programs.clear()


def what_it_lacks(model: Model, material: MaterialData) -> tuple[str, ...]:
    """Preprocessor definitions that leave out of a program what a material does without (surface.glsl)."""
    return (
        *(("NO_CUTOUT",) if material.alpha_mode != "MASK" else ()),
        *(("NO_BLEND",) if material.alpha_mode != "BLEND" else ()),
        *(("NO_FACTOR",) if material.base_color_factor == (1.0, 1.0, 1.0, 1.0) else ()),
        *(("NO_ROUGHNESS_FACTOR",) if material.roughness_factor == 1.0 else ()),
        *(("NO_EMISSION",) if not any(material.emissive_factor) else ()),
        *(("NO_METAL",) if not material.metallic_factor else ()),
        *(("ONE_SIDED",) if not material.double_sided else ()),
        *(("UNLIT",) if material.unlit else ()),
        *model.channels.defines,
    )


def _program_key(
    name: str, tessellated: bool, model: Model, level: int, material: MaterialData
) -> tuple[str | bool, ...]:
    known = model.define_names
    names = known.get((level, id(material)))  # materials live as long as the model
    if names is None:
        names = (*model.shader_defines, *model.lods[level].shader_defines, *what_it_lacks(model, material))
        known[level, id(material)] = names
    return name, tessellated, *names


def _set_state(gl: Functions, view: View) -> None:
    """What does not change while a picture is drawn."""
    gl.switch(gl_state.DEPTH_TEST, True)
    gl.switch(gl_state.FRAMEBUFFER_SRGB, False)
    gl.switch(gl_state.SAMPLE_ALPHA_TO_COVERAGE, False)
    gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
    gl.glCullFace(gl_state.BACK)
    if view.blends:
        gl.glBlendEquationSeparate(gl_state.FUNC_ADD, gl_state.FUNC_ADD)
        gl.glBlendFuncSeparate(
            gl_state.SRC_ALPHA, gl_state.ONE_MINUS_SRC_ALPHA, gl_state.ONE, gl_state.ONE_MINUS_SRC_ALPHA
        )
    if view.lines:
        gl.switch(gl_state.POLYGON_OFFSET_LINE, False)
        gl.glPolygonOffset(1.0, 1.0)
    if not view.writes_color:
        gl.glColorMask(0, 0, 0, 0)


def face_runs(gl: Functions, view: View) -> Iterator[bool | None]:
    """Which faces to draw, with the state for them set: all (None), or first the unblended, then the blended ones."""
    gl.glDepthFunc(gl_state.LESS)
    gl.switch(gl_state.POLYGON_OFFSET_FILL, bool(view.lines))
    for blended in (False, True) if view.blends else (False,):
        gl.switch(gl_state.BLEND, blended)
        gl.glDepthMask(not blended)
        yield blended if view.blends else None


def start_lines(gl: Functions) -> None:
    """State for lines over the faces that were drawn."""
    gl.switch(gl_state.POLYGON_OFFSET_FILL, False)
    gl.glDepthFunc(gl_state.LEQUAL)


def set_material(program: moderngl.Program, material: MaterialData, blends: bool) -> None:
    """Uniforms of one material, those that the program has."""
    values: dict[str, Any] = {
        "base_color_factor": material.base_color_factor,
        "surface_factors": (
            material.occlusion_strength,
            material.roughness_factor,
            material.metallic_factor,
            material.alpha_cutoff if material.alpha_mode == "MASK" else -1.0,
        ),
        "emissive_factor": material.emissive_factor,
        "surface_blended": material.alpha_mode == "BLEND" and blends,
    }
    set_uniforms(program, values)
