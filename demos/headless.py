"""Pictures without a window: a context of our own, an offscreen framebuffer, a PNG file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from demos.errors import DemoError

SAMPLES = 8  # of multisampling where smooth edges suit the picture


def create_context() -> moderngl.Context:
    """A standalone context that needs no display: EGL on Linux, the system's own elsewhere.

    Raises
    ------
    DemoError
        If this machine has none to give.
    """
    settings: dict[str, Any] = {"backend": "egl"} if sys.platform.startswith("linux") else {}
    try:
        return moderngl.create_context(standalone=True, **settings)
    except Exception as error:  # the backend raises its bare Exception whatever is missing
        reason = str(error).splitlines()[0]
        advice = "install libegl1, libgl1 and libgl1-mesa-dri" if settings else "update the graphics driver"
        raise DemoError(f"no headless OpenGL ({reason}): {advice}, or open a window") from None


class Canvas:
    """An offscreen framebuffer that multisamples, or not.

    Parameters
    ----------
    ctx : moderngl.Context
    size : (int, int)
        Width and height, pixels.
    smooth : bool
        Whether edges are multisampled.

    Attributes
    ----------
    samples : int
        A pixel, 0 without multisampling.
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int], smooth: bool = True) -> None:
        self.size = size
        self.samples = min(SAMPLES, ctx.max_samples) if smooth else 0
        self._ctx = ctx
        self._color = ctx.renderbuffer(size, 4, samples=self.samples)
        self._depth = ctx.depth_renderbuffer(size, samples=self.samples)
        self.framebuffer = ctx.framebuffer([self._color], self._depth)
        self._resolved = ctx.simple_framebuffer(size, 4) if self.samples else None

    @contextmanager
    def drawing(self, background: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)) -> Iterator[None]:
        """Bind and clear it; what is drawn inside the `with` block lands in it."""
        self.framebuffer.use()
        self.framebuffer.clear(*background, depth=1.0)
        yield

    def pixels(self) -> NDArray[np.uint8]:
        """The picture, (H, W, 4) uint8, row 0 at the top."""
        source = self.framebuffer
        if self._resolved is not None:
            self._ctx.copy_framebuffer(self._resolved, self.framebuffer)
            source = self._resolved
        data = source.read(components=4, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(self.size[1], self.size[0], 4)[::-1].copy()

    def release(self) -> None:
        """Free the buffers. May be called more than once."""
        for thing in (self.framebuffer, self._color, self._depth):
            thing.release()
        if self._resolved is not None:
            attachments = (*self._resolved.color_attachments, self._resolved.depth_attachment)
            self._resolved.release()
            for attachment in attachments:
                if attachment is not None:
                    attachment.release()
            self._resolved = None


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write a picture, (H, W, 3 or 4) uint8, whole or not at all.

    Raises
    ------
    DemoError
        If it cannot be written.
    """
    import OpenImageIO as oiio

    path = path.expanduser()
    if path.suffix.lower() != ".png":
        raise DemoError(f"{path}: pictures are written as PNG; end the name with .png")
    temporary = path.with_name(f".{path.stem}.part.png")
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("oiio:ColorSpace", "sRGB")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = oiio.ImageOutput.create(str(temporary))
        if writer is None or not writer.open(str(temporary), spec):
            raise DemoError(f"cannot write {path}: is the folder writable?")
        written = writer.write_image(np.ascontiguousarray(pixels))
        closed = writer.close()
        if not (written and closed):
            raise DemoError(f"cannot write {path}: {writer.geterror().strip() or 'disk full?'}")
        temporary.replace(path)
    except OSError as error:
        raise DemoError(f"cannot write {path}: {error.strerror}") from None
    finally:
        temporary.unlink(missing_ok=True)
