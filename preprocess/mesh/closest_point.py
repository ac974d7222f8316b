"""Nearest points on a triangle mesh: a complete binary tree of boxes over triangles in Morton order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from preprocess.arrays import Floats

LEAF_SIZE = 4
MORTON_BITS = 20


@njit(cache=True, error_model="numpy")
def _query(points, corners, low, high, num_leaves, guesses, enough_sq, squares, faces, weights):
    """For each point the nearest triangle, the squared distance and the barycentric weights of the nearest point.

    `corners` (F, 9) in leaf order; `low`, `high` (2 L, 3) boxes of the tree's nodes, the root first, node n's children
    2 n and 2 n + 1; leaf i holds triangles LEAF_SIZE i and after. The point's guess (N,) is tried first, and is all
    that is where it is near enough; without guesses it is the last point's triangle, since neighbouring points are near
    each other.
    """
    stack = np.empty(64, np.int64)
    p, w = np.empty(3), np.empty(3)
    guess = 0
    for i in range(len(points)):
        best, nearest = np.inf, -1
        if len(guesses) > 0:
            guess = guesses[i]
        top, node, f, last = 0, 0, guess, guess + 1
        while True:
            # Triangles of a leaf (or the guess, the first time round).
            while f < last:
                # Region by region (Ericson 2004, Real-Time Collision Detection, 5.1.5): a, b, c, ab, ac, bc, inside.
                d1, d2, d3, d4, d5, d6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(3):
                    p[k] = points[i, k]
                    a, b, c = corners[f, k], corners[f, 3 + k], corners[f, 6 + k]
                    d1 += (b - a) * (p[k] - a)
                    d2 += (c - a) * (p[k] - a)
                    d3 += (b - a) * (p[k] - b)
                    d4 += (c - a) * (p[k] - b)
                    d5 += (b - a) * (p[k] - c)
                    d6 += (c - a) * (p[k] - c)
                va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
                s, t = 0.0, 0.0
                if d1 <= 0.0 and d2 <= 0.0:
                    pass
                elif d3 >= 0.0 and d4 <= d3:
                    s = 1.0
                elif d6 >= 0.0 and d5 <= d6:
                    t = 1.0
                elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
                    s = d1 / (d1 - d3)
                elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
                    t = d2 / (d2 - d6)
                elif va <= 0.0 and d4 >= d3 and d5 >= d6:
                    t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
                    s = 1.0 - t
                else:
                    total = va + vb + vc
                    s, t = vb / total, vc / total
                square = 0.0
                for k in range(3):
                    a, b, c = corners[f, k], corners[f, 3 + k], corners[f, 6 + k]
                    square += (a + s * (b - a) + t * (c - a) - p[k]) ** 2
                if square < best:
                    best, nearest = square, f
                    w[0], w[1], w[2] = 1.0 - s - t, s, t
                f += 1
            if node == 0:
                if len(guesses) > 0 and best <= enough_sq[i]:
                    break
                node = 1
            elif top > 0:
                top -= 1
                node = stack[top]
            else:
                break
            # Down to the next leaf whose box is near enough, the nearer child first.
            while node < num_leaves:
                near, far = 0.0, 0.0
                for k in range(3):
                    left, right = 2 * node, 2 * node + 1
                    near += max(low[left, k] - p[k], 0.0, p[k] - high[left, k]) ** 2
                    far += max(low[right, k] - p[k], 0.0, p[k] - high[right, k]) ** 2
                node = left if near <= far else right
                if max(near, far) < best:
                    stack[top] = left + right - node
                    top += 1
                if not min(near, far) < best:
                    if top == 0:
                        node = -1
                        break
                    top -= 1
                    node = stack[top]
            if node < 0:
                break
            f = (node - num_leaves) * LEAF_SIZE
            last = min(f + LEAF_SIZE, len(corners))
        squares[i], faces[i], guess = best, nearest, nearest
        for k in range(3):
            weights[i, k] = w[k]


def _morton_order(centres: Floats) -> NDArray[np.int64]:
    """Order of points along a space-filling curve."""
    low, extent = centres.min(axis=0), np.ptp(centres, axis=0).max() or 1.0
    cells = ((centres - low) / extent * (2**MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(centres), np.uint64)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return np.argsort(code, kind="stable")


@dataclass(frozen=True)
class NearestTree:
    """Triangles with boxes around them.

    Attributes
    ----------
    corners : (F, 9) float64, in leaf order
    order : (F,) int64, the face of each row
    low, high : (2 L, 3) float64
    """

    corners: Floats
    order: NDArray[np.int64]
    low: Floats
    high: Floats

    def query(
        self, points: Floats, guesses: NDArray[np.int64] | None = None, enough: Floats | None = None
    ) -> tuple[Floats, NDArray[np.int64], Floats]:
        """Nearest point of the mesh to each point.

        Parameters
        ----------
        points : (N, 3) float64
            Quickest where neighbours in the array are near each other.
        guesses : (N,) int64 or None
            Faces that are likely to be the nearest.
        enough : (N,) float64 or None
            Where the guess is no further than this, it is taken for the nearest; negative for never.

        Returns
        -------
        distances : (N,) float64
        faces : (N,) int64
        weights : (N, 3) float64, barycentric
        """
        count = len(points)
        squares, faces, weights = np.zeros(count), np.zeros(count, np.int64), np.zeros((count, 3))
        _query(
            np.ascontiguousarray(points, np.float64),
            self.corners,
            self.low,
            self.high,
            len(self.low) // 2,
            np.zeros(0, np.int64) if guesses is None else np.argsort(self.order, kind="stable")[guesses],
            np.full(count, -1.0) if enough is None else enough * np.abs(enough),
            squares,
            faces,
            weights,
        )
        return np.sqrt(squares), self.order[faces], weights


def build_tree(corners: Floats) -> NearestTree:
    """Build a tree over triangles.

    Parameters
    ----------
    corners : (F, 3, 3) float64, at least one triangle
    """
    order = _morton_order(corners.mean(axis=1))
    sorted_corners = corners[order]
    num_leaves = 1
    while num_leaves * LEAF_SIZE < len(corners):
        num_leaves *= 2
    low = np.full((2 * num_leaves, 3), np.inf)
    high = np.full((2 * num_leaves, 3), -np.inf)
    leaf = num_leaves + np.arange(len(corners)) // LEAF_SIZE
    first = np.unique(leaf, return_index=True)
    low[first[0]] = np.minimum.reduceat(sorted_corners.min(axis=1), first[1])
    high[first[0]] = np.maximum.reduceat(sorted_corners.max(axis=1), first[1])
    begin = num_leaves // 2
    while begin >= 1:
        nodes = np.arange(begin, 2 * begin)
        low[nodes] = np.minimum(low[2 * nodes], low[2 * nodes + 1])
        high[nodes] = np.maximum(high[2 * nodes], high[2 * nodes + 1])
        begin //= 2
    return NearestTree(np.ascontiguousarray(sorted_corners.reshape(-1, 9)), order, low, high)
