"""A walkable scene in moderngl-window: python -m demos.embed_moderngl_window [DIR].

Arrow keys or WASD walk and turn, Esc closes. The library owns window, context and loop; the runtime is only ever given
the context. With --frames N it walks by itself for N frames (and --out FILE.png keeps the last).
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Any

from demos.embedding import EmbedOptions, Scripted, parse_arguments, save_picture
from demos.extras import needs_packages
from demos.options import run
from demos.walk_scene import WalkScene

with needs_packages(__name__, "embed_moderngl_window"):
    import moderngl_window


class WalkWindow(moderngl_window.WindowConfig):  # type: ignore[misc, name-defined]
    """The scene as moderngl-window wants it."""

    gl_version = (4, 1)
    title = "seamskin in moderngl-window"
    samples = 4
    log_level = logging.WARNING
    aspect_ratio = None  # type: ignore[assignment]  # follow the window
    options: EmbedOptions

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.scene = WalkScene(self.ctx, self.options.folder)
        self.scripted = Scripted(self.options.frames)
        self.pressed: set[Any] = set()

    def on_key_event(self, key: Any, action: Any, modifiers: Any) -> None:
        """Keys to directions."""
        keys = self.wnd.keys
        (self.pressed.add if action == keys.ACTION_PRESS else self.pressed.discard)(key)

        def down(*wanted: Any) -> int:
            return int(any(key in self.pressed for key in wanted))

        forward = down(keys.UP, keys.W) - down(keys.DOWN, keys.S)
        self.scene.steer(forward, down(keys.LEFT, keys.A) - down(keys.RIGHT, keys.D))

    def on_render(self, time: float, frame_time: float) -> None:
        """One frame."""
        self.scene.update(self.scripted.next_step(self.scene, frame_time))
        self.scene.draw(self.wnd.fbo)
        if self.scripted.finished:
            save_picture(self.options.out, self.wnd.fbo)
            self.wnd.close()

    def on_close(self) -> None:
        """The window goes, and so does everything on the GPU."""
        self.scene.release()


def play(arguments: Sequence[str] | None) -> None:
    """Hand the loop over."""
    WalkWindow.options = parse_arguments("python -m demos.embed_moderngl_window", arguments)
    WalkWindow.window_size = WalkWindow.options.size
    moderngl_window.run_window_config(WalkWindow, args=["--window", WalkWindow.options.window])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.embed_moderngl_window`."""
    return run("embed_moderngl_window", lambda: play(arguments))


if __name__ == "__main__":
    sys.exit(main())
