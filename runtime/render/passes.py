"""The GL calls of one picture: which state, which program, and what of each level in which order.

Solid parts come first, then blended ones, then lines over both. State is saved around it by the caller.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from runtime.gpu import gl_state
from runtime.gpu.frame_uniforms import MAX_FACTOR
from runtime.gpu.gl_state import Functions
from runtime.gpu.lod_buffers import GpuLod, MaterialRange
from runtime.gpu.model import Model
from runtime.gpu.patches import PATCH_VERTICES
from runtime.gpu.programs import build_program, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS, is_software
from runtime.render.draw_batches import DrawBatch
from runtime.render.views import LINE_COLORS, LINES, VIEWS, View

if TYPE_CHECKING:
    from runtime.asset.asset import MaterialData

# Mesa's software rasteriser numbers the vertices that one call tessellates with 16 bits, and drops what is beyond.
SOFTWARE_VERTICES_PER_CALL = 60_000
PREPASS_ALPHA = 0.5  # texels of blended materials with at least so much hide what is behind them, if that is asked
PATCH_STAGES = ("patch.vert", "patch.tesc", "patch.tese")


@dataclass(frozen=True)
class DrawSettings:
    """How a picture looks: the same for all that is drawn in it.

    Attributes
    ----------
    name, view : the view, and its name
    uniforms : mapping
        Of a caller's own fragment shader.
    factor : float
        Divides every tessellated edge, 0 for as its length on the screen asks.
    texels_per_segment : float
        Shortest piece of an edge then, texels of the position texture.
    blend_prepass : bool
        Whether blended faces write the depth of what is nearly opaque in them first.
    """

    name: str
    view: View
    uniforms: Mapping[str, Any]
    factor: float = 0.0
    texels_per_segment: float = 1.0
    blend_prepass: bool = False


class Faces(Enum):
    """Which faces of a level a run draws."""

    ALL = auto()
    SOLID = auto()  # not blended
    DEPTH = auto()  # the depth of what is nearly opaque in blended ones
    BLENDED = auto()

    def of(self, ranges: Sequence[MaterialRange]) -> list[MaterialRange]:
        """Those of a level's ranges that are drawn."""
        if self is Faces.ALL:
            return list(ranges)
        chosen = [part for part in ranges if (part.material.alpha_mode == "BLEND") == (self is not Faces.SOLID)]
        return [_alpha_tested(part) for part in chosen] if self is Faces.DEPTH else chosen


@lru_cache(maxsize=64)
def _alpha_tested(part: MaterialRange) -> MaterialRange:
    """A blended range drawn with an alpha test instead."""
    material = replace(part.material, alpha_mode="MASK", alpha_cutoff=PREPASS_ALPHA)
    return replace(part, material=material, defines=tuple(one for one in part.defines if one != "NO_ALPHA_TEST"))


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
        self._programs: dict[tuple[Any, ...], moderngl.Program] = {}
        self._models: weakref.WeakSet[Model] = weakref.WeakSet()
        self._is_software = is_software(ctx)

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
        for lod in model.lods:
            for part in lod.ranges:
                self._programs[name, tessellated, lod.program_defines, part.defines] = program

    def _program(self, settings: DrawSettings, tessellated: bool, lod: GpuLod, part: MaterialRange) -> moderngl.Program:
        key = (settings.name, tessellated, lod.program_defines, part.defines)
        program = self._programs.get(key)
        if program is None:
            view = settings.view
            stages = [*(PATCH_STAGES if tessellated else ("static.vert",))]
            if view.fragment:
                stages.append(view.fragment)
            defines = {**self._defines, **view.defines, **dict(lod.program_defines), **dict.fromkeys(part.defines, 1)}
            program = build_program(self.ctx, stages, defines, view.text, view.folder)
            set_uniforms(program, TEXTURE_UNITS)
            set_uniforms(program, view.uniforms)
            self._programs[key] = program
        return program

    def _prepare(
        self, settings: DrawSettings, tessellated: bool, model: Model, lod: GpuLod, part: MaterialRange
    ) -> moderngl.Program:
        """The program for a material of a level, with all its uniforms."""
        program = self._program(settings, tessellated, lod, part)
        prepared = program.extra.prepared_for
        wanted = part.material, settings.view.blends
        if prepared is None or prepared[0] is not model.constants or prepared[1] != wanted:
            set_uniforms(program, model.constants)
            set_material(program, *wanted)
            program.extra.prepared_for = model.constants, wanted
        if settings.uniforms:
            set_uniforms(program, settings.uniforms)
            program.extra.prepared_for = None  # they may be anything
        return program

    # Drawing

    def draw(self, gl: Functions, batches: Sequence[DrawBatch], settings: DrawSettings) -> None:
        """Draw batches of actors into the bound framebuffer. Poses and the frame are bound already."""
        _set_state(gl, settings.view)
        for batch in batches:
            self._models.add(batch.model)
            batch.model.levels.instance_buffer(batch.key, batch.instances)
        for faces in face_runs(gl, settings.view, settings.blend_prepass):
            how = (
                replace(settings, name="depth", view=VIEWS["depth"], uniforms={}) if faces is Faces.DEPTH else settings
            )
            for batch in _far_first(batches) if faces is Faces.BLENDED else batches:
                self._draw_faces(gl, batch, how, faces)
        if settings.view.lines:
            start_lines(gl)
            for batch in batches:
                self._draw_lines(gl, batch, settings)

    def _draw_faces(self, gl: Functions, batch: DrawBatch, settings: DrawSettings, faces: Faces) -> None:
        """Draw those ranges of a level that are meant."""
        model, view = batch.model, settings.view
        lod = model.lods[batch.level]
        ranges = faces.of(lod.ranges)
        if not ranges:
            return
        model.bind_textures()
        kind = "patches" if batch.tessellated else "triangles"
        per_face = PATCH_VERTICES if batch.tessellated else 3
        if batch.tessellated:
            self.ctx.patch_vertices = PATCH_VERTICES
        mode = moderngl.PATCHES if batch.tessellated else moderngl.TRIANGLES
        at_most = self._patches_per_call(batch, settings) if batch.tessellated and self._is_software else None
        gl.glFrontFace(gl_state.CW if batch.mirrored else gl_state.CCW)
        for part in ranges:
            gl.switch(gl_state.CULL_FACE, not (part.material.double_sided or view.two_sided))
            program = self._prepare(settings, batch.tessellated, model, lod, part)
            array = model.levels.vertex_array((id(self), program.glo), batch.key, program, batch.level, kind)
            for first in range(0, part.count, at_most or part.count):
                count = min(at_most or part.count, part.count - first)
                start = (part.first + first) * per_face
                array.render(mode, vertices=count * per_face, first=start, instances=len(batch.instances))

    def _patches_per_call(self, batch: DrawBatch, settings: DrawSettings) -> int:
        """How many patches a software rasteriser takes in one call, whatever their factors turn out to be."""
        longest = batch.model.levels.longest_edge_texels(batch.level) / settings.texels_per_segment
        segments = int(np.ceil(settings.factor or min(MAX_FACTOR, longest))) + 1  # fractional spacing rounds up to odd
        vertices = 3 * (segments // 2 + 1) ** 2  # rings of 3 n, 3 (n - 2) ... vertices
        return max(1, SOFTWARE_VERTICES_PER_CALL // vertices)

    def _draw_lines(self, gl: Functions, batch: DrawBatch, settings: DrawSettings) -> None:
        lines = settings.view.lines
        over = replace(settings, name="lines", view=LINES, uniforms={"flat_color": LINE_COLORS[lines]})
        if lines == "wireframe":
            gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.LINE)
            self._draw_faces(gl, batch, over, Faces.ALL)
            gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
            return
        levels = batch.model.levels
        if levels.seam_lines(batch.level) is None:
            return
        batch.model.bind_textures()
        lod = batch.model.lods[batch.level]
        program = self._prepare(over, False, batch.model, lod, lod.ranges[0])
        array = levels.vertex_array((id(self), program.glo), batch.key, program, batch.level, "seams")
        array.render(moderngl.LINES, instances=len(batch.instances))

    def release(self) -> None:
        """Free all programs, and the vertex arrays that models made for them."""
        self._forget_vertex_arrays()
        for program in self._programs.values():
            program.release()
        self._programs.clear()


def _set_state(gl: Functions, view: View) -> None:
    """What does not change while a picture is drawn."""
    gl.switch(gl_state.DEPTH_TEST, True)
    gl.switch(gl_state.FRAMEBUFFER_SRGB, False)
    gl.switch(gl_state.PRIMITIVE_RESTART, False)
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


def face_runs(gl: Functions, view: View, blend_prepass: bool) -> Iterator[Faces]:
    """Which faces to draw, one after another, with the state for them set."""
    gl.glDepthFunc(gl_state.LESS)
    gl.switch(gl_state.POLYGON_OFFSET_FILL, bool(view.lines))
    gl.switch(gl_state.BLEND, False)
    gl.glDepthMask(1)
    if not view.blends:
        yield Faces.ALL
        return
    yield Faces.SOLID
    if blend_prepass:
        mask = gl.integers(gl_state.COLOR_WRITEMASK, 4)
        gl.glColorMask(0, 0, 0, 0)
        yield Faces.DEPTH
        gl.glColorMask(*mask)
        gl.glDepthFunc(gl_state.LEQUAL)
    gl.switch(gl_state.BLEND, True)
    gl.glDepthMask(0)
    yield Faces.BLENDED


def _far_first(batches: Sequence[DrawBatch]) -> list[DrawBatch]:
    """Batches by the distance of their actors from the eye, the farthest first."""
    return sorted(batches, key=lambda batch: -float(np.square(batch.instances["rows"][:, :, 3]).sum(axis=1).mean()))


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
