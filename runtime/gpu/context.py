"""Which OpenGL context is current in this thread: drawing without one, or in somebody else's, fails without a word.

GL itself answers a call without a current context by doing nothing, and one in the wrong context by mixing up objects
that happen to have the same number. So the platform is asked before anything is made or drawn.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from runtime.errors import RenderError

if TYPE_CHECKING:
    import moderngl

# Function that names the current context, and where it lies. On Linux a context is EGL's or GLX's.
_QUESTIONS = {
    "darwin": (("/System/Library/Frameworks/OpenGL.framework/OpenGL", "CGLGetCurrentContext"),),
    "win32": (("opengl32", "wglGetCurrentContext"),),
    "linux": (
        ("libEGL.so.1", "eglGetCurrentContext"),
        ("libGL.so.1", "glXGetCurrentContext"),
        ("libGLX.so.0", "glXGetCurrentContext"),
    ),
}
_KNOWN: WeakKeyDictionary[moderngl.Context, int] = WeakKeyDictionary()


@lru_cache(maxsize=1)
def _questions() -> tuple[Callable[[], int | None], ...]:
    """The platform's functions, those that it has."""
    found: dict[str, Callable[[], int | None]] = {}
    for library, name in _QUESTIONS.get(sys.platform, ()):
        try:
            function = getattr(ctypes.PyDLL(library), name)  # so short a call keeps Python's lock
        except (OSError, AttributeError):
            continue
        function.restype, function.argtypes = ctypes.c_void_p, []
        found.setdefault(name, function)
    return tuple(found.values())


def current_context() -> int | None:
    """A number for the context that is current in this thread: 0 for none, None where the platform cannot be asked."""
    questions = _questions()
    if not questions:
        return None
    for ask in questions:
        handle = ask()
        if handle:
            return handle
    return 0


def is_gone(ctx: moderngl.Context) -> bool:
    """Whether a context was released."""
    return type(ctx.mglo).__name__ == "InvalidObject"


def can_free(ctx: moderngl.Context, what: str) -> bool:
    """Whether objects of a context can be freed now; False where they went with their context or no context is current.

    Raises
    ------
    RenderError
        While another context is current: its own objects of the same numbers would be freed.
    """
    if is_gone(ctx) or current_context() == 0:
        return False
    require_current(ctx, what)
    return True


def require_current(ctx: moderngl.Context, what: str) -> None:
    """Refuse to go on unless a context is current in this thread: the one that was when it was first asked for.

    Parameters
    ----------
    ctx : moderngl.Context
    what : str
        What needs it, for the message.

    Raises
    ------
    RenderError
    """
    handle = current_context()
    if handle is None:
        return
    if handle == 0:
        raise RenderError(
            f"no OpenGL context is current in this thread, which a {what} needs: use the thread of the window, or make "
            "the context current here"
        )
    if _KNOWN.setdefault(ctx, handle) != handle:
        raise RenderError(f"another context than the {what}'s own is current: make its own current first (with ctx: …)")
