"""Samples of a source image through its own sampler rules: wrap modes, filtering, KHR_texture_transform.

A target texel that covers several source texels averages a grid of samples over its footprint; one that covers less
than one reads a bilinear sample, as the GPU would.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.numerics.jit import entry, helper

WRAP_CODES = {"REPEAT": 0, "CLAMP_TO_EDGE": 1, "MIRRORED_REPEAT": 2}
MAX_SAMPLES = 8  # a side of the grid over one target texel: beyond it the source is 8 times denser than asked for


def sample_footprints(
    texels: NDArray[np.floating],
    uvs: NDArray[np.float64],
    uv_dx: NDArray[np.float64],
    uv_dy: NDArray[np.float64],
    wrap_s: str,
    wrap_t: str,
    nearest: bool,
) -> NDArray[np.float64]:
    """Average an image over the parallelogram that each target texel covers in it.

    Parameters
    ----------
    texels : (h, w, C) float
        In linear light where it is a colour.
    uvs : (N, 2) float64
        Source coordinates of the target texels' centres.
    uv_dx, uv_dy : (N, 2) float64
        Change of the source coordinates over one target texel to the right and down.
    wrap_s, wrap_t : str
        glTF wrap modes: REPEAT, CLAMP_TO_EDGE or MIRRORED_REPEAT.
    nearest : bool
        Whether the sampler magnifies without filtering.

    Returns
    -------
    (N, C) float64
    """
    result = np.zeros((len(uvs), texels.shape[2]))
    source = np.ascontiguousarray(texels, np.float32)
    _sample_footprints(
        source,
        np.ascontiguousarray(uvs, np.float64),
        np.ascontiguousarray(uv_dx, np.float64),
        np.ascontiguousarray(uv_dy, np.float64),
        WRAP_CODES[wrap_s],
        WRAP_CODES[wrap_t],
        nearest,
        result,
    )
    return result


@helper
def _wrap(i, size, code):  # type: ignore[no-untyped-def]
    if code == 1:
        return min(max(i, 0), size - 1)
    if code == 2:
        i = i % (2 * size)
        return i if i < size else 2 * size - 1 - i
    return i % size


@entry
def _sample_footprints(texels, uvs, uv_dx, uv_dy, wrap_s, wrap_t, nearest, result):  # type: ignore[no-untyped-def]
    height, width, channels = texels.shape
    for n in range(len(uvs)):
        span_x = max(abs(uv_dx[n, 0]) * width, abs(uv_dx[n, 1]) * height)
        span_y = max(abs(uv_dy[n, 0]) * width, abs(uv_dy[n, 1]) * height)
        grid_x = min(MAX_SAMPLES, max(1, int(np.ceil(span_x - 0.1))))
        grid_y = min(MAX_SAMPLES, max(1, int(np.ceil(span_y - 0.1))))
        scale = 1.0 / (grid_x * grid_y)
        for gy in range(grid_y):
            for gx in range(grid_x):
                ox, oy = (gx + 0.5) / grid_x - 0.5, (gy + 0.5) / grid_y - 0.5
                u = (uvs[n, 0] + ox * uv_dx[n, 0] + oy * uv_dy[n, 0]) * width
                v = (uvs[n, 1] + ox * uv_dx[n, 1] + oy * uv_dy[n, 1]) * height
                if nearest:
                    i, j = _wrap(int(np.floor(u)), width, wrap_s), _wrap(int(np.floor(v)), height, wrap_t)
                    for c in range(channels):
                        result[n, c] += scale * texels[j, i, c]
                    continue
                x, y = np.floor(u - 0.5), np.floor(v - 0.5)
                fx, fy = u - 0.5 - x, v - 0.5 - y
                i0, i1 = _wrap(int(x), width, wrap_s), _wrap(int(x) + 1, width, wrap_s)
                j0, j1 = _wrap(int(y), height, wrap_t), _wrap(int(y) + 1, height, wrap_t)
                for c in range(channels):
                    top = texels[j0, i0, c] * (1.0 - fx) + texels[j0, i1, c] * fx
                    bottom = texels[j1, i0, c] * (1.0 - fx) + texels[j1, i1, c] * fx
                    result[n, c] += scale * (top * (1.0 - fy) + bottom * fy)
