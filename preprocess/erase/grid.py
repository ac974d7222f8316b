"""The unknowns: every texel near the silhouette, and ever coarser squares away from it.

The change that erasure makes is free near seams and smooth away from them, so a quadtree carries it (Agarwala 2007,
"Efficient gradient-domain compositing using quadtrees"). Cells of four texel centres are the finest squares. A square
of side 2h is split as long as the silhouette passes within `reach` squares of half its side; with a reach of two or
more, neighbours differ by at most a factor of two in size. Inside a square the change is the bilinear blend of its
corners; a corner in the middle of a larger neighbour's side is not free but the mean of that side's ends.

The mass and stiffness of a square (the sums of squares of the change, and of its differences along grid edges, over
the texels it covers) have closed forms, and texels or grid edges on a common side count half for each square. So the
coarse system is exactly Sᵀ A S of the full grid's A, with S the interpolation, and costs only what the squares cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from preprocess.erase.region import Region
from preprocess.mesh import Floats

# Rows of cell keys are this far apart.
STRIDE = 1 << 32

# Texels that a change is spread to at a time.
BATCH = 1 << 20


@dataclass(frozen=True)
class Grid:
    """Unknowns and squares for one region. N nodes (texels that carry a value), U free unknowns, Q squares.

    Attributes
    ----------
    nodes : (N,) int64
        Flat texel index of every node, sorted.
    interpolation : (N, U) sparse array
        Node values from the free ones; the identity except at hanging nodes.
    texel_mass : (N,) float64
        How much of each node's texel the finest cells account for, 0 to 1 (squares account for the rest).
    edge_nodes : (E, 2) int64
        Grid edges of the finest cells, as nodes.
    edge_mass : (E,) float64
        How much of each grid edge the finest cells account for, 0 to 1.
    squares : (Q, 4) int64
        Corner nodes of the squares larger than a cell: (0,0), (1,0), (0,1), (1,1) of (column, row).
    square_sides : (Q,) int64
        Their sides in texels.
    inside : (N,) bool
        Whether a node's texel is inside the uv mesh.
    size_px : (int, int)
        Width and height.
    """

    nodes: NDArray[np.int64]
    interpolation: sparse.csr_array
    texel_mass: Floats
    edge_nodes: NDArray[np.int64]
    edge_mass: Floats
    squares: NDArray[np.int64]
    square_sides: NDArray[np.int64]
    inside: NDArray[np.bool_]
    size_px: tuple[int, int]

    def node_of(self, texels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Node of each texel; every texel must be one."""
        found = np.searchsorted(self.nodes, texels)
        assert (self.nodes[np.minimum(found, len(self.nodes) - 1)] == texels).all()
        return found


def _keys(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number a cell."""
    return y * STRIDE + x


def _spread(keys: NDArray[np.int64], reach: int, columns: int, rows: int, repeat: bool) -> NDArray[np.int64]:
    """Cells within `reach` of the given ones (chessboard distance) on a grid of columns x rows, sorted."""
    offsets = np.arange(-reach, reach + 1)
    y, x = np.divmod(keys, STRIDE)
    x = (x + offsets[:, None]).ravel()
    y = np.tile(y, len(offsets))
    kept = slice(None) if repeat else (x >= 0) & (x < columns)
    y, x = np.divmod(np.unique(_keys(x[kept] % columns, y[kept])), STRIDE)
    y = (y + offsets[:, None]).ravel()
    x = np.tile(x, len(offsets))
    kept = slice(None) if repeat else (y >= 0) & (y < rows)
    return np.unique(_keys(x[kept], y[kept] % rows))


def _split_squares(
    region: Region, fine_reach: int, reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Keys of the finest cells; top left texels, as keys, of the other squares; and the sides of those."""
    width, height = region.width, region.height
    columns, rows = (width, height) if region.repeat else (max(width - 1, 1), max(height - 1, 1))
    seed_y, seed_x = np.divmod(region.cells, width)
    seeds = _keys(seed_x, seed_y)
    finest = inner = _spread(seeds, 1, columns, rows, region.repeat)
    corners, sides = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    level = 0
    while len(inner) and (1 << level) < max(width, height):
        # Squares of twice the side that must be split; those of their quarters that need not be are leaves.
        side = 1 << level
        grown = _spread(seeds, fine_reach if level == 0 else reach, -(-columns >> level), -(-rows >> level), False)
        y, x = np.divmod(grown, STRIDE)
        split = np.unique(_keys(x >> 1, y >> 1))
        seeds = np.unique(_keys(seed_x >> (level + 1), seed_y >> (level + 1)))
        level += 1
        y, x = np.divmod(split, STRIDE)
        quarters = np.concatenate([_keys(2 * x + dx, 2 * y + dy) for dy in (0, 1) for dx in (0, 1)])
        y, x = np.divmod(np.setdiff1d(quarters, inner, assume_unique=True), STRIDE)
        x, y = x * side, y * side
        fits = (x + side < width) & (y + side < height)
        x, y = x[fits], y[fits]
        used = region.inside[y, x]
        corners.append(_keys(x[used], y[used]))
        sides.append(np.full(np.count_nonzero(used), side, np.int64))
        inner = split
    return finest, np.concatenate(corners), np.concatenate(sides)


def _find_fine_parts(
    region: Region, finest: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64], Floats]:
    """Texels and grid edges of the finest cells, with the share of each that these cells account for.

    Returns
    -------
    texels : (N,) int64, sorted
    texel_mass : (N,) float64
    edges : (E, 2) int64, texels
    edge_mass : (E,) float64
    """
    width, height = region.width, region.height
    y, x = np.divmod(finest, STRIDE)
    x1, y1 = (x + 1) % width, (y + 1) % height
    corner = [y * width + x, y * width + x1, y1 * width + x, y1 * width + x1]
    texels, which, count = np.unique(np.stack(corner), return_inverse=True, return_counts=True)
    which = which.reshape(4, -1)
    silhouette_y, silhouette_x = np.divmod(region.cells, width)
    read = np.concatenate(
        [((silhouette_y + b) % height) * width + (silhouette_x + a) % width for a in (0, 1) for b in (0, 1)]
    )
    used = region.inside.ravel()[texels]
    used[np.searchsorted(texels, np.unique(read))] = True
    # A cell beyond the image's edge does not exist: what is there counts as accounted for.
    row, column = np.divmod(texels, width)
    edge_x = 2.0 if not region.repeat else 1.0
    at_side = np.where((column == 0) | (column == width - 1), edge_x, 1.0)
    at_end = np.where((row == 0) | (row == height - 1), edge_x, 1.0)
    if width == 1:
        at_side = np.full(len(texels), 2.0)
    if height == 1:
        at_end = np.full(len(texels), 2.0)
    texel_mass = np.minimum(count * at_side * at_end / 4.0, 1.0)

    num = len(texels)
    pairs = np.concatenate(
        [which[0] * num + which[1], which[2] * num + which[3], which[0] * num + which[2], which[1] * num + which[3]]
    )
    pairs, count = np.unique(pairs, return_counts=True)
    first, second = np.divmod(pairs, num)
    horizontal = row[first] == row[second]
    edge_mass = np.minimum(count * np.where(horizontal, at_end[first], at_side[first]) / 2.0, 1.0)
    kept = used[first] & used[second] & (first != second)
    renumber = np.cumsum(used) - 1
    edges = np.stack([renumber[first[kept]], renumber[second[kept]]], axis=1)
    return texels[used], texel_mass[used], edges, edge_mass[kept]


def _find_hanging(nodes: NDArray[np.int64], squares: NDArray[np.int64], sides: NDArray[np.int64], width: int):
    """Nodes in the middle of a square's side and that side's two ends: (M,), (M, 2) node numbers."""
    big = sides > 1
    corner = squares[big]
    half = (sides[big] // 2)[:, None]
    side_ends = corner[:, [[0, 1], [2, 3], [0, 2], [1, 3]]]  # (Q, 4, 2)
    step = half * np.array([1, 1, width, width])
    middle = nodes[side_ends[:, :, 0]] + step
    found = np.minimum(np.searchsorted(nodes, middle), len(nodes) - 1)
    hit = nodes[found] == middle
    hanging, first = np.unique(found[hit], return_index=True)
    return hanging, side_ends[hit][first]


def _interpolate_hanging(num_nodes: int, hanging: NDArray[np.int64], ends: NDArray[np.int64]) -> sparse.csr_array:
    """Matrix from free unknowns to all nodes, (N, U)."""
    free = np.ones(num_nodes, np.bool_)
    free[hanging] = False
    kept = np.flatnonzero(free)
    rows = np.concatenate([kept, np.repeat(hanging, 2)])
    columns = np.concatenate([kept, ends.ravel()])
    values = np.concatenate([np.ones(len(kept)), np.full(2 * len(hanging), 0.5)])
    blend = sparse.csr_array((values, (rows, columns)), shape=(num_nodes, num_nodes))
    # The ends of a large square's side may hang on a larger one's: apply the blend until only free nodes are left.
    matrix = blend
    while len(hanging) and np.isin(matrix.indices, hanging).any():
        matrix = matrix @ blend
        matrix.sum_duplicates()
    return sparse.csr_array(matrix[:, kept])


def build_grid(region: Region, *, fine_reach: int = 4, reach: int = 3) -> Grid:
    """Lay the quadtree over a region.

    Parameters
    ----------
    region : Region
    fine_reach : int
        Distance from the silhouette, texels, within which there are only cells. At least 2.
    reach : int
        Distance, in squares, within which larger squares are split. At least 2.

    Returns
    -------
    Grid
        Empty where the region has no silhouette.
    """
    width, height = region.width, region.height
    finest, corners, sides = _split_squares(region, fine_reach, reach)
    texels, texel_mass, edges, edge_mass = _find_fine_parts(region, finest)
    y, x = np.divmod(corners, STRIDE)
    square_texels = np.stack([(y + b * sides) * width + x + a * sides for b in (0, 1) for a in (0, 1)], axis=1)
    nodes = np.union1d(texels, square_texels)
    renumber = np.searchsorted(nodes, texels)
    mass = np.zeros(len(nodes))
    mass[renumber] = texel_mass
    squares = np.searchsorted(nodes, square_texels)
    hanging, ends = _find_hanging(nodes, squares, sides, width)
    return Grid(
        nodes=nodes,
        interpolation=_interpolate_hanging(len(nodes), hanging, ends),
        texel_mass=mass,
        edge_nodes=renumber[edges].reshape(-1, 2),
        edge_mass=edge_mass,
        squares=squares,
        square_sides=sides,
        inside=region.inside.ravel()[nodes],
        size_px=(width, height),
    )


@njit(cache=True)
def _fill_squares(squares, sides, corners, width, change, texels, delta):
    """Write every covered texel's index and bilinear change, square by square, right and lower sides excepted."""
    channels = change.shape[1]
    n = 0
    for q in range(squares.shape[0]):
        side = sides[q]
        for dy in range(side):
            fy = dy / side
            for dx in range(side):
                fx = dx / side
                texels[n] = corners[q] + dy * width + dx
                for c in range(channels):
                    top = (1.0 - fx) * change[squares[q, 0], c] + fx * change[squares[q, 1], c]
                    low = (1.0 - fx) * change[squares[q, 2], c] + fx * change[squares[q, 3], c]
                    delta[n, c] = (1.0 - fy) * top + fy * low
                n += 1


def spread_change(grid: Grid, node_change: Floats, negligible: float) -> Iterator[tuple[NDArray[np.int64], Floats]]:
    """Interpolate the change over the squares, a batch of texels at a time.

    Parameters
    ----------
    grid : Grid
    node_change : (N, C) float64
    negligible : float
        Squares whose corners all change by no more than this are left out.

    Yields
    ------
    texels : (M,) int64
        Flat indices; nodes occur among them too, with the same change.
    change : (M, C) float64
    """
    moves = np.abs(node_change).max(axis=1, initial=0.0) > negligible
    active = np.flatnonzero(moves[grid.squares].any(axis=1) & (grid.square_sides > 1))
    area = grid.square_sides[active] ** 2
    batch = np.cumsum(area) // BATCH
    for part in np.split(active, np.flatnonzero(np.diff(batch)) + 1):
        sides = grid.square_sides[part]
        num = int((sides**2).sum())
        texels, change = np.empty(num, np.int64), np.empty((num, node_change.shape[1]))
        squares = grid.squares[part]
        _fill_squares(squares, sides, grid.nodes[squares[:, 0]], grid.size_px[0], node_change, texels, change)
        yield texels, change
