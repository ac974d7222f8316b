"""Splits a triangle soup of shared vertices into an oriented manifold: no edge with three faces, one fan a vertex.

Every half-edge gets at most one partner across its edge. An edge with two faces pairs them. An edge with more pairs
the faces that the source draws as one sheet (the same source vertices, then the same texture vertices of the same
part); what is left is paired around the edge so that each pair encloses a solid, and what is left then is cut.
Components are then turned to wind one way, where one exists; a non-orientable one is cut along a line. Last, the
corners that partners hold together become the vertices, which splits fans that meet in a point only.

Gueziec, Taubin, Lazarus, Horn 2001, "Cutting and stitching: converting sets of polygons to manifold surfaces".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from preprocess.arrays import Bools, Floats, Indices
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.grouping import connected_groups, group_rows

ANGLE_ROUNDS = 4  # enough for nine faces on an edge; more are cut apart


@dataclass(frozen=True)
class Manifold:
    """The result of `make_manifold`. V vertices, F faces.

    Attributes
    ----------
    corners : (F, 3) int64
        Which corner of the input face each corner is: (0, 1, 2), or (0, 2, 1) where the face was turned.
    faces : (F, 3) int64, into the new vertices
    vertex_origin : (V,) int64
        The input vertex of each new one. Input vertices without faces have none.
    num_split_edges : int
        Edges that had three or more faces.
    num_split_vertices : int
        Vertices that the result has more than the input used.
    num_turned : int
        Faces whose winding was reversed.
    num_unorientable : int
        Components that had to be cut because they have one side only.
    """

    corners: Indices
    faces: Indices
    vertex_origin: Indices
    num_split_edges: int
    num_split_vertices: int
    num_turned: int
    num_unorientable: int


class _HalfEdges:
    """Half-edge h runs along face h // 3 from its corner h % 3 to the next."""

    def __init__(self, faces: Indices) -> None:
        self.num = faces.size
        self.face = np.arange(self.num) // 3
        self.start = faces.reshape(-1)
        self.end = np.roll(faces, -1, axis=1).reshape(-1)
        self.start_corner = np.arange(self.num)
        self.end_corner = self.face * 3 + (np.arange(self.num) + 1) % 3
        self.forward = self.start < self.end
        low, high = np.minimum(self.start, self.end), np.maximum(self.start, self.end)
        self.edge, firsts = group_rows(low, high)
        self.edge_faces = np.bincount(self.edge, minlength=len(firsts))

    def ends(self, corner_values: Indices) -> tuple[Indices, Indices]:
        """A value a corner (F, 3), at the lower and the higher end of each half-edge's edge."""
        flat = corner_values.reshape(-1)
        start, end = flat[self.start_corner], flat[self.end_corner]
        return np.where(self.forward, start, end), np.where(self.forward, end, start)


def _pair_groups(mate: Indices, half: _HalfEdges, candidates: Indices, columns: list[Indices], opposed: bool) -> None:
    """Pair candidates that are exactly two in their group; with `opposed`, only if they run against each other."""
    if not len(candidates):
        return
    groups, _ = group_rows(*(column[candidates] for column in columns))
    order = np.argsort(groups, kind="stable")
    counts = np.bincount(groups)
    firsts = np.cumsum(counts) - counts
    pairs = firsts[counts == 2]
    left, right = candidates[order[pairs]], candidates[order[pairs + 1]]
    if opposed:
        fits = half.forward[left] != half.forward[right]
        left, right = left[fits], right[fits]
    mate[left], mate[right] = right, left


def _angles_around(half: _HalfEdges, faces: Indices, positions: Floats, candidates: Indices) -> Floats:
    """Direction of each half-edge's face around its edge, right-handed about low -> high; radians."""
    low = np.minimum(half.start, half.end)[candidates]
    high = np.maximum(half.start, half.end)[candidates]
    axis = positions[high] - positions[low]
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    # Two directions across the axis, the same for every half-edge of one edge.
    helper = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    across = np.cross(axis, helper)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    third = np.cross(axis, across)
    tip = faces[half.face[candidates]].sum(axis=1) - low - high
    arm = positions[tip] - positions[low]
    result: Floats = np.arctan2(np.einsum("ij,ij->i", arm, third), np.einsum("ij,ij->i", arm, across))
    return result


def _pair_by_angle(mate: Indices, half: _HalfEdges, faces: Indices, positions: Floats, open_halves: Indices) -> None:
    """Pair a backward half-edge with the next forward one around the edge: between them lies the inside."""
    angle = _angles_around(half, faces, positions, open_halves)
    for _ in range(ANGLE_ROUNDS):
        free = np.flatnonzero(mate[open_halves] < 0)
        if len(free) < 2:
            return
        ordered = open_halves[free[np.lexsort((open_halves[free], angle[free], half.edge[open_halves[free]]))]]
        edge = half.edge[ordered]
        is_first = np.r_[True, edge[1:] != edge[:-1]]
        is_last = np.r_[edge[1:] != edge[:-1], True]
        following = np.roll(ordered, -1)
        following[is_last] = ordered[is_first]
        fits = ~half.forward[ordered] & half.forward[following] & (following != ordered)
        if not fits.any():
            return
        left, right = ordered[fits], following[fits]
        mate[left], mate[right] = right, left


def _find_mates(
    half: _HalfEdges, faces: Indices, positions: Floats, corner_sources: Indices, corner_uvs: Indices, parts: Indices
) -> Indices:
    """Partner of every half-edge across its edge, -1 for none."""
    mate = np.full(half.num, -1, np.int64)
    faces_there = half.edge_faces[half.edge]
    _pair_groups(mate, half, np.flatnonzero(faces_there == 2), [half.edge], opposed=False)
    crowded = np.flatnonzero(faces_there > 2)
    if len(crowded):
        part = parts[half.face]
        _pair_groups(mate, half, crowded, [half.edge, *half.ends(corner_sources)], opposed=True)
        crowded = crowded[mate[crowded] < 0]
        _pair_groups(mate, half, crowded, [half.edge, part, *half.ends(corner_uvs)], opposed=True)
        _pair_by_angle(mate, half, faces, positions, crowded[mate[crowded] < 0])
    return mate


def _orient(half: _HalfEdges, mate: Indices, areas: Floats) -> tuple[Bools, int]:
    """Which faces to turn so that partners run against each other; cuts `mate` where that cannot be.

    Each face is two nodes of a graph, as it is and turned; a link says that two states agree. A component that
    holds both states of a face has one side only.
    """
    num_faces = len(areas)
    left = np.flatnonzero(mate > np.arange(half.num))
    right = mate[left]
    f, g = half.face[left], half.face[right]
    # The direction along the edge, not of the vertex numbers: two corners of a pair may be different vertices.
    clash = half.forward[left] == half.forward[right]
    if not clash.any():
        return np.zeros(num_faces, bool), 0
    _, states = connected_groups(
        2 * num_faces, np.r_[f, f + num_faces], np.r_[g + num_faces * clash, g + num_faces * ~clash]
    )
    as_is, turned_state = states[:num_faces], states[num_faces:]
    area_of_state = np.bincount(as_is, areas, minlength=states.max() + 1)
    turned = area_of_state[turned_state] > area_of_state[as_is] * (1 + 1e-9)
    tied = (area_of_state[turned_state] >= area_of_state[as_is] * (1 - 1e-9)) & ~turned
    turned |= tied & (turned_state < as_is) & (as_is != turned_state)

    one_sided = as_is == turned_state
    num_one_sided = 0
    if one_sided.any():
        spanning = _spanning_turns(num_faces, f, g, clash, one_sided)
        turned[one_sided] = spanning[one_sided]
        cut = one_sided[f] & (turned[f] ^ turned[g] ^ clash)
        mate[left[cut]] = mate[right[cut]] = -1
        num_one_sided = len(np.unique(as_is[one_sided]))
    return turned, num_one_sided


def _spanning_turns(num_faces: int, f: Indices, g: Indices, clash: Bools, wanted: Bools) -> Bools:
    """Turns that agree along a spanning tree of each wanted component; other links may disagree.

    The tree takes links that agree already before those that clash, so most faces stay as they are.
    """
    keep = wanted[f] & (f != g)
    f, g, clash = f[keep], g[keep], clash[keep]
    _, first = np.unique(np.minimum(f, g) * num_faces + np.maximum(f, g), return_index=True)
    f, g, clash = f[first], g[first], clash[first]
    graph = coo_array(
        (np.r_[clash, clash] + 1, (np.r_[f, g], np.r_[g, f])), shape=(num_faces, num_faces), dtype=np.int8
    ).tocsr()
    tree = minimum_spanning_tree(graph)
    tree = tree + tree.T
    _, labels = connected_components(tree, directed=False)
    parent = np.arange(num_faces)
    for label in np.unique(labels[wanted]):
        root = int(np.flatnonzero(labels == label)[0])
        order, before = breadth_first_order(tree, root, directed=False)
        parent[order[1:]] = before[order[1:]]
    # Turns relative to the parent, then to the root by doubling the stride (pointer jumping).
    child = np.flatnonzero(parent != np.arange(num_faces))
    turned = np.zeros(num_faces, bool)
    turned[child] = np.asarray(graph[child, parent[child]]).reshape(-1) == 2
    while (parent != parent[parent]).any():
        turned ^= turned[parent]
        parent = parent[parent]
    return turned


def _corner_vertices(half: _HalfEdges, mate: Indices) -> tuple[int, Indices]:
    """Corners that partners hold together, as new vertices, (F, 3)."""
    left = np.flatnonzero(mate > np.arange(half.num))
    right = mate[left]
    same_way = half.start[left] == half.start[right]
    start, end = half.start_corner[right], half.end_corner[right]
    num, labels = connected_groups(
        half.num,
        np.r_[half.start_corner[left], half.end_corner[left]],
        np.r_[np.where(same_way, start, end), np.where(same_way, end, start)],
    )
    return num, labels.reshape(-1, 3)


def _bad_edges(faces: Indices) -> Bools:
    """Half-edges whose edge, by vertex numbers, has more than two faces or two that run the same way, (3F,)."""
    half = _HalfEdges(faces)
    balance = np.bincount(half.edge, np.where(half.forward, 1.0, -1.0))
    bad = (half.edge_faces > 2) | ((half.edge_faces == 2) & (balance != 0))
    result: Bools = bad[half.edge]
    return result


def make_manifold(
    faces: Indices, positions: Floats, corner_sources: Indices, corner_uvs: Indices, parts: Indices
) -> Manifold:
    """Split non-manifold edges and vertices and make the winding of each component consistent.

    Parameters
    ----------
    faces : (F, 3) int64
        Into positions; no face has a vertex twice.
    positions : (V, 3) float64
    corner_sources, corner_uvs : (F, 3) int64
        Source vertex and texture vertex of each corner: they tell which faces belong to one sheet.
    parts : (F,) int64

    Returns
    -------
    Manifold
        Every edge of its faces has one face, or two that run against each other.
    """
    half = _HalfEdges(faces)
    mate = _find_mates(half, faces, positions, corner_sources, corner_uvs, parts)
    areas = face_areas(positions[faces])
    turned, num_unorientable = _orient(half, mate, areas)
    corners = np.where(turned[:, None], [0, 2, 1], [0, 1, 2])

    # Two pairs on one edge may still share both end vertices through the fans around them: cut those pairs, and if
    # that is not enough (it is, but for surfaces that touch themselves twice), set their faces free.
    attempt = 0
    while True:
        num_vertices, labels = _corner_vertices(half, mate)
        new_faces = np.take_along_axis(labels, corners, axis=1)
        bad = _bad_edges(new_faces)
        if not bad.any():
            break
        # Half-edges of turned faces are numbered differently: cut by face corner pairs in the input's numbering.
        bad_faces = bad.reshape(-1, 3)
        in_input = np.where(turned[:, None], bad_faces[:, ::-1], bad_faces).reshape(-1)
        if attempt:
            in_input = np.repeat(bad_faces.any(axis=1), 3)
        cut = np.flatnonzero(in_input & (mate >= 0))
        mate[mate[cut]] = -1
        mate[cut] = -1
        attempt += 1
        assert attempt < 64, "free faces have no shared edges"

    origin = np.empty(num_vertices, np.int64)
    origin[labels.reshape(-1)] = faces.reshape(-1)
    return Manifold(
        corners=corners,
        faces=new_faces,
        vertex_origin=origin,
        num_split_edges=int((half.edge_faces > 2).sum()),
        num_split_vertices=num_vertices - len(np.unique(faces)),
        num_turned=int(turned.sum()),
        num_unorientable=num_unorientable,
    )
