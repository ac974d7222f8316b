"""Edges, components and charts of a textured surface, as arrays (docs/method.md, section 1).

- Half-edge `3 f + c` runs from corner c of face f to corner c + 1.
- Glued edge: one with exactly two faces that run along it in opposite directions. Only glued edges can lie inside a
  chart; mesh boundaries, non-manifold edges and the odd edge of a non-orientable strip are always cut.
- Chart: faces joined through uncut edges. Texture vertex: corners joined around a 3D vertex through uncut edges, so a
  vertex that a chart touches twice has two texture vertices in it and every chart is a manifold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from preprocess.arrays import Floats, Ints

Bools = NDArray[np.bool_]


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
    start = faces.reshape(-1).astype(np.int64)
    end = np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    fresh = np.ones(len(order), bool)
    fresh[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    first = np.flatnonzero(fresh)
    count = np.diff(np.r_[first, len(order)])
    edge_of_half = np.empty(len(order), np.int32)
    edge_of_half[order] = np.cumsum(fresh) - 1

    halves = np.full((len(first), 2), -1, np.int32)
    halves[:, 0] = order[first]
    several = count >= 2
    halves[several, 1] = order[first[several] + 1]
    glued = (count == 2) & (start[halves[:, 0]] == end[halves[:, 1]]) & (start[halves[:, 0]] != end[halves[:, 0]])
    neighbors = np.full(len(start), -1, np.int32)
    neighbors[halves[glued, 0]] = halves[glued, 1] // 3
    neighbors[halves[glued, 1]] = halves[glued, 0] // 3
    vertices = np.stack([low[order][first], high[order][first]], axis=1).astype(np.int32)
    return MeshEdges(vertices, edge_of_half.reshape(-1, 3), halves, glued, neighbors.reshape(-1, 3))


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
    return _components(joined[:, 0], joined[:, 1], len(edges.face_edges))


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
    starts = np.r_[left, _next_corner(left)]
    ends = np.r_[_next_corner(right), right]
    count, labels = _components(starts, ends, faces.size)
    return count, labels.reshape(-1, 3)


def cut_edges(edges: MeshEdges, face_uvs: Ints) -> Bools:
    """Edges of which the two faces use different texture vertices, and all edges that are not glued, (E,) bool."""
    flat = face_uvs.reshape(-1)
    left, right = edges.halves[:, 0], edges.halves[:, 1]
    same = (flat[left] == flat[_next_corner(right)]) & (flat[_next_corner(left)] == flat[right])
    return ~(edges.glued & same)


def _next_corner(corner: Ints) -> Ints:
    return corner - corner % 3 + (corner + 1) % 3


def _components(a: Ints, b: Ints, count: int) -> tuple[int, Ints]:
    graph = sp.coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), labels.astype(np.int32)


def face_frames(positions: Floats, faces: Ints) -> tuple[Floats, Floats, Floats]:
    """Area, unit normal (zero for a face without area) and centroid of every face: (F,), (F, 3), (F, 3)."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1)
    return 0.5 * double, normal / np.where(double > 0, double, 1)[:, None], (a + b + c) / 3
