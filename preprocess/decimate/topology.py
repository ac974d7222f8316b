"""From a textured surface to half-edges (paper, section 5.2).

Half-edge `3 f + k` runs from corner k to corner k + 1 of face f. Each has the surface vertex and the wedge it starts
at. A wedge is a fan of faces around a surface vertex, between two silhouette edges: the paper's (position, uv) pair.
Where the source joins one uv to several fans, each fan gets a wedge of its own, so the parameter mesh is manifold.
Open boundaries are closed with a virtual vertex at infinity and one virtual face for every boundary edge, so a walk
around a vertex always comes back. Non-manifold edges are cut open and non-manifold vertices split before that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices, Ints
from preprocess.decimate.levels import Repairs
from preprocess.errors import InputError
from preprocess.mesh.surface import TexturedSurface
from preprocess.numerics.jit import fixed_memory_helper as helper

TAIL, WEDGE, TWIN = 0, 1, 2  # columns of the table of half-edges
NO_WEDGE = -1  # the wedge of a virtual face's corner
LARGEST = 1e60  # quadrics multiply five coordinates: beyond it they leave float64's range


class HalfEdges(NamedTuple):
    """Connectivity. F real faces come first, then one virtual face for each of the B boundary edges.

    Attributes
    ----------
    tail : (3 (F + B),) int64, surface vertex at the start; the virtual vertex is number V
    wedge : (3 (F + B),) int64, wedge at the start, NO_WEDGE in virtual faces
    twin : (3 (F + B),) int64, the half-edge that runs back; -1 in faces that were removed
    out : (V + 1,) int64, some half-edge that starts at each vertex
    num_silhouettes : (V + 1,) uint8, seam and boundary edges at each vertex, 255 for so many or more
    num_faces : F
    vertex_source : (V,) int32, vertex of the input
    wedge_source : (W,) int32, texture vertex of the input
    face_source : (F,) int32, face of the input
    """

    tail: Indices
    wedge: Indices
    twin: Indices
    out: Indices
    num_silhouettes: NDArray[np.uint8]
    num_faces: int
    vertex_source: Ints
    wedge_source: Ints
    face_source: Ints


@helper
def next_of(h):
    """Half-edge after h in its face."""
    return h - 2 if h % 3 == 2 else h + 1


@helper
def previous_of(h):
    """Half-edge before h in its face."""
    return h + 2 if h % 3 == 0 else h - 1


@njit(cache=True)
def _pair(tail, num_vertices):
    """Twin of each half-edge (-1 for none) and the number of non-manifold edges.

    Half-edges are bucketed by their lower vertex; in a bucket, equal higher vertices are one edge. Two half-edges that
    run against each other are twins; anything else leaves its edge open.
    """
    count = len(tail)
    twin = np.full(count, -1, np.int32)
    start = np.zeros(num_vertices + 2, np.int32)
    for h in range(count):
        start[min(tail[h], tail[next_of(h)]) + 2] += 1
    for v in range(num_vertices):
        start[v + 2] += start[v + 1]
    bucket = np.empty(count, np.int32)
    for h in range(count):
        low = min(tail[h], tail[next_of(h)])
        bucket[start[low + 1]] = h
        start[low + 1] += 1
    first = np.full(num_vertices, -1, np.int32)
    uses = np.zeros(num_vertices, np.int32)
    broken = 0
    for v in range(num_vertices):
        for i in range(start[v], start[v + 1]):
            h = bucket[i]
            high = tail[h] + tail[next_of(h)] - v
            uses[high] += 1
            if uses[high] == 1:
                first[high] = h
            elif uses[high] == 2 and tail[first[high]] != tail[h]:
                twin[h] = first[high]
                twin[first[high]] = h
            else:
                g = twin[first[high]]
                if g >= 0:
                    twin[g] = -1
                    twin[first[high]] = -1
        for i in range(start[v], start[v + 1]):
            h = bucket[i]
            high = tail[h] + tail[next_of(h)] - v
            if uses[high] > 2 or (uses[high] == 2 and twin[h] < 0):
                broken += 1
            uses[high] = 0
    return twin, broken


@njit(cache=True)
def _label_fans(tail, twin):
    """Number the fans of faces around vertices that twins connect: (label a corner, a corner a label)."""
    count = len(tail)
    label = np.full(count, -1, np.int32)
    corner = np.empty(count, np.int32)
    num_labels = 0
    for seed in range(count):
        if label[seed] >= 0:
            continue
        corner[num_labels] = seed
        h = seed
        while h >= 0 and label[h] < 0:
            label[h] = num_labels
            h = twin[previous_of(h)]
        h = twin[seed]
        while h >= 0 and label[next_of(h)] < 0:
            h = next_of(h)
            label[h] = num_labels
            h = twin[h]
        num_labels += 1
    return label, corner[:num_labels].copy()


def check_surface(surface: TexturedSurface) -> None:
    """Refuse what no collapse can work on; vertices that no face uses do not matter.

    Raises
    ------
    InputError
        If the mesh has no faces, or positions or uvs are not finite, or so large that their squares are not.
    """
    if not len(surface.faces):
        raise InputError("the mesh has no faces: give a mesh with at least one triangle")
    for values, ids, what in (
        (surface.positions, surface.faces, "positions"),
        (surface.uvs, surface.face_uvs, "texture coordinates"),
    ):
        used = np.unique(ids)
        bad = used[~(np.abs(values[used]) < LARGEST).all(axis=1)]
        if len(bad):
            raise InputError(
                f"{len(bad)} {what} are not finite or beyond {LARGEST:g} (the first is number {bad[0]}): "
                "repair the mesh"
            )


def _clean_faces(surface: TexturedSurface) -> tuple[NDArray[np.int64], int, int]:
    """Faces worth keeping, and how many use a vertex twice or repeat another."""
    faces = surface.faces
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    kept = np.flatnonzero(proper)
    num_degenerate = len(faces) - len(kept)
    if not len(kept):
        return kept, num_degenerate, 0
    # Same three vertices, either way round: only one of them can be part of a surface.
    low, middle, high = np.sort(faces[kept].astype(np.int64), axis=1).T
    order = np.lexsort((kept, high, middle, low))
    fresh = np.ones(len(order), bool)
    fresh[1:] = np.diff(low[order]) != 0
    fresh[1:] |= np.diff(middle[order]) != 0
    fresh[1:] |= np.diff(high[order]) != 0
    unique = np.sort(kept[order[fresh]])
    return unique, num_degenerate, len(kept) - len(unique)


def build_half_edges(
    surface: TexturedSurface, face_groups: NDArray[np.integer] | None = None
) -> tuple[HalfEdges, Repairs]:
    """Clean a surface, make it manifold and connect it.

    Parameters
    ----------
    surface : TexturedSurface
    face_groups : (F,) int or None
        Where two groups meet is a seam, whatever the uvs.

    Returns
    -------
    HalfEdges
    Repairs

    Raises
    ------
    InputError
        See `check_surface`; also if no face is left after cleaning.
    """
    check_surface(surface)
    kept, num_degenerate, num_duplicate = _clean_faces(surface)
    if not len(kept):
        raise InputError("every face uses a vertex twice: give a mesh with at least one triangle")
    num_faces = len(kept)
    source_vertex = np.ascontiguousarray(surface.faces[kept].ravel())
    source_uv = np.ascontiguousarray(surface.face_uvs[kept].ravel())
    num_used = len(np.unique(source_vertex))

    twin, num_broken = _pair(source_vertex, len(surface.positions))
    tail, vertex_corner = _label_fans(source_vertex, twin)
    paired = twin >= 0
    corner = np.arange(3 * num_faces)
    ahead = np.where(corner % 3 == 2, corner - 2, corner + 1)
    across = np.where(paired, twin, 0)
    joined = paired & (source_uv == source_uv[ahead[across]]) & (source_uv[ahead] == source_uv[across])
    if face_groups is not None:
        groups = np.repeat(np.asarray(face_groups)[kept], 3)
        joined &= groups == groups[across]
    wedge, wedge_corner = _label_fans(source_vertex, np.where(joined, twin, -1).astype(np.int32))

    num_vertices = len(vertex_corner)
    half_edges = _close_boundaries(tail, wedge, twin, ahead, num_vertices)
    tail, wedge, twin = half_edges
    silhouette = np.ones(len(tail), bool)
    silhouette[: 3 * num_faces] = ~joined
    real = tail < num_vertices
    # Silhouette half-edges that start at a real vertex: one for each silhouette edge there.
    silhouette[3 * num_faces :] = (np.arange(len(tail) - 3 * num_faces) % 3) == 0
    counts = np.bincount(tail[silhouette & real], minlength=num_vertices + 1)
    out = np.zeros(num_vertices + 1, np.int64)
    out[tail[::-1]] = np.arange(len(tail))[::-1]
    return (
        HalfEdges(
            tail=tail,
            wedge=wedge,
            twin=twin,
            out=out,
            num_silhouettes=np.minimum(counts, 255).astype(np.uint8),
            num_faces=num_faces,
            vertex_source=source_vertex[vertex_corner].astype(np.int32),
            wedge_source=source_uv[wedge_corner].astype(np.int32),
            face_source=kept.astype(np.int32),
        ),
        Repairs(
            degenerate_faces=num_degenerate,
            duplicate_faces=num_duplicate,
            isolated_vertices=len(surface.positions) - num_used,
            split_edges=num_broken,
            split_vertices=num_vertices - num_used,
        ),
    )


def _close_boundaries(
    tail: Ints, wedge: Ints, twin: Ints, ahead: NDArray[np.int64], num_vertices: int
) -> tuple[Indices, Indices, Indices]:
    """Add a virtual face (b, a, infinity) on every half-edge a -> b without a twin."""
    open_edges = np.flatnonzero(twin < 0)
    count = len(open_edges)
    begin, end = tail[open_edges], tail[ahead[open_edges]]
    first = len(tail) + 3 * np.arange(count)
    virtual_tail = np.stack([end, begin, np.full(count, num_vertices)], axis=1).ravel()
    # After splitting, exactly one open half-edge arrives at and one leaves each boundary vertex.
    arriving = np.full(num_vertices + 1, -1, np.int64)
    arriving[end] = np.arange(count)
    leaving = np.full(num_vertices + 1, -1, np.int64)
    leaving[begin] = np.arange(count)
    virtual_twin = np.stack([open_edges, first[arriving[begin]] + 2, first[leaving[end]] + 1], axis=1).ravel()
    twin = twin.copy()
    twin[open_edges] = first
    return (
        np.r_[tail, virtual_tail].astype(np.int64),
        np.r_[wedge, np.full(3 * count, NO_WEDGE)].astype(np.int64),
        np.r_[twin, virtual_twin].astype(np.int64),
    )


def source_uvs(half_edges: HalfEdges, surface: TexturedSurface) -> Floats:
    """uvs of the wedges, (W, 2) float64."""
    return np.ascontiguousarray(surface.uvs[half_edges.wedge_source], np.float64)
