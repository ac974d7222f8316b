"""Half-edges of a mesh paired into edges, and the charts that cuts leave, as arrays (docs/method.md, section 1).

- Half-edge `3 f + c` runs from corner c of face f to corner c + 1.
- Glued edge: one with exactly two faces that run along it in opposite directions. Only glued edges can lie inside a
  chart; mesh boundaries, non-manifold edges and the odd edge of a non-orientable strip are always cut.
- Chart: faces joined through uncut edges. Texture vertex: corners joined around a 3D vertex through uncut edges, so a
  vertex that a chart touches twice has two texture vertices in it and every chart is a manifold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Indices, Ints
from preprocess.mesh.grouping import connected_faces, connected_groups
from preprocess.mesh.surface import TexturedSurface


@dataclass(frozen=True)
class EdgeGroups:
    """Half-edges sorted into undirected edges. H = 3 F half-edges, E edges in the order of their vertices.

    Attributes
    ----------
    start, end : (H,) int64
        Vertices at the ends of each half-edge.
    edge : (H,) int32
        The edge that each half-edge lies on.
    order : (H,) int64
        Half-edges edge by edge, those of an edge in rising order.
    first : (E,) int64
        Where each edge begins in `order`.
    count : (E,) int64
        Half-edges of each edge: one at the mesh's boundary, two inside, more where it is not manifold.
    """

    start: Indices
    end: Indices
    edge: Ints
    order: Indices
    first: Indices
    count: Indices

    @property
    def real(self) -> Bools:
        """Edges that join two different vertices, (E,) bool."""
        halves = self.order[self.first]
        result: Bools = self.start[halves] != self.end[halves]
        return result

    def pairs(self, chosen: Bools) -> tuple[Indices, Indices]:
        """The first and the second half-edge of chosen edges (E,), which must have two or more."""
        at = self.first[chosen]
        return self.order[at], self.order[at + 1]


def group_half_edges(faces: NDArray[np.integer]) -> EdgeGroups:
    """Bring the half-edges together that lie on one undirected edge.

    Parameters
    ----------
    faces : (F, 3) int
    """
    start = faces.reshape(-1).astype(np.int64)
    end = np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    fresh = np.ones(len(order), bool)
    fresh[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    first = np.flatnonzero(fresh)
    edge = np.empty(len(order), np.int32)
    edge[order] = np.cumsum(fresh) - 1
    return EdgeGroups(start, end, edge, order, first, np.diff(np.r_[first, len(order)]))


def next_corners(half_edges: NDArray[np.integer]) -> NDArray[np.integer]:
    """The corner that follows each in its face: the end of a half-edge that starts at a corner."""
    result: NDArray[np.integer] = half_edges - half_edges % 3 + (half_edges + 1) % 3
    return result


@dataclass(frozen=True)
class MeshEdges:
    """Undirected edges of a triangle mesh, E of them.

    Attributes
    ----------
    vertices : (E, 2) int32
        The lower vertex first.
    face_edges : (F, 3) int32
        The edge under each half-edge.
    halves : (E, 2) int32
        The first two half-edges, -1 where there is one only.
    glued : (E,) bool
    neighbors : (F, 3) int32
        The face across each glued half-edge, -1 across the others.
    """

    vertices: Ints
    face_edges: Ints
    halves: Ints
    glued: Bools
    neighbors: Ints


def find_edges(faces: Ints) -> MeshEdges:
    """Pair the half-edges of a mesh.

    Parameters
    ----------
    faces : (F, 3) int32

    Returns
    -------
    MeshEdges
    """
    groups = group_half_edges(faces)
    start, end = groups.start, groups.end
    halves = np.full((len(groups.first), 2), -1, np.int32)
    halves[:, 0] = groups.order[groups.first]
    several = groups.count >= 2
    halves[several, 1] = groups.pairs(several)[1]
    glued = (groups.count == 2) & (start[halves[:, 0]] == end[halves[:, 1]]) & groups.real
    neighbors = np.full(len(start), -1, np.int32)
    neighbors[halves[glued, 0]] = halves[glued, 1] // 3
    neighbors[halves[glued, 1]] = halves[glued, 0] // 3
    ends = np.stack([start[halves[:, 0]], end[halves[:, 0]]], axis=1)
    vertices = np.sort(ends, axis=1).astype(np.int32)
    return MeshEdges(vertices, groups.edge.reshape(-1, 3), halves, glued, neighbors.reshape(-1, 3))


def label_faces(edges: MeshEdges, cut: Bools) -> tuple[int, Ints]:
    """Faces joined through glued edges that are not cut.

    Parameters
    ----------
    edges : MeshEdges
    cut : (E,) bool

    Returns
    -------
    count : int
    labels : (F,) int32
    """
    joined = edges.halves[edges.glued & ~cut] // 3
    count, labels = connected_groups(len(edges.face_edges), joined[:, 0], joined[:, 1])
    return count, labels.astype(np.int32)


def label_corners(faces: Ints, edges: MeshEdges, cut: Bools) -> tuple[int, Ints]:
    """Texture vertices of a cut mesh: corners joined around their vertex through edges that are not cut.

    Parameters
    ----------
    faces : (F, 3) int32
    edges : MeshEdges
    cut : (E,) bool

    Returns
    -------
    count : int
    face_uvs : (F, 3) int32
    """
    halves = edges.halves[edges.glued & ~cut]
    left, right = halves[:, 0], halves[:, 1]
    starts = np.r_[left, next_corners(left)]
    ends = np.r_[next_corners(right), right]
    count, labels = connected_groups(faces.size, starts, ends)
    return count, labels.reshape(-1, 3).astype(np.int32)


def cut_edges(edges: MeshEdges, face_uvs: Ints) -> Bools:
    """Edges of which the two faces use different texture vertices, and all edges that are not glued, (E,) bool."""
    flat = face_uvs.reshape(-1)
    left, right = edges.halves[:, 0], edges.halves[:, 1]
    same = (flat[left] == flat[next_corners(right)]) & (flat[next_corners(left)] == flat[right])
    result: Bools = ~(edges.glued & same)
    return result


def pair_inside_charts(surface: TexturedSurface) -> Indices:
    """The other half of every half-edge inside a chart, -1 on chart boundaries, (3 F,) int64."""
    edges = find_edges(surface.faces)
    halves = edges.halves[~cut_edges(edges, surface.face_uvs)].astype(np.int64)
    twins = np.full(surface.faces.size, -1, np.int64)
    twins[halves[:, 0]], twins[halves[:, 1]] = halves[:, 1], halves[:, 0]
    return twins


def chart_of_faces(surface: TexturedSurface) -> Indices:
    """Charts: faces that share texture vertices, (F,) int64, numbered from 0 in the order of their first face."""
    return connected_faces(surface.face_uvs, len(surface.uvs))
