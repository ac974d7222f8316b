"""Parts into one indexed surface: vertices that are one point of the character become one vertex.

A file repeats a vertex wherever a uv seam, a hard edge, a material or a primitive ends. Two copies are one point if
they lie together (equal, or within WELD_REL of the character's size), hang on the same joints with the same weights (to
SAME_WEIGHT) and move together in every morph target, so that nothing parts them; other copies, as where a rigid part
only touches the body, stay apart. What makes copies differ otherwise stays where it belongs: uvs become texture
vertices of the surface vertex, normals corner values. Faces that have lost their area go, and so do faces drawn twice.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices
from preprocess.load.primitives import Target
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.grouping import cluster_points, group_rows

WELD_REL = 1e-6  # of the bounding diagonal: some ten roundings of a float32 position
WELD_UV = 1e-6  # 1/1000 of a texel at 1024²
SAME_SHIFT_REL = 1e-5  # of the bounding diagonal: copies that a morph target moves further apart are two points
SAME_WEIGHT = 1e-5  # normalising copies one by one leaves about 1e-7; a joint that moves by 1 m moves this by 10 um
FLAT_REL = 1e-7  # a face lower than this, of the bounding diagonal, has no area


@dataclass(frozen=True)
class Soup:
    """The vertices and faces of all parts, one after the other. N vertices, F faces, K influences, L uv sets.

    Attributes
    ----------
    positions : (N, 3) float64, object space
    normals : (N, 3) float64, NaN where the file has none
    tangents : (N, 4) float64 or None
    texcoords : (N, L, 2) float64
    num_texcoords : (N,) int64
        How many of the sets the vertex's part has; the others are zeros.
    colors : (N, 4) float32 or None
    joints : (N, K) int64, canonical: heaviest first, 0 where the weight is 0
    weights : (N, K) float64
    faces : (F, 3) int64
    face_parts, face_materials : (F,) int64
    targets : dict of morph name to Target
        Of all parts together.
    """

    positions: Floats
    normals: Floats
    tangents: Floats | None
    texcoords: Floats
    num_texcoords: Indices
    colors: NDArray[np.float32] | None
    joints: NDArray[np.int64]
    weights: Floats
    faces: Indices
    face_parts: Indices
    face_materials: Indices
    targets: dict[str, Target] = field(default_factory=dict)


@dataclass(frozen=True)
class Welded:
    """Source vertices sorted into surface vertices and uv clusters.

    Attributes
    ----------
    vertex_of : (N,) int64
        Surface vertex of each source vertex.
    vertex_firsts : (V,) int64
        The source vertex whose position and weights each surface vertex takes.
    uv_of : (N,) int64
        Cluster of equal TEXCOORD_0 values, over the whole file.
    uv_firsts : (U,) int64
    num_apart : int
        Points that stay several vertices because their weights differ.
    """

    vertex_of: Indices
    vertex_firsts: Indices
    uv_of: Indices
    uv_firsts: Indices
    num_apart: int


def canonical_influences(joints: NDArray[np.int64], weights: Floats) -> tuple[NDArray[np.int64], Floats]:
    """One form for equal influences: a joint once a vertex, heaviest first, zeros last, no unused columns.

    Parameters
    ----------
    joints : (N, K) int64
    weights : (N, K) float64

    Returns
    -------
    joints, weights : (N, K') with K' the largest number of joints that any vertex uses
    """
    order = np.argsort(joints, axis=1, kind="stable")
    joints = np.take_along_axis(joints, order, axis=1)
    weights = np.take_along_axis(weights, order, axis=1)
    for k in range(1, joints.shape[1]):  # a handful of influences
        same = joints[:, k] == joints[:, k - 1]
        weights[same, k] += weights[same, k - 1]
        weights[same, k - 1] = 0.0
    joints = np.where(weights > 0, joints, 0)
    order = np.lexsort((joints, -weights), axis=1)
    joints = np.take_along_axis(joints, order, axis=1)
    weights = np.take_along_axis(weights, order, axis=1)
    used = max(int((weights > 0).any(axis=0).sum()), 1)
    return np.ascontiguousarray(joints[:, :used]), np.ascontiguousarray(weights[:, :used])


def _weight_labels(point: Indices, joints: NDArray[np.int64], weights: Floats) -> list[Indices]:
    """A label for each influence, (N,) each, equal for copies of a point where the joint and (nearly) the weight agree.

    The copies' weights of one joint are sorted; a gap above the tolerance parts them.
    """
    none = joints.max(initial=0) + 1
    joints = np.where(weights > SAME_WEIGHT, joints, none)
    order = np.argsort(joints, axis=1, kind="stable")  # by joint: by weight, noise would swap equals
    joints, weights = np.take_along_axis(joints, order, axis=1), np.take_along_axis(weights, order, axis=1)
    weights = np.where(joints < none, weights, 0.0)
    labels = []
    for k in range(joints.shape[1]):  # a handful of influences
        by_weight = np.lexsort((weights[:, k], joints[:, k], point))
        p, j, w = point[by_weight], joints[by_weight, k], weights[by_weight, k]
        new = np.r_[True, (p[1:] != p[:-1]) | (j[1:] != j[:-1]) | (w[1:] - w[:-1] > SAME_WEIGHT)]
        label = np.empty(len(point), np.int64)
        label[by_weight] = np.cumsum(new)
        labels.append(label)
    return labels


def _part_moved_copies(vertex_of: Indices, targets: Iterable[Target], tolerance_m: float) -> Indices:
    """Labels (N,) like those given, but copies that a target moves apart, as lips that open, have other ones."""
    labels = vertex_of.copy()
    for target in targets:
        shifts = np.zeros((len(labels), 3))
        shifts[target.vertices] = target.shifts
        touched = np.zeros(int(labels.max(initial=0)) + 1, bool)
        touched[labels[target.vertices]] = True
        rows = np.flatnonzero(touched[labels] & (np.bincount(labels)[labels] > 1))
        for axis in range(3):
            order = rows[np.lexsort((shifts[rows, axis], labels[rows]))]
            label, along = labels[order], shifts[order, axis]
            apart = np.r_[False, (label[1:] == label[:-1]) & (np.diff(along) > tolerance_m)]
            if apart.any():  # within a run of one label, the copies from a gap on are others
                runs = np.cumsum(np.r_[False, label[1:] != label[:-1]] | apart)
                labels[order] = int(labels.max()) + 1 + runs
    return labels


def weld_vertices(soup: Soup, diagonal_m: float) -> Welded:
    """Find which source vertices are one surface vertex, and which uvs are one value.

    Parameters
    ----------
    soup : Soup
    diagonal_m : float
        Of the character's bounding box.
    """
    point, point_firsts = cluster_points(soup.positions, WELD_REL * diagonal_m)
    vertex_of, vertex_firsts = group_rows(point, *_weight_labels(point, soup.joints, soup.weights))
    if soup.targets:
        moved = _part_moved_copies(vertex_of, soup.targets.values(), SAME_SHIFT_REL * diagonal_m)
        vertex_of, vertex_firsts = group_rows(moved)
    uvs = soup.texcoords[:, 0] if soup.texcoords.shape[1] else np.zeros((len(point), 2))
    uv_of, uv_firsts = cluster_points(uvs, WELD_UV)
    return Welded(vertex_of, vertex_firsts, uv_of, uv_firsts, len(vertex_firsts) - len(point_firsts))


def faces_with_area(positions: Floats, faces: Indices, diagonal_m: float) -> NDArray[np.bool_]:
    """Whether each face has three vertices and a height that is not mere rounding, (F,) bool."""
    a, b, c = faces.T
    distinct = (a != b) & (b != c) & (c != a)
    corners = positions[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    doubled_area = 2.0 * face_areas(corners)
    longest = np.linalg.norm(sides, axis=2).max(axis=1, initial=0.0)
    result: NDArray[np.bool_] = distinct & (doubled_area > FLAT_REL * diagonal_m * longest)
    return result


@dataclass(frozen=True)
class Duplicates:
    """Which faces stay when faces on the same three vertices are sorted out.

    Attributes
    ----------
    keep : (F,) bool
    becomes_double_sided : (F,) bool
        Kept faces of single-sided materials whose removed twin faced the other way.
    num_same, num_opposite : int
        Removed faces that repeated another, and that were the back of another.
    """

    keep: NDArray[np.bool_]
    becomes_double_sided: NDArray[np.bool_]
    num_same: int
    num_opposite: int


def find_duplicates(
    faces: Indices, face_uvs: Indices, face_materials: Indices, is_double_sided: NDArray[np.bool_]
) -> Duplicates:
    """Sort out faces of one material on the same three vertices.

    One that faces the same way repeats the first: it goes. One that faces the other way is the back of the first. It
    goes where the material is double-sided; where it is not but the uvs agree, it goes and the front becomes
    double-sided; where the uvs differ, the two show different pictures and both stay, as two sheets.

    Parameters
    ----------
    faces, face_uvs : (F, 3) int64
        Surface vertices, and uv clusters, of the corners.
    face_materials : (F,) int64
    is_double_sided : (M,) bool
        Of each material.
    """
    num_faces = len(faces)
    # Bring every face to a form that starts at its smallest vertex, keeping its direction.
    turn = np.argmin(faces, axis=1)
    columns = (turn[:, None] + np.arange(3)) % 3
    cyclic = np.take_along_axis(faces, columns, axis=1)
    uvs = np.take_along_axis(face_uvs, columns, axis=1)
    backward = cyclic[:, 1] > cyclic[:, 2]
    low = np.where(backward[:, None], cyclic[:, [0, 2, 1]], cyclic)
    uvs = np.where(backward[:, None], uvs[:, [0, 2, 1]], uvs)
    triple, _ = group_rows(low[:, 0], low[:, 1], low[:, 2], face_materials)
    _, firsts = group_rows(triple, backward)
    keep = np.zeros(num_faces, bool)
    keep[firsts] = True
    num_same = num_faces - len(firsts)

    kept = np.flatnonzero(keep)
    group, group_firsts = group_rows(triple[kept])
    front = kept[group_firsts][group]  # the first kept face on the same vertices
    twin = kept != front
    back, front = kept[twin], front[twin]
    double_sided = is_double_sided[face_materials[back]]
    agree = (uvs[back] == uvs[front]).all(axis=1)
    keep[back[double_sided | agree]] = False
    becomes = np.zeros(num_faces, bool)
    becomes[front[agree & ~double_sided]] = True
    return Duplicates(keep, becomes, num_same, int((double_sided | agree).sum()))
