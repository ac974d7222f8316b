"""Topology of a LOD found again from its uvs: patches for tessellation, and seam edges for the diagrams.

Copies of a surface point have the same canonical uv, so the surface's edges are pairs of canonical uvs. Where the two
half-edges of an edge have different uvs (a seam), one is made the owning edge of all that lies between its ends: the
one with the smaller uvs, read as numbers, which is the same choice whichever triangle asks (Castaño 2008).
A patch ends with three more vertices, which say where its corners are fetched: vertices of coarse levels lie off the
surface, between which a divided triangle would stand out from its neighbours' points as a spike.
Letters in shapes: N vertices, F faces, E edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EDGES, PLACES = slice(3, 9), slice(9, 12)  # of a patch, after its corners: ends of the owning edges; see place_corners
PATCH_VERTICES = 12


def _words(uvs: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Each uv as one number that grows with u, then v: (N,) uint64. uvs are not negative in practice, -0 is 0."""
    bits = np.ascontiguousarray(uvs + np.float32(0.0)).view(np.uint32).astype(np.uint64)
    sign = bits >> np.uint64(31)
    ordered = np.where(sign == 1, ~bits & np.uint64(0xFFFFFFFF), bits | np.uint64(0x80000000))
    return (ordered[:, 0] << np.uint64(32)) | ordered[:, 1]


def _half_edges(
    uvs: NDArray[np.float32], canonical_uvs: NDArray[np.float32], triangles: NDArray[np.uint32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.uint64]]:
    """Every half-edge's start and end vertex, the number of its surface edge, and its uvs as a sortable key."""
    corners = triangles.astype(np.int64)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    _, point = np.unique(_words(canonical_uvs), return_inverse=True)
    low, high = np.minimum(point[start], point[end]), np.maximum(point[start], point[end])
    _, edge = np.unique(low.astype(np.int64) * (len(point) + 1) + high, return_inverse=True)
    keys = _words(uvs)
    forwards = point[start] <= point[end]
    first, second = np.where(forwards, keys[start], keys[end]), np.where(forwards, keys[end], keys[start])
    return start, end, edge.astype(np.int64), np.stack([first, second], axis=1)


def build_patches(
    uvs: NDArray[np.float32], canonical_uvs: NDArray[np.float32], triangles: NDArray[np.uint32]
) -> NDArray[np.uint32]:
    """Vertices of every patch: 3 corners, then from corner k to corner k + 1 the ends of the owning edge.

    Parameters
    ----------
    uvs, canonical_uvs : (N, 2) float32
    triangles : (F, 3) uint32

    Returns
    -------
    (F, 9) uint32
    """
    start, end, edge, keys = _half_edges(uvs, canonical_uvs, triangles)
    _, point = np.unique(_words(canonical_uvs), return_inverse=True)
    order = np.lexsort((np.arange(len(edge)), keys[:, 1], keys[:, 0], edge))
    is_first = np.ones(len(order), bool)
    is_first[1:] = edge[order[1:]] != edge[order[:-1]]
    owner = np.empty(edge.max() + 1, np.int64)
    owner[edge[order[is_first]]] = order[is_first]
    owning = owner[edge]
    same_way = point[start[owning]] == point[start]
    own_start = np.where(same_way, start[owning], end[owning])
    own_end = np.where(same_way, end[owning], start[owning])
    patches = np.empty((len(triangles), EDGES.stop), np.uint32)
    patches[:, :3] = triangles
    patches[:, 3::2] = own_start.reshape(-1, 3)
    patches[:, 4::2] = own_end.reshape(-1, 3)
    return patches


def surface_copies(uvs: NDArray[np.float32], canonical_uvs: NDArray[np.float32]) -> NDArray[np.int64]:
    """Of each vertex's copies (with its canonical uv) the one with the smallest uvs, whichever of them asks: (N,)."""
    _, point = np.unique(_words(canonical_uvs), return_inverse=True)
    order = np.lexsort((np.arange(len(point)), _words(uvs), point))
    first = order[np.r_[True, point[order[1:]] != point[order[:-1]]]]
    return first[point]


def place_corners(
    patches: NDArray[np.uint32], copies: NDArray[np.int64], moved: NDArray[np.bool_]
) -> NDArray[np.uint32]:
    """Patches with the three vertices that say where their corners are fetched, (F, 12) uint32.

    Parameters
    ----------
    patches : (F, 9) uint32
    copies : (N,) int
        From `surface_copies`.
    moved : (N,) bool
        Vertices that are fetched at the own uvs of that copy. The others stay at their canonical uv: a vertex of
        another point, which is no copy, tells the shader so.
    """
    corners = patches[:, :3].astype(np.int64)
    others = np.roll(corners, -1, axis=1)
    return np.concatenate([patches, np.where(moved[corners], copies[corners], others)], axis=1).astype(np.uint32)


def corner_uvs(
    uvs: NDArray[np.floating], canonical_uvs: NDArray[np.floating], patches: NDArray[np.integer]
) -> NDArray[np.floating]:
    """Where the corners of patches (F, 12) are fetched, (F, 3, 2): the twin of shaders/patch.tesc."""
    own, place = patches[:, :3].astype(np.int64), patches[:, PLACES].astype(np.int64)
    is_copy = (canonical_uvs[place] == canonical_uvs[own]).all(axis=2)
    return np.asarray(np.where(is_copy[..., None], uvs[place], canonical_uvs[own]))


def seam_edges(
    uvs: NDArray[np.float32], canonical_uvs: NDArray[np.float32], triangles: NDArray[np.uint32]
) -> NDArray[np.uint32]:
    """Vertices of the edges along which the atlas is cut, one a side: (E, 2) uint32."""
    start, end, edge, keys = _half_edges(uvs, canonical_uvs, triangles)
    lowest = np.full((edge.max() + 1, 2), np.iinfo(np.uint64).max, np.uint64)
    highest = np.zeros((edge.max() + 1, 2), np.uint64)
    for column in range(2):
        np.minimum.at(lowest[:, column], edge, keys[:, column])
        np.maximum.at(highest[:, column], edge, keys[:, column])
    is_cut = (lowest != highest).any(axis=1)[edge]
    return np.stack([start[is_cut], end[is_cut]], axis=1).astype(np.uint32)
