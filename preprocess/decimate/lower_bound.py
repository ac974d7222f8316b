"""How far an atlas can be decimated at all: the floor that its charts' corners set."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats
from preprocess.decimate.topology import NO_WEDGE, HalfEdges
from preprocess.mesh.grouping import connected_groups


def find_free_vertices(half_edges: HalfEdges, uvs: Floats, tolerance_uv: float) -> NDArray[np.bool_]:
    """Silhouette vertices that a straight, evenly timed line runs through: (V,) bool (see rules.py)."""
    tail, wedge, twin = half_edges.tail, half_edges.wedge, half_edges.twin
    num_vertices = len(half_edges.vertex_source)
    h = np.arange(len(tail))
    ahead = np.where(h % 3 == 2, h - 2, h + 1)
    silhouette = (wedge != wedge[ahead[twin]]) | (wedge[ahead] != wedge[twin])
    silhouette &= (tail < num_vertices) & (tail[ahead] < num_vertices)
    two = half_edges.num_silhouettes == 2
    outgoing = h[silhouette & two[tail]]
    outgoing = outgoing[np.argsort(tail[outgoing], kind="stable")].reshape(-1, 2)
    g, k = outgoing.T  # b -> q and b -> p
    b = tail[g]

    def side(p: NDArray[np.int64], middle: NDArray[np.int64], q: NDArray[np.int64]) -> tuple[Bools, Floats, Floats]:
        """Is the side real, its line and its offset from the line's start."""
        real = (p != NO_WEDGE) & (middle != NO_WEDGE) & (q != NO_WEDGE)
        line = np.where(real[:, None], uvs[q] - uvs[p], 0.0)
        return real, line, np.where(real[:, None], uvs[middle] - uvs[p], 0.0)

    tg, tk = twin[g], twin[k]
    left, line0, offset0 = side(wedge[tk], wedge[g], wedge[ahead[g]])
    right, line1, offset1 = side(wedge[ahead[k]], wedge[k], wedge[tg])
    same_kind = ((wedge[g] >= 0) == (wedge[tk] >= 0)) & ((wedge[tg] >= 0) == (wedge[k] >= 0)) & (left | right)
    dot = (line0 * offset0).sum(1) + (line1 * offset1).sum(1)
    square = (line0**2).sum(1) + (line1**2).sum(1)
    between = (dot > 0) & (dot < square)
    t = np.where(between, dot / np.where(square > 0, square, 1.0), 0.0)[:, None]
    distance = np.maximum(np.linalg.norm(offset0 - t * line0, axis=1), np.linalg.norm(offset1 - t * line1, axis=1))
    free = np.zeros(num_vertices, bool)
    free[b[same_kind & between & (distance <= tolerance_uv)]] = True
    return free


def count_floor(half_edges: HalfEdges, uvs: Floats, tolerance_uv: float) -> int:
    """Sum over the charts of k - 2 c, k corner wedges and Euler characteristic c; at least one face each."""
    num_faces = half_edges.num_faces
    wedges = half_edges.wedge[: 3 * num_faces]
    vertex_of_wedge = np.zeros(len(half_edges.wedge_source), np.int64)
    vertex_of_wedge[wedges] = half_edges.tail[: 3 * num_faces]
    free = find_free_vertices(half_edges, uvs, tolerance_uv)
    on_outline = half_edges.num_silhouettes[vertex_of_wedge] > 0
    corner = on_outline & ~free[vertex_of_wedge]

    ends = wedges.reshape(-1, 3)
    num_charts, chart = connected_groups(len(corner), ends[:, :2].ravel(), ends[:, 1:].ravel())
    # V - E + F with E from the half-edges: inner edges have two of them, outline edges one.
    h = np.arange(3 * num_faces)
    ahead = np.where(h % 3 == 2, h - 2, h + 1)
    twin = half_edges.twin[h]
    real_twin = np.where(twin < 3 * num_faces, twin, 0)
    inner = (twin < 3 * num_faces) & (wedges == wedges[ahead[real_twin]]) & (wedges[ahead] == wedges[real_twin])
    edges = np.bincount(chart[wedges], weights=np.where(inner, 0.5, 1.0), minlength=num_charts)
    faces = np.bincount(chart[ends[:, 0]], minlength=num_charts)
    euler = np.bincount(chart, minlength=num_charts) - np.round(edges).astype(np.int64) + faces
    corners = np.bincount(chart[corner], minlength=num_charts)
    return int(np.maximum(corners - 2 * euler, 1).sum())
