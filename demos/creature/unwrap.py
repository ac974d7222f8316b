"""Flat charts: a least-squares conformal map, then a few rounds that make it as rigid as possible.

The conformal energy of a chart is a quadratic form of its corners' u and v (Lévy et al. 2002, "Least squares conformal
maps"); two far vertices are pinned. Local/global rounds (Liu et al. 2008, "A local/global approach to mesh
parameterization") then even out the sizes. A chart whose rigid map folds or overlaps keeps the conformal one.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from demos.creature.surface import Floats, Ints, corner_cotangents, half_edges, unique_edges, weighted_laplacian

log = logging.getLogger(__name__)

_RIGID_ROUNDS = 12


def split_at_cuts(faces: Ints, cut: NDArray[np.bool_]) -> tuple[Ints, Ints]:
    """Texture vertices: corners that are joined by an edge that is not cut.

    Returns
    -------
    face_uvs : (F, 3) int64
        Texture vertex of each corner.
    uv_to_vertex : (T,) int64
    """
    _, edge_of_half, _ = unique_edges(faces)
    order = np.argsort(edge_of_half, kind="stable").reshape(-1, 2)
    order = order[~cut]
    following = (order // 3) * 3 + (order + 1) % 3
    # Both halves of an edge run in opposite directions: the start of one is the end of the other.
    rows = np.r_[order[:, 0], following[:, 0]]
    columns = np.r_[following[:, 1], order[:, 1]]
    count = 3 * len(faces)
    graph = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count)).tocsr()
    num, component = connected_components(graph, directed=False)
    uv_to_vertex = np.empty(num, np.int64)
    uv_to_vertex[component] = faces.reshape(-1)
    return component.reshape(-1, 3).astype(np.int64), uv_to_vertex


def _flat_triangles(points: Floats, faces: Ints) -> Floats:
    """Each triangle laid in its own plane, first corner at the origin: (F, 3, 2)."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    along = b - a
    length = np.linalg.norm(along, axis=1)
    side = c - a
    x = (side * along).sum(axis=1) / length
    y = np.linalg.norm(np.cross(along, side), axis=1) / length
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = length
    flat[:, 2, 0], flat[:, 2, 1] = x, y
    return flat


def _conformal_map(points: Floats, faces: Ints) -> Floats:
    """Least-squares conformal uvs of one chart, (N, 2), counter-clockwise triangles with v up."""
    flat = _flat_triangles(points, faces)
    double = flat[:, 1, 0] * flat[:, 2, 1]
    # Per triangle: sum over corners of w_j (u_j + i v_j) = 0 with w_j the opposite edge as a complex number.
    edge = np.roll(flat, -2, axis=1) - np.roll(flat, -1, axis=1)
    scale = 1.0 / np.sqrt(double)
    real, imaginary = edge[..., 0] * scale[:, None], edge[..., 1] * scale[:, None]
    num_faces, num = len(faces), len(points)
    row = np.repeat(np.arange(num_faces), 3)
    column = faces.reshape(-1)
    re = sparse.coo_matrix((real.reshape(-1), (row, column)), shape=(num_faces, num))
    im = sparse.coo_matrix((imaginary.reshape(-1), (row, column)), shape=(num_faces, num))
    system = sparse.bmat([[re, -im], [im, re]]).tocsc()
    first = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())
    second = int(np.linalg.norm(points - points[first], axis=1).argmax())
    pinned = np.array([first, second, first + num, second + num])
    values = np.array([0.0, np.linalg.norm(points[second] - points[first]), 0.0, 0.0])
    free = np.setdiff1d(np.arange(2 * num), pinned)
    left = system[:, free]
    solution = np.zeros(2 * num)
    solution[pinned] = values
    solution[free] = splu((left.T @ left).tocsc()).solve(-left.T @ (system[:, pinned] @ values))
    return solution.reshape(2, num).T


def _make_rigid(points: Floats, faces: Ints, uvs: Floats, rounds: int) -> Floats:
    """Local/global rounds: best rotation of each triangle, then the uvs whose edges fit those best."""
    flat = _flat_triangles(points, faces)
    weights = np.maximum(corner_cotangents(points, faces), 0.05)
    laplacian = weighted_laplacian(faces, weights, len(points)).tocsc()
    solver = splu(laplacian[1:, 1:])
    edge = np.roll(flat, -1, axis=1) - flat
    start, end = faces, np.roll(faces, -1, axis=1)
    uvs = uvs * np.sqrt((edge * edge).sum() / ((uvs[end] - uvs[start]) ** 2).sum())
    for _ in range(rounds):
        mapped = uvs[end] - uvs[start]
        cosine = (weights * (edge * mapped).sum(axis=2)).sum(axis=1)
        sine = (weights * (edge[..., 0] * mapped[..., 1] - edge[..., 1] * mapped[..., 0])).sum(axis=1)
        norm = np.maximum(np.hypot(cosine, sine), 1e-30)
        c, s = (cosine / norm)[:, None], (sine / norm)[:, None]
        turned = np.stack([c * edge[..., 0] - s * edge[..., 1], s * edge[..., 0] + c * edge[..., 1]], axis=2)
        pull = weights[..., None] * turned
        right = np.stack(
            [
                np.bincount(end.reshape(-1), pull[..., k].reshape(-1), minlength=len(points))
                - np.bincount(start.reshape(-1), pull[..., k].reshape(-1), minlength=len(points))
                for k in range(2)
            ],
            axis=1,
        )
        uvs = uvs.copy()
        uvs[0] = 0.0
        uvs[1:] = solver.solve(right[1:])
    return uvs


def _turn_back(uvs: Floats, faces: Ints, num_faces: int, rounds: int = 40) -> Floats:
    """Pull the corners of turned-over faces (of the first `num_faces`) towards the mean of their neighbours."""
    edges, _, count = unique_edges(faces)
    border = np.zeros(len(uvs), bool)
    border[edges[count == 1]] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    adjacency = sparse.coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(len(uvs), len(uvs))).tocsr()
    degree = np.asarray(adjacency.sum(axis=1))
    for _ in range(rounds):
        turned = _double_areas(uvs, faces[:num_faces]) <= 0
        if not turned.any():
            break
        moving = np.unique(faces[:num_faces][turned])
        moving = moving[~border[moving]]
        uvs = uvs.copy()
        uvs[moving] = 0.5 * uvs[moving] + 0.5 * np.asarray(adjacency[moving] @ uvs) / degree[moving]
    return uvs


def _double_areas(uvs: Floats, faces: Ints) -> Floats:
    a, b, c = (uvs[faces[:, k]] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _fill_holes(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Close every border loop but the longest with a fan around its centre, so that holes keep their size when flat."""
    _edges, edge_of_half, count = unique_edges(faces)
    start, end, _ = half_edges(faces)
    border = count[edge_of_half] == 1
    following = dict(zip(start[border].tolist(), end[border].tolist(), strict=True))
    loops: list[list[int]] = []
    while following:
        loop = [next(iter(following))]
        while loop[-1] in following:
            loop.append(following.pop(loop[-1]))
        loops.append(loop[:-1])
    loops.sort(key=lambda loop: -float(np.linalg.norm(points[loop] - points[np.roll(loop, 1)], axis=1).sum()))
    centres: list[Floats] = []
    fans: list[Ints] = []
    for loop in loops[1:]:
        apex = len(points) + len(centres)
        centres.append(points[loop].mean(axis=0))
        fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), apex)], axis=1))
    if not fans:
        return points, faces
    return np.concatenate([points, centres]), np.concatenate([faces, *fans])


def _is_one_to_one(uvs: Floats, faces: Ints, resolution: int = 384) -> bool:
    """No triangle flipped, and no pixel centre covered twice."""
    if (_double_areas(uvs, faces) <= 0).any():
        return False
    from demos.creature.raster import cover_texels

    low, span = uvs.min(axis=0), np.ptp(uvs, axis=0).max()
    face, x, y, _ = cover_texels((uvs - low) / span, faces, resolution)
    return bool(np.bincount(y * resolution + x).max(initial=0) <= 1) if len(face) else False


def flatten_charts(points: Floats, face_uvs: Ints, uv_to_vertex: Ints, charts: Ints) -> Floats:
    """Flatten every chart at the scale of the body: one uv unit is one metre.

    Parameters
    ----------
    points : (V, 3) float64
    face_uvs : (F, 3) int64
    uv_to_vertex : (T,) int64
    charts : (F,) int64

    Returns
    -------
    uvs : (T, 2) float64
        Charts lie on top of each other, to be packed.

    Raises
    ------
    ValueError
        If a chart folds or overlaps whichever way it is flattened.
    """
    uvs = np.zeros((len(uv_to_vertex), 2))
    for chart in range(int(charts.max()) + 1):
        used, local = np.unique(face_uvs[charts == chart], return_inverse=True)
        faces, corners = local.reshape(-1, 3), points[uv_to_vertex[used]]
        filled, filled_faces = _fill_holes(corners, faces)
        conformal = _conformal_map(filled, filled_faces)
        flat = None
        for rounds in (_RIGID_ROUNDS, 4, 1, 0):
            candidate = _make_rigid(filled, filled_faces, conformal, rounds)
            candidate = _turn_back(candidate, filled_faces, len(faces))[: len(used)]
            if _is_one_to_one(candidate, faces):
                flat = candidate
                break
        if flat is None:
            raise ValueError(f"chart {chart} does not lie flat: cut it further")
        log.info("chart %d: %d faces, %d rigid rounds", chart, len(faces), rounds)
        uvs[used] = flat
    return uvs
