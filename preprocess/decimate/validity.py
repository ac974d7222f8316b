"""Whether a collapse leaves a sound mesh: link conditions, and no triangle folded or degenerate in 3D or in uv."""

from __future__ import annotations

import math

from preprocess.decimate.rules import MARK, MIN_NORMAL_DOT, MIN_SHAPE, MIN_UV_HEIGHT, SIGN, STAMP, is_silhouette
from preprocess.decimate.topology import TAIL, TWIN, WEDGE, next_of, previous_of
from preprocess.numerics.jit import fixed_memory_helper as helper


@helper
def link_holds(links, vertices, counter, relaxed, h):
    """Link condition of an edge on the surface mesh and on the parameter mesh (Dey et al. 1999).

    The ends may share no neighbours but the two that face the edge, and may not both have three neighbours (a
    tetrahedron). The virtual vertex at infinity counts as a neighbour, so the same test holds at boundaries. The
    neighbours of a wedge lie over neighbours of its vertex, so the surface's condition implies the parameter mesh's
    but for what lies at its own infinity: a face whose other two edges are both silhouettes is a chart, or an end of
    one, that may not be closed up: not where seams are relaxed.
    """
    t = links[h, TWIN]
    counter[STAMP] += 1
    stamp = counter[STAMP]
    valence_a, valence_b, common = 0, 0, 0
    g = h
    while True:
        vertices[links[next_of(g), TAIL], MARK] = stamp
        valence_a += 1
        g = links[previous_of(g), TWIN]
        if g == h:
            break
    g = t
    while True:
        if vertices[links[next_of(g), TAIL], MARK] == stamp:
            common += 1
        valence_b += 1
        g = links[previous_of(g), TWIN]
        if g == t:
            break
    if common != 2 or (valence_a == 3 and valence_b == 3):
        return False
    if relaxed > 0.0:
        return True
    left = links[h, WEDGE] >= 0 and is_silhouette(links, next_of(h)) and is_silhouette(links, previous_of(h))
    right = links[t, WEDGE] >= 0 and is_silhouette(links, next_of(t)) and is_silhouette(links, previous_of(t))
    return not (left or right)


@helper
def uv_area(ux, uy, vx, vy, wx, wy, min_height):
    """Twice the signed area of a uv triangle, and the least that counts: its longest side times a height.

    That height is far above the rounding of the determinant, so the sign of what is larger is exact.
    """
    area = (vx - ux) * (wy - uy) - (vy - uy) * (wx - ux)
    longest = max((vx - ux) ** 2 + (vy - uy) ** 2, (wx - vx) ** 2 + (wy - vy) ** 2, (ux - wx) ** 2 + (uy - wy) ** 2)
    return area, min_height * math.sqrt(longest)


@helper
def uv_stays(uv, w, wn, wp, u, v, orientation, min_height):
    """Whether a face keeps its orientation when wedge w moves to (u, v), or at least gets no worse."""
    area, least = uv_area(u, v, uv[wn, 0], uv[wn, 1], uv[wp, 0], uv[wp, 1], min_height)
    area *= orientation
    if area > least:
        return True
    before, least = uv_area(uv[w, 0], uv[w, 1], uv[wn, 0], uv[wn, 1], uv[wp, 0], uv[wp, 1], min_height)
    before *= orientation
    return before <= least and area >= before


@helper
def position_stays(xyz, a, b, c, x, y, z, min_dot, min_shape):
    """Whether the face (a, b, c) keeps its side and a proper shape when a moves to (x, y, z)."""
    bx, by, bz = xyz[b, 0], xyz[b, 1], xyz[b, 2]
    fx, fy, fz = xyz[c, 0] - bx, xyz[c, 1] - by, xyz[c, 2] - bz
    ex, ey, ez = xyz[a, 0] - bx, xyz[a, 1] - by, xyz[a, 2] - bz
    gx, gy, gz = x - bx, y - by, z - bz
    nx, ny, nz = fy * ez - fz * ey, fz * ex - fx * ez, fx * ey - fy * ex
    kx, ky, kz = fy * gz - fz * gy, fz * gx - fx * gz, fx * gy - fy * gx
    before, after = nx * nx + ny * ny + nz * nz, kx * kx + ky * ky + kz * kz
    side = fx * fx + fy * fy + fz * fz
    longest = max(side, gx * gx + gy * gy + gz * gz, (gx - fx) ** 2 + (gy - fy) ** 2 + (gz - fz) ** 2)
    if not after > min_shape * min_shape * longest * longest:  # height over longest side
        longest = max(side, ex * ex + ey * ey + ez * ez, (ex - fx) ** 2 + (ey - fy) ** 2 + (ez - fz) ** 2)
        return before <= min_shape * min_shape * longest * longest and after >= before
    if before <= 1e-24 * longest * longest:
        return True
    return nx * kx + ny * ky + nz * kz > min_dot * math.sqrt(before * after)


@helper
def star_stays(links, xyz, uv, faces, settings, row, h, start):
    """Whether the surviving faces around one end of edge h stay sound when it goes to a placement.

    Corners of the wedges on the left of h take the row's first uv, those on the right the second, others keep theirs.
    """
    t = links[h, TWIN]
    a0, a1, b0, b1 = links[h, WEDGE], links[next_of(t), WEDGE], links[next_of(h), WEDGE], links[t, WEDGE]
    min_height, min_dot, min_shape = settings[MIN_UV_HEIGHT], settings[MIN_NORMAL_DOT], settings[MIN_SHAPE]
    g = start
    while True:
        f, w, n, p = g // 3, links[g, WEDGE], next_of(g), previous_of(g)
        if w >= 0 and f != h // 3 and f != t // 3:
            u, v = uv[w, 0], uv[w, 1]
            if w in (a0, b0):
                u, v = row[4], row[5]
            elif w in (a1, b1):
                u, v = row[6], row[7]
            if not uv_stays(uv, w, links[n, WEDGE], links[p, WEDGE], u, v, faces[f, SIGN], min_height):
                return False
            a, b, c = links[g, TAIL], links[n, TAIL], links[p, TAIL]
            if not position_stays(xyz, a, b, c, row[1], row[2], row[3], min_dot, min_shape):
                return False
        g = links[p, TWIN]
        if g == start:
            return True


@helper
def placement_holds(m, h, row):
    """Whether one candidate for edge h folds or degenerates nothing."""
    around_end = star_stays(m.links, m.xyz, m.uv, m.faces, m.settings, row, h, m.links[h, TWIN])
    return around_end and star_stays(m.links, m.xyz, m.uv, m.faces, m.settings, row, h, h)
