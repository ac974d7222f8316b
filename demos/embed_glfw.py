"""A walkable scene in a GLFW window: python -m demos.embed_glfw [DIR].

Arrow keys or WASD walk and turn, Esc closes. The window, its context and its events are this file's; the runtime is
only ever given the context. With --frames N it walks by itself for N frames (and --out FILE.png keeps the last).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import moderngl

from demos.embedding import Scripted, parse_arguments, save_picture
from demos.errors import DemoError
from demos.extras import needs_packages
from demos.options import run
from demos.walk_scene import WalkScene

with needs_packages(__name__, "embed_glfw"):
    import glfw


def open_window(size: tuple[int, int]) -> Any:
    """A window with an OpenGL 4.1 core context, current."""
    if not glfw.init():
        raise DemoError("GLFW finds no display to open a window on")
    glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 4)
    glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 1)
    glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
    glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
    glfw.window_hint(glfw.SAMPLES, 4)
    window = glfw.create_window(*size, "seamskin in GLFW", None, None)
    if not window:
        glfw.terminate()
        raise DemoError("no window with OpenGL 4.1 could be opened: update the graphics driver")
    glfw.make_context_current(window)
    glfw.swap_interval(1)
    return window


def steer(scene: WalkScene, window: Any) -> None:
    """Keys to directions."""

    def down(*keys: int) -> int:
        return int(any(glfw.get_key(window, key) == glfw.PRESS for key in keys))

    forward = down(glfw.KEY_UP, glfw.KEY_W) - down(glfw.KEY_DOWN, glfw.KEY_S)
    scene.steer(forward, down(glfw.KEY_LEFT, glfw.KEY_A) - down(glfw.KEY_RIGHT, glfw.KEY_D))


def play(arguments: Sequence[str] | None) -> None:
    """The game loop."""
    options = parse_arguments("python -m demos.embed_glfw", arguments)
    window = open_window(options.size)
    try:
        ctx = moderngl.create_context()  # wraps the window's context
        scene = WalkScene(ctx, options.folder)
        scripted = Scripted(options.frames)
        last = time.perf_counter()
        while not glfw.window_should_close(window) and glfw.get_key(window, glfw.KEY_ESCAPE) != glfw.PRESS:
            now = time.perf_counter()
            steer(scene, window)
            scene.update(scripted.next_step(scene, now - last))
            last = now
            screen = ctx.detect_framebuffer()
            screen.viewport = (0, 0, *glfw.get_framebuffer_size(window))
            scene.draw(screen)
            if scripted.finished:
                save_picture(options.out, screen)
                break
            glfw.swap_buffers(window)
            glfw.poll_events()
        scene.release()
        ctx.release()
    finally:
        glfw.terminate()


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.embed_glfw`."""
    return run("embed_glfw", lambda: play(arguments))


if __name__ == "__main__":
    sys.exit(main())
