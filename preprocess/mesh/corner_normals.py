"""Corner normals for parts that come without: smooth over the welded surface, hard where it is sharp.

glTF says that a primitive without normals is shaded flat. That is made for boxes; on a character every edge would
become a hard edge and every level of detail a different object. So normals are averaged around welded vertices,
weighted by the angle at the corner (Thuermer and Wuethrich 1998), within groups of faces that no sharp edge parts.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Indices
from preprocess.mesh.grouping import group_rows, join_pairs

CREASE_RAD = np.deg2rad(60.0)  # edges with a larger angle between their face normals stay hard


def face_normals(positions: Floats, faces: Indices) -> Floats:
    """Unit normals, (F, 3) float64; zero for a face without area."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)


def corner_angles(positions: Floats, faces: Indices) -> Floats:
    """Inner angles, (F, 3) float64 radians; zero beside an edge of no length."""
    corners = positions[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    return np.arctan2(sine, np.einsum("fkc,fkc->fk", ahead, back)) * (sine > 0)


def smooth_edges(normals: Floats, faces: Indices, crease_rad: float) -> tuple[Indices, Indices]:
    """Corners at either side of the edges that are not sharp, as two lists of flat corner indices to be joined."""
    start = faces.reshape(-1)
    end = np.roll(faces, -1, axis=1).reshape(-1)
    edge, firsts = group_rows(np.minimum(start, end), np.maximum(start, end))
    order = np.argsort(edge, kind="stable")
    counts = np.bincount(edge, minlength=len(firsts))
    begin = np.cumsum(counts) - counts
    left, right = order[begin[counts == 2]], order[begin[counts == 2] + 1]
    soft = np.einsum("ij,ij->i", normals[left // 3], normals[right // 3]) >= np.cos(crease_rad)
    left, right = left[soft], right[soft]
    left_end, right_end = (h // 3 * 3 + (h + 1) % 3 for h in (left, right))
    same_way = start[left] == start[right]
    return (
        np.r_[left, left_end],
        np.r_[np.where(same_way, right, right_end), np.where(same_way, right_end, right)],
    )


def smooth_corner_normals(positions: Floats, faces: Indices, crease_rad: float = CREASE_RAD) -> Floats:
    """Angle-weighted normals within smoothing groups.

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int64
        A manifold: edges with two faces are smooth unless their normals differ by more than the crease.
    crease_rad : float

    Returns
    -------
    (F, 3, 3) float64, unit
    """
    normals = face_normals(positions, faces)
    num_groups, groups = join_pairs(faces.size, *smooth_edges(normals, faces, crease_rad))
    weighted = (normals[:, None, :] * corner_angles(positions, faces)[:, :, None]).reshape(-1, 3)
    sums = np.stack([np.bincount(groups, weighted[:, c], minlength=num_groups) for c in range(3)], axis=1)
    corner = sums[groups].reshape(-1, 3, 3)
    lengths = np.linalg.norm(corner, axis=2, keepdims=True)
    flat = np.repeat(normals[:, None, :], 3, axis=1)
    smooth: Floats = np.where(lengths > 1e-9, corner / np.maximum(lengths, 1e-300), flat)
    return smooth
