"""Draws actors into the framebuffer that is bound, and leaves the GL state as it found it.

Used meanwhile, and put back after: texture units 0 to 11 (`runtime.gpu.textures.TEXTURE_UNITS`), uniform buffer binding
points 0 and 1, the program, vertex array and buffers that are bound, culling, depth, blending and polygon state.
The framebuffer, its viewport, scissor, stencil and colour masks are the caller's and only respected.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import moderngl
import numpy as np

from runtime.animation.dual_quaternions import joint_texels
from runtime.errors import NotCopied, RenderError
from runtime.gpu import gl_state
from runtime.gpu.context import can_free
from runtime.gpu.frame_uniforms import FRAME_BINDING, MAX_FACTOR, FrameBlock
from runtime.gpu.gl_state import saved_state
from runtime.gpu.model import Model, require_alive
from runtime.gpu.programs import TESSELLATION_VERSION_CODE, require_version
from runtime.gpu.textures import NUM_TEXTURE_UNITS
from runtime.render.draw_batches import DrawBatch, DrawnActor, LodRequest, make_draw_batches
from runtime.render.passes import DrawSettings, Passes
from runtime.render.views import VIEWS, Drawable, Frame, View
from runtime.scene.actor import Actor
from runtime.scene.actor_batch import ActorBatch, gather
from runtime.scene.camera import Camera, CameraLike, CameraMatrices, MatrixCamera
from runtime.scene.lighting import Lighting
from runtime.scene.lod_selection import Quality
from runtime.validation import describe, is_integer, is_number

SKINNING: dict[str, dict[str, str | int]] = {"linear": {}, "dual_quaternion": {"DUAL_QUATERNIONS": 1}}


T = TypeVar("T")


def checked(value: T, kind: type[T], what: str) -> T:
    """A value of a kind, or a RenderError that names it."""
    if not isinstance(value, kind):
        raise RenderError(f"a renderer's {what} is a runtime.{kind.__name__}, not {describe(value)}")
    return value


class Renderer(NotCopied):
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
        spacing, `WITHOUT_CANONICAL_UVS` fetches geometry at each copy's own uv (to see what these are for).

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
        self._quality = checked(quality or Quality(), Quality, "quality")
        self.has_tessellation = ctx.version_code >= TESSELLATION_VERSION_CODE
        self.last_drawn: dict[Actor, DrawnActor] = {}
        if skinning not in SKINNING:
            raise RenderError(f"no skinning {skinning!r}: one of {', '.join(SKINNING)}")
        self.skinning = skinning
        self._defines = {**SKINNING[skinning], **(shader_defines or {})}
        self._views = dict(VIEWS)
        self._levels: weakref.WeakKeyDictionary[Actor, int] = weakref.WeakKeyDictionary()
        self._released = False
        self._lighting = checked(lighting or Lighting(), Lighting, "lighting")
        self._passes = Passes(ctx, self._defines)
        units = [*range(NUM_TEXTURE_UNITS), ctx.default_texture_unit]
        self._state = saved_state(units, (FRAME_BINDING,), self.has_tessellation)
        with self._state:
            self._frame = FrameBlock(ctx, self._lighting)

    # Light and views

    @property
    def lighting(self) -> Lighting:
        """The light; set it to change it."""
        return self._lighting

    @lighting.setter
    def lighting(self, lighting: Lighting) -> None:
        self._require_usable()
        checked(lighting, Lighting, "lighting")
        changed = lighting.environment is not self._lighting.environment
        self._lighting = lighting
        if changed:
            with self._state:
                self._frame.upload_lighting(lighting)

    @property
    def quality(self) -> Quality:
        """How good pictures are to be; set it to change it."""
        return self._quality

    @quality.setter
    def quality(self, quality: Quality) -> None:
        self._quality = checked(quality, Quality, "quality")

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
        if not isinstance(name, str) or not isinstance(fragment, str | Path):
            raise RenderError(
                f"a view is a name and a shader's text or Path, not {describe(name)} and {describe(fragment)}"
            )
        if name in VIEWS:
            raise RenderError(f"the view {name!r} is built in: choose another name")
        folder = None
        if isinstance(fragment, Path):
            if not fragment.is_file():
                raise RenderError(f"no such shader file: {fragment}")
            folder, fragment = fragment.parent, fragment.read_text(encoding="utf-8")
        elif "main" not in fragment and "#include" not in fragment:
            raise RenderError(f"the view {name!r} has no main(): give a shader's text, or a pathlib.Path of its file")
        self._passes.forget(name)
        self._views[name] = View("", text=fragment, folder=folder, blends=blends, is_lit=True)

    # Drawing

    def clear(
        self, red: float = 0.0, green: float = 0.0, blue: float = 0.0, alpha: float = 1.0, *, depth: float = 1.0
    ) -> None:
        """Fill the bound framebuffer, into which `draw` draws.

        The one that is bound in OpenGL: moderngl's own `clear` fills, and binds, the last that moderngl itself was told
        of, which is another where a toolkit (Qt) binds a widget's, and leaves alpha 0 unless told otherwise.

        Parameters
        ----------
        red, green, blue, alpha : float, 0 to 1
        depth : float
            0 near, 1 far.

        Raises
        ------
        RenderError
            If the renderer was released, or something is no number.
        """
        self._require_usable()
        if not all(is_number(value) for value in (red, green, blue, alpha, depth)):
            raise RenderError(f"a framebuffer is cleared to numbers, not {describe((red, green, blue, alpha, depth))}")
        with self._state:
            gl_state.clear_bound((red, green, blue, alpha), depth)

    def draw(
        self,
        actors: Iterable[Actor | Drawable] | Actor | Drawable,
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
        actors : iterable of Actor and Crowd, or a single one
            Invisible, released and out-of-view ones are skipped.
        camera : Camera or MatrixCamera
        view : str
            "lit", "base_color", "normal", "position", "weights", "lod", "wireframe", "seams", "mask", "depth", or one
            given to `add_view`.
        lod : "auto" or int
            A level for all, or the coarsest of each actor's whose error stays under `quality.threshold_px`.
        tessellation : "auto", "off" or number
            A number from 1 to 64 divides every edge so often. "auto" tessellates a level that was asked for where its
            own error is over the threshold; a chosen one is good enough as it is, and tessellated only if
            `quality.prefer` says so.
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
        self._check_arguments(camera, view, lod, uniforms)
        factor = self._checked_tessellation(tessellation)
        crowds, batches = self._sorted(actors, lod)
        quality = self.quality
        settings = DrawSettings(
            view, self._views[view], dict(uniforms or {}), factor, quality.texels_per_segment, quality.blend_prepass
        )
        level = None if isinstance(lod, str) else int(lod)
        with self._state as gl:
            _, _, width, height = gl.integers(gl_state.VIEWPORT, 4)
            if not width or not height:
                return
            size_px = width, height
            matrices = camera.matrices(*size_px)
            self._frame.write(matrices, size_px, self._lighting, self.quality, factor)
            self._frame.bind()
            request = LodRequest(size_px, level, tessellation, self.has_tessellation, self.quality)
            self._passes.draw(gl, self._draw_batches(batches, matrices, request), settings)
            for crowd in crowds:
                crowd.draw_in(
                    Frame(
                        gl=gl,
                        camera=matrices,
                        size_px=size_px,
                        threshold_px=self.quality.threshold_px,
                        level=level,
                        view_name=view,
                        view=settings.view,
                        uniforms=settings.uniforms,
                        defines=self._defines,
                        blend_prepass=quality.blend_prepass,
                    )
                )

    def _check_arguments(self, camera: Any, view: Any, lod: Any, uniforms: Any) -> None:
        if not isinstance(view, str) or view not in self._views:
            raise RenderError(f"no view {describe(view)}: one of {', '.join(self._views)}")
        if not isinstance(camera, CameraLike):
            raise RenderError(f"pictures need a Camera or a MatrixCamera, not {describe(camera)}")
        if lod != "auto" and not is_integer(lod):
            raise RenderError(f"no level of detail {describe(lod)}: auto, or a number from 0, the finest")
        if uniforms is not None and not isinstance(uniforms, Mapping):
            raise RenderError(f"uniforms must be a mapping of names to values, not {describe(uniforms)}")

    def _sorted(self, things: Any, lod: int | str) -> tuple[list[Drawable], list[tuple[Model, ActorBatch]]]:
        """What draws itself, and the actors of each model posed together."""
        if not isinstance(things, list | tuple):
            is_one = isinstance(things, Actor | Drawable) or not isinstance(things, Iterable)
            things = (things,) if is_one else tuple(things)
        crowds: list[Drawable] = []
        singles: list[Actor] = []
        for thing in things:
            if isinstance(thing, Actor):
                singles.append(thing)
            elif isinstance(thing, Drawable):
                crowds.append(thing)
            else:
                raise RenderError(f"only actors and crowds can be drawn, not {describe(thing)}")
        for crowd in crowds:
            if crowd.ctx is not self.ctx:
                raise RenderError("a crowd belongs to another context than the renderer")
        batches = gather(singles)
        for model, _ in batches:
            self._check_model(model, lod)
        return crowds, batches

    def _draw_batches(
        self, batches: Iterable[tuple[Model, ActorBatch]], camera: CameraMatrices, request: LodRequest
    ) -> list[DrawBatch]:
        """All models' draw batches, their poses uploaded; what was decided is noted in `last_drawn`."""
        made: list[DrawBatch] = []
        self.last_drawn = {}
        for model, batch in batches:
            own, drawn = make_draw_batches(model, batch, camera, request, self._levels)
            self.last_drawn |= drawn
            made += own
            if own:
                self._write_poses(model, batch)
        return made

    def _write_poses(self, model: Model, batch: ActorBatch) -> None:
        is_dual = self.skinning == "dual_quaternion"
        texels = joint_texels(batch.joint_rows) if is_dual else batch.joint_rows
        model.joint_texture(np.ascontiguousarray(texels, np.float32))
        if batch.morph_weights is not None:
            model.write_morphs(batch.morph_weights)

    def _require_usable(self) -> None:
        if self._released:
            raise RenderError("the renderer was released: make a new one")
        require_alive(self.ctx, "renderer")

    def _checked_tessellation(self, tessellation: float | str) -> float:
        if isinstance(tessellation, str):
            if tessellation not in ("auto", "off"):
                raise RenderError(f"no tessellation {tessellation!r}: auto, off or a number from 1 to {MAX_FACTOR:g}")
            return 0.0
        if not is_number(tessellation) or not 1.0 <= tessellation <= MAX_FACTOR:
            raise RenderError(f"tessellation {tessellation} is not between 1 and {MAX_FACTOR:g}")
        if not self.has_tessellation:
            raise RenderError("tessellation needs OpenGL 4.1, this context is older: draw with tessellation off")
        return float(tessellation)

    def _check_model(self, model: Any, lod: int | str) -> None:
        if model.ctx is not self.ctx:
            raise RenderError(f"the model {model.asset.name} belongs to another context than the renderer")
        model.require_uploaded()
        if lod != "auto" and not (is_integer(lod) and 0 <= int(lod) < len(model.lods)):
            raise RenderError(f"{model.asset.name} has no level of detail {lod!r}: auto or 0 to {len(model.lods) - 1}")

    def release(self) -> None:
        """Free programs and buffers. May be called more than once; models are not released."""
        if self._released:
            return
        can_free_now = can_free(self.ctx, "renderer")
        self._released = True
        if not can_free_now:
            return
        self._passes.release()
        self._frame.release()
