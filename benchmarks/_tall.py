"""A character 200 pixels tall: what its levels of detail save, and how far they move its silhouette.

Pictures are no larger than the character needs, and an empty one is measured beside them: clearing and fetching pixels
costs the same whatever is drawn. Then ten side by side in a picture of 1920 x 1080, actors of one model, as in a game.
Each with one sample a pixel and with several, as viewers and games draw (drawn, not resolved: that costs the same
whatever is drawn). Both sides of every comparison are shaded by the same fragment program.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from demos.headless import Canvas
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.scene.actor import Actor
from runtime.scene.camera import Camera, framing
from runtime.scene.lod_selection import Quality

TALL_PX = 200
FOVY_DEG = 35.0
NUM_VIEWS = 24
WINDOW_PX = 256  # of the pictures in which silhouettes are compared
GRID, GRID_SIZE = (5, 2), (1920, 1080)
TESSELLATED = "1 px, tessellation preferred"
FINER = 4  # they are drawn so many times larger, so that thin parts do not come and go
Turns = Callable[[Mapping[str, Callable[[], None]]], dict[str, tuple[float, float]]]


def tall_m(model: Model) -> float:
    """How tall a model stands at rest, metres."""
    return float(np.ptp(model.asset.manifest.bind_bounds, axis=0)[1])


def camera_at(model: Model, actor: Actor, height_px: int, direction: NDArray[np.float64]) -> Camera:
    """A camera that looks at an actor's pose from where it is 200 pixels tall, at rest, in a picture of this height."""
    target = actor.bounds.mean(axis=0).astype(np.float64)
    distance = tall_m(model) * height_px / (2 * np.tan(np.radians(FOVY_DEG) / 2) * TALL_PX)
    eye = target + direction / np.linalg.norm(direction) * distance
    return Camera(tuple(eye), tuple(target), fovy_deg=FOVY_DEG)


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
        camera = camera_at(model, actor, WINDOW_PX, direction)
        full = mask(0, camera)
        for level in levels:
            worst[level] = max(worst[level], shift_px(mask(level, camera), full) / FINER)
    canvas.release()
    return worst


def actors_in_a_grid(model: Model, camera: Camera, size_px: tuple[int, int]) -> list[Actor]:
    """Actors in different moments of a clip, around the camera's target as far apart as the picture allows."""
    clip = model.asset.clips[min(1, len(model.asset.clips) - 1)]
    columns, rows = GRID
    rotation = camera.matrices(*size_px).rotation
    metres_per_px = tall_m(model) / TALL_PX
    actors = []
    for number in range(columns * rows):
        column, row = number % columns, number // columns
        aside_px = ((column + 0.5) / columns - 0.5) * size_px[0], ((row + 0.5) / rows - 0.5) * size_px[1]
        aside_m = (rotation[0] * aside_px[0] + rotation[1] * aside_px[1]) * metres_per_px
        other = model.actor(clip=clip.name, time_s=clip.duration_s * ((number * 0.618) % 1.0))
        transform = np.eye(4)
        transform[:3, 3] = camera.target + aside_m - other.bounds.mean(axis=0)
        other.transform = transform
        actors.append(other)
    return actors


@dataclass(frozen=True)
class Stage:
    """What is drawn in a series of pictures, and where.

    Attributes
    ----------
    name : str
    canvas : Canvas
    camera : Camera
    actors : list of Actor
    views : tuple of str
        The first is drawn tessellated as well, where that is asked for.
    tessellates : bool
    """

    name: str
    canvas: Canvas
    camera: Camera
    actors: list[Actor]
    views: tuple[str, ...] = ("lit",)
    tessellates: bool = False

    def drawing(self, renderer: Renderer, view: str, lod: int | str, draws: int, empty: bool) -> Callable[[], None]:
        """A function that draws so many pictures, each cleared anew, and waits for the end."""
        actors = [] if empty else self.actors

        def work() -> None:
            self.canvas.framebuffer.use()
            for _ in range(draws):  # each a picture of its own: what is behind another would not be shaded
                self.canvas.framebuffer.clear(depth=1.0)
                renderer.draw(actors, self.camera, view=view, lod=lod)
            renderer.ctx.finish()

        return work


def make_stages(model: Model, actor: Actor) -> list[Stage]:
    """One actor alone and ten together, each without and with multisampling."""
    ctx: moderngl.Context = model.ctx
    near = framing(model.asset.manifest.bind_bounds, 1.0)
    towards = np.asarray(near.eye) - near.target
    camera, wide = (camera_at(model, actor, height, towards) for height in (WINDOW_PX, GRID_SIZE[1]))
    many = actors_in_a_grid(model, wide, GRID_SIZE)
    stages = []
    for smooth in (False, True):
        alone, together = Canvas(ctx, (WINDOW_PX, WINDOW_PX), smooth), Canvas(ctx, GRID_SIZE, smooth)
        samples = f", {alone.samples} samples" if smooth else ""
        views = ("lit",) if smooth else ("lit", "mask")
        stages += [
            Stage(f"one, {WINDOW_PX} x {WINDOW_PX}{samples}", alone, camera, [actor], views, not smooth),
            Stage(f"{len(many)}, {GRID_SIZE[0]} x {GRID_SIZE[1]}{samples}", together, wide, many),
        ]
    return stages


def measure_tall(model: Model, actor: Actor, take_turns: Turns, draws: int) -> list[dict[str, Any]]:
    """Full detail beside the levels that thresholds allow, shaded and not, and beside tessellation; then many at once.

    Parameters
    ----------
    model, actor : what is drawn
    take_turns : function from candidates to their wall and CPU milliseconds
    draws : int
        Pictures a candidate draws before it waits for the end.
    """
    ctx: moderngl.Context = model.ctx
    stages = make_stages(model, actor)
    renderers = {"full detail": Renderer(ctx), "1 px": Renderer(ctx), "2 px": Renderer(ctx, quality=Quality(2.0))}
    if ctx.version_code >= 410:
        renderers[TESSELLATED] = Renderer(ctx, quality=Quality(prefer="tessellation"))
    rows, shifts = [], {0: 0.0}
    for stage in stages:
        ways: dict[tuple[str, str], Callable[[], None]] = {}
        for view in stage.views:
            ways[view, "empty"] = stage.drawing(renderers["1 px"], view, "auto", draws, empty=True)
            for name, renderer in renderers.items():
                if name != TESSELLATED or (stage.tessellates and view == stage.views[0]):
                    lod = 0 if name == "full detail" else "auto"
                    ways[view, name] = stage.drawing(renderer, view, lod, draws, empty=False)
        times = take_turns({f"{view}: {name}": work for (view, name), work in ways.items()})
        levels = {key: drawn_levels(renderers.get(key[1]), work, stage.actors) for key, work in ways.items()}
        new = {level for drawn in levels.values() for level in drawn if level not in shifts}
        shifts |= measure_silhouettes(model, renderers["1 px"], new)
        for (view, name), drawn in levels.items():
            wall, cpu = times[f"{view}: {name}"]
            full_wall, full_cpu = times[f"{view}: full detail"]
            nothing = times[f"{view}: empty"][1]
            rows.append(
                {
                    "what": f"{stage.name}, {view}: {name}",
                    "level": " ".join(map(str, sorted(set(drawn)))),
                    "faces": sum(len(model.lods[level].mesh.triangles) for level in drawn),
                    "silhouette px": max((shifts[level] for level in drawn), default="") if "tess" not in name else "",
                    "wall ms": wall,
                    "times faster": full_wall / wall if drawn else "",
                    "cpu ms": cpu,
                    "times less work": full_cpu / cpu if drawn else "",
                    "without the empty picture's": (full_cpu - nothing) / (cpu - nothing) if drawn else "",
                }
            )
    for renderer in renderers.values():
        renderer.release()
    for stage in stages:
        stage.canvas.release()
    return rows


def drawn_levels(renderer: Renderer | None, work: Callable[[], None], actors: list[Actor]) -> list[int]:
    """Levels at which actors are drawn, one each; none in an empty picture."""
    if renderer is None:
        return []
    work()
    return [renderer.last_drawn[actor].level for actor in actors]
