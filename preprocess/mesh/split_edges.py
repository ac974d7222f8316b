"""Splits mesh edges at their midpoints without changing the surface or its parametrisation.

Where: a face whose three corners are to lie on one straight silhouette run would lose its area. Splitting its interior
edges gives it a free vertex (paper, section 6, leaves such vertices unstraightened instead).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface

# Sub-triangles of a face whose edge k (corner k to k + 1) is split at point 3 + k; one table per set of split edges,
# as for edge 0, edges 0 and 1, and all. Other sets are these, rotated.
_ONE = ((0, 3, 2), (3, 1, 2))
_TWO = ((1, 4, 3), (2, 0, 3), (2, 3, 4))
_THREE = ((0, 3, 5), (1, 4, 3), (2, 5, 4), (3, 4, 5))


@dataclass(frozen=True)
class EdgeSplit:
    """A surface with some edges split. Primes mark the new counts.

    Attributes
    ----------
    surface : TexturedSurface
        Its first V vertices, T texture vertices and F faces are the input's, in order (a split face's place is taken
        by one of its parts; the other parts follow at the end).
    face_source : (F',) int32
        Face of the input that every face is a part of.
    corner_weights : (F', 3, 3) float64
        Barycentric coordinates of the new corners in the source face: 0, 1/2 or 1.
    vertex_source : (V', 2) int32
        The two input vertices whose mean a vertex is; twice itself for the first V.
    """

    surface: TexturedSurface
    face_source: Ints
    corner_weights: Floats
    vertex_source: Ints

    @property
    def num_edges(self) -> int:
        """Number of edges split."""
        return int((self.vertex_source[:, 0] != self.vertex_source[:, 1]).sum())


def split_edges(surface: TexturedSurface, edges: NDArray[np.integer]) -> EdgeSplit:
    """Split edges at their midpoints, in 3D and in uv.

    Parameters
    ----------
    surface : TexturedSurface
    edges : (E, 2) int
        Surface vertices at the ends of the edges to split, in any order; pairs that are no edge are ignored.

    Returns
    -------
    EdgeSplit
    """
    num_vertices, num_faces, num_uvs = len(surface.positions), len(surface.faces), len(surface.uvs)
    wanted = np.unique(_edge_keys(np.asarray(edges).reshape(-1, 2), num_vertices))
    corners = surface.faces.astype(np.int64)
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)  # (F, 3, 2)
    keys = _edge_keys(ends, num_vertices)
    cut = np.isin(keys, wanted) & (ends[..., 0] != ends[..., 1])
    middle_keys, middle = np.unique(keys[cut], return_inverse=True)
    uv_ends = np.stack([surface.face_uvs, np.roll(surface.face_uvs, -1, axis=1)], axis=2)[cut].astype(np.int64)
    uv_rows = np.column_stack([middle, uv_ends.min(axis=1), uv_ends.max(axis=1)])
    uv_rows, uv_middle = np.unique(uv_rows, axis=0, return_inverse=True)

    # Six points a face: its corners, then the midpoints of its edges (0 where an edge is whole; never used).
    six = np.zeros((num_faces, 6), np.int64)
    six_uv = np.zeros((num_faces, 6), np.int64)
    six[:, :3], six_uv[:, :3] = surface.faces, surface.face_uvs
    six[:, 3:][cut] = num_vertices + middle
    six_uv[:, 3:][cut] = num_uvs + uv_middle.reshape(-1)
    source, slots = _sub_faces(cut)

    weights = np.zeros((6, 3))
    weights[[0, 1, 2], [0, 1, 2]] = 1.0
    weights[[3, 4, 5], [0, 1, 2]] = weights[[3, 4, 5], [1, 2, 0]] = 0.5
    pairs = np.column_stack([middle_keys // num_vertices, middle_keys % num_vertices])
    split = TexturedSurface(
        positions=np.concatenate([surface.positions, surface.positions[pairs].mean(axis=1)]),
        faces=six[source[:, None], slots].astype(np.int32),
        uvs=np.concatenate([surface.uvs, surface.uvs[uv_rows[:, 1:]].mean(axis=1)]),
        face_uvs=six_uv[source[:, None], slots].astype(np.int32),
    )
    own = np.repeat(np.arange(num_vertices)[:, None], 2, axis=1)
    return EdgeSplit(
        surface=split,
        face_source=source.astype(np.int32),
        corner_weights=weights[slots],
        vertex_source=np.concatenate([own, pairs]).astype(np.int32),
    )


def _edge_keys(ends: NDArray[np.integer], num_vertices: int) -> NDArray[np.int64]:
    """One number an undirected edge, from (..., 2) vertices."""
    ends = ends.astype(np.int64)
    result: NDArray[np.int64] = ends.min(axis=-1) * max(num_vertices, 1) + ends.max(axis=-1)
    return result


def _sub_faces(cut: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Source face and the three of its six points of every new face, first parts in the order of their faces."""
    num_faces = len(cut)
    count = cut.sum(axis=1)
    sources, slots = [np.arange(num_faces)], [np.tile(np.arange(3), (num_faces, 1))]
    for table, number in ((_ONE, 1), (_TWO, 2), (_THREE, 3)):
        rows = np.flatnonzero(count == number)
        # The rotation that brings the set of split edges to the table's: its first split edge after a whole one.
        start = np.argmax(cut[rows] & ~np.roll(cut[rows], 1, axis=1), axis=1)
        parts = np.array(table)
        rotated = np.where(parts < 3, 0, 3) + (parts[None] + start[:, None, None]) % 3  # (rows, parts, 3)
        slots[0][rows] = rotated[:, 0]
        sources.append(np.repeat(rows, len(parts) - 1))
        slots.append(rotated[:, 1:].reshape(-1, 3))
    return np.concatenate(sources), np.concatenate(slots)


def apply_split(mesh: SkinnedMesh, split: EdgeSplit) -> SkinnedMesh:
    """Carry a split of a character's surface over to everything that lives on its corners and vertices.

    Normals are averaged and normalised, tangents likewise with their handedness kept; weights are averaged, with more
    influences per vertex where the two ends together have more.
    """
    source, weights = split.face_source, split.corner_weights
    whole = (weights == 1.0).any(axis=2)  # corners that were corners before: copied bit by bit

    def blend(values: NDArray[Any]) -> NDArray[Any]:
        old = values[source]
        mixed = np.einsum("fck,fk...->fc...", weights, old.astype(np.float64))
        kept = np.take_along_axis(
            old, weights.argmax(axis=2).reshape(weights.shape[:2] + (1,) * (old.ndim - 2)), axis=1
        )
        mask = whole.reshape(whole.shape + (1,) * (old.ndim - 2))
        return np.where(mask, kept, mixed).astype(values.dtype)

    def unit(vectors: Floats) -> Floats:
        length = np.linalg.norm(vectors, axis=2, keepdims=True)
        return np.where(whole[..., None] | (length == 0.0), vectors, vectors / np.where(length == 0.0, 1.0, length))

    normals = unit(blend(mesh.corner_normals))
    tangents = None
    if mesh.corner_tangents is not None:
        tangents = blend(mesh.corner_tangents)
        tangents[..., :3] = unit(tangents[..., :3])
        tangents[..., 3] = np.where(tangents[..., 3] < 0.0, -1.0, 1.0)
    joints, joint_weights = _blend_influences(mesh, split.vertex_source)
    return dataclasses.replace(
        mesh,
        surface=split.surface,
        corner_normals=normals,
        corner_tangents=tangents,
        corner_texcoords=blend(mesh.corner_texcoords),
        corner_colors=None if mesh.corner_colors is None else blend(mesh.corner_colors),
        joint_indices=joints,
        joint_weights=joint_weights,
        face_materials=mesh.face_materials[source],
        face_parts=mesh.face_parts[source],
        face_num_texcoords=None if mesh.face_num_texcoords is None else mesh.face_num_texcoords[source],
    )


def _blend_influences(mesh: SkinnedMesh, vertex_source: Ints) -> tuple[Ints, Floats]:
    """Mean of two vertices' weights, joint by joint, for the vertices that a split added."""
    num_old, width = mesh.joint_indices.shape
    joints = mesh.joint_indices[vertex_source[num_old:]].reshape(-1, 2 * width)
    weights = 0.5 * mesh.joint_weights[vertex_source[num_old:]].reshape(-1, 2 * width)
    # Bring equal joints together, sum each group into its first slot, then sort the heaviest to the front.
    order = np.argsort(np.where(weights > 0.0, joints, np.iinfo(np.int32).max), axis=1, kind="stable")
    joints, weights = np.take_along_axis(joints, order, axis=1), np.take_along_axis(weights, order, axis=1)
    for slot in range(2 * width - 1, 0, -1):
        same = joints[:, slot] == joints[:, slot - 1]
        weights[:, slot - 1] += np.where(same, weights[:, slot], 0.0)
        weights[:, slot] = np.where(same, 0.0, weights[:, slot])
    order = np.argsort(-weights, axis=1, kind="stable")
    joints, weights = np.take_along_axis(joints, order, axis=1), np.take_along_axis(weights, order, axis=1)
    joints = np.where(weights > 0.0, joints, 0)
    used = int((weights > 0.0).sum(axis=1).max(initial=0))
    full = max(width, used)
    pad = ((0, 0), (0, full - width))
    return (
        np.concatenate([np.pad(mesh.joint_indices, pad), joints[:, :full]]).astype(np.int32),
        np.concatenate([np.pad(mesh.joint_weights, pad), weights[:, :full]]),
    )
