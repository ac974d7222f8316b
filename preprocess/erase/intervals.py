"""Edges cut where a bilinear sample changes its four texels (paper, section 4; docs/method.md, section 2).

A sample that runs along a uv edge reads one fixed 2 x 2 cell of texels until it crosses a line through texel centres.
Between two crossings its value is a quadratic polynomial in the edge parameter, linear in the texels. For a seam both
uv edges run together and every crossing of either one cuts both, so on each interval the jump across the seam is one
quadratic in (at most) eight texels. Every integral of the method is a sum over these intervals, and Gauss-Legendre
points on each make it exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.mesh.texels import uv_to_px

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


def _cut(lines_px: Floats) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Cut edges (E, K, 2, 2) where a side crosses an integer line: edge, start and end of every interval, in order."""
    num_edges, num_tracks = len(lines_px), 2 * lines_px.shape[1]
    tracks = lines_px.transpose(0, 1, 3, 2).reshape(-1, 2)  # (E K 2 axes, 2 ends)
    low, high = np.ceil(tracks.min(axis=1)), np.floor(tracks.max(axis=1))
    count = np.where(tracks[:, 0] == tracks[:, 1], 0, np.maximum(high - low + 1, 0)).astype(np.int64)
    track = np.repeat(np.arange(len(tracks)), count)
    line = low[track] + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    first, last = tracks[track].T
    gamma = (line - first) / (last - first)
    # Crossings of all axes of an edge in one order, behind its start; those next to another one are the same.
    edges = np.concatenate([np.arange(num_edges), track // num_tracks])
    gamma = np.concatenate([np.zeros(num_edges), gamma])
    kept = gamma < 1 - MERGE_REL
    edges, gamma = edges[kept], gamma[kept]
    order = np.lexsort((gamma, edges))
    edges, gamma = edges[order], gamma[order]
    is_new = np.ones(len(edges), np.bool_)
    is_new[1:] = (edges[1:] != edges[:-1]) | (gamma[1:] > gamma[:-1] + MERGE_REL)
    edges, start = edges[is_new], gamma[is_new]
    end = np.ones(len(edges))
    goes_on = np.flatnonzero(edges[1:] == edges[:-1])
    end[goes_on] = start[goes_on + 1]
    return edges, start, end


def cut_into_intervals(uv_lines: Floats, width: int, height: int, *, repeat: bool = False) -> Intervals:
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
    edges, start, end = _cut(lines_px)
    middle = (0.5 * (start + end))[:, None, None]
    points = (1 - middle) * lines_px[edges][:, :, 0] + middle * lines_px[edges][:, :, 1]
    if not repeat:
        points = np.clip(points, 0.0, (width - 1, height - 1))
    cells = np.floor(points).astype(np.int32)
    if not repeat:
        cells = np.minimum(cells, (max(width - 2, 0), max(height - 2, 0))).astype(np.int32)
    return Intervals(edges.astype(np.int32), start, end, cells, lines_px, (width, height), repeat)
