"""Draws actors into the framebuffer that is bound, and leaves the GL state as it found it.

Used meanwhile, and put back after: texture units 0 to 9 (`runtime.gpu_asset.TEXTURE_UNITS`), uniform buffer binding
points 0 and 1, the program, vertex array and buffers that are bound, culling, depth, blending and polygon state.
The framebuffer, its viewport, scissor, stencil and colour masks are the caller's and only respected.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime import gl_state
from runtime.actor import ActorBatch, gather
from runtime.camera import Camera, CameraMatrices, MatrixCamera
from runtime.dual_quaternions import joint_texels
from runtime.environment import Lighting
from runtime.errors import RenderError
from runtime.gl_state import Functions, saved_state
from runtime.gpu_asset import INSTANCE, NUM_TEXTURE_UNITS, TEXTURE_UNITS, Model, require_alive
from runtime.lod import choose_levels, pixels_per_metre, transform_boxes, visible
from runtime.patches import PATCH_VERTICES
from runtime.programs import TESSELLATION_VERSION_CODE, build_program, require_version, set_uniforms
from runtime.views import LINE_COLORS, LINES, VIEWS, CrowdFrame, DrawsItself, View

if TYPE_CHECKING:
    from runtime.actor import Actor
    from runtime.asset import MaterialData
    from runtime.crowd import Crowd

FRAME_BINDING = 0
FRAME_FLOATS = 4 * 18
MAX_FACTOR = 64.0  # every OpenGL with tessellation has it
# Mesa's software rasteriser numbers the vertices that one call tessellates with 16 bits, and drops what is beyond.
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe")
SOFTWARE_VERTICES_A_CALL = 60_000
SKINNING: dict[str, dict[str, str | int]] = {"linear": {}, "dual_quaternion": {"DUAL_QUATERNIONS": 1}}
_PATCH_STAGES = ("patch.vert", "patch.tesc", "patch.tese")


@dataclass(frozen=True)
class Quality:
    """How good the picture is to be.

    Attributes
    ----------
    threshold_px : float
        Largest error on the screen that the chosen level of detail may have, pixels.
    segment_px : float
        Adaptive tessellation divides edges into pieces of about this length, pixels.
    texels_a_segment : float
        But not into pieces shorter than this many texels of the position texture, which have nothing to add.
    """

    threshold_px: float = 1.0
    segment_px: float = 6.0
    texels_a_segment: float = 1.0


@dataclass(frozen=True)
class DrawnActor:
    """What was done with one actor in the last picture: its level of detail (-1: not in view), tessellated or not."""

    level: int
    tessellated: bool


@dataclass(frozen=True)
class _Group:
    """Actors of one model that are drawn with one call: the same level, tessellated or not, mirrored or not."""

    model: Model
    level: int
    tessellated: bool
    mirrored: bool

    @property
    def key(self) -> tuple[int, bool, bool]:
        return self.level, self.tessellated, self.mirrored


class Renderer:
    """Draws actors of any models of one context.

    Parameters
    ----------
    ctx : moderngl.Context
        The caller's.
    lighting : Lighting, optional
    quality : Quality, optional
    skinning : "linear" or "dual_quaternion"
        How joints are blended. Dual quaternions keep volume in twists; crowds are always blended linearly.
    shader_defines : mapping, optional
        Preprocessor definitions for all programs: `EQUAL_SPACING` tessellates with equal instead of fractional
        spacing, `WITHOUT_OWNERS` fetches geometry at each copy's own uv (to see what owners are for).

    Raises
    ------
    RenderError
        If the context is too old or was released.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        *,
        lighting: Lighting | None = None,
        quality: Quality | None = None,
        skinning: str = "linear",
        shader_defines: Mapping[str, str | int] | None = None,
    ) -> None:
        require_alive(ctx, "renderer")
        require_version(ctx)
        self.ctx = ctx
        self.quality = quality or Quality()
        self.has_tessellation = ctx.version_code >= TESSELLATION_VERSION_CODE
        self.last_drawn: dict[Actor, DrawnActor] = {}
        if skinning not in SKINNING:
            raise RenderError(f"no skinning {skinning!r}: one of {', '.join(SKINNING)}")
        self.skinning = skinning
        self._defines = {**SKINNING[skinning], **(shader_defines or {})}
        self._views = dict(VIEWS)
        self._programs: dict[tuple[str, bool, bool], moderngl.Program] = {}
        self._models: weakref.WeakSet[Model] = weakref.WeakSet()
        self._levels: weakref.WeakKeyDictionary[Actor, int] = weakref.WeakKeyDictionary()
        self._is_software = any(name in ctx.info["GL_RENDERER"] for name in SOFTWARE_RENDERERS)
        self._factor = 0.0
        self._released = False
        self._lighting = lighting or Lighting()
        self._reflection: moderngl.Texture | None = None
        with self._guard():
            self._frame = ctx.buffer(reserve=4 * FRAME_FLOATS, dynamic=True)
            self._upload_lighting()

    # Light and views

    @property
    def lighting(self) -> Lighting:
        """The light; set it to change it."""
        return self._lighting

    @lighting.setter
    def lighting(self, lighting: Lighting) -> None:
        self._require_usable()
        changed = lighting.environment is not self._lighting.environment
        self._lighting = lighting
        if changed:
            with self._guard():
                self._upload_lighting()

    def _upload_lighting(self) -> None:
        levels = [level.astype(np.float16) for level in self._lighting.environment.levels]
        if self._reflection is None:
            rows, columns = levels[0].shape[:2]
            self._reflection = self.ctx.texture((columns, rows), 3, levels[0].tobytes(), alignment=1, dtype="f2")
            self._reflection.build_mipmaps(0, len(levels) - 1)
            self._reflection.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
            self._reflection.repeat_x, self._reflection.repeat_y = True, False
        for level, texels in enumerate(levels):
            self._reflection.write(texels.tobytes(), level=level, alignment=1)

    def add_view(self, name: str, fragment: str | Path, *, blends: bool = True) -> None:
        """Give a fragment shader of your own a name, to be drawn with `draw(..., view=name)`.

        Parameters
        ----------
        name : str
        fragment : str or Path
            GLSL text, or a file. It has no `#version`; it may include the files of shaders/include: `surface.glsl`
            declares the inputs and `read_surface()`, `lighting.glsl` `shade()` and `tone_map()`.
        blends : bool
            Whether materials with alpha mode BLEND are blended.

        Raises
        ------
        RenderError
            If the file is missing, or the name is one of the built-in views.
        """
        if name in VIEWS:
            raise RenderError(f"the view {name!r} is built in: choose another name")
        folder = None
        if isinstance(fragment, Path):
            if not fragment.is_file():
                raise RenderError(f"no such shader file: {fragment}")
            folder, fragment = fragment.parent, fragment.read_text(encoding="utf-8")
        for key in [key for key in self._programs if key[0] == name]:
            self._forget_vertex_arrays()
            self._programs.pop(key).release()
        self._views[name] = View("", text=fragment, folder=folder, blends=blends, is_lit=True)

    def _forget_vertex_arrays(self) -> None:
        for model in self._models:
            model.forget_programs(id(self))

    def _program(self, name: str, view: View, tessellated: bool, model: Model) -> moderngl.Program:
        key = (name, tessellated, bool(model.shader_defines))
        if key not in self._programs:
            stages = [*(_PATCH_STAGES if tessellated else ("static.vert",))]
            if view.fragment:
                stages.append(view.fragment)
            defines = {**self._defines, **view.defines, **model.shader_defines}
            program = build_program(self.ctx, stages, defines, view.text, view.folder)
            set_uniforms(program, TEXTURE_UNITS)
            self._programs[key] = program
        return self._programs[key]

    # Drawing

    def draw(
        self,
        actors: Iterable[Actor | Crowd],
        camera: Camera | MatrixCamera,
        *,
        view: str = "lit",
        lod: int | str = "auto",
        tessellation: float | str = "auto",
        uniforms: Mapping[str, Any] | None = None,
    ) -> None:
        """Draw actors and crowds into the bound framebuffer.

        Parameters
        ----------
        actors : iterable of Actor and Crowd
            Invisible, released and out-of-view ones are skipped.
        camera : Camera or MatrixCamera
        view : str
            "lit", "base_color", "normal", "position", "weights", "lod", "wireframe", "seams", "mask", "depth", or one
            given to `add_view`.
        lod : "auto" or int
            A level for all, or the coarsest of each actor's whose error stays under `quality.threshold_px`.
        tessellation : "auto", "off" or number
            A number from 1 to 64 divides every edge so often. "auto" tessellates a level where its own error is over
            the threshold: that happens to forced levels, since a chosen one is good enough as it is.
        uniforms : mapping, optional
            Values of uniforms of a caller's own fragment shader.

        Raises
        ------
        RenderError
            If something was released, or an argument or a pose makes no sense. The GL state is left intact.
        ValueError
            If an actor's transform is not finite.
        """
        self._require_usable()
        if view not in self._views:
            raise RenderError(f"no view {view!r}: one of {', '.join(self._views)}")
        factor = self._factor = self._checked_tessellation(tessellation)
        things = tuple(actors)
        crowds = [cast(DrawsItself, thing) for thing in things if hasattr(thing, "draw_in")]
        batches = gather(thing for thing in things if not hasattr(thing, "draw_in"))
        for model, _ in batches:
            self._check_model(model, lod)
        with self._guard() as gl:
            _, _, width, height = gl.integers(gl_state.VIEWPORT, 4)
            if not width or not height:
                return
            matrices = camera.matrices(width, height)
            self._write_frame(matrices, width, height, factor)
            self.last_drawn = {}
            groups = [
                group
                for model, batch in batches
                for group in self._place(model, batch, matrices, height, lod, tessellation)
            ]
            self._draw_groups(gl, groups, view, self._views[view], dict(uniforms or {}))
            for crowd in crowds:
                if crowd.ctx is not self.ctx:
                    raise RenderError("a crowd belongs to another context than the renderer")
                crowd.draw_in(
                    CrowdFrame(
                        gl=gl,
                        camera=matrices,
                        width_px=width,
                        height_px=height,
                        threshold_px=self.quality.threshold_px,
                        level=None if isinstance(lod, str) else lod,
                        view_name=view,
                        view=self._views[view],
                        uniforms=dict(uniforms or {}),
                        defines=self._defines,
                    )
                )

    def _require_usable(self) -> None:
        if self._released:
            raise RenderError("the renderer was released: make a new one")
        require_alive(self.ctx, "renderer")

    def _checked_tessellation(self, tessellation: float | str) -> float:
        if isinstance(tessellation, str):
            if tessellation not in ("auto", "off"):
                raise RenderError(f"no tessellation {tessellation!r}: auto, off or a number from 1 to {MAX_FACTOR:g}")
            return 0.0
        if not 1.0 <= tessellation <= MAX_FACTOR:
            raise RenderError(f"tessellation {tessellation} is not between 1 and {MAX_FACTOR:g}")
        if not self.has_tessellation:
            raise RenderError("tessellation needs OpenGL 4.1, this context is older: draw with tessellation off")
        return float(tessellation)

    def _check_model(self, model: Any, lod: int | str) -> None:
        model.require_usable()
        if model.ctx is not self.ctx:
            raise RenderError(f"the model {model.asset.name} belongs to another context than the renderer")
        if lod != "auto" and not (isinstance(lod, int) and 0 <= lod < len(model.lods)):
            raise RenderError(f"{model.asset.name} has no level of detail {lod!r}: auto or 0 to {len(model.lods) - 1}")

    def _guard(self) -> Any:
        units = [*range(NUM_TEXTURE_UNITS), self.ctx.default_texture_unit]
        return saved_state(units, (FRAME_BINDING,), self.ctx.version_code >= 400)

    def _write_frame(self, matrices: CameraMatrices, width: int, height: int, factor: float) -> None:
        light, quality = self._lighting, self.quality
        sun = np.asarray(light.sun_direction, np.float64)
        frame = np.zeros((18, 4), np.float32)
        frame[0:4] = matrices.clip_from_world.T
        frame[4, :3] = matrices.eye
        focal_px = max(matrices.projection[0, 0] * width, matrices.projection[1, 1] * height) / 2
        frame[5] = width, height, focal_px, float(matrices.is_perspective)
        frame[6, :3] = sun / max(float(np.linalg.norm(sun)), 1e-30)
        frame[7] = *light.sun_color, light.exposure
        frame[8:17, :3] = light.environment.irradiance
        frame[17] = quality.segment_px, MAX_FACTOR, factor, quality.texels_a_segment
        self._frame.write(frame.tobytes())
        self._frame.bind_to_uniform_block(FRAME_BINDING)

    def _place(
        self,
        model: Model,
        batch: ActorBatch,
        matrices: CameraMatrices,
        height: int,
        lod: int | str,
        tessellation: float | str,
    ) -> list[tuple[_Group, NDArray[Any]]]:
        """Choose a level for each actor in view, and fill the instance records of those drawn together."""
        if not np.isfinite(batch.joint_rows).all():
            broken = int(np.flatnonzero(~np.isfinite(batch.joint_rows).all(axis=(1, 2, 3)))[0])
            raise RenderError(
                f"the pose of actor {broken} of {model.asset.name} is not finite: check what sets its joints"
            )
        transforms = np.array([actor.transform for actor in batch.actors], np.float64)
        corners = transform_boxes(batch.bounds, transforms)
        seen = visible(corners, matrices)
        scale_px = pixels_per_metre(corners, transforms, matrices, height)
        errors = np.array([level.mesh.error_m for level in model.lods])
        if lod == "auto":
            previous = np.array([self._levels.get(actor, -1) for actor in batch.actors])
            levels = choose_levels(errors, scale_px, self.quality.threshold_px, previous)
        else:
            levels = np.full(len(batch.actors), int(lod))
        if isinstance(tessellation, str):
            with np.errstate(invalid="ignore"):
                too_coarse = np.nan_to_num(errors[levels] * scale_px) > self.quality.threshold_px
            tessellated = too_coarse & (levels > 0) & (tessellation == "auto") & self.has_tessellation
        else:
            tessellated = np.ones(len(levels), bool)
        for index, actor in enumerate(batch.actors):
            if seen[index] and lod == "auto":  # a level that was asked for says nothing about the next choice
                self._levels[actor] = int(levels[index])
            self.last_drawn[actor] = DrawnActor(int(levels[index]) if seen[index] else -1, bool(tessellated[index]))
        if not seen.any():
            return []
        self._models.add(model)
        is_dual = self.skinning == "dual_quaternion"
        model.joint_texture(
            np.ascontiguousarray(joint_texels(batch.joint_rows) if is_dual else batch.joint_rows, np.float32)
        )
        records = np.zeros(len(levels), INSTANCE)
        records["rows"] = transforms[:, :3]
        records["rows"][:, :, 3] = transforms[:, :3, 3] - matrices.eye
        records["tint"] = batch.tints
        records["numbers"][:, 0] = np.arange(len(levels))
        records["numbers"][:, 1] = levels
        mirrored = np.linalg.det(transforms[:, :3, :3]) < 0
        keys = levels * 4 + tessellated * 2 + mirrored
        return [
            (_Group(model, int(key) >> 2, bool(key & 2), bool(key & 1)), records[seen & (keys == key)])
            for key in np.unique(keys[seen])
        ]

    def _draw_groups(
        self, gl: Functions, groups: list[tuple[_Group, NDArray[Any]]], name: str, view: View, uniforms: dict[str, Any]
    ) -> None:
        gl.switch(gl_state.DEPTH_TEST, True)
        gl.switch(gl_state.FRAMEBUFFER_SRGB, False)
        gl.switch(gl_state.SAMPLE_ALPHA_TO_COVERAGE, False)
        gl.glDepthFunc(gl_state.LESS)
        gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
        gl.glBlendEquationSeparate(gl_state.FUNC_ADD, gl_state.FUNC_ADD)
        gl.glBlendFuncSeparate(
            gl_state.SRC_ALPHA, gl_state.ONE_MINUS_SRC_ALPHA, gl_state.ONE, gl_state.ONE_MINUS_SRC_ALPHA
        )
        gl.glCullFace(gl_state.BACK)
        for flag in (gl_state.POLYGON_OFFSET_FILL, gl_state.POLYGON_OFFSET_LINE):
            gl.switch(flag, bool(view.lines) and flag == gl_state.POLYGON_OFFSET_FILL)
        gl.glPolygonOffset(1.0, 1.0)
        if not view.writes_color:
            gl.glColorMask(0, 0, 0, 0)
        assert self._reflection is not None
        self._reflection.use(TEXTURE_UNITS["reflection_texture"])
        counts = [(group, len(records)) for group, records in groups]
        for group, records in groups:
            group.model.instance_buffer(group.key, records)
        uniforms = {**view.uniforms, **uniforms}
        for blended in (False, True) if view.blends else (False,):
            gl.switch(gl_state.BLEND, blended)
            gl.glDepthMask(not blended)
            for group, count in counts:
                self._draw_group(gl, group, count, name, view, uniforms, blended if view.blends else None)
        if view.lines:
            gl.switch(gl_state.POLYGON_OFFSET_FILL, False)
            gl.glDepthFunc(gl_state.LEQUAL)
            for group, count in counts:
                self._draw_lines(gl, group, count, view.lines)

    def _bind(self, group: _Group, program: moderngl.Program, uniforms: Mapping[str, Any]) -> None:
        model = group.model
        for sampler, texture in model.textures.items():
            texture.use(TEXTURE_UNITS[sampler])
        joints = model._joint_texture
        assert joints is not None
        joints.use(TEXTURE_UNITS["joint_texture"])
        set_uniforms(program, model.constants)
        set_uniforms(program, uniforms)

    def _draw_group(
        self,
        gl: Functions,
        group: _Group,
        count: int,
        name: str,
        view: View,
        uniforms: Mapping[str, Any],
        blended: bool | None,
    ) -> None:
        """Draw the ranges of a level: all of them, or those that are blended, or those that are not."""
        model = group.model
        lod = model.lods[group.level]
        ranges = [part for part in lod.groups if blended is None or (part.material.alpha_mode == "BLEND") == blended]
        if not ranges:
            return
        program = self._program(name, view, group.tessellated, model)
        self._bind(group, program, uniforms)
        kind = "patches" if group.tessellated else "triangles"
        array = model.vertex_array((id(self), name, group.tessellated), group.key, program, group.level, kind)
        per_face = PATCH_VERTICES if group.tessellated else 3
        if group.tessellated:
            self.ctx.patch_vertices = PATCH_VERTICES
        mode = moderngl.PATCHES if group.tessellated else moderngl.TRIANGLES
        gl.glFrontFace(gl_state.CW if group.mirrored else gl_state.CCW)
        for part in ranges:
            gl.switch(gl_state.CULL_FACE, not (part.material.double_sided or view.two_sided))
            set_material(program, part.material, view.blends)
            at_once = (
                self._patches_a_call(model, group.level) if group.tessellated and self._is_software else part.count
            )
            for first in range(0, part.count, at_once):
                faces = min(at_once, part.count - first)
                array.render(mode, vertices=faces * per_face, first=(part.first + first) * per_face, instances=count)

    def _patches_a_call(self, model: Model, level: int) -> int:
        """How many patches a software rasteriser takes in one call, whatever their factors turn out to be."""
        factor = self._factor
        if not factor:
            factor = min(MAX_FACTOR, model.longest_edge_texels(level) / self.quality.texels_a_segment)
        segments = int(np.ceil(factor)) + 1  # fractional spacing rounds up to an odd number
        vertices = 3 * (segments // 2 + 1) ** 2  # rings of 3 n, 3 (n - 2) ... vertices
        return max(1, SOFTWARE_VERTICES_A_CALL // vertices)

    def _draw_lines(self, gl: Functions, group: _Group, count: int, lines: str) -> None:
        uniforms = {"flat_color": LINE_COLORS[lines]}
        if lines == "wireframe":
            gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.LINE)
            self._draw_group(gl, group, count, "lines", LINES, uniforms, None)
            gl.glPolygonMode(gl_state.FRONT_AND_BACK, gl_state.FILL)
            return
        if group.model.seam_lines(group.level) is None:
            return
        program = self._program("lines", LINES, False, group.model)
        self._bind(group, program, uniforms)
        set_material(program, group.model.lods[group.level].groups[0].material, False)
        array = group.model.vertex_array((id(self), "lines", False), group.key, program, group.level, "seams")
        array.render(moderngl.LINES, instances=count)

    def release(self) -> None:
        """Free programs and buffers. May be called more than once; models are not released."""
        if self._released:
            return
        self._released = True
        if type(self.ctx.mglo).__name__ == "InvalidObject":
            return
        self._forget_vertex_arrays()
        for program in self._programs.values():
            program.release()
        self._programs.clear()
        for thing in (self._frame, self._reflection):
            if thing is not None:
                thing.release()


def set_material(program: moderngl.Program, material: MaterialData, blends: bool) -> None:
    """Uniforms of one material, those that the program has."""
    is_blended = material.alpha_mode == "BLEND" and blends
    values: dict[str, Any] = {
        "base_color_factor": material.base_color_factor,
        "surface_factors": (
            material.occlusion_strength,
            material.roughness_factor,
            material.metallic_factor,
            material.alpha_cutoff if material.alpha_mode == "MASK" else -1.0,
        ),
        "emissive_factor": material.emissive_factor,
        "surface_flags": int(is_blended) | 2 * int(material.unlit),
    }
    set_uniforms(program, values)
