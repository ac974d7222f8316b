"""Small mesh tools that several rooms share: edges, cotangents, areas, normals. V vertices, F faces, E edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def half_edges(faces: Ints) -> tuple[Ints, Ints, Ints]:
    """Start, end and opposite vertex of all half-edges, each (3F,), corner by corner."""
    return faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1), np.roll(faces, -2, axis=1).reshape(-1)


def unique_edges(faces: Ints) -> tuple[Ints, Ints, Ints]:
    """Undirected edges (E, 2), the edge of every half-edge (3F,) and the number of faces at each edge (E,)."""
    start, end, _ = half_edges(faces)
    both = np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1)
    scale = int(faces.max()) + 1
    keys, index, count = np.unique(both[:, 0] * scale + both[:, 1], return_inverse=True, return_counts=True)
    return np.stack([keys // scale, keys % scale], axis=1), index, count


def face_normals(points: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Unit normals (F, 3) and areas (F,)."""
    corners = points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(double, 1e-30)[:, None], 0.5 * double


def corner_cotangents(points: Floats, faces: Ints) -> Floats:
    """Cotangent of the angle opposite to each half-edge (start, end), (F, 3)."""
    corners = points[faces]
    tip = np.roll(corners, -2, axis=1)
    first, second = corners - tip, np.roll(corners, -1, axis=1) - tip
    cross = np.linalg.norm(np.cross(first, second), axis=2)
    result: Floats = (first * second).sum(axis=2) / np.maximum(cross, 1e-20)
    return result


def weighted_laplacian(faces: Ints, weights: Floats, num_vertices: int) -> sparse.csr_matrix:
    """Positive semi-definite Laplacian of half-edge weights (F, 3), each counted for both directions."""
    start, end, _ = half_edges(faces)
    w = weights.reshape(-1)
    rows, columns = np.r_[start, end], np.r_[end, start]
    adjacency = sparse.coo_matrix((np.r_[w, w], (rows, columns)), shape=(num_vertices, num_vertices)).tocsr()
    result: sparse.csr_matrix = (sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency).tocsr()
    return result


def vertex_areas(points: Floats, faces: Ints) -> Floats:
    """A third of the area around each vertex, (V,)."""
    areas = face_normals(points, faces)[1]
    return np.asarray(np.bincount(faces.reshape(-1), np.repeat(areas / 3.0, 3), minlength=len(points)), np.float64)
