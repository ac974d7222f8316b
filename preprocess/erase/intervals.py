"""Edges cut where a bilinear sample changes its four texels (paper, section 4; method, section 2).

A sample that runs along a uv edge reads one fixed 2 x 2 cell of texels until it crosses a line through texel centres.
Between two crossings its value is a quadratic polynomial in the edge parameter, linear in the texels. For a seam both
uv edges run together and every crossing of either one cuts both, so on each interval the jump across the seam is one
quadratic in (at most) eight texels. Every integral of the method is a sum over these intervals, and Gauss-Legendre
points on each make it exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from preprocess.mesh import Floats
from preprocess.texels import uv_to_px

# Crossings closer than this fraction of an edge are one crossing: rounding noise would otherwise make an interval.
MERGE_REL = 1e-10


@dataclass(frozen=True)
class Intervals:
    """Pieces of edges on which each side reads one cell. I intervals, K sides (1 or 2).

    Attributes
    ----------
    edges : (I,) int32
        The edge that each interval belongs to.
    start, end : (I,) float64
        Its range of the edge parameter.
    cells : (I, K, 2) int32
        Column and row of the top left texel of the cell that each side reads (may lie outside the image where the
        sampler repeats).
    lines_px : (E, K, 2, 2) float64
        The edges in texel coordinates, [edge, side, end, axis].
    size_px : (int, int)
        Width and height of the image.
    repeat : bool
        Whether the sampler repeats (or clamps).
    """

    edges: NDArray[np.int32]
    start: Floats
    end: Floats
    cells: NDArray[np.int32]
    lines_px: Floats
    size_px: tuple[int, int]
    repeat: bool

    def __len__(self) -> int:
        return len(self.edges)

    @property
    def texels(self) -> NDArray[np.int64]:
        """Flat indices of the texels read, (I, K, 4), in the order of `texels.bilinear_stencil`."""
        width, height = self.size_px
        near, far = self.cells.astype(np.int64), self.cells.astype(np.int64) + 1
        if self.repeat:
            near, far = near % (width, height), far % (width, height)
        else:
            far = np.minimum(far, (width - 1, height - 1))
        x = np.stack([near[..., 0], far[..., 0]] * 2, axis=-1)
        y = np.stack([near[..., 1]] * 2 + [far[..., 1]] * 2, axis=-1)
        return y * width + x

    def fractions(self, gamma: Floats) -> Floats:
        """Position inside the cell, (I, Q, K, 2), at edge parameters `gamma` (I, Q)."""
        lines = self.lines_px[self.edges]  # (I, K, 2, 2)
        along = gamma[:, :, None, None]
        points = (1 - along) * lines[:, None, :, 0] + along * lines[:, None, :, 1]
        if not self.repeat:
            width, height = self.size_px
            points = np.clip(points, 0.0, (width - 1, height - 1))
        return points - self.cells[:, None]

    @property
    def is_clamped(self) -> NDArray[np.bool_]:
        """Whether samples are clamped to the image's edge, so that they do not vary across it, (I, K, 2 axes)."""
        if self.repeat:
            return np.zeros(self.cells.shape, np.bool_)
        middle = 0.5 * (self.start + self.end)[:, None, None]
        lines = self.lines_px[self.edges]
        points = (1 - middle) * lines[:, :, 0] + middle * lines[:, :, 1]
        width, height = self.size_px
        return (points < 0) | (points > (width - 1, height - 1))

    def gauss(self, num_points: int) -> tuple[Floats, Floats]:
        """Gauss-Legendre parameters and weights on each interval, both (I, Q); exact to degree 2Q - 1."""
        nodes, weights = np.polynomial.legendre.leggauss(num_points)
        half = 0.5 * (self.end - self.start)[:, None]
        return 0.5 * (self.end + self.start)[:, None] + half * nodes, half * weights


@njit(cache=True)
def _cut(lines_px, offsets, merge, edges, start, end):
    """Fill the interval arrays, edge e from offsets[e] on; return how many each edge has.

    Every axis of every side crosses integer lines in one direction, so its crossings come in order: the next cut is
    the smallest of the axes' next crossings.
    """
    num_edges, num_sides = lines_px.shape[0], lines_px.shape[1]
    counts = np.zeros(num_edges, np.int64)
    line = np.empty(4)
    step = np.empty(4)
    for e in range(num_edges):
        for a in range(2 * num_sides):
            first, last = lines_px[e, a // 2, 0, a % 2], lines_px[e, a // 2, 1, a % 2]
            step[a] = 1.0 if last > first else (-1.0 if last < first else 0.0)
            line[a] = np.floor(first) + 1.0 if last > first else np.ceil(first) - 1.0
        at, n = 0.0, offsets[e]
        while at < 1.0:
            cut = 1.0
            for a in range(2 * num_sides):
                first, last = lines_px[e, a // 2, 0, a % 2], lines_px[e, a // 2, 1, a % 2]
                while step[a] != 0.0:
                    gamma = (line[a] - first) / (last - first)
                    if gamma > at + merge:
                        cut = min(cut, gamma)
                        break
                    line[a] += step[a]
            if cut > 1.0 - merge:
                cut = 1.0
            edges[n], start[n], end[n] = e, at, cut
            n += 1
            at = cut
        counts[e] = n - offsets[e]
    return counts


def split_edges(uv_lines: Floats, width: int, height: int, *, repeat: bool = False) -> Intervals:
    """Cut edges, or pairs of edges that run together, into intervals.

    Parameters
    ----------
    uv_lines : (E, K, 2, 2) float64
        [edge, side, end, axis]: K = 2 for seams, 1 for lone edges.
    width, height : int
        Size of the image in texels.
    repeat : bool
        Whether samples beyond the image wrap round; they clamp to its edge otherwise.

    Returns
    -------
    Intervals
        In the order of the edges and along each.
    """
    num_sides = uv_lines.shape[1]
    lines_px = np.ascontiguousarray(uv_to_px(uv_lines, width, height)).reshape(-1, num_sides, 2, 2)
    reach = np.abs(lines_px[:, :, 1] - lines_px[:, :, 0]).sum(axis=(1, 2))
    room = np.ceil(reach).astype(np.int64) + 2 * num_sides + 1
    offsets = np.concatenate([[0], np.cumsum(room)])
    edges = np.empty(offsets[-1], np.int32)
    start, end = np.empty(offsets[-1]), np.empty(offsets[-1])
    counts = _cut(lines_px, offsets[:-1], MERGE_REL, edges, start, end)
    kept = np.repeat(offsets[:-1] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts) + np.arange(counts.sum())
    edges, start, end = edges[kept], start[kept], end[kept]
    middle = (0.5 * (start + end))[:, None, None]
    points = (1 - middle) * lines_px[edges][:, :, 0] + middle * lines_px[edges][:, :, 1]
    if not repeat:
        points = np.clip(points, 0.0, (width - 1, height - 1))
    cells = np.floor(points).astype(np.int32)
    if not repeat:
        cells = np.minimum(cells, (max(width - 2, 0), max(height - 2, 0))).astype(np.int32)
    return Intervals(edges, start, end, cells, lines_px, (width, height), repeat)
