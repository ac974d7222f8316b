"""Corner normals for parts that come without: smooth over the welded surface, hard where it is sharp.

glTF says that a primitive without normals is shaded flat. That is made for boxes; on a character every edge would
become a hard edge and every level of detail a different object. So normals are averaged around welded vertices,
weighted by the angle at the corner (Thuermer and Wuethrich 1998), within groups of faces that no sharp edge parts.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Indices
from preprocess.mesh.edges import group_half_edges, next_corners
from preprocess.mesh.face_geometry import corner_angles, face_normals
from preprocess.mesh.grouping import connected_groups

CREASE_RAD = np.deg2rad(60.0)  # edges with a larger angle between their face normals stay hard


def smooth_edges(normals: Floats, faces: Indices, crease_rad: float) -> tuple[Indices, Indices]:
    """Corners at either side of the edges that are not sharp, as two lists of flat corner indices to be joined."""
    groups = group_half_edges(faces)
    left, right = groups.pairs(groups.count == 2)
    soft = np.einsum("ij,ij->i", normals[left // 3], normals[right // 3]) >= np.cos(crease_rad)
    left, right = left[soft], right[soft]
    left_end, right_end = next_corners(left), next_corners(right)
    same_way = groups.start[left] == groups.start[right]
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
    triangles = positions[faces]
    normals = face_normals(triangles)
    num_groups, groups = connected_groups(faces.size, *smooth_edges(normals, faces, crease_rad))
    weighted = (normals[:, None, :] * corner_angles(triangles)[:, :, None]).reshape(-1, 3)
    sums = np.stack([np.bincount(groups, weighted[:, c], minlength=num_groups) for c in range(3)], axis=1)
    corner = sums[groups].reshape(-1, 3, 3)
    lengths = np.linalg.norm(corner, axis=2, keepdims=True)
    flat = np.repeat(normals[:, None, :], 3, axis=1)
    smooth: Floats = np.where(lengths > 1e-9, corner / np.maximum(lengths, 1e-300), flat)
    return smooth
