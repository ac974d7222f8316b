"""Which triangles of a uv map lie under given uv points, by a uniform grid; linear in triangles and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from preprocess.gltf.grouping import Indices
from preprocess.mesh import Floats, TexturedSurface

TRIANGLES_A_CELL = 1.0
MARGIN_CELLS = 0.05  # a point this far outside a triangle's box still finds it
SAME_PLACE = 1e-6  # triangles whose barycentric excess is this close to the best one's are all reported


@dataclass(frozen=True)
class Places:
    """Triangles under N points; a point may have several. R rows, sorted by point.

    Attributes
    ----------
    points : (R,) int64
    faces : (R,) int64
    barycentrics : (R, 3) float64
        Non-negative, summing to one: a point outside every triangle is moved into the nearest.
    firsts : (N,) int64
        First row of each point; every point has one.
    """

    points: Indices
    faces: Indices
    barycentrics: Floats
    firsts: Indices


def _expand(starts: Indices, counts: Indices) -> tuple[Indices, Indices]:
    """Owner and value of the ranges [start, start + count), one after the other."""
    owner = np.repeat(np.arange(len(counts)), counts)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, starts[owner] + offset


def _candidates(corners: Floats, points: Floats) -> tuple[Indices, Indices]:
    """Pairs of a point and a triangle whose cell-rounded box holds it."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    side = max(int(np.sqrt(len(corners) / TRIANGLES_A_CELL)), 1)
    step = np.maximum(high - low, 1e-300) / side
    first = np.clip(np.floor((corners.min(axis=1) - low) / step - MARGIN_CELLS), 0, side - 1).astype(np.int64)
    last = np.clip(np.floor((corners.max(axis=1) - low) / step + MARGIN_CELLS), 0, side - 1).astype(np.int64)
    extent = last - first + 1
    owner, within = _expand(np.zeros(len(corners), np.int64), extent.prod(axis=1))
    cell = (first[owner, 1] + within // extent[owner, 0]) * side + first[owner, 0] + within % extent[owner, 0]
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=side * side)
    starts = np.cumsum(counts) - counts
    at = np.clip(np.floor((points - low) / step), 0, side - 1).astype(np.int64)
    here = at[:, 1] * side + at[:, 0]
    point, slot = _expand(starts[here], counts[here])
    return point, owner[order[slot]]


def _barycentrics(corners: Floats, points: Floats) -> Floats:
    """Barycentric coordinates of points in triangles, row by row; -inf in triangles without area."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def cross(p: Floats, q: Floats) -> NDArray[np.float64]:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    area = cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        wa, wb = cross(b - points, c - points) / area, cross(c - points, a - points) / area
        found = np.stack([wa, wb, 1.0 - wa - wb], axis=1)
    found[~np.isfinite(found).all(axis=1)] = -np.inf
    return found


def locate_uvs(surface: TexturedSurface, uvs: Floats) -> Places:
    """Find the triangles under uv points.

    Parameters
    ----------
    surface : TexturedSurface
        Its uv map need not be one-to-one.
    uvs : (N, 2) float64

    Returns
    -------
    Places
        For each point all triangles that hold it (those around it on an edge or vertex); where none does, the one it
        misses least, or else one at the nearest texture vertex.
    """
    corners = surface.uvs[surface.face_uvs]
    point, face = _candidates(corners, uvs)
    barycentric = _barycentrics(corners[face], uvs[point])
    inside = barycentric.min(axis=1, initial=np.inf)
    best = np.full(len(uvs), -np.inf)
    np.maximum.at(best, point, inside)
    kept = (inside >= np.minimum(best[point], 0.0) - SAME_PLACE) & np.isfinite(inside)
    point, face, barycentric = point[kept], face[kept], barycentric[kept]

    lost = np.flatnonzero(~np.isfinite(best))
    if len(lost):
        used, first_corner = np.unique(surface.face_uvs, return_index=True)
        _, nearest = cKDTree(surface.uvs[used]).query(uvs[lost])
        corner = first_corner[nearest]
        point, face = np.r_[point, lost], np.r_[face, corner // 3]
        barycentric = np.concatenate([barycentric, np.eye(3)[corner % 3]])
    barycentric = np.maximum(barycentric, 0.0)
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    order = np.lexsort((face, point))
    point = point[order]
    return Places(point, face[order], barycentric[order], np.searchsorted(point, np.arange(len(uvs))))
