"""Fills a square with a built character: a window with an orbit camera, or one picture with --headless.

    python -m demos.crowd human.seamless --count 10000
    python -m demos.crowd human.seamless --count 2000 --headless --out crowd.png --size 1920x1080

In the window: drag turns, the wheel goes nearer, Space pauses, L shows the levels of detail, Esc closes. The title
tells how many are in view and what a frame costs.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray

import runtime
from demos.errors import DemoError
from demos.headless import Canvas, create_context, write_png
from demos.options import Options, Parser, add_arguments, parse, run
from demos.orbit import Orbit
from demos.surroundings import DAY, Surroundings
from demos.viewer import find_folder
from demos.walk_scene import character_size, various_tints
from runtime.render.views import VIEWS

SPACING = 0.85  # between neighbours, of a character's size
MAX_COUNT = 1_000_000


def square(count: int, unit_m: float, seed: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (A, 3), metres, on a jittered grid around the origin, the front row first; and headings (A,), radians."""
    draw = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(max(count, 1))))
    spacing = SPACING * unit_m
    column, row = np.arange(count) % side, np.arange(count) // side
    places = np.zeros((count, 3))
    places[:, 0] = (column - (side - 1) / 2 + draw.uniform(-0.3, 0.3, count)) * spacing
    places[:, 2] = ((side - 1) / 2 - row + draw.uniform(-0.3, 0.3, count)) * spacing
    return places, draw.normal(0.0, 0.5, count)


class CrowdScene:
    """A crowd on a paved square with shadows.

    Parameters
    ----------
    ctx : moderngl.Context
    folder : Path
    count : int
    clip : str, int or None
        What everybody plays; None: each a clip by chance.
    """

    def __init__(self, ctx: moderngl.Context, folder: Path, count: int, clip: str | int | None = None) -> None:
        self.ctx = ctx
        self.model = runtime.Model(ctx, runtime.load(folder))
        box = self.model.asset.manifest.bind_bounds
        self.unit_m, self.sole_m = character_size(box), float(box[0, 1])
        self.renderer = runtime.Renderer(ctx, lighting=runtime.Lighting(sun_direction=DAY.sun))
        self.crowd = runtime.Crowd(ctx, self.model, count)
        places, headings = square(count, self.unit_m)
        self.crowd.place_on_ground(places - [0.0, self.sole_m, 0.0], headings)
        draw = np.random.default_rng(2)
        num_clips = len(self.model.asset.clips)
        try:
            if clip is not None or num_clips:
                chosen = draw.integers(0, num_clips, count) if clip is None else clip
                self.crowd.play(chosen, phases_s=draw.uniform(0, 10, count), speeds=draw.uniform(0.85, 1.15, count))
        except ValueError as error:
            raise DemoError(str(error)) from None
        self.crowd.tint(various_tints(count))
        self.radius_m = 0.75 * SPACING * self.unit_m * np.sqrt(max(count, 1)) + self.unit_m
        self.front_m = float(places[:, 2].max(initial=0.0))
        self.surroundings = Surroundings(ctx, DAY, self.unit_m)

    def camera(self, options: Options) -> runtime.Camera:
        """The camera that was asked for, or one over the heads of the front row."""
        front = self.front_m + 3.2 * self.unit_m
        eye = options.eye or (1.5 * self.unit_m, 2.9 * self.unit_m, front)
        target = options.target or (0.0, 0.7 * self.unit_m, front - 10.0 * self.unit_m)
        return runtime.Camera(eye, target, fovy_deg=options.fovy_deg)

    def draw(self, target: moderngl.Framebuffer, camera: runtime.Camera, options: Options, view: str) -> None:
        """One picture."""
        lit = VIEWS[view].is_lit and options.backdrop
        if lit:
            sharp_m = min(self.radius_m, 9 * self.unit_m)
            forward = np.subtract(camera.target, camera.eye) * [1.0, 0.0, 1.0]
            middle = np.array(camera.eye) * [1.0, 0.0, 1.0] + forward / max(np.linalg.norm(forward), 1e-9) * sharp_m
            self.surroundings.draw_shadows(
                self.renderer, [self.crowd], [(middle, sharp_m), (np.zeros(3), self.radius_m)]
            )
        target.use()
        target.clear(0.0, 0.0, 0.0, float(lit), depth=1.0)
        if lit:
            self.surroundings.draw(camera, target, 3 * self.radius_m + 100 * self.unit_m)
        self.renderer.draw([self.crowd], camera, view=view, lod=options.lod)

    def release(self) -> None:
        """Free everything on the GPU. May be called more than once."""
        self.surroundings.release()
        for thing in (self.crowd, self.renderer, self.model):
            thing.release()


def draw_picture(options: Options, count: int) -> None:
    """One picture to a file."""
    folder = find_folder(options)
    ctx = create_context()
    try:
        scene = CrowdScene(ctx, folder, count, options.clip)
        scene.crowd.update(options.time_s)
        canvas = Canvas(ctx, options.size, VIEWS[options.view].is_lit)
        scene.draw(canvas.framebuffer, scene.camera(options), options, options.view)
        assert options.out is not None
        write_png(options.out, canvas.pixels())
        scene.release()
        canvas.release()
    finally:
        ctx.release()


def show_window(options: Options, count: int) -> None:
    """Run the window until it is closed."""
    from demos.window import Window

    with Window("seamskin: a crowd", options.size) as window:
        scene = CrowdScene(window.ctx, find_folder(options), count, options.clip)
        orbit = Orbit(scene.camera(options))
        state = {"paused": False, "view": options.view}

        def press(key: str) -> None:
            if key == "space":
                state["paused"] = not state["paused"]
            elif key == "l":
                state["view"] = "lit" if state["view"] == "lod" else "lod"

        def drag(dx_px: float, dy_px: float, move: bool) -> None:
            if move:
                orbit.move(dx_px, dy_px, window.size[1])
            else:
                orbit.turn(dx_px, dy_px)

        window.on_key, window.on_drag, window.on_scroll = press, drag, orbit.zoom
        last = time.perf_counter()
        try:
            while window.next_frame():
                now = time.perf_counter()
                scene.crowd.update(0.0 if state["paused"] else now - last)
                scene.draw(window.framebuffer, orbit.camera(), options, str(state["view"]))
                window.set_title(f"{int(scene.crowd.last_counts.sum())} of {count} - {1e3 * (now - last):.1f} ms")
                last = now
        finally:
            scene.release()


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.crowd`."""

    def work() -> None:
        parser = Parser("python -m demos.crowd", description="Fill a square with a character.")
        add_arguments(parser)
        parser.add_argument("--count", type=int, default=1000, metavar="N", help="how many (1000)")
        parsed, options = parse(parser, arguments)
        if not 0 <= parsed.count <= MAX_COUNT:
            raise DemoError(f"--count {parsed.count}: between 0 and {MAX_COUNT}")
        (draw_picture if options.headless else show_window)(options, parsed.count)

    return run("crowd", work)


if __name__ == "__main__":
    sys.exit(main())
