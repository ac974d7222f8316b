"""Topology of a LOD found again from its uvs: patches for tessellation, and seam edges for the diagrams.

Copies of a surface point have the same owner uv, so the surface's edges are pairs of owner uvs. Where the two
half-edges of an edge have different uvs (a seam), one is made the owner of all that lies between its ends: the one with
the smaller uvs, read as numbers, which is the same choice whichever triangle asks (Castaño 2008).
Letters in shapes: N vertices, F faces, E edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PATCH_VERTICES = 9  # 3 corners, then the two ends of the owning edge of each side


def _words(uvs: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Each uv as one number that grows with u, then v: (N,) uint64. uvs are not negative in practice, -0 is 0."""
    bits = np.ascontiguousarray(uvs + np.float32(0.0)).view(np.uint32).astype(np.uint64)
    sign = bits >> np.uint64(31)
    ordered = np.where(sign == 1, ~bits & np.uint64(0xFFFFFFFF), bits | np.uint64(0x80000000))
    return (ordered[:, 0] << np.uint64(32)) | ordered[:, 1]


def _half_edges(
    uvs: NDArray[np.float32], owner_uvs: NDArray[np.float32], triangles: NDArray[np.uint32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.uint64]]:
    """Every half-edge's start and end vertex, the number of its surface edge, and its uvs as a sortable key."""
    corners = triangles.astype(np.int64)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    _, point = np.unique(_words(owner_uvs), return_inverse=True)
    low, high = np.minimum(point[start], point[end]), np.maximum(point[start], point[end])
    _, edge = np.unique(low.astype(np.int64) * (len(point) + 1) + high, return_inverse=True)
    keys = _words(uvs)
    forwards = point[start] <= point[end]
    first, second = np.where(forwards, keys[start], keys[end]), np.where(forwards, keys[end], keys[start])
    return start, end, edge.astype(np.int64), np.stack([first, second], axis=1)


def build_patches(
    uvs: NDArray[np.float32], owner_uvs: NDArray[np.float32], triangles: NDArray[np.uint32]
) -> NDArray[np.uint32]:
    """Vertices of every patch: 3 corners, then from corner k to corner k + 1 the ends of the owning edge.

    Parameters
    ----------
    uvs, owner_uvs : (N, 2) float32
    triangles : (F, 3) uint32

    Returns
    -------
    (F, 9) uint32
    """
    start, end, edge, keys = _half_edges(uvs, owner_uvs, triangles)
    _, point = np.unique(_words(owner_uvs), return_inverse=True)
    order = np.lexsort((np.arange(len(edge)), keys[:, 1], keys[:, 0], edge))
    is_first = np.ones(len(order), bool)
    is_first[1:] = edge[order[1:]] != edge[order[:-1]]
    owner = np.empty(edge.max() + 1, np.int64)
    owner[edge[order[is_first]]] = order[is_first]
    owning = owner[edge]
    same_way = point[start[owning]] == point[start]
    own_start = np.where(same_way, start[owning], end[owning])
    own_end = np.where(same_way, end[owning], start[owning])
    patches = np.empty((len(triangles), PATCH_VERTICES), np.uint32)
    patches[:, :3] = triangles
    patches[:, 3::2] = own_start.reshape(-1, 3)
    patches[:, 4::2] = own_end.reshape(-1, 3)
    return patches


def seam_edges(
    uvs: NDArray[np.float32], owner_uvs: NDArray[np.float32], triangles: NDArray[np.uint32]
) -> NDArray[np.uint32]:
    """Vertices of the edges along which the atlas is cut, one a side: (E, 2) uint32."""
    start, end, edge, keys = _half_edges(uvs, owner_uvs, triangles)
    lowest = np.full((edge.max() + 1, 2), np.iinfo(np.uint64).max, np.uint64)
    highest = np.zeros((edge.max() + 1, 2), np.uint64)
    for column in range(2):
        np.minimum.at(lowest[:, column], edge, keys[:, column])
        np.maximum.at(highest[:, column], edge, keys[:, column])
    is_cut = (lowest != highest).any(axis=1)[edge]
    return np.stack([start[is_cut], end[is_cut]], axis=1).astype(np.uint32)
