"""After the collapses: edges turn and vertices move where that brings the surface nearer to its witnesses.

Edges turn and vertices slide inside the charts, so seams and outlines stay as they are in uv. A vertex also leaves the
surface: one whose vertices all lie on it is inside wherever it bulges, and as far off as it could be. What is minimised
is the sum of the sixth powers of the witnesses' departures (deviation_samples.py), which the worst of them rule.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from preprocess.decimate.deviation import (
    CORNERS,
    CORNERS_STRIDE,
    NONE,
    departure_in_pose,
    find_face,
    gather,
    hand_over,
    num_poses,
    place_apex,
    posed_column_dot,
    rotation_at,
    set_apex,
    square_departure,
    write_face,
)
from preprocess.decimate.deviation_samples import FIRST_POSE, POSE_STRIDE, SLIP_COLUMN, WEIGHT_COLUMN
from preprocess.decimate.placement import draw_position, pose_position
from preprocess.decimate.quadrics import SYSTEM_ROW, THREE, solve
from preprocess.decimate.rules import (
    APEX_ROW,
    FIRST_WITNESS,
    GATHERED,
    ITS_CHART,
    LIFT,
    MIN_NORMAL_DOT,
    MIN_SHAPE,
    MIN_UV_HEIGHT,
    OUT,
    POINT_ROW,
    SIGN,
    SILHOUETTES,
    VERSION,
    WEIGHTS_ROW,
    is_silhouette,
)
from preprocess.decimate.topology import TAIL, TWIN, WEDGE, next_of, previous_of
from preprocess.decimate.validity import position_stays, uv_area, uv_stays
from preprocess.numerics.jit import digest_sources
from preprocess.numerics.jit import fixed_memory_entry as entry
from preprocess.numerics.jit import fixed_memory_helper as helper

ONE, TWO = np.int64(1), np.int64(2)  # NumPy integers: see quadrics.py
# What a change must gain to be made, so that the run comes to rest.
WORTH = 0.97
# Shares of the way to a neighbour that a vertex tries, the first that helps.
LONG_STEP, SHORT_STEP = 0.25, 0.1
# Shares of the least squares' step off the surface that it tries, each half of the one before: for sixth powers a
# fifth is Newton's (Rice and Usow 1968), and more often helps. Damping, of the system's trace.
LONG_LIFT, SHORT_LIFT = 0.8, 0.2
STEP_DAMPING = 1e-3
LIFT_ROW = 2  # of Mesh.work
# A turned edge may change the normals by less than a collapse may, and its faces must be as far again from degenerate.
MIN_TURN_DOT, TURN_MARGIN = 0.5, 4.0


@helper
def _sum_of_departures(m, rows, count, limit):
    """Sum of the sixth powers over the gathered witnesses; infinity where it is not below the limit."""
    total, guess = 0.0, NONE
    for j in range(count):
        found = find_face(m, m.witnesses[j, GATHERED], m.witnesses[j, ITS_CHART], rows, guess)
        if found >= 0:
            guess = found
            square = square_departure(m, m.witnesses[j, GATHERED], found)
            total += square * square * square
            if not total < limit:
                return math.inf
    return total


@helper
def _gather_star(m, v):
    """Gather the witnesses over the faces around a vertex; returns how many there are."""
    count = NONE
    start = m.vertices[v, OUT]
    g = start
    while True:
        if m.links[g, WEDGE] >= 0:
            count = gather(m, g // 3, count)
        g = m.links[previous_of(g), TWIN]
        if g == start:
            return count


@helper
def _write_star(m, v, du, dv):
    """Write the faces around a vertex with it at the apex and its uvs shifted; returns their number, 0 if too many."""
    rows = NONE
    start = m.vertices[v, OUT]
    g = start
    while True:
        w = m.links[g, WEDGE]
        if w >= 0:
            if rows == len(m.fan):
                return NONE
            write_face(m, rows, g // 3, m.uv[w, 0] + du, m.uv[w, 1] + dv, next_of(g), previous_of(g))
            rows += 1
        g = m.links[previous_of(g), TWIN]
        if g == start:
            return rows


@helper
def _star_stays(m, v, du, dv):
    """Whether no face around a vertex folds or degenerates with it at the apex and its uvs shifted."""
    x, y, z = m.work[APEX_ROW, 0], m.work[APEX_ROW, 1], m.work[APEX_ROW, 2]
    start = m.vertices[v, OUT]
    g = start
    while True:
        n, p = next_of(g), previous_of(g)
        w = m.links[g, WEDGE]
        if w >= 0:
            u, v1, height = m.uv[w, 0] + du, m.uv[w, 1] + dv, m.settings[MIN_UV_HEIGHT]
            if not uv_stays(m.uv, w, m.links[n, WEDGE], m.links[p, WEDGE], u, v1, m.faces[g // 3, SIGN], height):
                return False
            b, c = m.links[n, TAIL], m.links[p, TAIL]
            if not position_stays(m.xyz, v, b, c, x, y, z, m.settings[MIN_NORMAL_DOT], m.settings[MIN_SHAPE]):
                return False
        g = m.links[p, TWIN]
        if g == start:
            return True


@helper
def _write_lift(m, v):
    """Write how far an inner vertex has left the position texture into the scratch; nothing where there is none."""
    lift, wedge = m.work[LIFT_ROW], m.links[m.vertices[v, OUT], WEDGE]
    if m.texture.shape[0] > 0:
        draw_position(m.texture, m.uv[wedge, 0], m.uv[wedge, 1], lift)
        for i in range(3):
            lift[i] = m.xyz[v, i] - lift[i]


@helper
def _step_apex(m, v, g, step):
    """Put the apex a step towards the neighbour at the end of g, as far off the texture as it is; returns the shift."""
    w, to = m.links[g, WEDGE], m.links[next_of(g), WEDGE]
    b = m.links[next_of(g), TAIL]
    du, dv = step * (m.uv[to, 0] - m.uv[w, 0]), step * (m.uv[to, 1] - m.uv[w, 1])
    point = m.work[POINT_ROW]
    if m.texture.shape[0] > 0:
        draw_position(m.texture, m.uv[w, 0] + du, m.uv[w, 1] + dv, point)
        for i in range(3):
            point[i] += m.work[LIFT_ROW, i]
    else:
        for i in range(3):
            point[i] = m.xyz[v, i] + step * (m.xyz[b, i] - m.xyz[v, i])
    place_apex(m, v, b, point[0], point[1], point[2])
    return du, dv


@helper
def _move(m, v, b, rows, count):
    """Put a vertex at the apex, on its way to its neighbour b, in every pose; its star is in the fan."""
    x, y, z = m.work[APEX_ROW, 0], m.work[APEX_ROW, 1], m.work[APEX_ROW, 2]
    point = m.work[POINT_ROW]
    for p in range(m.pose.shape[1]):
        pose_position(m.pose, m.xyz, v, b, x, y, z, p, point)
        for i in range(3):
            m.pose[v, p, i] = point[i]
    m.xyz[v, 0], m.xyz[v, 1], m.xyz[v, 2] = x, y, z
    for i in range(rows):
        m.faces[int(m.fan[i, 0]), FIRST_WITNESS] = -1
    hand_over(m, rows, count)


@helper
def _slide(m, v):
    """Move an inner vertex a step towards the neighbour where that helps most, if it helps."""
    start = m.vertices[v, OUT]
    count = _gather_star(m, v)
    wedge = m.links[start, WEDGE]
    set_apex(m, v)
    rows = _write_star(m, v, 0.0, 0.0)
    if rows == 0 or count == 0:
        return False
    _write_lift(m, v)
    least, best, step = WORTH * _sum_of_departures(m, rows, count, math.inf), -1, LONG_STEP
    while True:
        g = start
        while True:
            du, dv = _step_apex(m, v, g, step)
            if _star_stays(m, v, du, dv):
                _write_star(m, v, du, dv)
                value = _sum_of_departures(m, rows, count, least)
                if value < least:
                    least, best = value, g
            g = m.links[previous_of(g), TWIN]
            if g == start:
                break
        if best >= 0 or step == SHORT_STEP:
            break
        step = SHORT_STEP
    if best < 0:
        return False
    du, dv = _step_apex(m, v, best, step)
    b = m.links[next_of(best), TAIL]
    m.uv[wedge, 0] += du
    m.uv[wedge, 1] += dv
    _write_star(m, v, 0.0, 0.0)
    _move(m, v, b, rows, count)
    return True


@helper
def _accumulate_step(m, v, rows, count):
    """Set up the least squares for a vertex's step off the surface; its star is in the fan.

    A sample's departure in the pose where it is largest is linear in the step. Squares of it count with the fourth
    power of what it is now: reweighted least squares for the sum of sixth powers (Lawson 1961).

    Returns
    -------
    float
        The sum of sixth powers now.
    """
    system, weights = m.work[SYSTEM_ROW:], m.work[WEIGHTS_ROW]
    for i in range(3):
        for j in range(4):
            system[i, j] = 0.0
    total, guess = 0.0, NONE
    for j in range(count):
        k = m.witnesses[j, GATHERED]
        found = find_face(m, k, m.witnesses[j, ITS_CHART], rows, guess)
        if found < 0:
            continue
        guess = found
        row, point = m.fan[found], m.points[k]
        largest, pose, slip = 0.0, 0, point[SLIP_COLUMN]
        for q in range(num_poses(m)):
            along, square = departure_in_pose(row, point, weights, q)
            value = along * along + slip * (square - along * along)
            if value > largest:
                largest, pose = value, q
        largest *= point[WEIGHT_COLUMN]
        total += largest * largest * largest
        o, p = CORNERS + CORNERS_STRIDE * pose, FIRST_POSE + POSE_STRIDE * pose
        along, square = departure_in_pose(row, point, weights, pose)
        importance = largest * largest * point[WEIGHT_COLUMN] * weights[0]
        # The vertex's step turns with it: of a column of its rotation c, n·c along the normal, and c itself.
        for i in range(3):
            normal_i = posed_column_dot(m, v, pose, i, point, p + 3)
            pull = (1.0 - slip) * normal_i * along
            for axis in range(3):
                away = weights[0] * row[o + axis] + weights[1] * row[o + 3 + axis] + weights[2] * row[o + 6 + axis]
                pull += slip * rotation_at(m, v, pose, axis, i) * (away - point[p + axis])
            system[i, 3] -= importance * pull
            for n in range(i, 3):
                normal_n = posed_column_dot(m, v, pose, n, point, p + 3)
                value = (1.0 - slip) * normal_i * normal_n + (slip if n == i else 0.0)
                system[i, n] += importance * weights[0] * value
    return total


@helper
def _lift(m, v):
    """Move a vertex off the position texture, its uvs unchanged, by the least squares' step or a part of it."""
    count = _gather_star(m, v)
    set_apex(m, v)
    rows = _write_star(m, v, 0.0, 0.0)
    if rows == 0 or count == 0:
        return False
    total = _accumulate_step(m, v, rows, count)
    system = m.work[SYSTEM_ROW:]
    damping = STEP_DAMPING * (system[0, 0] + system[1, 1] + system[2, 2])
    for i in range(3):
        system[i, i] += damping
    if not (total > 0.0 and solve(m.work, THREE)):
        return False
    dx, dy, dz = system[0, 3], system[1, 3], system[2, 3]
    least, best = WORTH * total, 0.0
    share = LONG_LIFT
    while share >= SHORT_LIFT:
        place_apex(m, v, v, m.xyz[v, 0] + share * dx, m.xyz[v, 1] + share * dy, m.xyz[v, 2] + share * dz)
        if _star_stays(m, v, 0.0, 0.0):
            _write_star(m, v, 0.0, 0.0)
            value = _sum_of_departures(m, rows, count, least)
            if value < least:
                least, best = value, share
        share *= 0.5
    if best == 0.0:
        return False
    place_apex(m, v, v, m.xyz[v, 0] + best * dx, m.xyz[v, 1] + best * dy, m.xyz[v, 2] + best * dz)
    _write_star(m, v, 0.0, 0.0)
    _move(m, v, v, rows, count)
    return True


@helper
def _normal(xyz, a, b, c, out):
    """Normal of a face, as long as twice its area, into `out`; returns that and the square of its longest side."""
    ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
    vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
    out[0], out[1], out[2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    longest = max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz)
    longest = max(longest, (vx - ux) ** 2 + (vy - uy) ** 2 + (vz - uz) ** 2)
    return math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2), longest


@helper
def _turn_holds(m, h):
    """Whether the faces on both sides of an edge stay sound when it turns."""
    t = m.links[h, TWIN]
    hp, tp = previous_of(h), previous_of(t)
    a, b, c, d = m.links[h, TAIL], m.links[t, TAIL], m.links[hp, TAIL], m.links[tp, TAIL]
    # An edge between two outlines could not collapse any more.
    across = m.vertices[c, SILHOUETTES] > 0 and m.vertices[d, SILHOUETTES] > 0
    if across and not (m.vertices[a, SILHOUETTES] > 0 and m.vertices[b, SILHOUETTES] > 0):
        return False
    g = hp
    while True:
        if m.links[next_of(g), TAIL] == d:
            return False
        g = m.links[previous_of(g), TWIN]
        if g == hp:
            break
    sign, uv = m.faces[h // 3, SIGN], m.uv
    old, new = m.work[0], m.work[1]
    _normal(m.xyz, a, b, c, old)
    _normal(m.xyz, b, a, d, new)
    x, y, z = old[0] + new[0], old[1] + new[1], old[2] + new[2]
    length = math.sqrt(x * x + y * y + z * z)
    for side in range(2):
        p, q, r = (h, tp, hp) if side == 0 else (tp, t, hp)
        i, j, k = m.links[p, WEDGE], m.links[q, WEDGE], m.links[r, WEDGE]
        area, least = uv_area(uv[i, 0], uv[i, 1], uv[j, 0], uv[j, 1], uv[k, 0], uv[k, 1], m.settings[MIN_UV_HEIGHT])
        if not sign * area > TURN_MARGIN * least:
            return False
        size, longest = _normal(m.xyz, m.links[p, TAIL], m.links[q, TAIL], m.links[r, TAIL], new)
        if not size > TURN_MARGIN * m.settings[MIN_SHAPE] * longest:
            return False
        if not new[0] * x + new[1] * y + new[2] * z > MIN_TURN_DOT * size * length:
            return False
    return True


@helper
def _set_corner(links, h, tail, wedge):
    links[h, TAIL], links[h, WEDGE] = tail, wedge


@helper
def _pair(links, deviation, h, twin, strayed):
    links[h, TWIN], links[twin, TWIN] = twin, h
    deviation[h] = strayed


@helper
def _turn(m, h):
    """Turn an edge inside a chart to the other diagonal of its two faces, if that helps."""
    links, t = m.links, m.links[h, TWIN]
    if links[h, WEDGE] < 0 or links[t, WEDGE] < 0 or is_silhouette(links, h):
        return False
    f, e = h // 3, t // 3
    count = gather(m, e, gather(m, f, NONE))
    if count == 0 or m.faces[f, SIGN] != m.faces[e, SIGN] or not _turn_holds(m, h):
        return False
    hn, hp, tn, tp = next_of(h), previous_of(h), next_of(t), previous_of(t)
    a, b, c, d = links[h, TAIL], links[t, TAIL], links[hp, TAIL], links[tp, TAIL]
    wa, wb, wc, wd = links[h, WEDGE], links[t, WEDGE], links[hp, WEDGE], links[tp, WEDGE]
    set_apex(m, a)
    write_face(m, NONE, f, m.uv[wa, 0], m.uv[wa, 1], t, hp)
    write_face(m, ONE, e, m.uv[wa, 0], m.uv[wa, 1], tp, t)
    before = _sum_of_departures(m, TWO, count, math.inf)
    write_face(m, NONE, f, m.uv[wa, 0], m.uv[wa, 1], tp, hp)
    set_apex(m, d)
    write_face(m, ONE, e, m.uv[wd, 0], m.uv[wd, 1], t, hp)
    if not _sum_of_departures(m, TWO, count, WORTH * before) < math.inf:
        return False
    # Faces (a, d, c) in the places of h, hn, hp and (c, d, b) in those of t, tn, tp.
    to_a, from_b, from_a, to_b = links[hp, TWIN], links[hn, TWIN], links[tn, TWIN], links[tp, TWIN]
    strayed = m.deviation[hp], m.deviation[hn], m.deviation[tn], m.deviation[tp]
    _set_corner(links, h, a, wa)
    _set_corner(links, hn, d, wd)
    _set_corner(links, hp, c, wc)
    _set_corner(links, t, c, wc)
    _set_corner(links, tn, d, wd)
    _set_corner(links, tp, b, wb)
    _pair(links, m.deviation, h, from_a, strayed[2])
    _pair(links, m.deviation, hn, t, 0.0)
    _pair(links, m.deviation, hp, to_a, strayed[0])
    _pair(links, m.deviation, tn, to_b, strayed[3])
    _pair(links, m.deviation, tp, from_b, strayed[1])
    m.deviation[t] = 0.0
    m.vertices[a, OUT], m.vertices[b, OUT], m.vertices[c, OUT], m.vertices[d, OUT] = h, tp, hp, tn
    m.faces[f, FIRST_WITNESS] = -1
    m.faces[e, FIRST_WITNESS] = -1
    hand_over(m, TWO, count)
    return True


def _make_polish(sources: int) -> Any:
    """The entry for one version of the kernels' sources (see jit.py)."""

    @entry
    def polish(m, sweeps, counts):
        """Turn every edge and slide every vertex inside the charts where that helps, a number of times.

        Parameters
        ----------
        m : rules.Mesh
            Prices of edges are out of date afterwards.
        sweeps : int
        counts : (3,) int64
            Gets the number of edges turned, of vertices moved along the surface and off it.
        """
        m.counter[VERSION] = sources
        for _ in range(sweeps):
            for h in range(3 * len(m.faces)):
                if m.links[h, TAIL] >= 0 and h < m.links[h, TWIN]:
                    counts[0] += _turn(m, h)
            for v in range(len(m.vertices) - 1):
                g = m.vertices[v, OUT]
                if m.vertices[v, SILHOUETTES] == 0 and g >= 0 and m.links[g, TAIL] == v:
                    counts[1] += _slide(m, v)
            if m.settings[LIFT] > 0.0:
                for v in range(len(m.vertices) - 1):
                    g = m.vertices[v, OUT]
                    if g >= 0 and m.links[g, TAIL] == v:
                        counts[2] += _lift(m, v)

    return polish


polish = _make_polish(digest_sources(Path(__file__).parent))
