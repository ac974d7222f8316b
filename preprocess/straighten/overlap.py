"""Where straightened silhouettes cross or touch: the guard that keeps a chart from overlapping itself or another.

Two segments that share no texture vertex may not meet at all; two that share one may not run along each other. Tests
are exact in the safe sense: orientations that rounding could turn count as touching.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats
from preprocess.numerics.jit import entry, helper

ROUNDING = 1e-15  # error of an orientation in float64, relative to the magnitudes of its products


@helper
def _turn(ax, ay, bx, by, cx, cy):  # type: ignore[no-untyped-def]
    """Orientation of a, b, c: -1, 1, or 0 where rounding decides."""
    left, right = (bx - ax) * (cy - ay), (by - ay) * (cx - ax)
    scale = max(abs(ax), abs(ay), abs(bx), abs(by), abs(cx), abs(cy))
    size = abs(bx - ax) + abs(by - ay) + abs(cx - ax) + abs(cy - ay)
    error = ROUNDING * (abs(left) + abs(right) + scale * size)
    value = left - right
    return 0 if abs(value) <= error else (1 if value > 0.0 else -1)


@helper
def _meet(p, q, ids_p, ids_q):  # type: ignore[no-untyped-def]
    """Whether segments p and q (ends as x0, y0, x1, y1), whose boxes overlap, meet where they should not."""
    shared = -1
    for a in range(2):
        for b in range(2):
            if ids_p[a] == ids_q[b]:
                if shared >= 0:
                    return True  # the same two ends
                shared = 2 * a + b
    if shared >= 0:
        a, b = shared // 2, shared % 2
        x, y = p[2 * a], p[2 * a + 1]
        px, py = p[2 - 2 * a], p[3 - 2 * a]
        qx, qy = q[2 - 2 * b], q[3 - 2 * b]
        return _turn(x, y, px, py, qx, qy) == 0 and (px - x) * (qx - x) + (py - y) * (qy - y) > 0.0
    a = _turn(p[0], p[1], p[2], p[3], q[0], q[1])
    b = _turn(p[0], p[1], p[2], p[3], q[2], q[3])
    c = _turn(q[0], q[1], q[2], q[3], p[0], p[1])
    d = _turn(q[0], q[1], q[2], q[3], p[2], p[3])
    if a == 0 and b == 0 and c == 0 and d == 0:  # on one line; their boxes overlap
        return True
    return a * b <= 0 and c * d <= 0


@helper
def _distance_sq(p, q):  # type: ignore[no-untyped-def]
    """Squared distance of two segments that do not cross: from an end of one to the other."""
    nearest = np.inf
    for swap in range(2):
        s, other = (p, q) if swap == 0 else (q, p)
        dx, dy = s[2] - s[0], s[3] - s[1]
        square = dx * dx + dy * dy
        for end in range(2):
            x, y = other[2 * end] - s[0], other[2 * end + 1] - s[1]
            t = min(max((x * dx + y * dy) / square, 0.0), 1.0)
            nearest = min(nearest, (x - t * dx) ** 2 + (y - t * dy) ** 2)
    return nearest


@entry
def _find_meeting(segments, ids, charts, keep_apart, gap, low, high, order):  # type: ignore[no-untyped-def]
    """Which segments meet another. `order` sorts them by their least x; `low` and `high` are their boxes."""
    n = len(segments)
    meets = np.zeros(n, np.bool_)
    for i in range(n):
        p = order[i]
        for j in range(i + 1, n):
            q = order[j]
            if low[q, 0] > high[p, 0] + gap:
                break
            if low[q, 1] > high[p, 1] + gap or low[p, 1] > high[q, 1] + gap or (meets[p] and meets[q]):
                continue
            same = charts[p] == charts[q]
            if not same and not keep_apart:
                continue
            near = low[q, 0] <= high[p, 0] and low[q, 1] <= high[p, 1] and low[p, 1] <= high[q, 1]
            bad = near and _meet(segments[p], segments[q], ids[p], ids[q])
            if not bad and not same and gap > 0.0:
                bad = _distance_sq(segments[p], segments[q]) < gap * gap
            if bad:
                meets[p] = True
                meets[q] = True
    return meets


def find_meeting_segments(
    segments: Floats, ids: NDArray[np.integer], charts: NDArray[np.integer], keep_apart: bool, gap_uv: float = 0.0
) -> Bools:
    """Which segments cross, touch or run along another one, or come too near another chart's.

    Parameters
    ----------
    segments : (S, 2, 2) float64
        End points. Segments without length are ignored.
    ids : (S, 2) int
        Texture vertices at the ends.
    charts : (S,) int
    keep_apart : bool
        Compare the segments of different charts too.
    gap_uv : float
        Least distance of different charts.

    Returns
    -------
    (S,) bool
    """
    result = np.zeros(len(segments), bool)
    real = np.flatnonzero((segments[:, 0] != segments[:, 1]).any(axis=1))
    if len(real):
        kept = segments[real]
        low, high = kept.min(axis=1), kept.max(axis=1)
        order = np.argsort(low[:, 0], kind="stable")
        flat = np.ascontiguousarray(kept.reshape(-1, 4))
        rows = (ids[real].astype(np.int64), charts[real].astype(np.int64))
        result[real] = _find_meeting(flat, *rows, keep_apart, float(gap_uv), low, high, order)
    return result


@entry
def find_swept_runs(joint, first, last, sides, run_charts, points, point_charts):  # type: ignore[no-untyped-def]
    """Which runs passed over a point of another chart on their way from outline to segment.

    Runs that meet nothing may still have swept over a chart that is small enough to lie between the two.

    Parameters
    ----------
    joint : (P, 4) float64
        Chain points as they were.
    first, last : (R,) int64
        Ends of the runs among them; the points between lie on the outline.
    sides : (R,) int64
        Which pair of columns a run is about.
    run_charts : (R,) int64
    points : (N, 2) float64
        Points that do not move.
    point_charts : (N,) int64

    Returns
    -------
    (R,) bool
    """
    swept = np.zeros(len(first), np.bool_)
    for r in range(len(first)):
        i, j, column = first[r], last[r], 2 * sides[r]
        if j == i + 1:
            continue
        x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
        for k in range(i, j + 1):
            x0, x1 = min(x0, joint[k, column]), max(x1, joint[k, column])
            y0, y1 = min(y0, joint[k, column + 1]), max(y1, joint[k, column + 1])
        for n in range(len(points)):
            x, y = points[n, 0], points[n, 1]
            if x < x0 or x > x1 or y < y0 or y > y1 or point_charts[n] == run_charts[r]:
                continue
            inside = False
            for k in range(i, j + 1):
                m = k + 1 if k < j else i
                ax, ay, bx, by = joint[k, column], joint[k, column + 1], joint[m, column], joint[m, column + 1]
                if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
                    inside = not inside
            if inside:
                swept[r] = True
                break
    return swept
