"""What is the same for everything in one picture, on the GPU: the frame's uniform block and the map of reflections.

Every field of `FRAME` is a member of the block in `shaders/include/frame.glsl`.
"""

from __future__ import annotations

import moderngl
import numpy as np

from runtime.gpu.environment_map import prefiltered_map
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.scene.camera import CameraMatrices
from runtime.scene.lighting import Lighting
from runtime.scene.lod_selection import Quality

FRAME_BINDING = 0
# The members in GLSL's layout std140, in which a vec3 and the number after it share sixteen bytes.
FRAME = np.dtype(
    [
        ("clip_from_world", "<f4", (4, 4)),  # a column of mathematics in each row
        ("eye", "<f4", 3),
        ("pixels_per_metre", "<f4"),
        ("sun_direction", "<f4", 3),
        ("exposure", "<f4"),
        ("sun_color", "<f4", 3),
        ("depth_per_metre", "<f4"),
        ("fixed_factor", "<f4"),
        ("largest_factor", "<f4"),
        ("segment_px", "<f4"),
        ("texels_per_segment", "<f4"),
    ]
)
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
        self._block = ctx.buffer(reserve=FRAME.itemsize, dynamic=True)
        self._reflection: moderngl.Texture | None = None
        self._values = np.zeros((), FRAME)
        self._written: Lighting | None = None
        self.upload_lighting(lighting)

    def upload_lighting(self, lighting: Lighting) -> None:
        """Fill the map of light by direction."""
        texels = prefiltered_map(lighting.environment)
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
        values = self._values
        values["clip_from_world"] = matrices.clip_from_world.T
        values["eye"] = matrices.eye
        values["pixels_per_metre"] = matrices.focal_px(*size_px)
        values["depth_per_metre"] = matrices.depth_per_metre
        if lighting is not self._written:
            sun = np.asarray(lighting.sun_direction, np.float64)
            values["sun_direction"] = sun / max(float(np.linalg.norm(sun)), 1e-30)
            values["sun_color"], values["exposure"] = lighting.sun_color, lighting.exposure
            self._written = lighting
        values["fixed_factor"], values["largest_factor"] = factor, MAX_FACTOR
        values["segment_px"], values["texels_per_segment"] = quality.segment_px, quality.texels_per_segment
        self._block.write(values)

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
