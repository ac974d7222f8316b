"""Where on the full mesh the corners of a level of detail lie.

A corner is looked for by its place in the atlas and on the surface together, among the faces around the nearest
corners of the full mesh, the face its own stems from and the one at its uv, in the same connected component. Either
alone is not enough: charts may overlap in uv (a palette), and parts may touch in space. The atlas counts most, since
vertices of coarse levels lie off the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from preprocess.arrays import Floats, Indices
from preprocess.mesh.grouping import connected_faces, expand_ranges, group_rows
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.uv_lookup import locate_uvs, uv_tree

NEAREST = 4  # corners of the full mesh whose faces are tried
MAX_FACES_A_CORNER = 32  # of a fan's centre
PLACE_SHARE = 0.01  # how much a distance in space, of the diagonal, counts beside one in uv
COMPONENT_STEP = 10.0  # more than any distance within a component, in units of the diagonal and the uv square
SAME_PLACE = 1e-5  # faces this much farther than the nearest, in those units, lie there too


@dataclass(frozen=True)
class Places:
    """Faces of the full mesh at N points; a point on an edge has several. R rows, sorted by point, nearest first.

    Attributes
    ----------
    points : (R,) int64
    faces : (R,) int64
    barycentrics : (R, 3) float64
        Non-negative, summing to one.
    firsts : (N,) int64
        First row of each point; every point has one.
    """

    points: Indices
    faces: Indices
    barycentrics: Floats
    firsts: Indices


def _nearest_in_triangles(corners: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Barycentric coordinates (R, 3) of the points' feet in triangles (R, 3, D), clamped, and their distances (R,).

    The foot of a point beside a triangle is clamped towards it, not exactly nearest: good enough to rank faces.
    """
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    to = points - a
    d11, d12, d22 = (np.einsum("rd,rd->r", x, y) for x, y in ((e1, e1), (e1, e2), (e2, e2)))
    b1, b2 = np.einsum("rd,rd->r", to, e1), np.einsum("rd,rd->r", to, e2)
    determinant = d11 * d22 - d12 * d12
    safe = np.where(determinant > 1e-30, determinant, 1.0)
    w1 = np.where(determinant > 1e-30, (d22 * b1 - d12 * b2) / safe, 0.0)
    w2 = np.where(determinant > 1e-30, (d11 * b2 - d12 * b1) / safe, 0.0)
    weights = np.maximum(np.stack([1.0 - w1 - w2, w1, w2], axis=1), 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    feet = np.einsum("rk,rkd->rd", weights, corners)
    return weights, np.linalg.norm(points - feet, axis=1)


def locate_corners(
    full: TexturedSurface, level: TexturedSurface, face_source: NDArray[np.integer]
) -> tuple[Places, Indices, Indices]:
    """Find the faces of the full mesh at each corner of a level.

    Parameters
    ----------
    full, level : TexturedSurface
        Over the same atlas.
    face_source : (F,) int
        For each face of the level, one of the full mesh's in the same connected component.

    Returns
    -------
    places : Places
        Of the N distinct pairs of a surface vertex and a texture vertex of the level.
    corner_points : (F, 3) int64
        Which of them each corner of the level is.
    first_corners : (N,) int64
        A flat corner for each of them.
    """
    scale = PLACE_SHARE / max(full.diagonal_m, 1e-30)
    components = connected_faces(full.faces, len(full.positions))

    def coordinates(surface: TexturedSurface, corners: Indices, component: Indices) -> Floats:
        place = surface.positions[surface.faces.reshape(-1)[corners]] * scale
        uv = surface.uvs[surface.face_uvs.reshape(-1)[corners]]
        return np.concatenate([place, uv, component[:, None] * COMPONENT_STEP], axis=1)

    wedge, wedge_corners = group_rows(full.faces.reshape(-1), full.face_uvs.reshape(-1))
    wedge_places = coordinates(full, wedge_corners, components[wedge_corners // 3])
    point, point_corners = group_rows(level.faces.reshape(-1), level.face_uvs.reshape(-1))
    targets = coordinates(level, point_corners, components[face_source][point_corners // 3])

    count = min(NEAREST, len(wedge_places))
    _, nearest = cKDTree(wedge_places).query(targets, k=count)
    order = np.argsort(wedge, kind="stable")
    valence = np.bincount(wedge)
    starts = np.cumsum(valence) - valence
    flat = nearest.reshape(-1)
    owner, slot = expand_ranges(starts[flat], np.minimum(valence[flat], MAX_FACES_A_CORNER))
    # A large face may have no corner nearby: those that the level's faces stem from are tried as well, and what lies
    # at the very place in the atlas.
    there, _ = locate_uvs(uv_tree(full.uvs[full.face_uvs]), level.uvs[level.face_uvs.reshape(-1)[point_corners]])
    own = np.flatnonzero(components[there] == components[face_source][point_corners // 3])
    candidate = np.r_[owner // count, point, own]
    face = np.r_[order[slot] // 3, np.repeat(face_source.astype(np.int64), 3), there[own]]
    _, distinct = group_rows(candidate, face)
    candidate, face = candidate[distinct], face[distinct]

    face_corners = 3 * face[:, None] + np.arange(3)
    component = np.repeat(components[face], 3)
    triangles = coordinates(full, face_corners.reshape(-1), component).reshape(-1, 3, targets.shape[1])
    weights, distance = _nearest_in_triangles(triangles, targets[candidate])
    rank = np.round(distance / SAME_PLACE)
    order = np.lexsort((face, rank, candidate))
    candidate, face, weights, distance = candidate[order], face[order], weights[order], distance[order]
    firsts = np.searchsorted(candidate, np.arange(len(targets)))
    kept = distance <= distance[firsts][candidate] + SAME_PLACE
    candidate = candidate[kept]
    firsts = np.searchsorted(candidate, np.arange(len(targets)))
    return Places(candidate, face[kept], weights[kept], firsts), point.reshape(-1, 3), point_corners
