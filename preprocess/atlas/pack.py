"""Convex charts into the unit square.

On a grid of cells, a convex chart is one interval a row, so whether it fits somewhere is one look-up a row in a table
of the free cells to the right of every cell; a row that does not fit says how far to move on. Charts, largest first,
take the lowest, then leftmost place over all rotations. Each is grown by half a gutter. The scale is found by trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.errors import InputError
from preprocess.numerics.jit import entry, helper

ROTATIONS = 8
"""Orientations tried, evenly spread, from the one whose bounding box is smallest."""

MAX_CELLS = 768
"""Cells a side of the grid, at most one a texel."""

MANY_CHARTS = 1000
"""Above this number the grid has half the cells and a quarter of the rotations: time grows with all three."""

MAX_ENLARGEMENT = 64.0
"""A chart is never enlarged more than this, however small it is."""

HEIGHT_WEIGHT = 0.6
"""A chart goes where its lowest row plus this many times its height is least."""

TRIALS = 9
"""Scales tried at most; five usually bring the scale to within 1 % of the largest."""


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

    def apply(self, points: Floats, charts: NDArray[np.integer]) -> Floats:
        """Place points (N, 2) that belong to charts (N,)."""
        turned = np.einsum("nij,nj->ni", self.rotation[charts], points)
        result: Floats = self.scale[charts][:, None] * turned + self.offset[charts]
        return result


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
    cells = min(size_px, MAX_CELLS) if num_charts <= MANY_CHARTS else min(size_px, MAX_CELLS // 2)
    rotations = ROTATIONS if num_charts <= MANY_CHARTS else ROTATIONS // 4
    gutter, least = gutter_px * cells / size_px, min_px * cells / size_px
    low_corner, high_corner = np.full((num_charts, 2), np.inf), np.full((num_charts, 2), -np.inf)
    np.minimum.at(low_corner, segment_charts[order], points.min(axis=1))
    np.maximum.at(high_corner, segment_charts[order], points.max(axis=1))
    boxes = (high_corner - low_corner).prod(axis=1)
    depth = 2 * cells
    scratch = (
        np.empty((depth, cells + 1), np.int32),
        np.empty(depth, np.int32),
        np.empty(depth, np.int64),
        np.empty(depth, np.int64),
    )
    best: tuple[Floats, NDArray[np.int64], Floats] | None = None
    low, high = 0.0, np.inf
    scale = 0.84 * cells / np.sqrt(total)
    for trial in range(TRIALS + 40):
        sizes = np.maximum(scale, least / np.sqrt(np.maximum(areas, 1e-12 * total)))
        sizes = np.minimum(sizes, MAX_ENLARGEMENT * scale)
        drop_order = np.argsort(-boxes * sizes**2, kind="stable")
        offsets, turns = np.zeros((num_charts, 2)), np.zeros(num_charts, np.int64)
        height = _drop_charts(points, first, drop_order, sizes, cells, gutter, rotations, *scratch, offsets, turns)
        if height <= cells:
            best, low = (sizes, turns, offsets), scale
        else:
            high = scale
        if low and (high < 1.01 * low or trial >= TRIALS):
            break
        guess = scale * np.sqrt(cells / height) if np.isfinite(height) else 0.7 * scale
        if low and np.isfinite(high):
            guess = np.clip(guess, low + 0.3 * (high - low), high - 0.3 * (high - low))
        scale = float(min(guess, 0.985 * scale) if not low else max(guess, 1.015 * low) if high == np.inf else guess)
    if best is None:
        raise InputError(
            f"{num_charts} charts with gutters of {gutter_px:g} texels do not fit into {size_px} x {size_px} texels: "
            "use larger textures"
        )
    sizes, turns, offsets = best
    angle = 2 * np.pi * turns / rotations
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cosine, -sine], axis=1), np.stack([sine, cosine], axis=1)], axis=1)
    return Packing(sizes / cells, turn @ rotation, offsets / cells)


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


@helper
def _rows(points, low, high, cosine, sine, half, left, right, corner):  # type: ignore[no-untyped-def]
    """Interval of cells in every row of a turned chart grown by `half`; returns the number of rows."""
    x_least, y_least, y_most = np.inf, np.inf, -np.inf
    for s in range(low, high):
        for k in range(2):
            x = cosine * points[s, k, 0] - sine * points[s, k, 1]
            y = sine * points[s, k, 0] + cosine * points[s, k, 1]
            x_least, y_least, y_most = min(x_least, x), min(y_least, y), max(y_most, y)
    corner[0], corner[1] = x_least, y_least
    rows = int(np.ceil(y_most - y_least + 2 * half))
    if rows > len(left):
        return rows
    for r in range(rows):
        left[r], right[r] = 1 << 30, -1
    for s in range(low, high):
        ax = cosine * points[s, 0, 0] - sine * points[s, 0, 1] - x_least + half
        ay = sine * points[s, 0, 0] + cosine * points[s, 0, 1] - y_least + half
        bx = cosine * points[s, 1, 0] - sine * points[s, 1, 1] - x_least + half
        by = sine * points[s, 1, 0] + cosine * points[s, 1, 1] - y_least + half
        if ay > by:
            ax, ay, bx, by = bx, by, ax, ay
        slope = (bx - ax) / (by - ay) if by - ay > 1e-9 else 0.0
        for r in range(max(0, int(np.floor(ay - half))), min(rows - 1, int(np.floor(by + half))) + 1):
            if by - ay > 1e-9:  # the part of the side within half a gutter of the row
                x0 = ax + slope * (min(max(r - half, ay), by) - ay)
                x1 = ax + slope * (min(max(r + 1 + half, ay), by) - ay)
            else:
                x0, x1 = ax, bx
            left[r] = min(left[r], max(int(np.floor(min(x0, x1) - half)), 0))
            right[r] = max(right[r], int(np.ceil(max(x0, x1) + half)))
    return rows


@entry
def _drop_charts(  # type: ignore[no-untyped-def]
    points, first, order, sizes, cells, gutter, rotations, run, widest, left, right, offsets, turns
):
    """Place the charts one by one; returns the height used (infinite when one is too wide).

    `run`: how many cells to the right, this one included, are as free (positive) or taken (negative) as this one;
    `widest`: the longest free run of each row; `left` and `right` are scratch space for a row each.
    """
    depth = len(run)
    for y in range(depth):
        widest[y] = cells
        for x in range(cells + 1):
            run[y, x] = cells - x
    corner = np.empty(2)
    half = 0.5 * gutter
    highest = 0
    for i in range(len(order)):
        c = order[i]
        best_turn, best_x, best_y, best_cost = -1, 0, 0, np.inf
        for turn in range(rotations):
            angle = 2 * np.pi * turn / rotations
            cosine, sine = sizes[c] * np.cos(angle), sizes[c] * np.sin(angle)
            rows = _rows(points, first[c], first[c + 1], cosine, sine, half, left, right, corner)
            if rows > cells:
                continue
            width, wide = 0, 0
            for r in range(rows):
                width = max(width, right[r])
                if right[r] - left[r] > right[wide] - left[wide]:
                    wide = r
            if width > cells:
                continue
            y = 0
            while y + HEIGHT_WEIGHT * rows < best_cost and y + rows <= depth:
                possible = widest[y + wide] >= right[wide] - left[wide]
                r = 0
                while possible and r < rows:
                    possible = widest[y + r] >= right[r] - left[r]
                    r += 1
                if not possible:
                    y += 1
                    continue
                x, found = 0, False
                while not found and x + width <= cells:
                    move = 0
                    for r in range(rows):
                        if right[r] < 0:
                            continue
                        x0 = x + left[r]
                        room = run[y + r, x0]
                        if room < right[r] - left[r]:  # past the cells that are taken there
                            room = max(room, 0)
                            move = max(move, room - min(run[y + r, x0 + room], 0))
                            if x + move + width > cells:
                                break
                    found = move == 0
                    x += move
                if found:
                    best_turn, best_x, best_y, best_cost = turn, x, y, y + HEIGHT_WEIGHT * rows
                    break
                y += 1
        if best_turn < 0:
            return np.inf
        angle = 2 * np.pi * best_turn / rotations
        cosine, sine = sizes[c] * np.cos(angle), sizes[c] * np.sin(angle)
        rows = _rows(points, first[c], first[c + 1], cosine, sine, half, left, right, corner)
        for r in range(rows):
            if right[r] < 0:
                continue
            y, x0, x1 = best_y + r, best_x + left[r], best_x + right[r]
            taken = min(run[y, x1], 0)
            for x in range(x1 - 1, x0 - 1, -1):
                taken -= 1
                run[y, x] = taken
            x = x0 - 1
            if x >= 0 and run[y, x] < 0:
                while x >= 0 and run[y, x] < 0:
                    taken -= 1
                    run[y, x] = taken
                    x -= 1
            else:
                while x >= 0 and run[y, x] > 0:
                    run[y, x] = x0 - x
                    x -= 1
            widest[y] = 0
            x = 0
            while x < cells:
                widest[y] = max(widest[y], run[y, x])
                x += abs(run[y, x])
        highest = max(highest, best_y + rows)
        turns[c] = best_turn
        offsets[c, 0] = best_x - corner[0] + half
        offsets[c, 1] = best_y - corner[1] + half
    return float(highest)
