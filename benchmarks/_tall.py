"""A character 200 pixels tall: what its levels of detail save, and how far they move its silhouette."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from demos.headless import Canvas
from runtime.actor import Actor
from runtime.camera import Camera, framing
from runtime.gpu_asset import Model
from runtime.lod import Quality
from runtime.renderer import Renderer

TALL_PX = 200
FOVY_DEG = 35.0
NUM_VIEWS = 24
WINDOW_PX = 256  # of the pictures in which silhouettes are compared
FINER = 4  # they are drawn so many times larger, so that thin parts do not come and go
Turns = Callable[[Mapping[str, Callable[[], None]]], dict[str, tuple[float, float]]]


def camera_at(model: Model, height_px: int, direction: NDArray[np.float64]) -> Camera:
    """A camera that sees the character 200 pixels tall in a picture of this height."""
    low, high = model.asset.manifest.bind_bounds
    distance = (high[1] - low[1]) * height_px / (2 * np.tan(np.radians(FOVY_DEG) / 2) * TALL_PX)
    eye = (low + high) / 2 + direction / np.linalg.norm(direction) * distance
    return Camera(tuple(eye), tuple((low + high) / 2), fovy_deg=FOVY_DEG)


def shift_px(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Largest distance of a pixel of one mask from the other mask."""
    extra = [distance_transform_edt(~y)[x & ~y].max() for x, y in ((a, b), (b, a)) if (x & ~y).any() and y.any()]
    return float(max(extra, default=0.0))


def measure_silhouettes(model: Model, renderer: Renderer, levels: set[int]) -> dict[int, float]:
    """How far each level's silhouette lies from full detail's at most, pixels, over views, clips and moments."""
    ctx = model.ctx
    canvas = Canvas(ctx, (WINDOW_PX * FINER, WINDOW_PX * FINER), smooth=False)
    actor = model.actor()
    worst = dict.fromkeys(levels, 0.0)

    def mask(level: int, camera: Camera) -> NDArray[np.bool_]:
        with canvas.drawing():
            renderer.draw([actor], camera, view="mask", lod=level, tessellation="off")
        return np.asarray(canvas.pixels()[:, :, 0] > 0)

    for view in range(NUM_VIEWS):
        clip = model.asset.clips[view % len(model.asset.clips)]
        actor.play(clip.name, time_s=clip.duration_s * ((view * 0.618) % 1.0))
        direction = np.array([np.sin(2.4 * view), 0.5 * np.sin(1.7 * view), np.cos(2.4 * view)])
        camera = camera_at(model, WINDOW_PX, direction)
        full = mask(0, camera)
        for level in levels:
            worst[level] = max(worst[level], shift_px(mask(level, camera), full) / FINER)
    canvas.release()
    return worst


def measure_tall(model: Model, actor: Actor, canvas: Canvas, take_turns: Turns, draws: int) -> list[dict[str, Any]]:
    """Full detail beside the levels that thresholds allow, shaded and not, and beside tessellation.

    Parameters
    ----------
    model, actor, canvas : what is drawn, and where
    take_turns : function from candidates to their wall and CPU milliseconds
    draws : int
        Pictures a candidate draws before it waits for the end.
    """
    ctx: moderngl.Context = model.ctx
    near = framing(model.asset.manifest.bind_bounds, canvas.size[0] / canvas.size[1])
    camera = camera_at(model, canvas.size[1], np.asarray(near.eye) - near.target)
    qualities = {"1 px": Quality(), "2 px": Quality(threshold_px=2.0)}
    if ctx.version_code >= 410:
        qualities["1 px, tessellation preferred"] = Quality(prefer="tessellation")
    renderers = {name: Renderer(ctx, quality=quality) for name, quality in qualities.items()}

    def draw(renderer: Renderer, view: str, lod: int | str) -> Callable[[], None]:
        def work() -> None:
            canvas.framebuffer.use()
            for _ in range(draws):  # each a picture of its own: what is behind another would not be shaded
                canvas.framebuffer.clear(depth=1.0)
                renderer.draw([actor], camera, view=view, lod=lod)
            ctx.finish()

        return work

    ways = {
        (view, name): draw(renderers.get(name, renderers["1 px"]), view, "auto" if name in renderers else 0)
        for view in ("lit", "mask") for name in ("full detail", *renderers)
    }  # fmt: skip
    times = take_turns({f"{view}: {name}": work for (view, name), work in ways.items()})
    levels = {}
    for key, work in ways.items():
        work()
        levels[key] = renderers.get(key[1], renderers["1 px"]).last_drawn[actor].level
    shifts = measure_silhouettes(model, renderers["1 px"], set(levels.values()))
    rows = []
    for (view, name), level in levels.items():
        (wall, cpu), (full_wall, full_cpu) = times[f"{view}: {name}"], times[f"{view}: full detail"]
        rows.append(
            {
                "what": f"{TALL_PX} px tall, {view}: {name}",
                "level": level,
                "faces": len(model.lods[level].mesh.triangles),
                "silhouette px": shifts[level] if "tess" not in name else "",
                "wall ms": wall,
                "times faster": full_wall / wall,
                "cpu ms": cpu,
                "times less work": full_cpu / cpu,
            }
        )
    for renderer in renderers.values():
        renderer.release()
    return rows
