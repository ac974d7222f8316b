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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.region import Region


@dataclass(frozen=True)
class Grid:
    """Unknowns and squares for one region. N nodes (texels that carry a value), U free unknowns, Q squares.

    Attributes
    ----------
    nodes : (N,) int64
        Flat texel index of every node, sorted.
    interpolation : (N, U) sparse array
        Node values from the free ones; the identity except at hanging nodes.
    free : (U,) int64
        Node of every free unknown. All nodes that seams read are free.
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
    free: NDArray[np.int64]
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
        if not len(texels):
            return found
        assert (self.nodes[np.minimum(found, len(self.nodes) - 1)] == texels).all()
        return found

    def unknown_of(self, texels: NDArray[np.integer]) -> NDArray[np.int32]:
        """Unknown of each texel; every texel must be a free node, as all are that seams read."""
        texel_of_unknown = self.nodes[self.free]
        found = np.searchsorted(texel_of_unknown, texels).astype(np.int32)
        assert not texels.size or (texel_of_unknown[np.minimum(found, len(self.free) - 1)] == texels).all()
        return found


def _mark_near(
    x: NDArray[np.int64], y: NDArray[np.int64], reach: int, shift: int, repeat: bool, mask: NDArray[np.bool_]
) -> None:
    """Mark the squares within reach of the given ones, or with shift 1 those of twice the side that hold them."""
    rows, columns = mask.shape
    # Twice as large ones: the squares from n - reach to n + reach lie in exactly 1 + reach of them.
    row, column = (y - reach) >> shift, (x - reach) >> shift
    for dy in range(1 + (reach if shift else 2 * reach)):
        there = (row + dy) % rows if repeat else np.clip(row + dy, 0, rows - 1)
        for dx in range(1 + (reach if shift else 2 * reach)):
            mask[there, (column + dx) % columns if repeat else np.clip(column + dx, 0, columns - 1)] = True


def _split_squares(
    region: Region, fine_reach: int, reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Finest cells and the other squares, as top left texels; and the sides of the other squares."""
    width, height = region.width, region.height
    columns, rows = (width, height) if region.repeat else (max(width - 1, 1), max(height - 1, 1))
    seed_y, seed_x = np.divmod(region.cells, width)
    inner = np.zeros((rows, columns), np.bool_)
    _mark_near(seed_x, seed_y, 1, 0, region.repeat, inner)
    y, x = np.nonzero(inner)
    finest = y * width + x
    corners, sides = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    side = 1
    while len(finest) and side < max(width, height):
        # Squares of twice the side that must be split; those of their quarters that need not be are leaves.
        split = np.zeros((-(-inner.shape[0] // 2), -(-inner.shape[1] // 2)), np.bool_)
        _mark_near(seed_x, seed_y, fine_reach if side == 1 else reach, 1, False, split)
        seeds = np.zeros_like(split)
        _mark_near(seed_x, seed_y, 0, 1, False, seeds)
        seed_y, seed_x = np.nonzero(seeds)
        y, x = np.nonzero(split)
        y, x = (2 * y[:, None] + np.array([0, 0, 1, 1])).ravel(), (2 * x[:, None] + np.array([0, 1, 0, 1])).ravel()
        fits = ((x + 1) * side < width) & ((y + 1) * side < height)
        y, x = y[fits], x[fits]
        leaf = ~inner[y, x]
        y, x = y[leaf] * side, x[leaf] * side
        used = region.inside[y, x]
        corners.append(y[used] * width + x[used])
        sides.append(np.full(np.count_nonzero(used), side, np.int64))
        inner = split
        side *= 2
    return finest, np.concatenate(corners), np.concatenate(sides)


def _find_fine_parts(
    region: Region, finest: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64], Floats]:
    """Texels and grid edges of the finest cells, with the share of each that these cells account for.

    Returns
    -------
    texels : (N,) int64, sorted
    texel_mass : (N,) float64
    edges : (E, 2) int64, numbers of texels in `texels`
    edge_mass : (E,) float64
    """
    width, height = region.width, region.height
    y, x = np.divmod(finest, width)
    x1, y1 = (x + 1) % width, (y + 1) % height
    corner = np.stack([y * width + x, y * width + x1, y1 * width + x, y1 * width + x1])
    covered = np.zeros(width * height, np.bool_)
    covered[corner] = True
    texels = np.flatnonzero(covered)
    which = np.searchsorted(texels, corner)
    num = len(texels)
    row, column = np.divmod(texels, width)
    used = region.used[row, column]
    # A cell beyond the image's edge does not exist: what is there counts as accounted for.
    at_side = np.where((column == 0) | (column == width - 1), 1.0 if region.repeat else 2.0, 1.0)
    at_end = np.where((row == 0) | (row == height - 1), 1.0 if region.repeat else 2.0, 1.0)
    if width == 1:
        at_side[:] = 2.0
    if height == 1:
        at_end[:] = 2.0
    texel_mass = np.minimum(np.bincount(which.ravel(), minlength=num) * at_side * at_end / 4.0, 1.0)

    # Every cell has two grid edges along x, from its left texels, and two along y, from its upper ones.
    edges, masses = [], []
    for starts, ends, beyond in (((0, 2), (1, 3), at_end), ((0, 1), (2, 3), at_side)):
        second = np.full(num, -1)
        for start, end in zip(starts, ends, strict=True):
            second[which[start]] = which[end]
        count = np.bincount(which[list(starts)].ravel(), minlength=num)
        first = np.flatnonzero(second >= 0)
        second = second[first]
        kept = used[first] & used[second] & (first != second)
        first, second = first[kept], second[kept]
        edges.append(np.stack([first, second], axis=1))
        masses.append(np.minimum(count[first] * beyond[first] / 2.0, 1.0))
    renumber = np.cumsum(used) - 1
    return texels[used], texel_mass[used], renumber[np.concatenate(edges)], np.concatenate(masses)


def _find_hanging(
    nodes: NDArray[np.int64], squares: NDArray[np.int64], sides: NDArray[np.int64], width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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


def _interpolate_hanging(
    num_nodes: int, hanging: NDArray[np.int64], ends: NDArray[np.int64]
) -> tuple[sparse.csr_array, NDArray[np.int64]]:
    """Matrix from free unknowns to all nodes, (N, U), and the nodes of the unknowns, (U,)."""
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
    return sparse.csr_array(matrix[:, kept]), kept


def build_grid(region: Region, *, fine_reach: int = 4, reach: int = 3) -> Grid:
    """Lay the quadtree over a region.

    Parameters
    ----------
    region : Region
    fine_reach : int
        Distance from the silhouette, texels, within which there are only cells. At least 2.
    reach : int
        Distance, in squares, within which larger squares are split. At least 1 + fine_reach / 2, so that neighbours
        differ by a factor of two at most.

    Returns
    -------
    Grid
        Empty where the region has no silhouette.
    """
    if fine_reach < 1 or reach < 1 + -(-fine_reach // 2):
        raise ValueError(f"reach {reach} is too short for fine_reach {fine_reach}")
    width, height = region.width, region.height
    finest, corners, sides = _split_squares(region, fine_reach, reach)
    texels, texel_mass, edges, edge_mass = _find_fine_parts(region, finest)
    y, x = np.divmod(corners, width)
    square_texels = np.stack([(y + b * sides) * width + x + a * sides for b in (0, 1) for a in (0, 1)], axis=1)
    covered = np.zeros(width * height, np.bool_)
    covered[texels] = True
    covered[square_texels] = True
    nodes = np.flatnonzero(covered)
    renumber = np.searchsorted(nodes, texels)
    mass = np.zeros(len(nodes))
    mass[renumber] = texel_mass
    squares = np.searchsorted(nodes, square_texels)
    hanging, ends = _find_hanging(nodes, squares, sides, width)
    interpolation, free = _interpolate_hanging(len(nodes), hanging, ends)
    return Grid(
        nodes=nodes,
        interpolation=interpolation,
        free=free,
        texel_mass=mass,
        edge_nodes=renumber[edges].reshape(-1, 2),
        edge_mass=edge_mass,
        squares=squares,
        square_sides=sides,
        inside=region.inside.ravel()[nodes],
        size_px=(width, height),
    )
