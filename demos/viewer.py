"""Looks at a built character: a window with an orbit camera, or one picture with --headless.

    python -m demos.viewer human.seamless
    python -m demos.viewer human.glb                 a character file: built once, into a cache
    python -m demos.viewer human.seamless --headless --out walk.png --clip walk --time 0.4

In the window: drag turns, the right button (or Shift) moves, the wheel goes nearer; Space pauses, Left and Right change
the clip, 1 to 9 the view, L the level of detail, T tessellation, F frames the character, P saves a picture, H hides the
panel, Esc closes. A folder or a character file that is dropped on the window is opened.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from demos.errors import DemoError
from demos.headless import Canvas, create_context, write_png
from demos.model_cache import built_folder
from demos.options import VIEW_NAMES, Options, Parser, add_arguments, parse, run
from demos.orbit import Orbit
from demos.stage import Stage
from runtime.asset.asset import Asset, load
from runtime.errors import AssetError
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.render.views import VIEWS
from runtime.scene.actor import Actor
from runtime.scene.camera import Camera, framing

LOOK_AGAIN_S = 1.0  # whether the folder was built anew
BUILT_IN = Path("out/demo/creature.seamless")


def find_folder(options: Options) -> Path:
    """The folder that was named, or the built-in character's.

    Raises
    ------
    DemoError
        If none was named and the built-in one is not built yet.
    """
    if options.folder is not None:
        return options.folder
    found = BUILT_IN if BUILT_IN.is_dir() else next(iter(sorted(BUILT_IN.parent.glob("*.seamless"))), None)
    if found is None:
        raise DemoError("no built-in character yet: run ./run demo, or name the folder of a built character")
    return found


def make_actor(model: Model, options: Options) -> Actor:
    """An actor at the moment of the clip that was asked for.

    Raises
    ------
    DemoError
        If the character has no such clip.
    """
    if options.clip is None:
        return model.actor()
    try:
        return model.actor(clip=options.clip, time_s=options.time_s)
    except (ValueError, IndexError):
        names = ", ".join(f"{index} {clip.name}" for index, clip in enumerate(model.asset.clips)) or "none"
        raise DemoError(f"{model.asset.name} has no clip {options.clip!r}; it has: {names}") from None


def choose_camera(model: Model, options: Options) -> Camera:
    """The camera that was asked for; what was left open frames the character."""
    box = model.asset.manifest.bind_bounds
    if options.clip is not None and options.eye is None:
        boxes = model.asset.manifest.clip_bounds
        name = options.clip if isinstance(options.clip, str) else model.asset.clips[options.clip].name
        if name in boxes:  # a clip's box covers all of it: loose, so it counts half
            box = (np.asarray(boxes[name]) + box) / 2
    automatic = framing(box, options.size[0] / options.size[1], options.fovy_deg)
    target = options.target or automatic.target
    eye = options.eye
    if eye is None:
        eye = tuple(np.asarray(automatic.eye) - automatic.target + target)
    return Camera(eye, target, fovy_deg=options.fovy_deg)  # type: ignore[arg-type]


def draw_picture(options: Options) -> None:
    """One picture to a file."""
    asset = load(find_folder(options))
    ctx = create_context()
    try:
        model, renderer = Model(ctx, asset), Renderer(ctx)
        actor = make_actor(model, options)
        camera = choose_camera(model, options)
        smooth = VIEWS[options.view].is_lit
        canvas = Canvas(ctx, options.size, smooth)
        with canvas.drawing():
            if smooth and options.backdrop:
                stage = Stage(ctx)
                stage.draw(canvas.framebuffer, renderer, [actor], camera, asset.manifest.bind_bounds)
            renderer.draw([actor], camera, view=options.view, lod=options.lod, tessellation=options.tessellation)
        assert options.out is not None
        write_png(options.out, canvas.pixels())
    finally:
        ctx.release()


def _made_ns(folder: Path) -> int:
    """When a character was built, as its manifest's time; 0 where it is not there."""
    try:
        return (folder / "manifest.json").stat().st_mtime_ns
    except OSError:
        return 0


class Viewer:
    """The window's contents and what its keys do.

    Attributes
    ----------
    paused, speed, fade_s : bool, float, float
        Of what plays; `fade_s` is the time in which one clip becomes the next.
    view, lod, tessellation
        As `Renderer.draw` takes them.
    wants_picture : bool
        Whether the next frame is kept as a file.
    panel : Panel or None
        Set by the window's loop.
    """

    def __init__(self, window: Any, options: Options) -> None:
        self.renderer = Renderer(window.ctx)
        self.stage = Stage(window.ctx)
        self.window = window
        self.paused, self.speed, self.fade_s = False, 1.0, 0.25
        self.wants_picture = False
        self.panel: Any = None
        self.view, self.lod, self.tessellation = options.view, options.lod, options.tessellation
        self._looked_s = 0.0
        self._open(options, load(find_folder(options)))

    def _open(self, options: Options, asset: Asset) -> None:
        """Show a character in place of the one that was there."""
        self._made_ns = _made_ns(asset.path)
        self.model = Model(self.window.ctx, asset)
        self.options = options
        self.actor = make_actor(self.model, options)
        self.clip = -1
        if options.clip is None and self.model.asset.clips:
            self.play(0)
        self.orbit = Orbit(choose_camera(self.model, options))

    def look_for_changes(self, dt_s: float) -> None:
        """Show the folder again, in the same clip from the same place, where it was built anew meanwhile."""
        self._looked_s += dt_s
        if self._looked_s < LOOK_AGAIN_S:
            return
        self._looked_s = 0.0
        made_ns = _made_ns(self.model.asset.path)
        if made_ns in (0, self._made_ns):
            return
        try:
            asset = load(self.model.asset.path)
        except AssetError:  # half of it is there: look again
            return
        before, clip, time_s, orbit = self.model, self.actor.clip, self.actor.time_s, self.orbit
        self._open(dataclasses.replace(self.options, clip=None), asset)
        if clip in asset.clip_names:
            self.play(asset.clip_names.index(clip))
            self.actor.time_s = time_s
        self.orbit = orbit
        if isinstance(self.lod, int) and self.lod >= len(self.model.lods):
            self.lod = "auto"
        before.release()

    def drop(self, paths: list[str]) -> None:
        """Open the first file or folder that was dropped; what cannot be opened is told on stderr."""
        try:
            options = dataclasses.replace(self.options, folder=built_folder(Path(paths[0])), clip=None, lod="auto")
            asset = load(find_folder(options))
        except (DemoError, AssetError) as error:
            print(f"viewer: {error}", file=sys.stderr)
            return
        before = self.model
        self.lod = "auto"
        self._open(options, asset)
        before.release()

    def play(self, clip: int) -> None:
        """Fade to a clip by its number, around the ends of the list."""
        clips = self.model.asset.clips
        if clips:
            self.clip = clip % len(clips)
            self.actor.play(self.clip, fade_s=self.fade_s, speed=self.speed)

    def key(self, name: str) -> None:
        """Do what a key stands for."""
        levels: list[str | int] = ["auto", *range(len(self.model.lods))]
        if name == "space":
            self.paused = not self.paused
        elif name in ("left", "right"):
            self.play(self.clip + (1 if name == "right" else -1))
        elif name.isdigit() and 1 <= int(name) <= len(VIEW_NAMES):
            self.view = VIEW_NAMES[int(name) - 1]
        elif name == "l":
            self.lod = levels[(levels.index(self.lod) + 1) % len(levels)] if self.lod in levels else "auto"
        elif name == "t":
            steps: list[str | float] = ["auto", "off", 4.0]
            self.tessellation = (
                steps[(steps.index(self.tessellation) + 1) % 3] if self.tessellation in steps else "auto"
            )
        elif name == "f":
            self.orbit = Orbit(choose_camera(self.model, self.options))
        elif name == "p":
            self.wants_picture = True
        elif name == "h" and self.panel is not None:
            self.panel.is_shown = not self.panel.is_shown

    def drag(self, dx_px: float, dy_px: float, move: bool) -> None:
        """Turn the camera, or move it."""
        if move:
            self.orbit.move(dx_px, dy_px, self.window.size[1])
        else:
            self.orbit.turn(dx_px, dy_px)

    def scroll(self, steps: float) -> None:
        """Come nearer or go away."""
        self.orbit.zoom(steps)

    def frame(self, dt_s: float) -> None:
        """Draw one picture into the window."""
        self.look_for_changes(dt_s)
        if not self.paused:
            self.actor.update(dt_s)
        framebuffer = self.window.framebuffer
        framebuffer.use()
        framebuffer.clear(0.0, 0.0, 0.0, 1.0, depth=1.0)
        camera = self.orbit.camera()
        if VIEWS[self.view].is_lit and self.options.backdrop:
            self.stage.draw(framebuffer, self.renderer, [self.actor], camera, self.model.asset.manifest.bind_bounds)
        self.renderer.draw([self.actor], camera, view=self.view, lod=self.lod, tessellation=self.tessellation)
        if self.wants_picture:
            self.wants_picture = False
            self._save_picture()
        if self.panel is not None:
            self.panel.draw(self, dt_s)

    def _save_picture(self) -> None:
        """What the window shows, without the panel, as a file in the current folder that was not there before."""
        width, height = self.window.size
        data = self.window.framebuffer.read(components=3, alignment=1)
        _ = self.window.ctx.error  # moderngl asked for an attachment by a name that a window's buffers do not have
        name = self.model.asset.name
        free = (Path(f"{name}-{number}.png") for number in itertools.count(1))
        path = next(path for path in free if not path.exists())
        write_png(path, np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1])
        print(f"viewer: {path}", file=sys.stderr)

    @property
    def title(self) -> str:
        """What the window's title says."""
        drawn = self.renderer.last_drawn.get(self.actor)
        level = "-" if drawn is None or drawn.level < 0 else drawn.level
        return f"{self.model.asset.name} - {self.actor.clip or 'at rest'} - {self.view} - level {level}"

    def release(self) -> None:
        """Free everything on the GPU."""
        if self.panel is not None:
            self.panel.release()
        self.stage.release()
        self.renderer.release()
        self.model.release()


def show_window(options: Options) -> None:
    """Run the window until it is closed."""
    from demos.window import Window

    with Window("seamskin", options.size) as window:
        viewer = Viewer(window, options)
        window.on_key, window.on_drag, window.on_scroll = viewer.key, viewer.drag, viewer.scroll
        window.on_drop = viewer.drop
        if options.panel:
            from demos.panel import Panel

            viewer.panel = Panel(window)
        last = time.perf_counter()
        try:
            while window.next_frame():
                now = time.perf_counter()
                viewer.frame(now - last)
                window.set_title(f"{viewer.title} - {1e3 * (now - last):.1f} ms")
                last = now
        finally:
            viewer.release()


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.viewer`."""

    def work() -> None:
        parser = Parser("python -m demos.viewer", description="Look at a built character.")
        add_arguments(parser)
        _, options = parse(parser, arguments)
        (draw_picture if options.headless else show_window)(options)

    return run("viewer", work)


if __name__ == "__main__":
    sys.exit(main())
