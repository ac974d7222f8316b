"""Charts into the plane with free boundaries, all at once: their matrices are the blocks of one sparse matrix.

As-rigid-as-possible parametrisation (Liu et al. 2008, "A local/global approach to mesh parameterization"). Folds are
possible: who asks for a map tests what comes out.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from preprocess.arrays import Floats, Ints

MIN_COTANGENT = 0.02
"""Cotangent weights are clamped from below, so that the Laplacian of a chart with obtuse triangles stays positive."""

LEAST_HEIGHT_REL = 0.01
"""Of a triangle's longest side: a thinner one, or one without area, is laid out as if it had this height. It is under a
texel wide, and a map that is one-to-one has to give it some."""


def local_triangles(positions: Floats, faces: Ints) -> Floats:
    """Every triangle laid flat: corner 0 at the origin, corner 1 on the x axis, counter-clockwise, (F, 3, 2).

    None is thinner than `LEAST_HEIGHT_REL`.
    """
    a, b, c = (positions[faces[:, k]] for k in range(3))
    base = np.linalg.norm(b - a, axis=1)
    axis = (b - a) / np.where(base > 0, base, 1)[:, None]
    along = ((c - a) * axis).sum(axis=1)
    height = np.linalg.norm(c - a - along[:, None] * axis, axis=1)
    longest = np.maximum(base, np.maximum(np.hypot(along, height), np.hypot(along - base, height)))
    longest = np.maximum(longest, 1e-9 * (float(longest.max(initial=0.0)) or 1.0))
    base = np.maximum(base, LEAST_HEIGHT_REL * longest)
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = base
    flat[:, 2, 0], flat[:, 2, 1] = along, np.maximum(height, LEAST_HEIGHT_REL * longest**2 / base)
    return flat


def cotangents(flat: Floats) -> Floats:
    """Clamped cotangent of the angle opposite each half-edge, (F, 3): entry c faces the edge from corner c to c + 1."""
    result = np.empty(flat.shape[:2])
    area = np.abs(_cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]))
    longest = np.max([((flat[:, (k + 1) % 3] - flat[:, k]) ** 2).sum(axis=1) for k in range(3)], axis=0)
    area = np.maximum(area, 1e-3 * longest + 1e-300)
    for c in range(3):
        tip = flat[:, (c + 2) % 3]
        result[:, c] = ((flat[:, c] - tip) * (flat[:, (c + 1) % 3] - tip)).sum(axis=1) / area
    return np.maximum(result, MIN_COTANGENT)


def project_charts(points: Floats, face_uvs: Ints, face_charts: Ints, num_charts: int) -> Floats:
    """Texture vertices (T, 3) on the mean plane of their chart, seen from outside, (T, 2)."""
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


def flatten_free(
    uvs: Floats, flat: Floats, face_uvs: NDArray[np.integer], face_charts: NDArray[np.integer], steps: int
) -> Floats:
    """Nearly isometric maps from a first guess.

    Parameters
    ----------
    uvs : (T, 2) float64
        The guess; every texture vertex belongs to a face.
    flat : (F, 3, 2) float64
        `local_triangles`.
    face_uvs : (F, 3) int32
    face_charts : (F,) int
        Numbered from 0 on, none left out.
    steps : int
        Of rotating every triangle as fits best and then solving for the vertices.

    Returns
    -------
    (T, 2) float64
        At the surface's own scale; one vertex of each chart has stayed.
    """
    num = len(uvs)
    weights = cotangents(flat)
    head, tail = face_uvs, np.roll(face_uvs, -1, axis=1)
    rows, columns = np.r_[head.ravel(), tail.ravel()], np.r_[tail.ravel(), head.ravel()]
    values = np.r_[weights.ravel(), weights.ravel()]
    adjacency = sp.coo_matrix((values, (rows, columns)), shape=(num, num)).tocsr()
    laplacian = sp.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    pinned = np.zeros(num, bool)
    pinned[face_uvs[np.unique(face_charts, return_index=True)[1], 0]] = True
    free = np.flatnonzero(~pinned)
    if not len(free):
        return uvs
    solver = splu(laplacian[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    held = laplacian[free][:, np.flatnonzero(pinned)] @ uvs[pinned]
    edge = flat - np.roll(flat, -1, axis=1)
    for _ in range(steps):
        drawn = uvs[head] - uvs[tail]
        cosine = (weights[:, :, None] * edge * drawn).sum(axis=(1, 2))
        sine = (weights * (edge[..., 0] * drawn[..., 1] - edge[..., 1] * drawn[..., 0])).sum(axis=1)
        length = np.hypot(cosine, sine)
        safe = np.where(length > 0, length, 1)
        cosine, sine = np.where(length > 0, cosine / safe, 1.0)[:, None], (sine / safe)[:, None]
        x, y = cosine * edge[..., 0] - sine * edge[..., 1], sine * edge[..., 0] + cosine * edge[..., 1]
        right = np.stack(
            [
                np.bincount(head.ravel(), (weights * force).ravel(), num)
                - np.bincount(tail.ravel(), (weights * force).ravel(), num)
                for force in (x, y)
            ],
            axis=1,
        )
        uvs = uvs.copy()
        uvs[free] = solver.solve(right[free] - held)
    return uvs


def _cross(a: Floats, b: Floats) -> Floats:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
