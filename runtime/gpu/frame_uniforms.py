"""What is the same for everything in one picture, on the GPU: the frame's uniform block and the map of reflections.

The block's words are those of `shaders/include/frame.glsl`.
"""

from __future__ import annotations

import moderngl
import numpy as np

from runtime.gpu.environment_map import light_map
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.scene.camera import CameraMatrices
from runtime.scene.lighting import Lighting
from runtime.scene.lod_selection import Quality

FRAME_BINDING = 0
FRAME_ROWS = 9  # vec4 in the block
RGB9_E5 = 0x8C3D  # three channels that share an exponent, in 32 bits: half as long to filter as half floats
MAX_FACTOR = 64.0  # every OpenGL with tessellation has it


class FrameBlock:
    """The frame's uniform block and the map of reflections of one renderer.

    Parameters
    ----------
    ctx : moderngl.Context
    lighting : Lighting
    """

    def __init__(self, ctx: moderngl.Context, lighting: Lighting) -> None:
        self.ctx = ctx
        self._block = ctx.buffer(reserve=16 * FRAME_ROWS, dynamic=True)
        self._reflection: moderngl.Texture | None = None
        self._words = np.zeros((FRAME_ROWS, 4), np.float32)
        self._written: Lighting | None = None
        self.upload_lighting(lighting)

    def upload_lighting(self, lighting: Lighting) -> None:
        """Fill the map of light by direction."""
        texels = light_map(lighting.environment)
        if self._reflection is None:
            rows, columns, _ = texels.shape
            self._reflection = self.ctx.texture((columns, rows), 3, dtype="f4", internal_format=RGB9_E5)
            self._reflection.filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._reflection.repeat_x = self._reflection.repeat_y = False
        self._reflection.write(texels)

    def write(
        self, matrices: CameraMatrices, size_px: tuple[int, int], lighting: Lighting, quality: Quality, factor: float
    ) -> None:
        """Fill the block for a picture; `factor` divides every tessellated edge, 0 for as its length on screen asks."""
        frame, words = self._words, self._words.ravel()
        frame[0:4] = matrices.clip_from_world.T
        frame[4, :3] = matrices.eye
        words[20], words[21] = size_px  # few numbers are quicker one by one
        words[22], words[23] = matrices.focal_px(*size_px), matrices.is_perspective
        if lighting is not self._written:
            sun = np.asarray(lighting.sun_direction, np.float64)
            frame[6, :3] = sun / max(float(np.linalg.norm(sun)), 1e-30)
            frame[7] = *lighting.sun_color, lighting.exposure
            self._written = lighting
        words[32], words[33] = quality.segment_px, MAX_FACTOR
        words[34], words[35] = factor, quality.texels_a_segment
        self._block.write(frame)

    def bind(self) -> None:
        """Put block and map where all programs expect them."""
        assert self._reflection is not None
        self._block.bind_to_uniform_block(FRAME_BINDING)
        self._reflection.use(TEXTURE_UNITS["reflection_texture"])

    def release(self) -> None:
        """Free both."""
        self._block.release()
        if self._reflection is not None:
            self._reflection.release()
