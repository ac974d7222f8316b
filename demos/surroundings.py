"""What demos put around characters outdoors: a sky, paving with shadows, and the light to match.

Two depth maps are drawn with the `depth` view, as any caller of the runtime could: a sharp one around what is looked
at, and a wide one for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

import runtime
from demos.sun_camera import sun_camera
from runtime.gpu.gl_state import functions
from runtime.gpu.programs import build_program

NEAR_PX, FAR_PX = 2048, 2048
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Mood:
    """Time of day.

    Attributes
    ----------
    sun : towards it
    sun_light, sky_light : radiance of a white sheet on the ground
    horizon, zenith, glow : colours of the sky, encoded
    mist : how fast the ground fades into the sky, a unit of distance squared
    """

    sun: Color
    sun_light: Color
    sky_light: Color
    horizon: Color
    zenith: Color
    glow: Color
    mist: float


DAY = Mood((0.45, 0.75, 0.5), (1.0, 0.93, 0.80), (0.30, 0.34, 0.42), (0.76, 0.80, 0.84), (0.36, 0.54, 0.76),
           (0.12, 0.11, 0.08), 0.0006)  # fmt: skip
EVENING = Mood((-0.80, 0.36, 0.32), (0.60, 0.34, 0.18), (0.12, 0.14, 0.22), (0.55, 0.40, 0.38), (0.14, 0.16, 0.30),
               (0.55, 0.28, 0.08), 0.0008)  # fmt: skip


class Surroundings:
    """Sky, ground and shadows.

    Parameters
    ----------
    ctx : moderngl.Context
    mood : Mood
    unit_m : float
        Size of a character.
    """

    def __init__(self, ctx: moderngl.Context, mood: Mood, unit_m: float) -> None:
        self.ctx, self.mood, self.unit_m = ctx, mood, unit_m
        self._sky = build_program(ctx, ("stage.vert", "sky.frag"))
        self._ground = build_program(ctx, ("ground.vert", "ground.frag"))
        self._arrays = [ctx.vertex_array(program, []) for program in (self._sky, self._ground)]
        self._maps = [ctx.depth_texture((size, size)) for size in (NEAR_PX, FAR_PX)]
        for depth in self._maps:
            depth.compare_func = ""
            depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
            depth.repeat_x = depth.repeat_y = False
        self._targets = [ctx.framebuffer(depth_attachment=depth) for depth in self._maps]
        self._suns: list[runtime.MatrixCamera] = []

    def draw_shadows(
        self,
        renderer: runtime.Renderer,
        things: Sequence[runtime.Actor | runtime.Crowd],
        balls: Sequence[tuple[ArrayLike, float]],
    ) -> None:
        """What the sun sees: the ball (centre and radius, metres) of the sharp map, then that of the wide one."""
        self._suns = [sun_camera(self.mood.sun, centre, radius) for centre, radius in balls]
        for sun, target in zip(self._suns, self._targets, strict=True):
            target.use()
            target.clear(depth=1.0)
            renderer.draw(things, sun, view="depth", tessellation="off")

    def draw(
        self,
        camera: runtime.Camera,
        target: moderngl.Framebuffer,
        size_m: float,
        lantern: NDArray[np.float64] | None = None,
    ) -> dict[str, Any]:
        """Sky and ground into the bound framebuffer.

        Parameters
        ----------
        camera : Camera
        target : Framebuffer
            For its size.
        size_m : half a side of the ground
        lantern : (3,) where one hangs, in the world

        Returns
        -------
        Uniforms of the camera, for things that are drawn beside them
        """
        matrices, mood = camera.matrices(*target.size), self.mood
        direction = np.array(mood.sun) / np.linalg.norm(mood.sun)
        values: dict[str, Any] = {
            "clip_from_world": matrices.clip_from_world,
            "world_from_clip": np.linalg.inv(matrices.clip_from_world),
            "sky_horizon": np.array(mood.horizon),
            "sky_zenith": np.array(mood.zenith),
            "sky_glow": np.array(mood.glow),
            "sky_sun": direction,
            "mist": mood.mist,
            "ground_centre": np.array([0.0, -matrices.eye[1], 0.0]),
            "ground_size": size_m,
            "eye": matrices.eye,
            "unit_m": self.unit_m,
            "sun_light": np.array(mood.sun_light),
            "sky_light": np.array(mood.sky_light),
            "lantern_light": np.zeros(3) if lantern is None else np.array([1.5, 0.85, 0.32]),
            "lantern_position": np.ones(3) if lantern is None else lantern - matrices.eye,
        }
        for unit, (name, sun, depth) in enumerate(zip(("near", "far"), self._suns, self._maps, strict=True)):
            from_sun = sun.matrices(*depth.size)
            moved = np.eye(4)
            moved[:3, 3] = matrices.eye - from_sun.eye
            values |= {f"{name}_sun_from_world": from_sun.clip_from_world @ moved, f"{name}_sun_depth": unit}
            depth.use(unit)
        sky, ground = self._arrays
        self.ctx.enable_only(moderngl.NOTHING)
        write_uniforms(self._sky, values)
        sky.render(moderngl.TRIANGLES, vertices=3)
        self.ctx.enable_only(moderngl.DEPTH_TEST)
        write_uniforms(self._ground, values)
        ground.render(moderngl.TRIANGLE_STRIP, vertices=4)
        return values

    def release(self) -> None:
        """Free everything on the GPU. May be called more than once."""
        functions().glUseProgram(0)  # OpenGL keeps a program that is in use, deleted or not
        owned: list[Any] = [*self._arrays, self._sky, self._ground, *self._targets, *self._maps]
        for thing in owned:
            thing.release()


def write_uniforms(program: moderngl.Program, values: dict[str, Any]) -> None:
    """Set the uniforms that a program has; matrices are given as mathematics writes them."""
    for name, value in values.items():
        if name not in program:
            continue
        if isinstance(value, np.ndarray):
            data = value.T if value.ndim == 2 else value
            program[name].write(np.ascontiguousarray(data, dtype=np.float32).tobytes())  # type: ignore[union-attr]
        else:
            program[name].value = value  # type: ignore[union-attr]
