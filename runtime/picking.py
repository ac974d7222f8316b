"""Who is under the mouse: the first surface that a ray meets, exact to the drawn triangle.

Boxes and spheres say who may be hit; each of those is drawn alone, nearest first, into a depth map of one pixel, by a
camera that looks along the ray. So what is picked is what is drawn: the pose, the skin, the finest level of detail.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.crowd.crowd import Crowd
from runtime.errors import RenderError
from runtime.gpu import gl_state
from runtime.gpu.gl_state import saved_state
from runtime.scene.actor import Actor
from runtime.scene.actor_batch import gather
from runtime.scene.camera import Camera, MatrixCamera, Ray

if TYPE_CHECKING:
    from runtime.render.renderer import Renderer

Doubles = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

_SCISSOR_TEST = 0x0C11


@dataclass(frozen=True)
class Hit:
    """What a ray met first.

    Attributes
    ----------
    thing : Actor or Crowd
    number : int or None
        Which actor of the crowd; None for an actor of its own.
    position : (3,) float64
        Where, in the world, metres.
    distance_m : float
        From the ray's origin.
    """

    thing: Actor | Crowd
    number: int | None
    position: Doubles
    distance_m: float


@dataclass(frozen=True)
class _Candidate:
    """Somebody whose bounds the ray enters and leaves at these distances."""

    enters_m: float
    leaves_m: float
    thing: Actor | Crowd
    number: int | None


def _through_boxes(ray: Ray, boxes: Doubles, transforms: Doubles) -> tuple[Doubles, Doubles]:
    """Distances at which a ray enters and leaves boxes (A, 2, 3) of object spaces; it misses where they are swapped."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.linalg.pinv(transforms)
        origin = inverse[:, :3, :3] @ ray[0] + inverse[:, :3, 3]
        ways = (boxes - origin[:, None]) / (inverse[:, :3, :3] @ ray[1])[:, None]
    ways = np.where(np.isnan(ways), np.array([-np.inf, np.inf])[None, :, None], ways)
    return ways.min(axis=1).max(axis=1), ways.max(axis=1).min(axis=1)


def _through_spheres(ray: Ray, centres: Doubles, radii: Floats) -> tuple[Doubles, Doubles]:
    """Distances at which a ray enters and leaves spheres; it misses where they are swapped."""
    offsets = centres - ray[0]
    along = offsets @ ray[1]
    aside_sq = (offsets**2).sum(axis=1) - along**2
    half_sq = radii.astype(np.float64) ** 2 - aside_sq
    half = np.sqrt(np.maximum(half_sq, 0.0))
    return np.where(half_sq >= 0, along - half, np.inf), np.where(half_sq >= 0, along + half, -np.inf)


def _candidates(things: Iterable[Actor | Crowd], ray: Ray) -> Iterator[_Candidate]:
    """Everybody whose bounds lie on the ray, before its origin or around it."""
    listed = list(things)
    crowds = [thing for thing in listed if isinstance(thing, Crowd)]
    for _, batch in gather(thing for thing in listed if isinstance(thing, Actor)):
        enters, leaves = _through_boxes(ray, batch.bounds.astype(np.float64), batch.transforms)
        for index in np.flatnonzero((enters <= leaves) & (leaves > 0)):
            yield _Candidate(float(enters[index]), float(leaves[index]), batch.actors[index], None)
    for crowd in crowds:
        if crowd.visible and crowd.count:
            enters, leaves = _through_spheres(ray, *crowd.state.spheres)
            for index in np.flatnonzero((enters <= leaves) & (leaves > 0) & crowd.state.visible):
                yield _Candidate(float(enters[index]), float(leaves[index]), crowd, int(index))


def _along(ray: Ray, near_m: float, far_m: float) -> MatrixCamera:
    """A camera without perspective that looks along a ray, and sees what lies between two distances on it."""
    origin, forward = ray
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    view, projection = np.eye(4), np.eye(4)
    view[:3, :3] = right, np.cross(right, forward), -forward
    view[:3, 3] = -view[:3, :3] @ origin
    projection[2, 2] = -2.0 / (far_m - near_m)
    projection[2, 3] = -(far_m + near_m) / (far_m - near_m)
    return MatrixCamera(view, projection)


class _OnePixel:
    """A depth map of one pixel to draw into; what was bound before is bound again at the end."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._state = saved_state((ctx.default_texture_unit,), (), False)

    def __enter__(self) -> _OnePixel:
        gl = self._state.__enter__()
        self._bound = [
            gl.integer(what) for what in (gl_state.DRAW_FRAMEBUFFER_BINDING, gl_state.READ_FRAMEBUFFER_BINDING)
        ]
        self._viewport, self._scissor = gl.integers(gl_state.VIEWPORT, 4), bool(gl.glIsEnabled(_SCISSOR_TEST))
        self._before = self._ctx.fbo
        self._depth = self._ctx.depth_texture((1, 1))
        self._framebuffer = self._ctx.framebuffer(depth_attachment=self._depth)
        return self

    def depth_of(self, renderer: Renderer, thing: Actor | Crowd, camera: MatrixCamera) -> float:
        """Depth of the first surface of a thing, 0 to 1; 1 where there is none."""
        self._framebuffer.use()
        self._framebuffer.clear(depth=1.0)
        renderer.draw([thing], camera, view="depth", lod=0, tessellation="off")
        return float(np.frombuffer(self._depth.read(alignment=1), np.float32)[0])

    def __exit__(self, *error: object) -> None:
        gl = gl_state.functions()
        self._framebuffer.release()
        self._depth.release()
        if self._before is not None and type(self._before.mglo).__name__ != "InvalidObject":
            self._before.use()  # so that moderngl knows as well
        gl.glBindFramebuffer(gl_state.DRAW_FRAMEBUFFER, self._bound[0])
        gl.glBindFramebuffer(gl_state.READ_FRAMEBUFFER, self._bound[1])
        gl.glViewport(*self._viewport)
        gl.switch(_SCISSOR_TEST, self._scissor)
        self._state.__exit__(*error)


def pick(
    renderer: Renderer,
    things: Iterable[Actor | Crowd],
    camera: Camera | MatrixCamera,
    point_px: ArrayLike,
    size_px: tuple[int, int],
) -> Hit | None:
    """What is under a point of the picture: the actor, or the actor of a crowd, that is nearest there.

    Parameters
    ----------
    renderer : Renderer
    things : iterable of Actor and Crowd
        Those that are drawn; hidden and released ones are left out.
    camera : Camera or MatrixCamera
        That of the picture.
    point_px : x and y from the upper left corner, as a mouse has them
    size_px : width and height of the picture, in the same pixels

    Returns
    -------
    Hit, or None where nobody is

    Raises
    ------
    RenderError, ValueError
        As `Renderer.draw`; for numbers that are not finite.

    Notes
    -----
    Waits for the GPU, once for each whose bounds are in the way and nearer than the nearest found: for clicks, not for
    every frame of ten thousand.
    """
    ray = camera.ray(point_px, size_px)
    listed = tuple(things)
    for thing in listed:
        if not isinstance(thing, Actor | Crowd):
            raise RenderError(f"only actors and crowds can be picked, not {thing!r:.80}")
    found: Hit | None = None
    drawn, counts = renderer.last_drawn, {thing: thing.last_counts for thing in listed if isinstance(thing, Crowd)}
    renderer.draw((), camera)  # refuses what was released
    with _OnePixel(renderer.ctx) as pixel:
        for one in sorted(_candidates(listed, ray), key=lambda candidate: candidate.enters_m):
            if found is not None and one.enters_m > found.distance_m:
                break
            slack = 0.01 * (one.leaves_m - one.enters_m) + 1e-6 * abs(one.leaves_m)
            near = max(one.enters_m - slack, 0.0)
            far = max(one.leaves_m + slack, near + 1e-9)
            shown = one.thing.state.visible.copy() if isinstance(one.thing, Crowd) else None
            try:
                if isinstance(one.thing, Crowd) and one.number is not None:
                    one.thing.state.visible[:] = False
                    one.thing.state.visible[one.number] = True
                depth = pixel.depth_of(renderer, one.thing, _along(ray, near, far))
            finally:
                if isinstance(one.thing, Crowd) and shown is not None:
                    one.thing.state.visible[:] = shown
            distance = near + depth * (far - near)
            if depth < 1.0 and (found is None or distance < found.distance_m):
                found = Hit(one.thing, one.number, ray[0] + distance * ray[1], distance)
    renderer.last_drawn = drawn
    for crowd, count in counts.items():
        crowd.last_counts = count
    return found
