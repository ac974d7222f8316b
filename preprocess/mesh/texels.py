"""The one rule that ties uv to texels, on the CPU. Its GLSL twin is shaders/include/texels.glsl.

uv follows glTF: origin at the top left of the image, v down. Texel (column i, row j) of a W x H image has its
centre at ((i + 1/2) / W, (j + 1/2) / H). Samples outside the outermost centres clamp to the edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.asset.lod_mesh import UV_STEPS

FloatArray = NDArray[np.floating]


def uv_to_px(uvs: FloatArray, width: int, height: int) -> NDArray[np.float64]:
    """Continuous texel coordinates in which the centre of texel (i, j) is exactly (i, j).

    Parameters
    ----------
    uvs : (..., 2) float
    width, height : int
        Size of the image in texels.

    Returns
    -------
    (..., 2) float64
    """
    return np.asarray(uvs, np.float64) * (width, height) - 0.5


def px_to_uv(points_px: FloatArray, width: int, height: int) -> NDArray[np.float64]:
    """Inverse of `uv_to_px`, (..., 2) float to (..., 2) float64."""
    return (np.asarray(points_px, np.float64) + 0.5) / (width, height)


def bilinear_stencil(uvs: FloatArray, width: int, height: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The four texels that a bilinear sample reads, and their weights.

    Parameters
    ----------
    uvs : (N, 2) float
    width, height : int

    Returns
    -------
    texels : (N, 4) int64
        Flat indices `row * width + column`, in the order (0,0), (1,0), (0,1), (1,1) of (column, row).
    weights : (N, 4) float64
        Non-negative, each row sums to one.
    """
    px = uv_to_px(uvs, width, height)
    px = np.clip(px, 0.0, (width - 1, height - 1))
    corner = np.minimum(np.floor(px).astype(np.int64), (max(width - 2, 0), max(height - 2, 0)))
    fx, fy = (px - corner).T
    x0, y0 = corner.T
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    texels = np.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1], axis=1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    return texels, weights


def sample_bilinear(image: FloatArray, uvs: FloatArray) -> NDArray[np.float64]:
    """Bilinear samples of an image, clamped at its edge.

    Parameters
    ----------
    image : (H, W, C) float
    uvs : (N, 2) float

    Returns
    -------
    (N, C) float64
    """
    height, width, channels = image.shape
    texels, weights = bilinear_stencil(uvs, width, height)
    flat = np.asarray(image, np.float64).reshape(-1, channels)
    result: NDArray[np.float64] = np.einsum("nk,nkc->nc", weights, flat[texels])
    return result


def snap_canonical_uvs(uvs: FloatArray) -> NDArray[np.float64]:
    """Where geometry is fetched for texture vertices: the nearest uv in [0, 1] that 16 bits can say, (N, 2)."""
    return np.rint(np.clip(np.asarray(uvs, np.float64), 0.0, 1.0) * UV_STEPS) / UV_STEPS
