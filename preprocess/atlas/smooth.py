"""Lowers the stretch of charts without ever folding a face.

Sander et al. 2001 ("Texture mapping progressive meshes", section 4): vertex by vertex, each moves to where the L2
stretch of the faces around it is least. Here with Newton steps, since the energy's Hessian is short, and with the
vertices on straight sides sliding along them, at one and the same fraction on both sides of a seam.

Per face, with uv edge vectors p, q from the moving corner, their cross product D, the 3D dot products g11, g12, g22 of
the same edges and the 3D area A, the energy is A / 2 * (g11 |q|² - 2 g12 p·q + g22 |p|²) / D²: infinite where D is 0, a
barrier.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.atlas.layout import Layout
from preprocess.mesh.surface import TexturedSurface
from preprocess.numerics.jit import entry, helper

MIN_AREA_REL = 1e-5
"""Least area of a uv triangle, relative to the square of its longest edge, that a move may leave."""


def smooth_charts(
    positions: Floats,
    faces: Ints,
    layout: Layout,
    corners: Floats,
    uvs: Floats,
    fractions: Floats,
    folds: Ints,
    sweeps: int,
) -> tuple[Floats, Floats]:
    """Move inner vertices and slide boundary vertices to lower the stretch.

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int32
    layout : Layout
    corners : (N, 2) float64
        Polygon corners of all charts, in the order of the layout's sides.
    uvs : (T, 2) float64
        Counter-clockwise charts.
    fractions : (N',) float64
        Fraction along its path of each entry of the layout's `path_vertices`.
    folds : (C,) int32
        Charts with any are left alone, and so are their boundaries.
    sweeps : int
        Times that every vertex moves.

    Returns
    -------
    uvs : (T, 2) float64
    fractions : (N',) float64
    """
    fractions, uvs = fractions.copy(), uvs.copy()
    boundary = layout.boundary_uvs
    side = layout.boundary_sides
    ends = layout.side_ends
    start = np.where(layout.side_forward[:, None], corners, corners[ends])[side]
    stop = np.where(layout.side_forward[:, None], corners[ends], corners)[side]
    is_corner = np.zeros(len(uvs), bool)
    is_corner[layout.side_uvs] = True

    # The one or two texture vertices that slide together, by their rows in `boundary`.
    rows = np.flatnonzero(~is_corner[boundary])
    rows = rows[np.argsort(layout.boundary_slots[rows], kind="stable")]
    slots = layout.boundary_slots[rows]
    tied = np.full((len(layout.path_vertices), 2), -1, np.int32)
    tied[slots, np.r_[False, slots[1:] == slots[:-1]].astype(np.int64)] = rows

    incident = np.argsort(layout.face_uvs.ravel(), kind="stable").astype(np.int32)
    first = np.r_[0, np.cumsum(np.bincount(layout.face_uvs.ravel(), minlength=len(uvs)))].astype(np.int64)
    moving = np.ones(len(uvs), bool)
    moving[boundary] = False
    moving[layout.face_uvs[folds[layout.face_charts] > 0]] = False
    fixed_slots = np.zeros(len(tied), bool)
    fixed_slots[slots] |= (folds[layout.face_charts] > 0)[incident[first[boundary[rows]]] // 3]
    tied[fixed_slots] = -1
    edge_sq = _edge_squares(positions, faces)
    mean = edge_sq.mean() if edge_sq.size else 1.0
    _descend(
        uvs, layout.face_uvs, edge_sq / mean, first, incident, moving, tied, boundary, start, stop, fractions, sweeps
    )
    return uvs, fractions


def _edge_squares(positions: Floats, faces: Ints) -> Floats:
    """Squared 3D length opposite each corner, (F, 3), no triangle quite flat: slivers are given some height."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    squares = np.stack([((b - c) ** 2).sum(axis=1), ((c - a) ** 2).sum(axis=1), ((a - b) ** 2).sum(axis=1)], axis=1)
    tiny = 1e-6 * squares.max(axis=1) + 1e-12 * squares.max(initial=0.0) + 1e-30
    return np.asarray(squares + tiny[:, None])


def face_energies(surface: TexturedSurface, uvs: Floats, face_uvs: Ints) -> Floats:
    """The energy of every face, (F,): its area times its squared L2 stretch at the uvs' own scale."""
    opposite, g22, g11 = _edge_squares(surface.positions, surface.faces).T  # of corner 0
    p, q = uvs[face_uvs[:, 1]] - uvs[face_uvs[:, 0]], uvs[face_uvs[:, 2]] - uvs[face_uvs[:, 0]]
    g12 = 0.5 * (g11 + g22 - opposite)
    area = 0.5 * np.sqrt(np.maximum(g11 * g22 - g12 * g12, 0))
    double = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    trace = g11 * (q * q).sum(axis=1) - 2 * g12 * (p * q).sum(axis=1) + g22 * (p * p).sum(axis=1)
    return 0.5 * area * trace / np.maximum(double * double, 1e-30)


@helper
def _derivatives(uvs, face_uvs, edge_sq, first, incident, v, total):  # type: ignore[no-untyped-def]
    """Energy around a vertex, its gradient and Hessian: total = (E, Ex, Ey, Exx, Exy, Eyy)."""
    for i in range(6):
        total[i] = 0.0
    for i in range(first[v], first[v + 1]):
        f, c = incident[i] // 3, incident[i] % 3
        j, k = (c + 1) % 3, (c + 2) % 3
        y, z = face_uvs[f, j], face_uvs[f, k]
        px, py = uvs[y, 0] - uvs[v, 0], uvs[y, 1] - uvs[v, 1]
        qx, qy = uvs[z, 0] - uvs[v, 0], uvs[z, 1] - uvs[v, 1]
        g11, g22, opposite = edge_sq[f, k], edge_sq[f, j], edge_sq[f, c]
        g12 = 0.5 * (g11 + g22 - opposite)
        area = 0.5 * np.sqrt(max(g11 * g22 - g12 * g12, 0.0))
        d = px * qy - py * qx
        if d <= 0.0:
            total[0] = np.inf
            return
        n = g11 * (qx * qx + qy * qy) - 2 * g12 * (px * qx + py * qy) + g22 * (px * px + py * py)
        nx = -2 * g11 * qx + 2 * g12 * (px + qx) - 2 * g22 * px
        ny = -2 * g11 * qy + 2 * g12 * (py + qy) - 2 * g22 * py
        dx, dy = py - qy, qx - px
        w = 0.5 * area / (d * d)
        total[0] += w * n
        total[1] += w * (nx - 2 * n * dx / d)
        total[2] += w * (ny - 2 * n * dy / d)
        total[3] += w * (2 * opposite - 4 * nx * dx / d + 6 * n * dx * dx / (d * d))
        total[4] += w * (-2 * (nx * dy + ny * dx) / d + 6 * n * dx * dy / (d * d))
        total[5] += w * (2 * opposite - 4 * ny * dy / d + 6 * n * dy * dy / (d * d))


@helper
def _energy(uvs, face_uvs, edge_sq, first, incident, v):  # type: ignore[no-untyped-def]
    """Energy around a vertex; infinite where a face is folded or too thin."""
    energy = 0.0
    for i in range(first[v], first[v + 1]):
        f, c = incident[i] // 3, incident[i] % 3
        j, k = (c + 1) % 3, (c + 2) % 3
        y, z = face_uvs[f, j], face_uvs[f, k]
        px, py = uvs[y, 0] - uvs[v, 0], uvs[y, 1] - uvs[v, 1]
        qx, qy = uvs[z, 0] - uvs[v, 0], uvs[z, 1] - uvs[v, 1]
        pp, qq, pq = px * px + py * py, qx * qx + qy * qy, px * qx + py * qy
        d = px * qy - py * qx
        if d <= MIN_AREA_REL * max(pp, qq):
            return np.inf
        g11, g22, opposite = edge_sq[f, k], edge_sq[f, j], edge_sq[f, c]
        g12 = 0.5 * (g11 + g22 - opposite)
        area = 0.5 * np.sqrt(max(g11 * g22 - g12 * g12, 0.0))
        energy += 0.5 * area * (g11 * qq - 2 * g12 * pq + g22 * pp) / (d * d)
    return energy


@helper
def _line_search(  # type: ignore[no-untyped-def]
    uvs, face_uvs, edge_sq, first, incident, parts, count, direction, begin, energy
):
    """Halve the step until the energy falls; returns the share of it that was taken, 0 for none."""
    for k in range(count):
        begin[k, 0], begin[k, 1] = uvs[parts[k], 0], uvs[parts[k], 1]
    share = 1.0
    for _trial in range(10):
        for k in range(count):
            uvs[parts[k], 0] = begin[k, 0] + share * direction[k, 0]
            uvs[parts[k], 1] = begin[k, 1] + share * direction[k, 1]
        now = 0.0
        for k in range(count):
            now += _energy(uvs, face_uvs, edge_sq, first, incident, parts[k])
        if now < energy:
            return share
        share *= 0.5
    for k in range(count):
        uvs[parts[k], 0], uvs[parts[k], 1] = begin[k, 0], begin[k, 1]
    return 0.0


@entry
def _descend(  # type: ignore[no-untyped-def]
    uvs, face_uvs, edge_sq, first, incident, moving, tied, boundary, start, stop, fractions, sweeps
):
    """Newton steps, one vertex or path slot at a time, all of them `sweeps` times."""
    num_uvs = len(uvs)
    parts = np.empty(2, np.int64)
    direction = np.empty((2, 2))
    begin = np.empty((2, 2))
    total = np.empty(6)
    for _sweep in range(sweeps):
        for v in range(num_uvs):
            if not moving[v] or first[v] == first[v + 1]:
                continue
            _derivatives(uvs, face_uvs, edge_sq, first, incident, np.int64(v), total)
            energy, gx, gy = total[0], total[1], total[2]
            hxx, hxy, hyy = total[3], total[4], total[5]
            det = hxx * hyy - hxy * hxy
            if hxx > 0.0 and det > 1e-12 * hxx * hyy:
                dx, dy = -(hyy * gx - hxy * gy) / det, -(hxx * gy - hxy * gx) / det
            else:
                scale = 1.0 / max(abs(hxx) + abs(hyy), 1e-30)
                dx, dy = -gx * scale, -gy * scale
            parts[0] = v
            count = np.int64(1)
            direction[0, 0], direction[0, 1] = dx, dy
            _line_search(uvs, face_uvs, edge_sq, first, incident, parts, count, direction, begin, energy)
        for s in range(len(tied)):
            if tied[s, 0] < 0:
                continue
            energy, slope, curve = 0.0, 0.0, 0.0
            count = np.int64(0)
            for k in range(2):
                if tied[s, k] < 0:
                    continue
                b = tied[s, k]
                u = np.int64(boundary[b])
                _derivatives(uvs, face_uvs, edge_sq, first, incident, u, total)
                dx, dy = stop[b, 0] - start[b, 0], stop[b, 1] - start[b, 1]
                energy += total[0]
                slope += total[1] * dx + total[2] * dy
                curve += total[3] * dx * dx + 2 * total[4] * dx * dy + total[5] * dy * dy
                parts[count] = u
                direction[count, 0], direction[count, 1] = dx, dy
                count += 1
            if curve <= 0.0 or not np.isfinite(energy):
                continue
            step = -slope / curve
            for k in range(count):
                direction[k, 0] *= step
                direction[k, 1] *= step
            taken = _line_search(uvs, face_uvs, edge_sq, first, incident, parts, count, direction, begin, energy)
            fractions[s] += taken * step
