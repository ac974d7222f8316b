"""Even triangles of a wanted size: rounds of edge collapses, edge flips and tangential smoothing.

After Botsch and Kobbelt 2004, "A remeshing approach to multiresolution modeling", with whole sets of independent
edges at a time instead of one edge after the other. The input is finer than wanted, so edges are never split. Works
on a half mesh whose border lies on x = 0 and stays there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from demos.creature.field import Field
from demos.creature.surface import Floats, Ints, corner_cotangents, face_normals, unique_edges

_COLLAPSE_BELOW = 0.86  # times the wanted length
_NO_EDGES = np.zeros((0, 2), np.int64)
_MIN_TURN = 0.35  # cosine: no face turns further than this in one collapse


def _adjacency(edges: Ints, num_vertices: int) -> sparse.csr_matrix:
    ones = np.ones(2 * len(edges), np.int32)
    rows, columns = np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]]
    return sparse.coo_matrix((ones, (rows, columns)), shape=(num_vertices, num_vertices)).tocsr()


def _independent(edges: Ints, rank: Ints, all_edges: Ints, num_vertices: int) -> NDArray[np.bool_]:
    """Edges that come before every other candidate that touches their ends' neighbours."""
    first = np.full(num_vertices, np.iinfo(np.int64).max)
    np.minimum.at(first, edges[:, 0], rank)
    np.minimum.at(first, edges[:, 1], rank)
    around = first.copy()
    np.minimum.at(around, all_edges[:, 0], first[all_edges[:, 1]])
    np.minimum.at(around, all_edges[:, 1], first[all_edges[:, 0]])
    return np.asarray((around[edges] >= rank[:, None]).all(axis=1))


def _collapse_round(points: Floats, faces: Ints, sizes: Floats) -> tuple[Floats, Ints, Floats, int]:
    edges, _, count = unique_edges(faces)
    border_edge = count == 1
    border = np.zeros(len(points), bool)
    border[edges[border_edge]] = True
    wanted = 0.5 * (sizes[edges[:, 0]] + sizes[edges[:, 1]])
    ratio = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) / wanted
    allowed = (ratio < _COLLAPSE_BELOW) & ~(border[edges].all(axis=1) & ~border_edge)
    adjacency = _adjacency(edges, len(points))
    candidate = np.flatnonzero(allowed)
    a, b = edges[candidate].T
    common = np.asarray(adjacency[a].multiply(adjacency[b]).sum(axis=1)).ravel()
    linked = common == np.where(border_edge[candidate], 1, 2)
    # An inner edge between two border vertices would become a double edge in the mirrored mesh.
    touches = adjacency @ border.astype(np.int32)
    shared = np.asarray(adjacency[a].multiply(adjacency[b]) @ border.astype(np.int32)).ravel()
    onto_border = border[a] ^ border[b]
    inner_end = np.where(border[a], b, a)
    linked &= ~onto_border | (touches[inner_end] <= shared + 1)
    candidate = candidate[linked]
    rank = np.empty(len(candidate), np.int64)
    rank[np.argsort(ratio[candidate], kind="stable")] = np.arange(len(candidate))
    candidate = candidate[_independent(edges[candidate], rank, edges, len(points))]
    if not len(candidate):
        return points, faces, sizes, 0

    # The survivor is the end on the border, if there is one.
    a, b = edges[candidate].T
    a, b = np.where(border[b] & ~border[a], b, a), np.where(border[b] & ~border[a], a, b)
    target = 0.5 * (points[a] + points[b])
    pinned = border[a] & ~border[b]
    target[pinned] = points[a[pinned]]
    owner = np.full(len(points), -1)
    owner[a] = owner[b] = np.arange(len(candidate))
    of_face = owner[faces]
    hit = of_face.max(axis=1)
    touched = np.flatnonzero(hit >= 0)
    dying = (of_face[touched] >= 0).sum(axis=1) == 2
    touched = touched[~dying]
    corners = points[faces[touched]]
    inside = of_face[touched] >= 0
    after = np.where(inside[..., None], target[hit[touched]][:, None], corners)
    before_normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    after_normal = np.cross(after[:, 1] - after[:, 0], after[:, 2] - after[:, 0])
    scale = np.linalg.norm(before_normal, axis=1) * np.linalg.norm(after_normal, axis=1)
    bad = (before_normal * after_normal).sum(axis=1) < _MIN_TURN * scale
    valence = np.bincount(edges.reshape(-1), minlength=len(points))
    refused = np.zeros(len(candidate), bool)
    refused[hit[touched[bad]]] = True
    dead_faces = np.flatnonzero((of_face >= 0).sum(axis=1) == 2)
    wing = np.where(of_face[dead_faces] >= 0, -1, faces[dead_faces]).max(axis=1)
    refused[hit[dead_faces[(valence[wing] < 5) & ~border[wing]]]] = True
    refused[hit[dead_faces[(valence[wing] < 4)]]] = True

    a, b, target = a[~refused], b[~refused], target[~refused]
    points, sizes = points.copy(), sizes.copy()
    points[a] = target
    sizes[a] = np.minimum(sizes[a], sizes[b])
    rename = np.arange(len(points))
    rename[b] = a
    faces = rename[faces]
    alive = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    used, compact = np.unique(faces[alive], return_inverse=True)
    return points[used], compact.reshape(-1, 3), sizes[used], len(a)


def _flip_round(points: Floats, faces: Ints, locked: Ints) -> Ints:
    """Flip inner edges whose opposite angles sum to more than π, where the surface is nearly flat.

    Edges in `locked`, (L, 2) with the smaller vertex first, stay. Both new faces take the numbers of the old ones.
    """
    edges, edge_of_half, count = unique_edges(faces)
    order = np.argsort(edge_of_half, kind="stable")
    starts = np.searchsorted(edge_of_half[order], np.arange(len(edges)))
    inner = np.flatnonzero(count == 2)
    left, right = order[starts[inner]], order[starts[inner] + 1]
    cotangents = corner_cotangents(points, faces).reshape(-1)
    excess = cotangents[left] + cotangents[right]
    normals, _ = face_normals(points, faces)
    flat = (normals[left // 3] * normals[right // 3]).sum(axis=1) > 0.6
    # A face with two locked edges is an ear: a smooth line through its tip would leave it without area.
    held = np.isin(edges[:, 0] * len(points) + edges[:, 1], locked[:, 0] * len(points) + locked[:, 1])
    ear = held[edge_of_half].reshape(-1, 3).sum(axis=1) == 2
    excess = np.where(ear[left // 3] | ear[right // 3], np.minimum(excess, -1e3), excess)
    pick = np.flatnonzero((excess < -1e-3) & flat & ~held[inner])
    left, right, excess = left[pick], right[pick], excess[pick]

    def corner(half: Ints, step: int) -> Ints:
        return faces[half // 3, (half + step) % 3]

    a, b, c, d = corner(left, 0), corner(left, 1), corner(left, 2), corner(right, 2)
    scale = len(points)
    keys = edges[:, 0] * scale + edges[:, 1]
    new = np.minimum(c, d) * scale + np.maximum(c, d)
    border = np.zeros(len(points), bool)
    border[edges[count == 1]] = True
    exists = np.isin(new, keys) | (border[c] & border[d])
    first_n = np.cross(points[d] - points[c], points[b] - points[c])
    second_n = np.cross(points[a] - points[c], points[d] - points[c])
    old = normals[left // 3] + normals[right // 3]
    fine = ((first_n * old).sum(axis=1) > 0) & ((second_n * old).sum(axis=1) > 0) & ~exists
    left, right, a, b, c, d, excess, new = (x[fine] for x in (left, right, a, b, c, d, excess, new))
    rank = np.empty(len(left), np.int64)
    rank[np.argsort(excess, kind="stable")] = np.arange(len(left))
    # One flip a vertex neighbourhood and round keeps the flips independent.
    first = np.full(len(points), np.iinfo(np.int64).max)
    for end in (a, b, c, d):
        np.minimum.at(first, end, rank)
    chosen = (np.stack([first[a], first[b], first[c], first[d]]) == rank).all(axis=0)
    left, right, a, b, c, d = (x[chosen] for x in (left, right, a, b, c, d))
    faces = faces.copy()
    faces[left // 3] = np.stack([c, d, b], axis=1)
    faces[right // 3] = np.stack([c, a, d], axis=1)
    return faces


def relax(field: Field, points: Floats, faces: Ints, fixed: NDArray[np.bool_], chains: Ints, rounds: int) -> Floats:
    """Move vertices along the skin towards the mean of their neighbours.

    Parameters
    ----------
    field : Field
    points : (V, 3) float64
    faces : (F, 3) int64
    fixed : (V,) bool
        Vertices that stay where they are.
    chains : (C, 2) int64
        Edges of lines: their vertices look only at their neighbours along the line, so that it becomes smooth.
    rounds : int

    Returns
    -------
    points : (V, 3) float64
        On the skin.
    """
    edges, _, _ = unique_edges(faces)
    count = len(points)
    on_chain = np.zeros(count, bool)
    on_chain[chains] = True
    free_edges = _adjacency(edges, count)
    chain_edges = _adjacency(chains, count)
    pick = sparse.diags((~on_chain).astype(float)) @ free_edges + sparse.diags(on_chain.astype(float)) @ chain_edges
    degree = np.maximum(np.asarray(pick.sum(axis=1)).ravel(), 1.0)
    middle = points[:, 0] == 0.0
    for step in range(rounds):
        face_normal, area = face_normals(points, faces)
        normal = np.zeros((count, 3))
        for k in range(3):
            for axis in range(3):
                normal[:, axis] += np.bincount(faces[:, k], face_normal[:, axis] * area, minlength=count)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
        move = pick @ points / degree[:, None] - points
        move -= (move * normal).sum(axis=1)[:, None] * normal
        move[fixed] = 0.0
        points = points + 0.6 * move
        if step % 3 == 2 or step == rounds - 1:
            points = points - np.clip(field.distance(points), -0.004, 0.004)[:, None] * normal
        points[middle, 0] = 0.0
    return points


def remesh(field: Field, points: Floats, faces: Ints, sizes: Floats) -> tuple[Floats, Ints]:
    """Coarsen a fine half mesh to the wanted edge lengths.

    Parameters
    ----------
    field : Field
        Whose skin the vertices stay on.
    points : (V, 3) float64
        Border vertices have x = 0.
    faces : (F, 3) int64
    sizes : (V,) float64
        Wanted edge length at each vertex, metres.

    Returns
    -------
    points, faces
        The half mesh with even triangles.
    """
    for stage in range(5):
        for _ in range(4):
            points, faces, sizes, done = _collapse_round(points, faces, sizes)
            if done < 8:
                break
        for _ in range(3):
            faces = _flip_round(points, faces, _NO_EDGES)
        edges, _, count = unique_edges(faces)
        borders = edges[count == 1]
        points = relax(field, points, faces, np.zeros(len(points), bool), borders, 2 if stage < 4 else 4)
    for _ in range(3):
        faces = _flip_round(points, faces, _NO_EDGES)
    middle = points[:, 0] == 0.0
    points = field.project(points)
    points[middle, 0] = 0.0
    return points, faces


def _bent_faces(field: Field, points: Floats, faces: Ints) -> NDArray[np.bool_]:
    """Faces that look away from the skin, or have an angle under two and a half degrees."""
    normals, _ = face_normals(points, faces)
    outwards = field.gradient(points[faces].mean(axis=1))
    flat = corner_cotangents(points, faces).max(axis=1) > 23.0
    result: NDArray[np.bool_] = ((normals * outwards).sum(axis=1) < 0.1) | flat
    return result


def smooth_seams(
    field: Field, points: Floats, faces: Ints, cut: NDArray[np.bool_], rounds: int = 6
) -> tuple[Floats, Ints, NDArray[np.bool_]]:
    """Turn the zigzag of cut edges into smooth curves on the skin, the other vertices and edges following.

    Parameters
    ----------
    field : Field
    points : (V, 3) float64
    faces : (F, 3) int64
    cut : (E,) bool
        Of the edges of `unique_edges(faces)`. Where other than two of them meet, the vertex stays.
    rounds : int

    Returns
    -------
    points, faces, cut
        Edges that are not cut may have been flipped; every face stays on its side of the cuts.
    """
    seams = unique_edges(faces)[0][cut]
    fixed = ~np.isin(np.bincount(seams.reshape(-1), minlength=len(points)), (0, 2))
    for _ in range(3):
        faces = _flip_round(points, faces, seams)
    for _ in range(rounds):
        points = relax(field, points, faces, fixed, seams, 3)
        faces = _flip_round(points, faces, seams)
    middle = points[:, 0] == 0.0
    points = field.project(points)
    points[middle, 0] = 0.0
    for _ in range(8):  # around a face that was pressed flat or turned over, the line gives way
        bent = _bent_faces(field, points, faces)
        if not bent.any():
            break
        held = np.ones(len(points), bool)
        held[faces[bent]] = False
        points = relax(field, points, faces, held, _NO_EDGES, 3)
        faces = _flip_round(points, faces, seams)
    edges = unique_edges(faces)[0]
    keys = edges[:, 0] * len(points) + edges[:, 1]
    return points, faces, np.isin(keys, seams[:, 0] * len(points) + seams[:, 1])
