"""A studio around characters: a backdrop, and a floor with soft shadows. For pictures and the viewer only.

Two small depth maps of the characters (from the sun, and from under the floor) are drawn with the `depth` view, as any
caller of the runtime could.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.gpu.programs import build_program
from runtime.render.renderer import Renderer
from runtime.scene.camera import Camera, MatrixCamera

if TYPE_CHECKING:
    from runtime.scene.actor import Actor

MAP_PX = 512
TOP, BOTTOM, FLOOR = (0.80, 0.83, 0.86), (0.61, 0.63, 0.67), (0.74, 0.74, 0.75)


def _orthographic(direction: ArrayLike, centre: NDArray[np.float64], radius: float) -> MatrixCamera:
    """A camera outside a ball that sees all of it along a direction, in parallel."""
    forward = np.asarray(direction, np.float64) / np.linalg.norm(np.asarray(direction, np.float64))
    helper = np.array([0.0, 0.0, 1.0]) if abs(forward[1]) > 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(right, forward), -forward])
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = -rotation @ (centre - 2 * radius * forward)
    projection = np.diag([1 / radius, 1 / radius, -1 / (2 * radius), 1.0])
    projection[2, 3] = -1.0
    return MatrixCamera(view, projection)


class Stage:
    """Backdrop, floor and shadows.

    Parameters
    ----------
    ctx : moderngl.Context
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._program = build_program(ctx, ("stage.vert", "stage.frag"))
        self._array = ctx.vertex_array(self._program, [])
        self._maps = [ctx.depth_texture((MAP_PX, MAP_PX)) for _ in range(2)]
        for texture in self._maps:
            texture.compare_func = ""
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            texture.repeat_x = texture.repeat_y = False
        self._targets = [ctx.framebuffer(depth_attachment=texture) for texture in self._maps]

    def draw(
        self,
        target: moderngl.Framebuffer,
        renderer: Renderer,
        actors: Sequence[Actor],
        camera: Camera | MatrixCamera,
        box: ArrayLike,
    ) -> None:
        """Fill a framebuffer with the studio; the characters are drawn over it afterwards.

        Parameters
        ----------
        target : Framebuffer
        renderer : Renderer
        actors : sequence of Actor
            Whose shadows fall on the floor.
        camera : Camera or MatrixCamera
        box : (2, 3) float
            Around the characters at rest, world space: the floor is its underside.
        """
        low, high = np.asarray(box, np.float64)
        centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) * 0.9
        foot = np.array([centre[0], low[1], centre[2]])
        cameras = [
            _orthographic(-np.asarray(renderer.lighting.sun_direction), centre, radius),
            _orthographic((0.0, 1.0, 0.0), foot, radius),
        ]
        for framebuffer, from_there in zip(self._targets, cameras):
            framebuffer.use()
            framebuffer.clear(depth=1.0)
            if actors:
                renderer.draw(actors, from_there, view="depth", tessellation="off")
        target.use()
        matrices = camera.matrices(*target.size)
        program = self._program
        size = {"world_from_clip": np.linalg.inv(matrices.clip_from_world)}
        for name, from_there in zip(("sun", "below"), cameras):
            other = from_there.matrices(MAP_PX, MAP_PX)
            moved = np.eye(4)
            moved[:3, 3] = matrices.eye - other.eye
            size[f"{name}_clip_from_world"] = other.clip_from_world @ moved
        for uniform, matrix in size.items():
            program[uniform].write(matrix.T.astype(np.float32).tobytes())  # type: ignore[union-attr]
        values = {
            "floor_point": tuple(foot - matrices.eye),
            "floor_size": radius,
            "depth_range_m": 4 * radius,
            "sun_softness": 0.09,
            "background_top": TOP,
            "background_bottom": BOTTOM,
            "floor_color": FLOOR,
            "sun_depth": 0,
            "below_depth": 1,
        }
        for uniform, value in values.items():
            program[uniform].value = value  # type: ignore[union-attr]
        for unit, texture in enumerate(self._maps):
            texture.use(unit)
        self._ctx.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE | moderngl.BLEND)
        self._array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Free everything. May be called more than once."""
        owned: list[Any] = [self._array, self._program, *self._targets, *self._maps]
        for thing in owned:
            thing.release()
