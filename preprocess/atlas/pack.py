"""Charts into the unit square: horizon packing.

Lévy et al. 2002, "Least squares conformal maps", section 4.3: charts, tallest first, fall onto the horizon of those
placed before; each takes the rotation and column where it wastes least. All in whole columns of the final texture,
each chart grown by half a gutter, so two charts are never nearer than the gutter. The scale is found by trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from preprocess.mesh import Floats, Ints

ROTATIONS = 16
"""Orientations tried, evenly spread, from the one whose bounding box is smallest."""

TRIALS = 9
"""Scales tried; the coverage changes by under 2 % after six."""


@dataclass(frozen=True)
class Packing:
    """A similarity for each of C charts: `uv = scale * (points @ rotation.T) + offset`.

    Attributes
    ----------
    scale : (C,) float64
        uv a metre.
    rotation : (C, 2, 2) float64
    offset : (C, 2) float64
    """

    scale: Floats
    rotation: Floats
    offset: Floats

    def apply(self, points: Floats, charts: Ints) -> Floats:
        """Place points (N, 2) that belong to charts (N,)."""
        turned = np.einsum("nij,nj->ni", self.rotation[charts], points)
        return self.scale[charts][:, None] * turned + self.offset[charts]


def pack_charts(
    segments: Floats,
    segment_charts: Ints,
    num_charts: int,
    areas: Floats,
    size_px: int,
    gutter_px: float,
    min_px: float,
) -> Packing:
    """Pack charts given by the line segments of their outlines.

    Parameters
    ----------
    segments : (S, 2, 2) float64
        Ends of outline segments, metres.
    segment_charts : (S,) int32
    num_charts : int
    areas : (C,) float64
        Area of each chart in the plane, square metres.
    size_px : int
        Side of the square texture.
    gutter_px : float
        Least distance of two charts, and twice that of a chart and the border.
    min_px : float
        A chart's area is at least the square of this, at the cost of its neighbours' scale.

    Returns
    -------
    Packing
    """
    order = np.argsort(segment_charts, kind="stable")
    segments, counts = segments[order], np.bincount(segment_charts, minlength=num_charts)
    first = np.r_[0, np.cumsum(counts)].astype(np.int32)
    rotation = _upright(segments, segment_charts[order], num_charts)
    points = np.einsum("sij,skj->ski", rotation[segment_charts[order]], segments)
    total = max(float(areas.sum()), 1e-300)
    scale = 0.85 * size_px / np.sqrt(total)
    best: tuple[Floats, Floats, Floats] | None = None
    low, high = 0.0, np.inf
    for _ in range(TRIALS * 4):
        sizes = np.maximum(scale, min_px / np.sqrt(np.maximum(areas, 1e-12 * total)))
        sizes = np.minimum(sizes, 64 * scale)
        offsets, turns, height = _drop_charts(points, first, sizes, size_px, gutter_px, ROTATIONS)
        if height <= size_px:
            best, low = (sizes, turns, offsets), scale
        else:
            high = scale
        if low and high < 1.012 * low:
            break
        guess = scale * np.sqrt(size_px / max(height, 1.0)) if np.isfinite(height) else 0.7 * scale
        if low and np.isfinite(high):
            guess = np.clip(guess, low + 0.25 * (high - low), high - 0.25 * (high - low))
        elif not low:
            guess = min(guess, 0.97 * scale)
        else:
            guess = max(guess, 1.01 * scale)
        scale = float(guess)
    if best is None:
        raise ValueError(f"{num_charts} charts with gutters of {gutter_px} texels do not fit into {size_px} texels")
    sizes, turns, offsets = best
    angle = 2 * np.pi * turns / ROTATIONS
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cosine, -sine], axis=1), np.stack([sine, cosine], axis=1)], axis=1)
    return Packing(sizes / size_px, turn @ rotation, offsets / size_px)


def _upright(segments: Floats, charts: Ints, num_charts: int) -> Floats:
    """Rotation of each chart in which its bounding box is smallest, of 32 tried, (C, 2, 2)."""
    best = np.full(num_charts, np.inf)
    result = np.tile(np.eye(2), (num_charts, 1, 1))
    for angle in np.linspace(0, np.pi / 2, 32, endpoint=False):
        cosine, sine = np.cos(angle), np.sin(angle)
        extent = []
        for axis in ((cosine, -sine), (sine, cosine)):
            along = segments @ np.asarray(axis)
            low, high = np.full(num_charts, np.inf), np.full(num_charts, -np.inf)
            np.minimum.at(low, charts, along.min(axis=1))
            np.maximum.at(high, charts, along.max(axis=1))
            extent.append(high - low)
        area = extent[0] * extent[1] + 1e-9 * (extent[0] + extent[1]) ** 2
        better = area < best * (1 - 1e-9)
        best = np.where(better, area, best)
        result[better] = ((cosine, -sine), (sine, cosine))
    return result


@njit(cache=True)
def _drop_charts(points, first, sizes, width, gutter, rotations):  # type: ignore[no-untyped-def]
    """Drop the charts one by one; returns offsets, turns and the height used (infinite when one is too wide)."""
    num_charts = len(first) - 1
    offsets = np.zeros((num_charts, 2))
    turns = np.zeros(num_charts, np.int32)
    tallness = np.zeros(num_charts)
    for c in range(num_charts):
        low, high = np.inf, -np.inf
        left, right = np.inf, -np.inf
        for s in range(first[c], first[c + 1]):
            for k in range(2):
                low, high = min(low, points[s, k, 1]), max(high, points[s, k, 1])
                left, right = min(left, points[s, k, 0]), max(right, points[s, k, 0])
        tallness[c] = max(high - low, right - left) * sizes[c]
    order = np.argsort(-tallness, kind="mergesort")
    horizon = np.zeros(width)
    bottom, top = np.empty(width), np.empty(width)
    keep_bottom, keep_top = np.empty(width), np.empty(width)
    half = 0.5 * gutter
    highest = 0.0
    for i in range(num_charts):
        c = order[i]
        best, best_x, best_y, best_turn, best_columns = np.inf, 0, 0.0, -1, 0
        best_left, best_low = 0.0, 0.0
        for turn in range(rotations):
            angle = 2 * np.pi * turn / rotations
            cosine, sine = sizes[c] * np.cos(angle), sizes[c] * np.sin(angle)
            left, right, low = np.inf, -np.inf, np.inf
            for s in range(first[c], first[c + 1]):
                for k in range(2):
                    x = cosine * points[s, k, 0] - sine * points[s, k, 1]
                    y = sine * points[s, k, 0] + cosine * points[s, k, 1]
                    left, right, low = min(left, x), max(right, x), min(low, y)
            columns = int(np.ceil(right - left + gutter))
            if columns < 1:
                columns = 1
            if columns > width:
                continue
            for j in range(columns):
                bottom[j], top[j] = np.inf, -np.inf
            for s in range(first[c], first[c + 1]):
                ax = cosine * points[s, 0, 0] - sine * points[s, 0, 1] - left + half
                ay = sine * points[s, 0, 0] + cosine * points[s, 0, 1] - low + half
                bx = cosine * points[s, 1, 0] - sine * points[s, 1, 1] - left + half
                by = sine * points[s, 1, 0] + cosine * points[s, 1, 1] - low + half
                if ax > bx:
                    ax, ay, bx, by = bx, by, ax, ay
                slope = (by - ay) / (bx - ax) if bx - ax > 1e-9 else 0.0
                j0 = max(0, int(np.floor(ax - half)))
                j1 = min(columns - 1, int(np.floor(bx + half)))
                for j in range(j0, j1 + 1):
                    # the part of the segment within half a gutter of this column
                    x0 = min(max(j - half, ax), bx)
                    x1 = min(max(j + 1 + half, ax), bx)
                    y0, y1 = ay + slope * (x0 - ax), ay + slope * (x1 - ax)
                    if bx - ax <= 1e-9:
                        y0, y1 = ay, by
                    bottom[j] = min(bottom[j], min(y0, y1) - half)
                    top[j] = max(top[j], max(y0, y1) + half)
            for j in range(columns):
                if top[j] < bottom[j]:
                    bottom[j], top[j] = 0.0, 0.0
            improved = False
            for x in range(width - columns + 1):
                y = 0.0
                for j in range(columns):
                    y = max(y, horizon[x + j] - bottom[j])
                waste, peak = 0.0, 0.0
                for j in range(columns):
                    waste += y + bottom[j] - horizon[x + j]
                    peak = max(peak, y + top[j])
                cost = waste + 0.35 * columns * peak
                if cost < best * (1 - 1e-12):
                    best, best_x, best_y, best_turn = cost, x, y, turn
                    best_columns, best_left, best_low = columns, left, low
                    improved = True
            if improved:
                for j in range(columns):
                    keep_bottom[j], keep_top[j] = bottom[j], top[j]
        if best_turn < 0:
            return offsets, turns, np.inf
        for j in range(best_columns):
            horizon[best_x + j] = max(horizon[best_x + j], best_y + keep_top[j])
            highest = max(highest, horizon[best_x + j])
        turns[c] = best_turn
        offsets[c, 0] = best_x - best_left + half
        offsets[c, 1] = best_y - best_low + half
        if highest > 8.0 * width:
            return offsets, turns, highest
    return offsets, turns, highest
