"""A convex polygon for every chart, near the shape of its free map.

Corners come from the free map. Where that polygon is not convex, its turning angles are clamped and its side
lengths changed as little as closes it (least squares of relative changes); a polygon that does not close so becomes
one inscribed in a circle, its arcs in proportion to its side lengths.
"""

from __future__ import annotations

import itertools

import numpy as np

from preprocess.arrays import Floats, Ints

MIN_TURN = np.radians(10.0)
"""Least exterior angle: faces in a flatter corner are stretched far (4°: L∞ 29 on Fox, 10°: 6)."""

MIN_INTERIOR = np.radians(30.0)
"""Least interior angle: sharper corners only make slivers."""

MIN_SHARE = 0.25
"""A side keeps at least this share of its length while its polygon is made convex."""


def convex_polygons(corners: Floats, chart_first: Ints, side_lengths: Floats) -> Floats:
    """Corner positions of convex, counter-clockwise polygons.

    Parameters
    ----------
    corners : (N, 2) float64
        Corners in the charts' free maps, in boundary order, charts one after the other.
    chart_first : (C + 1,) int32
    side_lengths : (N,) float64
        Arc length of each side, metres.

    Returns
    -------
    (N, 2) float64
        Each polygon has the area of its free map's polygon where that is positive.
    """
    result = np.empty_like(corners)
    for low, high in itertools.pairwise(chart_first):
        result[low:high] = _convex_polygon(corners[low:high], side_lengths[low:high])
    return result


def _convex_polygon(points: Floats, arc_lengths: Floats) -> Floats:
    sides = np.roll(points, -1, axis=0) - points
    lengths = np.hypot(*sides.T)
    fair = float(arc_lengths.mean())
    if not np.isfinite(sides).all() or lengths.min() <= 1e-3 * fair:
        return _inscribed(arc_lengths)
    heading = np.arctan2(sides[:, 1], sides[:, 0])
    turn = np.angle(np.exp(1j * (heading - np.roll(heading, 1))))  # at the start of each side
    widest = np.pi - MIN_INTERIOR
    least = min(MIN_TURN, np.pi / len(points))
    if turn.min() >= least and turn.max() <= widest and abs(turn.sum() - 2 * np.pi) < 1e-6:
        return points
    if abs(turn.sum() - 2 * np.pi) > 1.0:  # wound the wrong way, or crossing itself
        return _inscribed(arc_lengths)
    for _ in range(20):
        turn = np.clip(turn, least, widest)
        spare = turn - least if turn.sum() > 2 * np.pi else widest - turn
        if abs(turn.sum() - 2 * np.pi) < 1e-9 or spare.sum() <= 0:
            break
        turn = turn + (2 * np.pi - turn.sum()) * spare / spare.sum()
    heading = heading[0] + np.cumsum(np.r_[0.0, turn[1:]])
    directions = np.stack([np.cos(heading), np.sin(heading)])
    closed = _closing_lengths(directions, lengths)
    if closed is None:
        return _inscribed(arc_lengths)
    shape = np.cumsum((directions * closed).T, axis=0)
    shape = np.roll(shape, 1, axis=0)
    before, after = _area(points), _area(shape)
    if after <= 1e-3 * fair**2:
        return _inscribed(arc_lengths)
    return shape * np.sqrt(before / after) if before > 0.1 * after else shape


def _closing_lengths(directions: Floats, lengths: Floats) -> Floats | None:
    """Side lengths nearest to the given ones, relatively, with which the polygon closes."""
    free = np.ones(len(lengths), bool)
    result = lengths.copy()
    for _ in range(len(lengths)):
        weighted = directions[:, free] * lengths[free]
        gram = weighted @ weighted.T
        if free.sum() < 2 or np.linalg.cond(gram) > 1e9:
            return None
        gap = directions @ np.where(free, lengths, MIN_SHARE * lengths)
        change = weighted.T @ np.linalg.solve(gram, gap)
        result[free] = lengths[free] * (1 - change)
        short = free & (result < MIN_SHARE * lengths)
        if not short.any():
            return result
        result[short] = MIN_SHARE * lengths[short]
        free &= ~short
    return None


def _inscribed(arc_lengths: Floats) -> Floats:
    """Polygon in a circle whose arcs are in proportion to the lengths, none over 150 degrees or too short."""
    share = np.clip(arc_lengths / arc_lengths.sum(), 0.08 / len(arc_lengths), 0.416)
    share /= share.sum()
    angle = 2 * np.pi * np.cumsum(np.r_[0.0, share[:-1]])
    shape = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    perimeter = np.hypot(*(np.roll(shape, -1, axis=0) - shape).T).sum()
    return shape * (arc_lengths.sum() / perimeter)


def _area(points: Floats) -> float:
    following = np.roll(points, -1, axis=0)
    return 0.5 * float((points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum())
