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

from preprocess.decimate.quadrics import (
    FIRST,
    FIVE,
    FOUR,
    REGULARISE_REL,
    SYSTEM_ROW,
    THREE,
    add_with_uv_held,
    clear,
    evaluate_position,
    solve,
)
from preprocess.decimate.rules import (
    POINT_ROW,
    POSE_QUADRIC,
    POSE_ROTATION,
    QUADRIC_ROW,
    SEAM_TOLERANCE,
    SILHOUETTES,
    STRICT,
    STRICT_NONE,
    STRICT_SEAMLESS,
    UV_SCALE,
    is_silhouette,
    line_distance,
    other_silhouette,
)
from preprocess.decimate.topology import TAIL, TWIN, WEDGE, next_of, previous_of
from preprocess.numerics.jit import fixed_memory_helper as helper


@helper
def _blend(p, q, f):
    return (1.0 - f) * p + f * q


@helper
def draw_position(texture, u, v, point):
    """Write the position texture's value at a uv into `point`: bilinear, clamped (the rule of texels.py)."""
    height, width = texture.shape[0], texture.shape[1]
    px = min(max(u * width - 0.5, 0.0), width - 1.0)
    py = min(max(v * height - 0.5, 0.0), height - 1.0)
    i, j = min(int(px), max(width - 2, 0)), min(int(py), max(height - 2, 0))
    i1, j1 = min(i + 1, width - 1), min(j + 1, height - 1)
    for axis in range(3):
        above = _blend(texture[j, i, axis], texture[j, i1, axis], px - i)
        below = _blend(texture[j1, i, axis], texture[j1, i1, axis], px - i)
        point[axis] = _blend(above, below, py - j)


@helper
def hold_vertex(links, uv, quadric, ten, h, scale):
    """Add the position quadrics of all wedges of the silhouette vertex that h starts at, each at its own uv."""
    start = h
    while not is_silhouette(links, h):
        h = links[previous_of(h), TWIN]
        if h == start:  # no seam is left here: one wedge is all there is
            w = links[h, WEDGE]
            if w >= 0:
                add_with_uv_held(quadric, w, uv[w, 0] * scale, uv[w, 1] * scale, ten)
            return
    g = h
    while True:
        w = links[g, WEDGE]
        if w >= 0 and is_silhouette(links, g):
            add_with_uv_held(quadric, w, uv[w, 0] * scale, uv[w, 1] * scale, ten)
        g = links[previous_of(g), TWIN]
        if g == h:
            return


@helper
def hold_end(links, quadric, ten, left, right, u0, v0, u1, v1, scale):
    """Add the position quadrics of one or two wedges of an edge's end, the left at (u0, v0), the right at (u1, v1)."""
    if left >= 0:
        add_with_uv_held(quadric, left, u0 * scale, v0 * scale, ten)
    if right >= 0 and right != left:
        add_with_uv_held(quadric, right, u1 * scale, v1 * scale, ten)


@helper
def pose_position(pose, xyz, a, b, x, y, z, p, point):
    """Write, in pose p, a point near the edge a-b: the ends' blend, and the offset from it turned along with it."""
    dx, dy, dz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
    square = dx * dx + dy * dy + dz * dz
    ex, ey, ez = x - xyz[a, 0], y - xyz[a, 1], z - xyz[a, 2]
    s = min(max((dx * ex + dy * ey + dz * ez) / square, 0.0), 1.0) if square > 0.0 else 0.0
    nearest = a if s < 0.5 else b
    for axis in range(3):
        r = POSE_ROTATION + 3 * axis
        value = pose[nearest, p, r] * (ex - s * dx) + pose[nearest, p, r + 1] * (ey - s * dy)
        value += pose[nearest, p, r + 2] * (ez - s * dz)
        point[axis] = value + _blend(pose[a, p, axis], pose[b, p, axis], s)


@helper
def pose_cost(pose, xyz, a, b, x, y, z, point):
    """Sum over the poses of the ends' quadrics at the posed point; `point` is scratch."""
    cost = 0.0
    for p in range(pose.shape[1]):
        pose_position(pose, xyz, a, b, x, y, z, p, point)
        cost += evaluate_position(pose[a, p], POSE_QUADRIC, point[0], point[1], point[2])
        cost += evaluate_position(pose[b, p], POSE_QUADRIC, point[0], point[1], point[2])
    return cost


@helper
def _add_candidate(m, n, h, x, y, z, u0, v0, u1, v1):
    """Write candidate n with the cost that the held quadrics and the poses give it; returns n + 1."""
    cost = evaluate_position(m.work[QUADRIC_ROW], FIRST, x, y, z)
    if m.pose.shape[1] > 0:
        a, b = m.links[h, TAIL], m.links[m.links[h, TWIN], TAIL]
        cost += pose_cost(m.pose, m.xyz, a, b, x, y, z, m.work[POINT_ROW])
    row = m.work[n]
    row[0], row[1], row[2], row[3] = cost, x, y, z
    row[4], row[5], row[6], row[7] = u0, v0, u1, v1
    return n + 1


@helper
def _add_free(m, n, h, x, y, z, u0, v0, u1, v1):
    """Add the candidate of two free ends; with a texture it stands where the texture draws it."""
    t = m.links[h, TWIN]
    if m.texture.shape[0] > 0:
        point = m.work[POINT_ROW]
        draw_position(m.texture, u0, v0, point)
        x, y, z = point[0], point[1], point[2]
    clear(m.work[QUADRIC_ROW])
    scale = m.settings[UV_SCALE]
    left, right = m.links[h, WEDGE], m.links[next_of(t), WEDGE]
    hold_end(m.links, m.quadric, m.work[QUADRIC_ROW], left, right, u0, v0, u1, v1, scale)
    left, right = m.links[next_of(h), WEDGE], m.links[t, WEDGE]
    hold_end(m.links, m.quadric, m.work[QUADRIC_ROW], left, right, u0, v0, u1, v1, scale)
    return _add_candidate(m, n, h, x, y, z, u0, v0, u1, v1)


@helper
def _solve_free(work, xyz, uv, quadric, a, b, wa, wb, scale):
    """Least cost over R5 of two wedges' quadrics, into the last column of the system; False where there is none."""
    trace, n = 0.0, 0
    for i in range(5):
        for j in range(i, 5):
            work[SYSTEM_ROW + i, j] = quadric[wa, n] + quadric[wb, n]
            n += 1
        trace += work[SYSTEM_ROW + i, i]
    weight = REGULARISE_REL * trace
    for i in range(5):
        middle = _blend(xyz[a, i], xyz[b, i], 0.5) if i < 3 else scale * _blend(uv[wa, i - 3], uv[wb, i - 3], 0.5)
        work[SYSTEM_ROW + i, i] += weight
        work[SYSTEM_ROW + i, 5] = weight * middle - quadric[wa, 15 + i] - quadric[wb, 15 + i]
    return solve(work, FIVE)


@helper
def _propose_free(m, h, full):
    """Both ends inside a chart."""
    t = m.links[h, TWIN]
    a, b, wa, wb = m.links[h, TAIL], m.links[t, TAIL], m.links[h, WEDGE], m.links[t, WEDGE]
    scale = m.settings[UV_SCALE]
    n = FIRST
    if _solve_free(m.work, m.xyz, m.uv, m.quadric, a, b, wa, wb, scale):
        x, y, z = m.work[SYSTEM_ROW, 5], m.work[SYSTEM_ROW + 1, 5], m.work[SYSTEM_ROW + 2, 5]
        u, v = m.work[SYSTEM_ROW + 3, 5] / scale, m.work[SYSTEM_ROW + 4, 5] / scale
        n = _add_free(m, n, h, x, y, z, u, v, u, v)
    if full or n == 0 or m.texture.shape[0] > 0:
        for step in range(5):
            f = 0.25 * step
            x, y, z = (
                _blend(m.xyz[a, 0], m.xyz[b, 0], f),
                _blend(m.xyz[a, 1], m.xyz[b, 1], f),
                _blend(m.xyz[a, 2], m.xyz[b, 2], f),
            )
            u, v = _blend(m.uv[wa, 0], m.uv[wb, 0], f), _blend(m.uv[wa, 1], m.uv[wb, 1], f)
            n = _add_free(m, n, h, x, y, z, u, v, u, v)
    return n


@helper
def _propose_fixed(m, h, full):
    """The start of h keeps its uvs; only its position may move, and with a texture not even that."""
    t = m.links[h, TWIN]
    a, wa0, wa1 = m.links[h, TAIL], m.links[h, WEDGE], m.links[next_of(t), WEDGE]
    scale = m.settings[UV_SCALE]
    w0 = wa0 if wa0 >= 0 else wa1
    w1 = wa1 if wa1 >= 0 else wa0
    u0, v0, u1, v1 = m.uv[w0, 0], m.uv[w0, 1], m.uv[w1, 0], m.uv[w1, 1]
    q, s = m.work[QUADRIC_ROW], m.work
    clear(q)
    hold_vertex(m.links, m.uv, m.quadric, q, h, scale)
    silhouettes = m.vertices[m.links[t, TAIL], SILHOUETTES]
    if silhouettes > 2 or (silhouettes > 0 and not is_silhouette(m.links, h)):
        hold_vertex(m.links, m.uv, m.quadric, q, t, scale)
    else:
        hold_end(m.links, m.quadric, q, m.links[next_of(h), WEDGE], m.links[t, WEDGE], u0, v0, u1, v1, scale)
    n = FIRST
    x, y, z = m.xyz[a, 0], m.xyz[a, 1], m.xyz[a, 2]
    if m.texture.shape[0] == 0:
        weight = REGULARISE_REL * (q[0] + q[3] + q[5])
        s[8, 0], s[8, 1], s[8, 2], s[8, 3] = q[0] + weight, q[1], q[2], weight * x - q[6]
        s[9, 1], s[9, 2], s[9, 3] = q[3] + weight, q[4], weight * y - q[7]
        s[10, 2], s[10, 3] = q[5] + weight, weight * z - q[8]
        if solve(s, THREE):
            n = _add_candidate(m, n, h, s[8, 3], s[9, 3], s[10, 3], u0, v0, u1, v1)
    if full or n == 0:
        n = _add_candidate(m, n, h, x, y, z, u0, v0, u1, v1)
    return n


@helper
def joint_line(m, h):
    """Wedges at the ends of the line along which a seam edge with two unifiable ends may slide.

    Returns
    -------
    p0, q0, p1, q1 : wedges, of the left and the right side of h; NO_WEDGE on a boundary's open side
    at_a, at_b : float, the two ends' fractions along the line
    deviation : float
        Largest uv distance of the two ends from that line, and of what they already stand for.
    """
    links = m.links
    t = links[h, TWIN]
    a0, a1, b0, b1 = links[h, WEDGE], links[next_of(t), WEDGE], links[next_of(h), WEDGE], links[t, WEDGE]
    if m.settings[STRICT] == STRICT_NONE:
        return a0, b0, a1, b1, 0.0, 1.0, m.deviation[h]
    k, g = other_silhouette(links, h), other_silhouette(links, t)
    tk, tg = links[k, TWIN], links[g, TWIN]
    p0, q0, p1, q1 = links[tk, WEDGE], links[next_of(g), WEDGE], links[next_of(k), WEDGE], links[tg, WEDGE]
    paired = m.settings[STRICT] == STRICT_SEAMLESS and a0 >= 0 and b1 >= 0
    from_a, at_a = line_distance(m.uv, p0, p1, a0, a1, q0, q1, paired)
    from_b, at_b = line_distance(m.uv, p0, p1, b0, b1, q0, q1, paired)
    before = max(m.deviation[h], m.deviation[k], m.deviation[g])
    return p0, q0, p1, q1, at_a, at_b, before + max(from_a, from_b)


@helper
def _hold_line(quadric, uv, work, w, p, q, scale):
    """Add a wedge's quadric, restricted to uvs on the line p-q, to the system in (x, y, z, t)."""
    pu, pv = uv[p, 0] * scale, uv[p, 1] * scale
    du, dv = uv[q, 0] * scale - pu, uv[q, 1] * scale - pv
    n = 0
    for i in range(3):
        for j in range(i, 3):
            work[SYSTEM_ROW + i, j] += quadric[w, n]
            n += 1
        to_u, to_v = quadric[w, n], quadric[w, n + 1]
        n += 2
        work[SYSTEM_ROW + i, 3] += to_u * du + to_v * dv
        work[SYSTEM_ROW + i, 4] -= quadric[w, 15 + i] + to_u * pu + to_v * pv
    uu, uv_, vv = quadric[w, 12], quadric[w, 13], quadric[w, 14]
    work[SYSTEM_ROW + 3, 3] += uu * du * du + 2.0 * uv_ * du * dv + vv * dv * dv
    along_u, along_v = quadric[w, 18] + uu * pu + uv_ * pv, quadric[w, 19] + uv_ * pu + vv * pv
    work[SYSTEM_ROW + 3, 4] -= along_u * du + along_v * dv


@helper
def solve_joint(links, xyz, uv, quadric, work, h, p0, q0, p1, q1, regularise, scale):
    """Position and parameter of least cost on a joint line: the quadratic program in closed form.

    Returns
    -------
    solved : bool
    x, y, z, t : float
    """
    twin = links[h, TWIN]
    a, b = links[h, TAIL], links[twin, TAIL]
    held, t, column = False, 0.5, FOUR
    # First the four unknowns; where t leaves [0, 1], the three with t at the end it left by.
    while True:
        for i in range(4):
            for j in range(i, 5):
                work[SYSTEM_ROW + i, j] = 0.0
        if p0 >= 0:
            _hold_line(quadric, uv, work, links[h, WEDGE], p0, q0, scale)
            _hold_line(quadric, uv, work, links[next_of(h), WEDGE], p0, q0, scale)
        if p1 >= 0:
            _hold_line(quadric, uv, work, links[next_of(twin), WEDGE], p1, q1, scale)
            _hold_line(quadric, uv, work, links[twin, WEDGE], p1, q1, scale)
        weight = regularise * (work[SYSTEM_ROW, 0] + work[SYSTEM_ROW + 1, 1] + work[SYSTEM_ROW + 2, 2])
        for i in range(3):
            work[SYSTEM_ROW + i, i] += weight
            work[SYSTEM_ROW + i, 4] += weight * _blend(xyz[a, i], xyz[b, i], 0.5)
        if held:
            column = THREE
            for i in range(3):
                work[SYSTEM_ROW + i, 3] = work[SYSTEM_ROW + i, 4] - work[SYSTEM_ROW + i, 3] * t
        else:
            weight = regularise * work[SYSTEM_ROW + 3, 3]
            work[SYSTEM_ROW + 3, 3] += weight
            work[SYSTEM_ROW + 3, 4] += weight * 0.5
        solved = solve(work, column)
        if not held:
            t = work[SYSTEM_ROW + 3, 4]
        if held or not solved or (t >= 0.0 and t <= 1.0):
            return solved, work[SYSTEM_ROW, column], work[SYSTEM_ROW + 1, column], work[SYSTEM_ROW + 2, column], t
        held, t = True, min(max(t, 0.0), 1.0)


@helper
def _propose_joint(m, h, full):
    """Two unifiable ends: slide along the joint line. None where both ends cannot go at once within the tolerance."""
    p0, q0, p1, q1, at_a, at_b, deviation = joint_line(m, h)
    if not deviation <= m.settings[SEAM_TOLERANCE]:
        return 0
    a, b = m.links[h, TAIL], m.links[m.links[h, TWIN], TAIL]
    best, x, y, z, t = solve_joint(
        m.links, m.xyz, m.uv, m.quadric, m.work, h, p0, q0, p1, q1, REGULARISE_REL, m.settings[UV_SCALE]
    )
    n = FIRST
    for step in range(-1, 3):
        if step >= 0:
            if not (full or n == 0 or m.texture.shape[0] > 0):
                break
            f = 0.5 * step
            x, y, z = (
                _blend(m.xyz[a, 0], m.xyz[b, 0], f),
                _blend(m.xyz[a, 1], m.xyz[b, 1], f),
                _blend(m.xyz[a, 2], m.xyz[b, 2], f),
            )
            t = (1.0 - f) * at_a + f * at_b
        elif not best:
            continue
        u0 = _blend(m.uv[p0, 0], m.uv[q0, 0], t) if p0 >= 0 else _blend(m.uv[p1, 0], m.uv[q1, 0], t)
        v0 = _blend(m.uv[p0, 1], m.uv[q0, 1], t) if p0 >= 0 else _blend(m.uv[p1, 1], m.uv[q1, 1], t)
        u1 = _blend(m.uv[p1, 0], m.uv[q1, 0], t) if p1 >= 0 else u0
        v1 = _blend(m.uv[p1, 1], m.uv[q1, 1], t) if p1 >= 0 else v0
        n = _add_free(m, n, h, x, y, z, u0, v0, u1, v1)
    return n


@helper
def propose(m, h, free_ends, full):
    """Fill the first rows of `m.work` with placements for an oriented edge.

    Parameters
    ----------
    m : Mesh
    h : half-edge, from the end to keep (`rules.orient`)
    free_ends : 1 or 2
    full : BEST or ALL (rules.py)
        Whether to add the alternatives to the best one.

    Returns
    -------
    int
        Number of candidates, rows [cost, x, y, z, u0, v0, u1, v1].
    """
    if free_ends == 1:
        return _propose_fixed(m, h, full)
    if is_silhouette(m.links, h):
        n = _propose_joint(m, h, full)
        return n if n > 0 else _propose_fixed(m, h, full)
    return _propose_free(m, h, full)


@helper
def best_cost(m, count):
    """Least cost among the first candidates, infinity for none; squared distances below zero are rounding."""
    best = math.inf
    for n in range(count):
        best = min(best, m.work[n, 0])
    return max(best, 0.0)
