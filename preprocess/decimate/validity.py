"""Whether a collapse leaves a sound mesh: link conditions, and no triangle folded or degenerate in 3D or in uv."""

from __future__ import annotations

import math

from preprocess.decimate.jit import helper
from preprocess.decimate.rules import MIN_NORMAL_DOT, MIN_SHAPE, MIN_UV_HEIGHT, STAMP, is_silhouette
from preprocess.decimate.topology import next_of, previous_of


@helper
def link_holds(m, h):
    """Link condition of an edge on the surface mesh and on the parameter mesh (Dey et al. 1999).

    The ends may share no neighbours but the two that face the edge, and may not both have three neighbours (a
    tetrahedron). The virtual vertex at infinity counts as a neighbour, so the same test holds at boundaries. The
    neighbours of a wedge lie over neighbours of its vertex, so the surface's condition implies the parameter mesh's
    but for what lies at its own infinity: a face whose other two edges are both silhouettes is a chart, or an end of
    one, that may not be closed up.
    """
    t = m.twin[h]
    m.counter[STAMP] += 1
    stamp = m.counter[STAMP]
    valence_a, valence_b, common = 0, 0, 0
    g = h
    while True:
        m.mark[m.tail[next_of(g)]] = stamp
        valence_a += 1
        g = m.twin[previous_of(g)]
        if g == h:
            break
    g = t
    while True:
        if m.mark[m.tail[next_of(g)]] == stamp:
            common += 1
        valence_b += 1
        g = m.twin[previous_of(g)]
        if g == t:
            break
    if common != 2 or (valence_a == 3 and valence_b == 3):
        return False
    for side in (h, t):
        if m.wedge[side] >= 0 and is_silhouette(m, next_of(side)) and is_silhouette(m, previous_of(side)):
            return False
    return True


@helper
def uv_stays(m, f, ux, uy, vx, vy, wx, wy):
    """Whether a face with these uvs keeps its orientation by more than rounding, or at least gets no worse."""
    area = (vx - ux) * (wy - uy) - (vy - uy) * (wx - ux)
    longest = max((vx - ux) ** 2 + (vy - uy) ** 2, (wx - vx) ** 2 + (wy - vy) ** 2, (ux - wx) ** 2 + (uy - wy) ** 2)
    limit = m.settings[MIN_UV_HEIGHT] * math.sqrt(longest)
    # The limit is far above the rounding of the determinant, so the sign of what passes is exact.
    area *= m.orientation[f]
    if area > limit:
        return True
    w0, w1, w2 = m.wedge[3 * f], m.wedge[3 * f + 1], m.wedge[3 * f + 2]
    ux, uy, vx, vy, wx, wy = m.uv[w0, 0], m.uv[w0, 1], m.uv[w1, 0], m.uv[w1, 1], m.uv[w2, 0], m.uv[w2, 1]
    before = m.orientation[f] * ((vx - ux) * (wy - uy) - (vy - uy) * (wx - ux))
    longest = max((vx - ux) ** 2 + (vy - uy) ** 2, (wx - vx) ** 2 + (wy - vy) ** 2, (ux - wx) ** 2 + (uy - wy) ** 2)
    return before <= m.settings[MIN_UV_HEIGHT] * math.sqrt(longest) and area >= before


@helper
def position_stays(m, ax, ay, az, bx, by, bz, cx, cy, cz, dx, dy, dz):
    """Whether the face (a, b, c) keeps its side and a proper shape when a moves to d."""
    ex, ey, ez, fx, fy, fz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    before = nx * nx + ny * ny + nz * nz
    gx, gy, gz, hx, hy, hz = bx - dx, by - dy, bz - dz, cx - dx, cy - dy, cz - dz
    kx, ky, kz = gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx
    after = kx * kx + ky * ky + kz * kz
    opposite = (cx - bx) ** 2 + (cy - by) ** 2 + (cz - bz) ** 2
    longest = max(gx * gx + gy * gy + gz * gz, hx * hx + hy * hy + hz * hz, opposite)
    longest_before = max(ex * ex + ey * ey + ez * ez, fx * fx + fy * fy + fz * fz, opposite)
    shape = m.settings[MIN_SHAPE] ** 2
    if not after > shape * longest * longest:  # height over longest side
        return before <= shape * longest_before * longest_before and after >= before
    if before <= 1e-24 * longest_before * longest_before:
        return True
    return nx * kx + ny * ky + nz * kz > m.settings[MIN_NORMAL_DOT] * math.sqrt(before * after)


@helper
def star_stays(m, v, h, x, y, z, u0, v0, u1, v1):
    """Whether the faces around one end v of edge h that survive stay sound when v goes to a placement.

    Corners of the wedges on the left of h take (u0, v0), those on the right (u1, v1), others keep theirs.
    """
    t = m.twin[h]
    a0, a1, b0, b1 = m.wedge[h], m.wedge[next_of(t)], m.wedge[next_of(h)], m.wedge[t]
    first_face, second_face = h // 3, t // 3
    g = m.out[v]
    start = g
    while True:
        f = g // 3
        w = m.wedge[g]
        if w >= 0 and f != first_face and f != second_face:
            if w in (a0, b0):
                u, vv = u0, v0
            elif w in (a1, b1):
                u, vv = u1, v1
            else:
                u, vv = m.uv[w, 0], m.uv[w, 1]
            n, p = next_of(g), previous_of(g)
            wn, wp = m.wedge[n], m.wedge[p]
            if not uv_stays(m, f, u, vv, m.uv[wn, 0], m.uv[wn, 1], m.uv[wp, 0], m.uv[wp, 1]):
                return False
            c, d = m.tail[n], m.tail[p]
            if not position_stays(
                m,
                m.xyz[v, 0],
                m.xyz[v, 1],
                m.xyz[v, 2],
                m.xyz[c, 0],
                m.xyz[c, 1],
                m.xyz[c, 2],
                m.xyz[d, 0],
                m.xyz[d, 1],
                m.xyz[d, 2],
                x,
                y,
                z,
            ):
                return False
        g = m.twin[previous_of(g)]
        if g == start:
            return True


@helper
def placement_holds(m, h, row):
    """Whether one candidate for edge h folds or degenerates nothing."""
    x, y, z, u0, v0, u1, v1 = row[1], row[2], row[3], row[4], row[5], row[6], row[7]
    return star_stays(m, m.tail[m.twin[h]], h, x, y, z, u0, v0, u1, v1) and star_stays(
        m, m.tail[h], h, x, y, z, u0, v0, u1, v1
    )
