"""Leaves of weight quadtrees that may hold the same: equal ones are one record in GPU memory.

Quadtrees divide squares until vertices are told apart, and most of the quarters that come of it hold no vertex, or only
places where weights need not be exact. Such a leaf takes over the corners of a neighbour in its cell, if these suit all
that lies in it as well. On the characters here that leaves half to two thirds of the records.
Letters in shapes: L leaves, N points, J joints.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from runtime.asset.weight_quadtree import MAX_DEPTH

NEIGHBOURS = 5  # tried, along a Z-curve in the cell: mostly the other quarters of a square


def _along_cells(places: NDArray[np.int64], depths: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Leaves cell by cell, along a Z-curve in each: their order, each one's turn in its cell, first of it, how many."""
    fine = places << (MAX_DEPTH - depths)[:, None]
    code = np.zeros(len(fine), np.int64)
    for bit in range(MAX_DEPTH):
        code |= ((fine[:, 0] >> bit & 1) << 2 * bit) | ((fine[:, 1] >> bit & 1) << 2 * bit + 1)
    cell = fine >> MAX_DEPTH
    order = np.lexsort((code, cell[:, 0], cell[:, 1]))
    cell = cell[order]
    firsts = np.flatnonzero(np.r_[True, (cell[1:] != cell[:-1]).any(axis=1)])
    counts = np.diff(np.r_[firsts, len(order)])
    turn, first, count = (np.empty(len(order), np.int64) for _ in range(3))
    first[order], count[order] = np.repeat(firsts, counts), np.repeat(counts, counts)
    turn[order] = np.arange(len(order)) - first[order]
    return order, turn, first, count


def share_corners(
    corners: Floats,
    places: NDArray[np.int64],
    depths: NDArray[np.int64],
    leaf_of_point: NDArray[np.int64],
    num_vertices: NDArray[np.int64],
    suits: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]],
) -> Floats:
    """Give leaves the corners of neighbours that suit them.

    Parameters
    ----------
    corners : (L, 4, J) float64
    places : (L, 2) int64
    depths : (L,) int64
    leaf_of_point : (N,) int64
    num_vertices : (L,) int64
        Vertices in each leaf: of two that could do with one, that with more keeps its own.
    suits : callable
        Of points (M,) and a leaf for each of them, (M,): whether that leaf's corners would do, (M,) bool.

    Returns
    -------
    (L, 4, J) float64
    """
    count = len(corners)
    if not count:
        return corners
    order, turn, first, in_cell = _along_cells(places, depths)
    own = record = np.arange(count)
    for offset in range(1, NEIGHBOURS + 1):
        other_turn = turn ^ offset
        other = order[first + np.minimum(other_turn, in_cell - 1)]
        tries = (other_turn < in_cell) & (record == own) & (record[other] == other)
        record_of_point = record[leaf_of_point]
        points = np.flatnonzero(tries[record_of_point])
        wrong = points[~suits(points, other[record_of_point[points]])]
        gives_up = tries.copy()
        gives_up[record_of_point[wrong]] = False
        held = np.bincount(record, num_vertices, count)
        stays = (held > held[other]) | ((held == held[other]) & (turn < other_turn))
        gives_up &= ~(gives_up[other] & stays)
        record = np.where(gives_up, other, own)[record]
    return corners[record]
