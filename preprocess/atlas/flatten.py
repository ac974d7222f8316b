"""Charts into the plane: free, and inside a convex polygon.

- `flatten_free` lets every boundary go where it likes: as-rigid-as-possible parameterization (Liu et al. 2008, "A
  local/global approach to mesh parameterization") from a projection on each chart's mean plane.
- `flatten_fixed` holds the boundary. Tutte's and Floater's theorem makes a map with positive weights and a convex
  boundary one-to-one (mean value weights, Floater 2003); the same local/global steps then lower the stretch, chart by
  chart, as long as no triangle folds.

All charts are solved at once: their matrices are the blocks of one sparse matrix, factored once.
"""

from __future__ import annotations

import logging

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from preprocess.arrays import Floats, Ints
from preprocess.mesh.edges import Bools
from preprocess.mesh.predicates import count_folds

log = logging.getLogger(__name__)

MIN_COTANGENT = 0.02
"""Cotangent weights are clamped from below, so that the Laplacian of a chart with obtuse triangles stays positive."""

FREE_STEPS = 8
FIXED_STEPS = 6


def local_triangles(points: Floats, faces: Ints) -> Floats:
    """Every triangle laid flat: corner 0 at the origin, corner 1 on the x axis, counter-clockwise, (F, 3, 2)."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    base = np.linalg.norm(b - a, axis=1)
    safe = np.where(base > 0, base, 1)
    axis = (b - a) / safe[:, None]
    along = ((c - a) * axis).sum(axis=1)
    height = np.linalg.norm(np.cross(axis, c - a), axis=1)
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = base
    flat[:, 2, 0], flat[:, 2, 1] = along, height
    return flat


def cotangents(flat: Floats) -> Floats:
    """Clamped cotangent of the angle opposite each half-edge, (F, 3): entry c faces the edge from corner c to c + 1."""
    result = np.empty(flat.shape[:2])
    area = np.abs(_cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]))
    longest = np.max([((flat[:, (k + 1) % 3] - flat[:, k]) ** 2).sum(axis=1) for k in range(3)], axis=0)
    area = np.maximum(area, 1e-3 * longest + 1e-30)
    for c in range(3):
        tip = flat[:, (c + 2) % 3]
        result[:, c] = ((flat[:, c] - tip) * (flat[:, (c + 1) % 3] - tip)).sum(axis=1) / area
    return np.maximum(result, MIN_COTANGENT)


def mean_value_weights(flat: Floats) -> Floats:
    """Half-angle tangents of Floater 2003: entry (f, c) is tan(angle at corner c / 2), (F, 3)."""
    result = np.empty(flat.shape[:2])
    for c in range(3):
        a = flat[:, (c + 1) % 3] - flat[:, c]
        b = flat[:, (c + 2) % 3] - flat[:, c]
        lengths = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
        sine, cosine = np.abs(_cross(a, b)), (a * b).sum(axis=1)
        result[:, c] = np.minimum(sine / np.maximum(lengths + cosine, 1e-3 * lengths + 1e-30), 1e3)
    return np.maximum(result, 1e-4)


def flatten_free(points: Floats, face_uvs: Ints, face_charts: Ints, num_charts: int) -> Floats:
    """Nearly isometric plane positions with free boundaries; folds are possible.

    Parameters
    ----------
    points : (T, 3) float64
        3D position of each texture vertex.
    face_uvs : (F, 3) int32
    face_charts : (F,) int32
    num_charts : int

    Returns
    -------
    (T, 2) float64
        At the surface's own scale; each chart has its own place.
    """
    flat = local_triangles(points, face_uvs)
    start = _project(points, face_uvs, face_charts, num_charts)
    pinned = np.zeros(len(points), bool)
    first = np.full(num_charts, -1)
    first[face_charts[::-1]] = face_uvs[::-1, 0]
    pinned[first[first >= 0]] = True
    return _local_global(start, flat, face_uvs, pinned, FREE_STEPS)


def flatten_fixed(
    points: Floats,
    face_uvs: Ints,
    face_charts: Ints,
    num_charts: int,
    boundary: Bools,
    boundary_uvs: Floats,
) -> tuple[Floats, Ints]:
    """Inner vertices of charts whose boundaries are convex polygons.

    Parameters
    ----------
    points : (T, 3) float64
    face_uvs : (F, 3) int32
    face_charts : (F,) int32
    num_charts : int
    boundary : (T,) bool
    boundary_uvs : (T, 2) float64
        Counter-clockwise in each chart; only rows where `boundary` are read.

    Returns
    -------
    uvs : (T, 2) float64
    folds : (C,) int32
        Faces of each chart that are not certainly counter-clockwise. Zero unless an inner edge joins two vertices of
        one straight side, or numbers are degenerate.
    """
    flat = local_triangles(points, face_uvs)
    inner = ~boundary
    uvs = np.where(boundary[:, None], boundary_uvs, 0.0)
    if inner.any():
        weights = mean_value_weights(flat)
        lengths = [np.maximum(np.linalg.norm(flat[:, (c + 1) % 3] - flat[:, c], axis=1), 1e-30) for c in range(3)]
        uvs = _solve_tutte(uvs, face_uvs, inner, weights, np.stack(lengths, axis=1))
        folds = count_folds(uvs, face_uvs, face_charts, num_charts)
        if folds.any():  # numbers too far apart for mean value weights: uniform ones
            uniform = _solve_tutte(uvs, face_uvs, inner, np.ones_like(weights), np.ones_like(weights))
            bad = np.zeros(len(points), bool)
            bad[face_uvs[folds[face_charts] > 0]] = True
            uvs = np.where((bad & inner)[:, None], uniform, uvs)
    folds = count_folds(uvs, face_uvs, face_charts, num_charts)
    if inner.any():
        uvs = _relax_fixed(uvs, flat, face_uvs, face_charts, num_charts, boundary, folds)
    return uvs, folds


def _relax_fixed(
    uvs: Floats, flat: Floats, face_uvs: Ints, face_charts: Ints, num_charts: int, boundary: Bools, folds: Ints
) -> Floats:
    """Local/global steps with the boundary held; a chart keeps its last map without folds."""
    uv_chart = np.zeros(len(uvs), np.int32)
    uv_chart[face_uvs] = face_charts[:, None]
    target = _local_global(uvs, flat, face_uvs, boundary, FIXED_STEPS)
    step = np.where(folds > 0, 0.0, 1.0)
    best = uvs
    for _ in range(8):
        trial = uvs + step[uv_chart][:, None] * (target - uvs)
        folded = (count_folds(trial, face_uvs, face_charts, num_charts) > 0) & (folds == 0)
        best = np.where(folded[uv_chart][:, None], best, trial)
        if not folded.any():
            break
        step = np.where(folded, 0.6 * step, step)
    return best


def _local_global(uvs: Floats, flat: Floats, face_uvs: Ints, pinned: Bools, steps: int) -> Floats:
    """As-rigid-as-possible energy: best rotation of each triangle, then one Laplacian solve; pinned rows stay."""
    weights = cotangents(flat)
    head, tail = face_uvs, np.roll(face_uvs, -1, axis=1)
    rows = np.r_[head.ravel(), tail.ravel()]
    columns = np.r_[tail.ravel(), head.ravel()]
    values = np.r_[weights.ravel(), weights.ravel()]
    n = len(uvs)
    adjacency = sp.coo_matrix((values, (rows, columns)), shape=(n, n)).tocsr()
    laplacian = sp.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    free = np.flatnonzero(~pinned)
    if not len(free):
        return uvs
    used = np.zeros(n, bool)
    used[face_uvs] = True
    free = free[used[free]]
    solver = splu(laplacian[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    held = laplacian[free][:, np.flatnonzero(pinned)]
    edge = flat - np.roll(flat, -1, axis=1)
    for _ in range(steps):
        drawn = uvs[head] - uvs[tail]
        cosine = (weights[:, :, None] * edge * drawn).sum(axis=(1, 2))
        sine = (weights * (edge[..., 0] * drawn[..., 1] - edge[..., 1] * drawn[..., 0])).sum(axis=1)
        length = np.hypot(cosine, sine)
        safe = np.where(length > 0, length, 1)
        cosine, sine = (
            np.where(length > 0, cosine / safe, 1.0)[:, None],
            np.where(length > 0, sine / safe, 0.0)[:, None],
        )
        turned = np.stack(
            [cosine * edge[..., 0] - sine * edge[..., 1], sine * edge[..., 0] + cosine * edge[..., 1]], axis=-1
        )
        force = weights[:, :, None] * turned
        right = np.stack(
            [
                np.bincount(head.ravel(), force[..., k].ravel(), n)
                - np.bincount(tail.ravel(), force[..., k].ravel(), n)
                for k in range(2)
            ],
            axis=1,
        )
        uvs = uvs.copy()
        uvs[free] = solver.solve(right[free] - held @ uvs[pinned])
    return uvs


def _solve_tutte(uvs: Floats, face_uvs: Ints, inner: Bools, weights: Floats, lengths: Floats) -> Floats:
    """Each inner vertex at the weighted mean of its neighbours.

    The weight of neighbour j at vertex i is the sum, over the faces of edge ij, of `weights` at i over the length.
    """
    n = len(uvs)
    head, tail = face_uvs, np.roll(face_uvs, -1, axis=1)
    rows = np.r_[head.ravel(), tail.ravel()]
    columns = np.r_[tail.ravel(), head.ravel()]
    values = np.r_[(weights / lengths).ravel(), (np.roll(weights, -1, axis=1) / lengths).ravel()]
    adjacency = sp.coo_matrix((values, (rows, columns)), shape=(n, n)).tocsr()
    sums = np.asarray(adjacency.sum(axis=1)).ravel()
    rows_inner = np.flatnonzero(inner & (sums > 0))
    adjacency = sp.diags(1 / np.where(sums > 0, sums, 1)) @ adjacency
    matrix = sp.eye(len(rows_inner), format="csr") - adjacency[rows_inner][:, rows_inner]
    outer = np.flatnonzero(~inner)
    solution = uvs.copy()
    solution[rows_inner] = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(
        adjacency[rows_inner][:, outer] @ uvs[outer]
    )
    return solution


def _project(points: Floats, face_uvs: Ints, face_charts: Ints, num_charts: int) -> Floats:
    """Texture vertices on the mean plane of their chart, seen from outside."""
    a, b, c = (points[face_uvs[:, k]] for k in range(3))
    area_normal = np.cross(b - a, c - a)
    normal = np.stack([np.bincount(face_charts, area_normal[:, k], num_charts) for k in range(3)], axis=1)
    length = np.linalg.norm(normal, axis=1)
    normal = np.where(length[:, None] > 0, normal / np.where(length > 0, length, 1)[:, None], (0.0, 0.0, 1.0))
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(least, normal)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normal, first)
    uv_chart = np.zeros(len(points), np.int32)
    uv_chart[face_uvs] = face_charts[:, None]
    return np.stack([(points * first[uv_chart]).sum(axis=1), (points * second[uv_chart]).sum(axis=1)], axis=1)


def _cross(a: Floats, b: Floats) -> Floats:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
