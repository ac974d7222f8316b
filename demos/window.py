"""A GLFW window with an OpenGL context, for the demos. The runtime itself never opens one."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any

import moderngl

from demos.errors import DemoError

VERSIONS = ((4, 1), (3, 3))


class Window:
    """Opens in the constructor, closes at the end of a `with` block.

    Attributes
    ----------
    ctx : moderngl.Context
    on_key : function of a key's name ("space", "left", "a", "1" ...)
    on_drag : function of dx, dy and whether to move (then they are pixels) instead of to turn (screen units)
    on_scroll : function of steps
    on_drop : function of the paths of files that were dropped on the window
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        try:
            import glfw
        except ImportError:
            raise DemoError(
                'windows need GLFW: pip install "seamskin[demos]", or use --headless --out FILE.png'
            ) from None
        self._glfw = glfw
        self.on_key: Callable[[str], None] = lambda name: None
        self.on_drag: Callable[[float, float, bool], None] = lambda dx, dy, move: None
        self.on_scroll: Callable[[float], None] = lambda steps: None
        self.on_drop: Callable[[list[str]], None] = lambda paths: None
        glfw.ERROR_REPORTING = "ignore"
        if not glfw.init():
            raise DemoError("no display to open a window on: use --headless --out FILE.png")
        self._window: Any = None
        for major, minor in VERSIONS:
            glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, major)
            glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, minor)
            glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
            glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
            glfw.window_hint(glfw.SAMPLES, 4)
            self._window = glfw.create_window(*size, title, None, None)
            if self._window:
                break
        if not self._window:
            glfw.terminate()
            raise DemoError("no window with OpenGL 3.3 could be opened: update the graphics driver, or use --headless")
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)
        self.ctx = moderngl.create_context()
        self._first = True
        self._cursor = (0.0, 0.0)
        glfw.set_key_callback(self._window, self._key)
        glfw.set_scroll_callback(self._window, lambda _, dx, dy: self.on_scroll(dy))
        glfw.set_cursor_pos_callback(self._window, self._moved)
        dropped: Any = self._dropped
        glfw.set_drop_callback(self._window, dropped)

    def _key(self, _: Any, key: int, scancode: int, action: int, mods: int) -> None:
        glfw = self._glfw
        if action == glfw.RELEASE:
            return
        named = {glfw.KEY_SPACE: "space", glfw.KEY_LEFT: "left", glfw.KEY_RIGHT: "right"}
        if key == glfw.KEY_ESCAPE:
            glfw.set_window_should_close(self._window, True)
        else:
            self.on_key(named.get(key) or glfw.get_key_name(key, scancode) or "")

    def _dropped(self, _: Any, paths: list[str]) -> None:
        self.on_drop(list(paths))

    def _moved(self, _: Any, x: float, y: float) -> None:
        glfw = self._glfw
        dx, dy = x - self._cursor[0], y - self._cursor[1]
        self._cursor = (x, y)
        left = glfw.get_mouse_button(self._window, glfw.MOUSE_BUTTON_LEFT)
        other = any(glfw.get_mouse_button(self._window, b) for b in (glfw.MOUSE_BUTTON_RIGHT, glfw.MOUSE_BUTTON_MIDDLE))
        shift = glfw.get_key(self._window, glfw.KEY_LEFT_SHIFT) or glfw.get_key(self._window, glfw.KEY_RIGHT_SHIFT)
        if left or other:
            move = bool(other or shift)
            # What is moved follows the pointer by pixels, two a screen unit on Retina; turning follows the hand.
            scale = self.size[0] / max(glfw.get_window_size(self._window)[0], 1) if move else 1.0
            self.on_drag(dx * scale, dy * scale, move)

    @property
    def handle(self) -> Any:
        """GLFW's window."""
        return self._window

    @property
    def framebuffer(self) -> moderngl.Framebuffer:
        """What is shown, with a viewport as large as the window is now."""
        framebuffer = self.ctx.screen
        framebuffer.viewport = (0, 0, *self._glfw.get_framebuffer_size(self._window))
        return framebuffer

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        width, height = self._glfw.get_framebuffer_size(self._window)
        return width, height

    def set_title(self, title: str) -> None:
        """Change the title."""
        self._glfw.set_window_title(self._window, title)

    def next_frame(self) -> bool:
        """Show what was drawn and take in events; False when the window was closed."""
        if not self._first:
            self._glfw.swap_buffers(self._window)
        self._first = False
        self._glfw.poll_events()
        while not all(self.size) and not self._glfw.window_should_close(self._window):
            self._glfw.wait_events()  # minimised: nothing to draw on
        return not self._glfw.window_should_close(self._window)

    def __enter__(self) -> Window:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.ctx.release()
        self._glfw.destroy_window(self._window)
        self._glfw.terminate()
