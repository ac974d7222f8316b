"""Moves uvs apart where a few faces overlap by a texel or so, as at slits that an artist has left too narrow.

A pair of faces is parted along the axis on which it overlaps least: each face's vertices that are beyond the middle of
the overlap go back to it.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.uv_overlap import find_overlap

FEW_SHARE, FEW_FACES = 0.01, 8
"""Of the faces that may overlap, or so many: more of them are no accident."""

MOST_FACES = 1000  # that overlap: all pairs of them are looked at

FARTHEST_UV = 4.0 / 1024.0
"""That a vertex may move: a few texels."""

GAP_UV = 1.0 / 8192.0
"""Left between faces on either side."""

ROUNDS = 20


def part_overlaps(uvs: Floats, face_uvs: Ints) -> Floats | None:
    """Texture vertices with which no two faces overlap, or None where that takes more than a few small moves.

    Parameters
    ----------
    uvs : (T, 2) float64
        Finite.
    face_uvs : (F, 3) int32
    """
    wanted = face_orientation(uvs, face_uvs)
    moved = uvs.copy()
    for _ in range(ROUNDS):
        overlap = find_overlap(moved, face_uvs)
        faces = np.flatnonzero(overlap.faces)
        if not len(faces):
            near = np.linalg.norm(moved - uvs, axis=1).max(initial=0.0) <= FARTHEST_UV
            return moved if near and (face_orientation(moved, face_uvs) == wanted).all() else None
        if overlap.num_flat or len(faces) > min(max(FEW_SHARE * len(face_uvs), FEW_FACES), MOST_FACES):
            return None
        for f, g, axis in zip(*_overlapping_pairs(moved[face_uvs[faces]]), strict=True):
            _clamp(moved, face_uvs[faces[f]], face_uvs[faces[g]], axis)
    return None


def _overlapping_pairs(triangles: Floats) -> tuple[Ints, Ints, Floats]:
    """Pairs of triangles (N, 3, 2) that overlap, and the unit axis of least overlap from the first to the second."""
    first, second = np.triu_indices(len(triangles), 1)
    edges = np.roll(triangles, -1, axis=1) - triangles
    normals = np.stack([-edges[..., 1], edges[..., 0]], axis=2)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300)
    axes = np.concatenate([normals[first], normals[second]], axis=1)
    axes = np.concatenate([axes, -axes], axis=1)  # (P, 12, 2)
    depth = np.einsum("pad,pkd->pak", axes, triangles[first]).max(axis=2)
    depth -= np.einsum("pad,pkd->pak", axes, triangles[second]).min(axis=2)
    least = depth.argmin(axis=1)
    rows = np.flatnonzero(depth.min(axis=1) > 0)
    return first[rows].astype(np.int32), second[rows].astype(np.int32), axes[rows, least[rows]]


def _clamp(uvs: Floats, first: Ints, second: Ints, axis: Floats) -> None:
    """Move the vertices of two faces that are beyond the middle of their overlap back to it, in place."""
    shared = np.intersect1d(first, second)
    first, second = np.setdiff1d(first, shared), np.setdiff1d(second, shared)
    along_first, along_second = uvs[first] @ axis, uvs[second] @ axis
    if not len(first) or not len(second):
        return
    middle = 0.5 * (along_first.max() + along_second.min())
    uvs[first] -= np.maximum(along_first - middle + GAP_UV, 0.0)[:, None] * axis
    uvs[second] += np.maximum(middle + GAP_UV - along_second, 0.0)[:, None] * axis
