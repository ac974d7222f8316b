"""Where the vertex that is left of an edge may go, and at what cost (paper, section 5.1).

Three cases of the rule table have something to choose:

- both ends inside a chart: the point of R5 with the least sum of the two quadrics;
- one end fixed: the same with uv held, position alone;
- two unifiable ends of a seam edge: position and one parameter t in [0, 1] along the joint lines p-q of both sides.
  The paper's quadratic program over (x, y, z, u1, v1, u2, v2) has one degree of freedom in uv once its equality
  constraints are put in, so it is four linear equations; where t leaves the box, it is three with t at its end
  (the minimum over position is a convex parabola in t).

With a position texture, the position is not free: it is what the texture holds at the uv, and the quadric is evaluated
there. Every case also proposes plain alternatives (the two ends, points between) for when the best one would fold
the mesh.
"""

from __future__ import annotations

import math

from preprocess.decimate.jit import helper
from preprocess.decimate.quadrics import REGULARISE_REL, add_with_uv_held, clear, evaluate, evaluate_position, solve
from preprocess.decimate.rules import (
    SEAM_TOLERANCE,
    STRICT,
    STRICT_NONE,
    STRICT_SEAMLESS,
    UV_SCALE,
    is_silhouette,
    line_distance,
    other_silhouette,
)
from preprocess.decimate.topology import next_of, previous_of


@helper
def drawn_position(m, u, v):
    """Position texture at a uv: bilinear, clamped (the rule of texels.py)."""
    height, width = m.texture.shape[0], m.texture.shape[1]
    px = min(max(u * width - 0.5, 0.0), width - 1.0)
    py = min(max(v * height - 0.5, 0.0), height - 1.0)
    i, j = min(int(px), max(width - 2, 0)), min(int(py), max(height - 2, 0))
    i1, j1 = min(i + 1, width - 1), min(j + 1, height - 1)
    fx, fy = px - i, py - j
    w00, w10, w01, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    t = m.texture
    return (
        w00 * t[j, i, 0] + w10 * t[j, i1, 0] + w01 * t[j1, i, 0] + w11 * t[j1, i1, 0],
        w00 * t[j, i, 1] + w10 * t[j, i1, 1] + w01 * t[j1, i, 1] + w11 * t[j1, i1, 1],
        w00 * t[j, i, 2] + w10 * t[j, i1, 2] + w01 * t[j1, i, 2] + w11 * t[j1, i1, 2],
    )


@helper
def hold_all_wedges(m, v):
    """Add to `m.ten` the position quadrics of all wedges of a silhouette vertex, each at its own uv."""
    scale = m.settings[UV_SCALE]
    infinity = len(m.out) - 1
    first = m.out[v]
    while not is_silhouette(m, first) or m.tail[next_of(first)] == infinity:
        first = m.twin[previous_of(first)]
    g = first
    while True:
        if m.wedge[g] >= 0 and m.tail[next_of(g)] != infinity and is_silhouette(m, g):
            w = m.wedge[g]
            add_with_uv_held(m.quadric[w], m.uv[w, 0] * scale, m.uv[w, 1] * scale, m.ten)
        g = m.twin[previous_of(g)]
        if g == first:
            break


@helper
def pose_position(m, a, b, x, y, z, p, axis):
    """One coordinate, in pose p, of a point near the edge a-b: the ends' blend, and the offset from it turned along."""
    dot, square = 0.0, 0.0
    dot += (x - m.xyz[a, 0]) * (m.xyz[b, 0] - m.xyz[a, 0]) + (y - m.xyz[a, 1]) * (m.xyz[b, 1] - m.xyz[a, 1])
    dot += (z - m.xyz[a, 2]) * (m.xyz[b, 2] - m.xyz[a, 2])
    for i in range(3):
        square += (m.xyz[b, i] - m.xyz[a, i]) ** 2
    s = min(max(dot / square, 0.0), 1.0) if square > 0.0 else 0.0
    rotation = m.pose_rotation[a, p, axis] if s < 0.5 else m.pose_rotation[b, p, axis]
    value = (1.0 - s) * m.pose_xyz[a, p, axis] + s * m.pose_xyz[b, p, axis]
    value += rotation[0] * (x - (1.0 - s) * m.xyz[a, 0] - s * m.xyz[b, 0])
    value += rotation[1] * (y - (1.0 - s) * m.xyz[a, 1] - s * m.xyz[b, 1])
    value += rotation[2] * (z - (1.0 - s) * m.xyz[a, 2] - s * m.xyz[b, 2])
    return value


@helper
def pose_cost(m, a, b, x, y, z):
    """Sum over the poses of the ends' quadrics at the posed point."""
    cost = 0.0
    for p in range(m.pose_xyz.shape[1]):
        px = pose_position(m, a, b, x, y, z, p, 0)
        py = pose_position(m, a, b, x, y, z, p, 1)
        pz = pose_position(m, a, b, x, y, z, p, 2)
        cost += evaluate_position(m.pose_quadric[a, p], px, py, pz)
        cost += evaluate_position(m.pose_quadric[b, p], px, py, pz)
    return cost


@helper
def _put(m, n, cost, x, y, z, u0, v0, u1, v1):
    row = m.candidates[n]
    row[0], row[1], row[2], row[3] = cost, x, y, z
    row[4], row[5], row[6], row[7] = u0, v0, u1, v1
    return n + 1


@helper
def _try_free(m, n, a, b, qa, qb, x, y, z, u, v):
    """Add the candidate at a point of R5 (at what is drawn there, with a texture)."""
    scale = m.settings[UV_SCALE]
    if m.texture.shape[0] > 0:
        x, y, z = drawn_position(m, u, v)
    cost = evaluate(qa, x, y, z, u * scale, v * scale) + evaluate(qb, x, y, z, u * scale, v * scale)
    if m.pose_xyz.shape[1] > 0:
        cost += pose_cost(m, a, b, x, y, z)
    return _put(m, n, cost, x, y, z, u, v, u, v)


@helper
def _propose_free(m, h, full):
    """Both ends inside a chart."""
    t = m.twin[h]
    a, b, wa, wb = m.tail[h], m.tail[t], m.wedge[h], m.wedge[t]
    qa, qb = m.quadric[wa], m.quadric[wb]
    scale = m.settings[UV_SCALE]
    s = m.scratch
    trace, n = 0.0, 0
    for i in range(5):
        for j in range(i, 5):
            s[i, j] = qa[n] + qb[n]
            if i == j:
                trace += s[i, j]
            n += 1
    weight = REGULARISE_REL * trace
    for i in range(5):
        if i < 3:
            middle = 0.5 * (m.xyz[a, i] + m.xyz[b, i])
        else:
            middle = 0.5 * scale * (m.uv[wa, i - 3] + m.uv[wb, i - 3])
        s[i, i] += weight
        s[i, 5] = weight * middle - qa[15 + i] - qb[15 + i]
    n = 0
    solved = solve(s, 5)
    if solved:
        n = _try_free(m, n, a, b, qa, qb, s[0, 5], s[1, 5], s[2, 5], s[3, 5] / scale, s[4, 5] / scale)
    if full or not solved or m.texture.shape[0] > 0:
        for f in (0.0, 1.0, 0.5):
            x, y, z = (
                (1 - f) * m.xyz[a, 0] + f * m.xyz[b, 0],
                (1 - f) * m.xyz[a, 1] + f * m.xyz[b, 1],
                (1 - f) * m.xyz[a, 2] + f * m.xyz[b, 2],
            )
            u, v = (1 - f) * m.uv[wa, 0] + f * m.uv[wb, 0], (1 - f) * m.uv[wa, 1] + f * m.uv[wb, 1]
            n = _try_free(m, n, a, b, qa, qb, x, y, z, u, v)
    return n


@helper
def _solve_position(m, x, y, z):
    """Minimum of the position quadric `m.ten`, drawn a little towards (x, y, z); False where there is none."""
    s, q = m.scratch, m.ten
    weight = REGULARISE_REL * (q[0] + q[3] + q[5])
    s[0, 0], s[0, 1], s[0, 2], s[0, 3] = q[0] + weight, q[1], q[2], weight * x - q[6]
    s[1, 1], s[1, 2], s[1, 3] = q[3] + weight, q[4], weight * y - q[7]
    s[2, 2], s[2, 3] = q[5] + weight, weight * z - q[8]
    return solve(s, 3)


@helper
def _propose_fixed(m, h, full):
    """The start of h keeps its uvs; only its position may move, and with a texture not even that."""
    t = m.twin[h]
    a, b = m.tail[h], m.tail[t]
    scale = m.settings[UV_SCALE]
    wa0, wa1 = m.wedge[h], m.wedge[next_of(t)]
    wb0, wb1 = m.wedge[next_of(h)], m.wedge[t]
    q = m.ten
    clear(q)
    hold_all_wedges(m, a)
    if wb0 >= 0:
        add_with_uv_held(m.quadric[wb0], m.uv[wa0, 0] * scale, m.uv[wa0, 1] * scale, q)
    if wb1 >= 0 and wb1 != wb0:
        add_with_uv_held(m.quadric[wb1], m.uv[wa1, 0] * scale, m.uv[wa1, 1] * scale, q)
    w0 = wa0 if wa0 >= 0 else wa1
    w1 = wa1 if wa1 >= 0 else wa0
    u0, v0, u1, v1 = m.uv[w0, 0], m.uv[w0, 1], m.uv[w1, 0], m.uv[w1, 1]
    n = 0
    solved = False
    posed = m.pose_xyz.shape[1] > 0
    if m.texture.shape[0] == 0:
        solved = _solve_position(m, m.xyz[a, 0], m.xyz[a, 1], m.xyz[a, 2])
        if solved:
            x, y, z = m.scratch[0, 3], m.scratch[1, 3], m.scratch[2, 3]
            cost = evaluate_position(q, x, y, z) + (pose_cost(m, a, b, x, y, z) if posed else 0.0)
            n = _put(m, n, cost, x, y, z, u0, v0, u1, v1)
    if full or not solved:
        x, y, z = m.xyz[a, 0], m.xyz[a, 1], m.xyz[a, 2]
        cost = evaluate_position(q, x, y, z) + (pose_cost(m, a, b, x, y, z) if posed else 0.0)
        n = _put(m, n, cost, x, y, z, u0, v0, u1, v1)
    return n


@helper
def _add_joint(m, wa, wb, pu, pv, du, dv, s):
    """Add one side's two quadrics, restricted to uv = p + t d, to the system in (x, y, z, t); returns its constant."""
    constant = 0.0
    for w in (wa, wb):
        q = m.quadric[w]
        s[0, 0] += q[0]
        s[0, 1] += q[1]
        s[0, 2] += q[2]
        s[1, 1] += q[5]
        s[1, 2] += q[6]
        s[2, 2] += q[9]
        s[0, 3] += q[3] * du + q[4] * dv
        s[1, 3] += q[7] * du + q[8] * dv
        s[2, 3] += q[10] * du + q[11] * dv
        s[3, 3] += q[12] * du * du + 2.0 * q[13] * du * dv + q[14] * dv * dv
        s[0, 4] -= q[15] + q[3] * pu + q[4] * pv
        s[1, 4] -= q[16] + q[7] * pu + q[8] * pv
        s[2, 4] -= q[17] + q[10] * pu + q[11] * pv
        s[3, 4] -= (q[18] + q[12] * pu + q[13] * pv) * du + (q[19] + q[13] * pu + q[14] * pv) * dv
        constant += q[20] + 2.0 * (q[18] * pu + q[19] * pv) + q[12] * pu * pu + 2 * q[13] * pu * pv + q[14] * pv * pv
    return constant


@helper
def joint_line(m, h):
    """Wedges at the ends of the line along which a seam edge with two unifiable ends may slide.

    Returns
    -------
    p0, q0, p1, q1 : wedges, of the left and the right side of h; NO_WEDGE on a boundary's open side
    deviation : float
        Largest uv distance of the two ends from that line, and of what they already stand for.
    """
    t = m.twin[h]
    if m.settings[STRICT] == STRICT_NONE:
        deviation = m.deviation[h]
        return m.wedge[h], m.wedge[next_of(h)], m.wedge[next_of(t)], m.wedge[t], deviation
    k, g = other_silhouette(m, h), other_silhouette(m, t)
    tk, tg = m.twin[k], m.twin[g]
    p0, q0, p1, q1 = m.wedge[tk], m.wedge[next_of(g)], m.wedge[next_of(k)], m.wedge[tg]
    paired = m.settings[STRICT] == STRICT_SEAMLESS and m.wedge[h] >= 0 and m.wedge[t] >= 0
    at_a, _ = line_distance(m, p0, p1, m.wedge[h], m.wedge[next_of(t)], q0, q1, paired)
    at_b, _ = line_distance(m, p0, p1, m.wedge[next_of(h)], m.wedge[t], q0, q1, paired)
    before = max(m.deviation[h], m.deviation[k], m.deviation[g])
    return p0, q0, p1, q1, before + max(at_a, at_b)


@helper
def _try_joint(m, n, h, a, b, p0, q0, p1, q1, t, x, y, z):
    """Add the candidate at parameter t of a joint line."""
    scale = m.settings[UV_SCALE]
    q = m.ten
    clear(q)
    u0, v0, u1, v1 = 0.0, 0.0, 0.0, 0.0
    if p0 >= 0:
        u0, v0 = (1 - t) * m.uv[p0, 0] + t * m.uv[q0, 0], (1 - t) * m.uv[p0, 1] + t * m.uv[q0, 1]
        add_with_uv_held(m.quadric[m.wedge[h]], u0 * scale, v0 * scale, q)
        add_with_uv_held(m.quadric[m.wedge[next_of(h)]], u0 * scale, v0 * scale, q)
    if p1 >= 0:
        twin = m.twin[h]
        u1, v1 = (1 - t) * m.uv[p1, 0] + t * m.uv[q1, 0], (1 - t) * m.uv[p1, 1] + t * m.uv[q1, 1]
        add_with_uv_held(m.quadric[m.wedge[twin]], u1 * scale, v1 * scale, q)
        add_with_uv_held(m.quadric[m.wedge[next_of(twin)]], u1 * scale, v1 * scale, q)
    if p0 < 0:
        u0, v0 = u1, v1
    if p1 < 0:
        u1, v1 = u0, v0
    if m.texture.shape[0] > 0:
        x, y, z = drawn_position(m, u0, v0)
    cost = evaluate_position(q, x, y, z)
    if m.pose_xyz.shape[1] > 0:
        cost += pose_cost(m, a, b, x, y, z)
    return _put(m, n, cost, x, y, z, u0, v0, u1, v1)


@helper
def solve_joint(m, h, p0, q0, p1, q1, regularise, scale):
    """Position and parameter of least cost on a joint line: the quadratic program in closed form.

    Returns
    -------
    solved : bool
    x, y, z, t : float
    """
    twin = m.twin[h]
    a, b = m.tail[h], m.tail[twin]
    s = m.scratch
    x, y, z, t = 0.0, 0.0, 0.0, 0.5
    for clamp in (-1.0, 0.0, 1.0):
        # First the four unknowns; where t leaves [0, 1], the three with t at the end it left by.
        if clamp == 0.0 and not t < 0.0:
            continue
        if clamp == 1.0 and not t > 1.0:
            continue
        for i in range(4):
            for j in range(i, 5):
                s[i, j] = 0.0
        if p0 >= 0:
            du, dv = (m.uv[q0, 0] - m.uv[p0, 0]) * scale, (m.uv[q0, 1] - m.uv[p0, 1]) * scale
            _add_joint(m, m.wedge[h], m.wedge[next_of(h)], m.uv[p0, 0] * scale, m.uv[p0, 1] * scale, du, dv, s)
        if p1 >= 0:
            du, dv = (m.uv[q1, 0] - m.uv[p1, 0]) * scale, (m.uv[q1, 1] - m.uv[p1, 1]) * scale
            _add_joint(m, m.wedge[next_of(twin)], m.wedge[twin], m.uv[p1, 0] * scale, m.uv[p1, 1] * scale, du, dv, s)
        weight = regularise * (s[0, 0] + s[1, 1] + s[2, 2])
        for i in range(3):
            s[i, i] += weight
            s[i, 4] += weight * 0.5 * (m.xyz[a, i] + m.xyz[b, i])
        if clamp < 0.0:
            weight = regularise * s[3, 3]
            s[3, 3] += weight
            s[3, 4] += weight * 0.5
            if not solve(s, 4):
                return False, 0.0, 0.0, 0.0, 0.0
            t = s[3, 4]
            x, y, z = s[0, 4], s[1, 4], s[2, 4]
        else:
            t = clamp
            for i in range(3):
                s[i, 3] = s[i, 4] - s[i, 3] * t
            if not solve(s, 3):
                return False, 0.0, 0.0, 0.0, 0.0
            return True, s[0, 3], s[1, 3], s[2, 3], t
    return True, x, y, z, t


@helper
def _propose_joint(m, h, full):
    """Two unifiable ends: slide along the joint line. None where both ends cannot go at once within the tolerance."""
    p0, q0, p1, q1, deviation = joint_line(m, h)
    if not deviation <= m.settings[SEAM_TOLERANCE]:
        return 0
    twin = m.twin[h]
    a, b = m.tail[h], m.tail[twin]
    n = 0
    solved, x, y, z, t = solve_joint(m, h, p0, q0, p1, q1, REGULARISE_REL, m.settings[UV_SCALE])
    if solved:
        n = _try_joint(m, n, h, a, b, p0, q0, p1, q1, t, x, y, z)
    if full or not solved or m.texture.shape[0] > 0:
        if m.settings[STRICT] == STRICT_NONE:
            at_a, at_b = 0.0, 1.0
        else:
            _, at_a = line_distance(m, p0, p1, m.wedge[h], m.wedge[next_of(twin)], q0, q1, True)
            _, at_b = line_distance(m, p0, p1, m.wedge[next_of(h)], m.wedge[twin], q0, q1, True)
        for f in (0.0, 1.0, 0.5):
            x, y, z = (
                (1 - f) * m.xyz[a, 0] + f * m.xyz[b, 0],
                (1 - f) * m.xyz[a, 1] + f * m.xyz[b, 1],
                (1 - f) * m.xyz[a, 2] + f * m.xyz[b, 2],
            )
            n = _try_joint(m, n, h, a, b, p0, q0, p1, q1, (1 - f) * at_a + f * at_b, x, y, z)
    return n


@helper
def propose(m, h, free_ends, full):
    """Fill `m.candidates` with placements for an oriented edge.

    Parameters
    ----------
    m : Mesh
    h : half-edge, from the end to keep (`rules.orient`)
    free_ends : 1 or 2
    full : bool
        Whether to add the alternatives to the best one.

    Returns
    -------
    int
        Number of candidates, rows [cost, x, y, z, u0, v0, u1, v1].
    """
    if free_ends == 1:
        return _propose_fixed(m, h, full)
    if is_silhouette(m, h):
        n = _propose_joint(m, h, full)
        return n if n > 0 else _propose_fixed(m, h, full)
    return _propose_free(m, h, full)


@helper
def best_cost(m, count):
    """Least cost among the first candidates, infinity for none; squared distances below zero are rounding."""
    best = math.inf
    for n in range(count):
        best = min(best, m.candidates[n, 0])
    return max(best, 0.0)
