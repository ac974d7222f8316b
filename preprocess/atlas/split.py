"""Splits edges of a skinned mesh at their middle; nothing that is drawn changes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.mesh import Ints, SkinnedMesh, TexturedSurface


def split_edges(mesh: SkinnedMesh, vertex_pairs: Ints) -> SkinnedMesh:
    """Put a vertex on the middle of edges and split the faces around them.

    Every attribute is interpolated linearly, corner by corner (normals are not renormalised to anything but unit
    length), so the surface and its looks stay the same.

    Parameters
    ----------
    mesh : SkinnedMesh
    vertex_pairs : (S, 2) int32
        Ends of the edges, without repeats.

    Returns
    -------
    SkinnedMesh
        New vertices come last in `positions`. Faces are reordered: a split face's parts are neighbours.
    """
    surface = mesh.surface
    num_vertices, num_uvs = len(surface.positions), len(surface.uvs)
    if not len(vertex_pairs):
        return mesh
    low, high = np.sort(vertex_pairs, axis=1).astype(np.int64).T
    order = np.argsort(low * num_vertices + high, kind="stable")
    keys = (low * num_vertices + high)[order]
    low, high = low[order], high[order]

    # Corner rows of the new faces: each is a mean of two corners of the old face (the same twice for an old corner).
    start = surface.faces.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    key = np.minimum(start, end) * num_vertices + np.maximum(start, end)
    slot = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
    hit = keys[slot] == key
    pattern = hit @ np.array([1, 2, 4])
    source, first, second = [], [], []
    for bits, triangles in _SPLITS.items():
        chosen = np.flatnonzero(pattern == bits)
        for triangle in triangles:
            source.append(chosen)
            first.append(np.tile([c if c < 3 else c - 3 for c in triangle], (len(chosen), 1)))
            second.append(np.tile([c if c < 3 else (c - 2) % 3 for c in triangle], (len(chosen), 1)))
    face, a, b = np.concatenate(source), np.concatenate(first), np.concatenate(second)
    order = np.argsort(face, kind="stable")
    face, a, b = face[order], a[order], b[order]
    row = face[:, None]

    def mean(values: NDArray[Any]) -> NDArray[Any]:
        same = (a == b).reshape(a.shape + (1,) * (values.ndim - 2))
        return np.where(same, values[row, a], 0.5 * (values[row, a] + values[row, b])).astype(values.dtype)

    middle = num_vertices + slot[row, a]
    faces = np.where(a == b, surface.faces[row, a], middle).astype(np.int32)
    # A texture vertex a split half-edge and uv pair: both sides of an uncut edge share it.
    uv_a, uv_b = surface.face_uvs[row, a].astype(np.int64), surface.face_uvs[row, b].astype(np.int64)
    uv_key = np.minimum(uv_a, uv_b) * max(num_uvs, 1) + np.maximum(uv_a, uv_b)
    fresh, inverse = np.unique(uv_key[a != b], return_inverse=True)
    face_uvs = surface.face_uvs[row, a].astype(np.int32)
    uvs = surface.uvs
    if num_uvs:
        face_uvs[a != b] = num_uvs + inverse.ravel()
        uvs = np.concatenate([uvs, 0.5 * (uvs[fresh // num_uvs] + uvs[fresh % num_uvs])])
    positions = np.concatenate([surface.positions, 0.5 * (surface.positions[low] + surface.positions[high])])
    joints, weights = _blend_influences(mesh, low, high)
    return dataclasses.replace(
        mesh,
        surface=TexturedSurface(positions, faces, uvs, face_uvs),
        corner_normals=_unit(mean(mesh.corner_normals)),
        corner_tangents=None if mesh.corner_tangents is None else _unit(mean(mesh.corner_tangents), 3),
        corner_texcoords=mean(mesh.corner_texcoords),
        corner_colors=None if mesh.corner_colors is None else mean(mesh.corner_colors),
        joint_indices=joints,
        joint_weights=weights,
        face_materials=mesh.face_materials[face],
        face_parts=mesh.face_parts[face],
    )


# Triangles that replace a face, by which of its edges 0-1, 1-2, 2-0 are split (bits 1, 2, 4). Corners 0, 1, 2 are the
# face's own; 3, 4, 5 are the middles of its edges.
_SPLITS = {
    0: [(0, 1, 2)],
    1: [(0, 3, 2), (3, 1, 2)],
    2: [(1, 4, 0), (4, 2, 0)],
    4: [(2, 5, 1), (5, 0, 1)],
    3: [(3, 1, 4), (0, 3, 2), (3, 4, 2)],
    6: [(4, 2, 5), (1, 4, 0), (4, 5, 0)],
    5: [(5, 0, 3), (2, 5, 1), (5, 3, 1)],
    7: [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
}


def _unit(vectors: NDArray[Any], dimensions: int = 3) -> NDArray[Any]:
    length = np.linalg.norm(vectors[..., :dimensions], axis=-1, keepdims=True)
    scaled = vectors.copy()
    scaled[..., :dimensions] /= np.where(length > 0, length, 1)
    return scaled


def _blend_influences(
    mesh: SkinnedMesh, low: NDArray[np.int64], high: NDArray[np.int64]
) -> tuple[Ints, NDArray[np.float64]]:
    """Joint weights with rows for the middles: both ends' influences, merged; wider where they need more slots."""
    width = mesh.joint_indices.shape[1]
    joints = np.concatenate([mesh.joint_indices[low], mesh.joint_indices[high]], axis=1)
    weights = 0.5 * np.concatenate([mesh.joint_weights[low], mesh.joint_weights[high]], axis=1)
    for k in range(1, 2 * width):  # fold each slot into the first of the same joint
        same = joints[:, :k] == joints[:, k : k + 1]
        target = np.argmax(same, axis=1)
        rows = np.flatnonzero(same.any(axis=1))
        weights[rows, target[rows]] += weights[rows, k]
        weights[rows, k] = 0.0
    order = np.argsort(-weights, axis=1, kind="stable")
    joints, weights = np.take_along_axis(joints, order, axis=1), np.take_along_axis(weights, order, axis=1)
    joints = np.where(weights > 0, joints, 0).astype(np.int32)
    needed = max(width, int((weights > 0).sum(axis=1).max()))
    pad = ((0, 0), (0, needed - width))
    return (
        np.concatenate([np.pad(mesh.joint_indices, pad), joints[:, :needed]]).astype(np.int32),
        np.concatenate([np.pad(mesh.joint_weights, pad), weights[:, :needed]]),
    )
