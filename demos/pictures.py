"""Pictures made of several: drawn one by one in a studio, labelled, and set side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from demos.headless import Canvas
from demos.stage import Stage
from runtime.render.renderer import Renderer
from runtime.render.views import VIEWS
from runtime.scene.actor import Actor
from runtime.scene.camera import Camera

Pixels = NDArray[np.uint8]

PAPER = (242, 243, 245)
INK = (40, 44, 52)


class Studio:
    """Draws actors of one context into pictures of any size.

    Parameters
    ----------
    ctx : moderngl.Context
    renderer : Renderer, optional
        One with settings of its own.
    """

    def __init__(self, ctx: moderngl.Context, renderer: Renderer | None = None) -> None:
        self.ctx = ctx
        self.renderer = renderer or Renderer(ctx)
        self._stage = Stage(ctx)

    def picture(
        self,
        actors: Sequence[Actor],
        camera: Camera,
        size: tuple[int, int],
        *,
        floor: ArrayLike | None = None,
        view: str = "lit",
        lod: int | str = "auto",
        tessellation: float | str = "off",
        finer: int = 1,
    ) -> Pixels:
        """Draw one picture, (H, W, 3) uint8.

        Parameters
        ----------
        actors : sequence of Actor
        camera : Camera
        size : (width, height)
        floor : (2, 3) float, optional
            Box of the actors at rest: lit pictures get a backdrop, and a floor under it.
        view, lod, tessellation
            As for `Renderer.draw`.
        finer : int
            Drawn so many times as large and averaged: smooth edges in views without multisampling, and finer detail.
        """
        width, height = size
        canvas = Canvas(self.ctx, (width * finer, height * finer), VIEWS[view].is_lit)
        with canvas.drawing((PAPER[0] / 255, PAPER[1] / 255, PAPER[2] / 255, 1.0)):
            if floor is not None and VIEWS[view].is_lit:
                self._stage.draw(canvas.framebuffer, self.renderer, actors, camera, floor)
            self.renderer.draw(actors, camera, view=view, lod=lod, tessellation=tessellation)
        pixels = canvas.pixels()[..., :3].copy()
        canvas.release()
        if finer == 1:
            return pixels
        cells = pixels.reshape(height, finer, width, finer, 3).astype(np.float32)
        result: Pixels = np.rint(cells.mean(axis=(1, 3))).astype(np.uint8)
        return result

    def fit(self, actors: Sequence[Actor], camera: Camera, size: tuple[int, int], fill: float = 0.86) -> Camera:
        """Move a camera sideways, nearer or away until the actors fill a share of the picture, in its middle."""
        for _ in range(4):
            shown = self.picture(actors, camera, (size[0] // 4, size[1] // 4), view="mask")
            paper = np.abs(shown.astype(int) - PAPER).max(axis=2) <= 2
            rows, columns = np.flatnonzero(~paper.all(axis=1)), np.flatnonzero(~paper.all(axis=0))
            if not len(rows):
                return camera
            low = np.array([columns[0], rows[0]]) / shown.shape[1::-1]
            high = np.array([columns[-1] + 1, rows[-1] + 1]) / shown.shape[1::-1]
            middle, extent = low + high - 1.0, float((high - low).max())
            eye, target = np.asarray(camera.eye), np.asarray(camera.target)
            matrices = camera.matrices(*size)
            distance = float(np.linalg.norm(eye - target))
            half = distance * np.tan(np.radians(camera.fovy_deg) / 2) * np.array([size[0] / size[1], 1.0])
            shift = middle[0] * half[0] * matrices.rotation[0] - middle[1] * half[1] * matrices.rotation[1]
            away = (eye - target) * extent / fill
            target = target + shift
            camera = dataclasses.replace(camera, eye=tuple(target + away), target=tuple(target))
        return camera

    def release(self) -> None:
        """Free everything. May be called more than once."""
        self._stage.release()
        self.renderer.release()


def label(pixels: Pixels, text: str, *, size_px: int = 22, at: tuple[float, float] | None = None) -> Pixels:
    """The picture with a line of text on a plate: in its lower left corner, or with its upper middle at a point."""
    image = Image.fromarray(pixels)
    font = ImageFont.load_default(size_px)
    left, top, right, bottom = font.getbbox(text)
    pad = 0.35 * size_px
    width, height = right - left + 2 * pad, bottom - top + 2 * pad
    x, y = (0.5 * size_px, pixels.shape[0] - height - 0.5 * size_px) if at is None else (at[0] - width / 2, at[1])
    x = min(max(x, 2.0), pixels.shape[1] - width - 2.0)
    pen = ImageDraw.Draw(image, "RGBA")
    pen.rounded_rectangle((x, y, x + width, y + height), radius=pad, fill=(*PAPER, 215))
    pen.text((x + pad - left, y + pad - top), text, fill=INK, font=font)
    return np.asarray(image)


def side_by_side(rows: Sequence[Sequence[Pixels]], gap_px: int = 8) -> Pixels:
    """Rows of equally high pictures, one under the other, on paper; short rows are centred."""
    bands = []
    for row in rows:
        parts: list[Pixels] = []
        for pixels in row:
            parts += [np.full((pixels.shape[0], gap_px, 3), PAPER, np.uint8), pixels]
        bands.append(np.concatenate(parts[1:], axis=1))
    width = max(band.shape[1] for band in bands)
    sheet: list[Pixels] = []
    for band in bands:
        whole = np.full((band.shape[0], width, 3), PAPER, np.uint8)
        left = (width - band.shape[1]) // 2
        whole[:, left : left + band.shape[1]] = band
        sheet += [np.full((gap_px, width, 3), PAPER, np.uint8), whole]
    return np.concatenate(sheet[1:], axis=0)
