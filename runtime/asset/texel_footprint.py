"""What a mesh reads of a texture: which 2 x 2 cells, those that a triangle touches in the atlas; and bilinear samples.

Letters in shapes: N vertices, F faces, P pairs of a triangle and a cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROUNDING_PX = 1e-3  # places between vertices are blended in 32 bits: triangles may reach so much further


def touched_cells(
    uvs: NDArray[np.floating], triangles: NDArray[np.integer], size: tuple[int, int]
) -> NDArray[np.bool_]:
    """Cells under triangles, with a little room for rounding.

    Parameters
    ----------
    uvs : (N, 2) float
    triangles : (F, 3) int
    size : (W, H)
        Of the texture, texels.

    Returns
    -------
    (max(H - 1, 1), max(W - 1, 1)) bool
        Cell (row, column) lies between the centres of its four texels.
    """
    num_cells = np.maximum(np.array(size) - 1, 1)
    touched = np.zeros((num_cells[1], num_cells[0]), bool)
    if not len(triangles):
        return touched
    px = np.clip(np.asarray(uvs, np.float64) * size - 0.5, 0.0, np.array(size) - 1.0)
    corners = px[triangles]
    first = np.clip(np.floor(corners.min(axis=1) - ROUNDING_PX).astype(np.int64), 0, num_cells - 1)
    last = np.clip(np.floor(corners.max(axis=1) + ROUNDING_PX).astype(np.int64), 0, num_cells - 1)
    extent = last - first + 1
    counts = extent.prod(axis=1)
    face = np.repeat(np.arange(len(triangles)), counts)
    number = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    row, column = np.divmod(number, extent[face, 0])
    row, column = row + first[face, 1], column + first[face, 0]
    apart = np.zeros(len(face), bool)
    edges = np.roll(corners, -1, axis=1) - corners
    turn = np.sign(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    for side in range(3):  # a cell wholly beyond an edge's line is not touched
        inwards = np.stack([-edges[:, side, 1], edges[:, side, 0]], axis=1) * turn[:, None]
        reach = 0.5 * np.abs(inwards).sum(axis=1) + ROUNDING_PX * np.linalg.norm(inwards, axis=1)
        level = (inwards * corners[:, side]).sum(axis=1)
        nearest = inwards[face, 0] * (column + 0.5) + inwards[face, 1] * (row + 0.5) + reach[face] - level[face]
        apart |= nearest < 0.0
    touched[row[~apart], column[~apart]] = True
    return touched


def fetch_bilinear(texels: NDArray[np.float32], uvs: NDArray[np.floating]) -> NDArray[np.float32]:
    """Bilinear samples of (H, W, 3) texels at (..., 2) uvs, as shaders/include/texels.glsl takes them."""
    size = np.array(texels.shape[1::-1])
    px = np.clip(uvs * size.astype(np.float32) - np.float32(0.5), 0, (size - 1).astype(np.float32))
    corner = np.minimum(px.astype(np.int64), np.maximum(size - 2, 0))
    x, y = corner[..., 0], corner[..., 1]
    far_x, far_y = np.minimum(x + 1, size[0] - 1), np.minimum(y + 1, size[1] - 1)
    fraction = (px - corner).astype(np.float32)[..., None]
    across, down = fraction[..., 0, :], fraction[..., 1, :]
    top = texels[y, x] + (texels[y, far_x] - texels[y, x]) * across
    bottom = texels[far_y, x] + (texels[far_y, far_x] - texels[far_y, x]) * across
    return np.asarray(top + (bottom - top) * down, np.float32)
