"""A model, a renderer and somewhere to draw: what tests of drawing share."""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np

from runtime.asset.asset import Asset
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.scene.camera import framing

SIDE_PX = 96


class Scene:
    """A model, a renderer and somewhere to draw."""

    def __init__(self, ctx: moderngl.Context, asset: Asset, **options: Any) -> None:
        self.ctx = ctx
        self.model, self.renderer = Model(ctx, asset), Renderer(ctx, **options)
        self.framebuffer = ctx.simple_framebuffer((SIDE_PX, SIDE_PX), 4)
        self.camera = framing(asset.manifest.bind_bounds)

    def picture(self, actors: Any, camera: Any = None, **how: Any) -> np.ndarray:
        """(H, W, 4) uint8, row 0 at the top."""
        self.framebuffer.use()
        self.framebuffer.clear(depth=1.0)
        self.renderer.draw(actors, camera or self.camera, **how)
        data = self.framebuffer.read(components=4)
        return np.frombuffer(data, np.uint8).reshape(SIDE_PX, SIDE_PX, 4)[::-1].astype(int)

    def release(self) -> None:
        self.model.release()
        self.renderer.release()
        for thing in (*self.framebuffer.color_attachments, self.framebuffer.depth_attachment, self.framebuffer):
            thing.release()
