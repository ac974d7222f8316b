"""A level of detail as ordinary vertex attributes: positions, normals, joints and weights from the full mesh.

Each corner lies somewhere on the full mesh (corner_locations.py); the face there says what normal and which weights it
has. Where several do (at a vertex or an edge), a corner takes the normal that its own face agrees with most, so hard
edges stay hard without being marked. Vertices split where normals or uvs differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices
from preprocess.fit.corner_locations import Places, locate_corners
from preprocess.mesh.face_geometry import face_normals
from preprocess.mesh.grouping import expand_ranges, group_rows
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from runtime.asset.lod_mesh import UV_STEPS

SAME_TANGENT = 2e-2  # tangents likewise: a degree, of a direction in the surface
SAME_NORMAL = 1e-3  # normals of one point that differ less, a component, are one vertex


@dataclass(frozen=True)
class LodTarget:
    """What a morph target does to a level. N touched vertices.

    Attributes
    ----------
    vertices : (N,) int64, rising
    shifts : (N, 3) float32, metres
    turns : (N, 3) float32
        Changes of normals.
    """

    vertices: Indices
    shifts: NDArray[np.float32]
    turns: NDArray[np.float32]


@dataclass(frozen=True)
class LodMesh:
    """Vertex attributes of a level. N vertices, F faces, K influences, a multiple of four.

    Attributes
    ----------
    positions, normals : (N, 3) float32
    uvs, canonical_uvs : (N, 2) float32
    normal_uvs : (N, 2) uint16 or None
        Where the normal texture is sampled, as whole steps; None where that is at `uvs`.
    joints : (N, K) uint8 or uint16
    weights : (N, K) float32
        Heaviest first, rows sum to one.
    faces : (F, 3) int64
    tangents : (N, 4) float32 or None
        With handedness, for a tangent-space normal map.
    targets : tuple of LodTarget
        One a morph of the character.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    canonical_uvs: NDArray[np.float32]
    normal_uvs: NDArray[np.uint16] | None
    joints: NDArray[np.unsignedinteger]
    weights: NDArray[np.float32]
    faces: Indices
    tangents: NDArray[np.float32] | None = None
    targets: tuple[LodTarget, ...] = ()


def _level_targets(mesh: SkinnedMesh, places: Places, rows: Indices, normals: Floats) -> tuple[LodTarget, ...]:
    """Targets of vertices that lie on the full mesh at these rows of `places`, and have these normals (N, 3)."""
    corners, shares = mesh.surface.faces[places.faces[rows]], places.barycentrics[rows]
    targets = []
    for morph in mesh.morphs:
        dense = morph.dense_rows(mesh.num_vertices)
        found = np.einsum("nk,nkc->nc", shares, dense[corners]).reshape(-1, 3, 4)
        shifts = found[..., 3].astype(np.float32)
        turns = np.einsum("nij,nj->ni", found[..., :3], normals).astype(np.float32)
        touched = np.flatnonzero(shifts.any(axis=1) | turns.any(axis=1))
        targets.append(LodTarget(touched, shifts[touched], turns[touched]))
    return tuple(targets)


def _corner_normals(
    mesh: SkinnedMesh, level: TexturedSurface, places: Places, corner_points: Indices
) -> tuple[Floats, Indices]:
    """The full mesh's normal at each corner of the level, on the side that the level's face is on.

    Returns
    -------
    normals : (F, 3, 3) float64
    rows : (3 F,) int64
        The row of `places` that each corner's normal is from.
    """
    own = np.repeat(face_normals(level.positions[level.faces]), 3, axis=0)
    points = corner_points.reshape(-1)
    counts = np.diff(np.r_[places.firsts, len(places.points)])[points]
    corner, row = expand_ranges(places.firsts[points], counts)
    normals = np.einsum("rk,rkc->rc", places.barycentrics[row], mesh.corner_normals[places.faces[row]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    agreement = np.round(np.einsum("rc,rc->r", normals, own[corner]), 6)  # ties go to the first: the same bits again
    best = np.lexsort((np.arange(len(row)), -agreement, corner))
    first = np.r_[True, corner[best][1:] != corner[best][:-1]]
    chosen = normals[best[first]]
    unusable = np.linalg.norm(chosen, axis=1) < 0.5
    chosen[unusable] = own[unusable]
    return chosen.reshape(-1, 3, 3), row[best[first]]


def _corner_tangents(places: Places, rows: Indices, tangents: Floats, normals: Floats) -> Floats:
    """The full mesh's tangents (F, 3, 4) where corners have their normals (N, 3) from, across these, (N, 4)."""
    faces, weights = places.faces[rows], places.barycentrics[rows]
    along = np.einsum("nk,nkc->nc", weights, tangents[faces, :, :3])
    along -= np.einsum("nc,nc->n", along, normals)[:, None] * normals
    lengths = np.linalg.norm(along, axis=1)
    lost = lengths < 1e-6  # opposite tangents cancel: any direction across the normal is as good
    along[lost] = np.cross(normals[lost], np.eye(3)[np.argmin(np.abs(normals[lost]), axis=1)])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.concatenate([along, tangents[faces, 0, 3:]], axis=1)


def _vertex_weights(mesh: SkinnedMesh, num_joints: int, places: Places, rows: Indices) -> Floats:
    """Dense weights of the level's surface vertices, interpolated over the full mesh's, (V, J)."""
    sources = mesh.surface.faces[places.faces[rows]]
    dense = np.zeros((len(rows), num_joints))
    vertex = np.arange(len(rows))[:, None]
    for k in range(3):
        joints, weights = mesh.joint_indices[sources[:, k]], mesh.joint_weights[sources[:, k]]
        np.add.at(dense, (vertex, joints), weights * places.barycentrics[rows, k : k + 1])
    return dense


def limit_influences(dense: Floats, num_influences: int) -> tuple[NDArray[np.int64], Floats]:
    """The heaviest joints of each row, renormalised.

    Parameters
    ----------
    dense : (N, J) float64
    num_influences : int

    Returns
    -------
    joints, weights : (N, num_influences)
        Heaviest first; joint 0 where the weight is 0.
    """
    count = min(num_influences, dense.shape[1])
    joints = np.argsort(-dense, axis=1, kind="stable")[:, :count]
    weights = np.take_along_axis(dense, joints, axis=1)
    weights = weights / weights.sum(axis=1, keepdims=True)
    weights[weights < 1e-6] = 0.0
    weights = weights / weights.sum(axis=1, keepdims=True)
    joints = np.where(weights > 0, joints, 0)
    missing = ((0, 0), (0, num_influences - count))
    return np.pad(joints, missing), np.pad(weights, missing)


def build_lod_mesh(
    mesh: SkinnedMesh,
    num_joints: int,
    level: TexturedSurface,
    canonical_uvs: NDArray[np.integer],
    face_source: NDArray[np.integer],
    num_influences: int,
    normal_uvs: Floats | None = None,
    fetch_uvs: Floats | None = None,
    tangents: Floats | None = None,
) -> LodMesh:
    """Turn a level into vertex attributes.

    Parameters
    ----------
    mesh : SkinnedMesh
        The full character with the atlas as its uvs.
    num_joints : int
    level : TexturedSurface
        Its uvs lie in the same atlas.
    canonical_uvs : (V,) int
        The texture vertex that owns each surface vertex of the level.
    face_source : (F,) int
        A face of the full mesh that each face stems from.
    num_influences : int
        4 or 8.
    normal_uvs : (F, 3, 2) float64, optional
        Where the level's corners sample the normal texture, if not at its uvs.
    fetch_uvs : (V, 2) float64, optional
        Where each surface vertex fetches its geometry, if not at its canonical uv.
    tangents : (F', 3, 4) float64, optional
        Of the full mesh's corners.
    """
    places, corner_points, point_corners = locate_corners(mesh.surface, level, face_source)
    normals, rows = _corner_normals(mesh, level, places, corner_points)
    # The weights of a surface vertex are those at its canonical uv; one that has no corner takes its first.
    point_vertex = level.faces.reshape(-1)[point_corners]
    owns = level.face_uvs.reshape(-1)[point_corners] == canonical_uvs[point_vertex]
    order = np.lexsort((np.arange(len(owns)), ~owns, point_vertex))
    point_of_vertex = np.zeros(len(level.positions), np.int64)
    point_of_vertex[point_vertex[order[::-1]]] = order[::-1]
    vertex_rows = places.firsts[point_of_vertex]
    dense = _vertex_weights(mesh, num_joints, places, vertex_rows)
    joints, weights = limit_influences(dense, num_influences)

    flat = normals.reshape(-1, 3)
    steps = np.rint(flat / SAME_NORMAL).astype(np.int64)
    vertices, texture_vertices = level.faces.reshape(-1), level.face_uvs.reshape(-1)
    columns = [vertices, texture_vertices, *steps.T]
    stored = None
    if normal_uvs is not None:
        stored = np.rint(normal_uvs.reshape(-1, 2) * UV_STEPS).astype(np.uint16)
        columns += list(stored.T)
    across = None
    if tangents is not None:
        across = _corner_tangents(places, rows, tangents, flat)
        columns += list(np.rint(across / SAME_TANGENT).astype(np.int64).T)
    index, corners = group_rows(*columns)
    surface_vertex = vertices[corners]
    geometry_uvs = level.uvs[canonical_uvs] if fetch_uvs is None else fetch_uvs
    return LodMesh(
        positions=level.positions[surface_vertex].astype(np.float32),
        normals=flat[corners].astype(np.float32),
        uvs=level.uvs[texture_vertices[corners]].astype(np.float32),
        canonical_uvs=geometry_uvs[surface_vertex].astype(np.float32),
        normal_uvs=None if stored is None else stored[corners],
        joints=joints[surface_vertex].astype(np.uint8 if num_joints <= 256 else np.uint16),
        weights=weights[surface_vertex].astype(np.float32),
        faces=index.reshape(-1, 3),
        tangents=None if across is None else across[corners].astype(np.float32),
        targets=_level_targets(mesh, places, vertex_rows[surface_vertex], flat[corners]),
    )
