"""Which 2 x 2 cells of a texture a mesh can ever read: those that one of its triangles touches in the atlas.

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
