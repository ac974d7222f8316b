"""Where the skin is cut: charts by body part, and slits that let a closed part lie flat.

Thirteen charts: the head (slit up the nape and under the chin), the two sides of the trunk and of the tail, four
limbs (slit down the back of the leg and along the sole), two ears and two wings (slit along one edge).
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from demos.creature.field import Field
from demos.creature.surface import Floats, Ints, unique_edges

HEAD, TRUNK, TAIL, ARM, LEG, EAR, WING = range(7)
_MIRRORED = (TRUNK, TAIL, ARM, LEG, EAR, WING)
_PART_OF_REGION = {
    "trunk": TRUNK,
    "neck": TRUNK,
    "head": HEAD,
    "muzzle": HEAD,
    "nostril": HEAD,
    "eye": HEAD,
    "lid": HEAD,
    "horn": HEAD,
    "jaw": HEAD,
    "mouth": HEAD,
    "ear": EAR,
    "tail": TAIL,
    "fin": TAIL,
    "arm": ARM,
    "leg": LEG,
    "wing": WING,
}
_TAIL_FROM_Z = -0.375
_HEAD_FROM = (0.0, 0.53, 0.285)  # a point of the plane between neck and head ...
_HEAD_TOWARDS = (0.0, 0.75, 0.66)  # ... and its normal

# Slits follow these lines (left side): from the chart's border to its last point.
_SLITS: dict[int, tuple[tuple[float, float, float], ...]] = {
    ARM: ((0.10, 0.22, 0.10), (0.125, 0.15, 0.085), (0.140, 0.06, 0.115), (0.150, 0.0, 0.165), (0.152, 0.0, 0.225)),
    LEG: ((0.11, 0.20, -0.29), (0.130, 0.13, -0.275), (0.150, 0.075, -0.30), (0.158, 0.0, -0.25), (0.160, 0.0, -0.16)),
    HEAD: ((0.0, 0.80, 0.305), (0.055, 0.790, 0.290), (0.085, 0.850, 0.225), (0.096, 0.890, 0.185)),
    EAR: ((0.165, 0.665, 0.285), (0.250, 0.715, 0.230), (0.350, 0.845, 0.150)),
    WING: ((0.075, 0.505, 0.06), (0.21, 0.61, 0.0), (0.365, 0.69, -0.075)),
}


def assign_parts(field: Field, points: Floats) -> Ints:
    """Body part of (N, 3) points near the skin, (N,)."""
    mix = field.regions_at(points)
    scores = np.zeros((len(points), 7))
    for region, share in zip(field.regions, mix.T, strict=True):
        if region in _PART_OF_REGION:
            scores[:, _PART_OF_REGION[region]] += share
        elif region == "claw":
            scores[points[:, 2] > 0, ARM] += share[points[:, 2] > 0]
            scores[points[:, 2] <= 0, LEG] += share[points[:, 2] <= 0]
        else:  # the crest follows what it stands on
            scores[:, TRUNK] += share
    parts: Ints = scores.argmax(axis=1)
    central = np.isin(parts, (HEAD, TRUNK, TAIL))
    towards = np.array(_HEAD_TOWARDS) / np.linalg.norm(_HEAD_TOWARDS)
    in_head = (points - np.array(_HEAD_FROM)) @ towards > 0
    parts[central] = np.where(points[central, 2] < _TAIL_FROM_Z, TAIL, TRUNK)
    parts[central & in_head] = HEAD
    return parts


def _slit_path(points: Floats, edges: Ints, inside: NDArray[np.bool_], border: NDArray[np.bool_], line: Floats) -> Ints:
    """Cheapest vertex path along a guiding polyline, from the chart's border to the line's end inside."""
    inner = inside & ~border
    both = np.concatenate([edges, edges[:, ::-1]])
    usable = both[inner[both[:, 0]] & inside[both[:, 1]]]  # a path that reaches the border ends there
    middle = points[usable].mean(axis=1)
    off = np.full(len(usable), np.inf)
    for start, end in itertools.pairwise(line):
        axis = end - start
        t = np.clip((middle - start) @ axis / (axis @ axis), 0.0, 1.0)
        off = np.minimum(off, np.linalg.norm(middle - start - t[:, None] * axis, axis=1))
    length = np.linalg.norm(points[usable[:, 0]] - points[usable[:, 1]], axis=1)
    cost = length * (1.0 + (off / 0.02) ** 2)
    graph = sparse.coo_matrix((cost, (usable[:, 0], usable[:, 1])), shape=(len(points), len(points))).tocsr()
    candidates = np.flatnonzero(inner)
    last = int(candidates[np.linalg.norm(points[candidates] - line[-1], axis=1).argmin()])
    distances, predecessors = dijkstra(graph, directed=True, indices=np.array([last]), return_predecessors=True)
    reach, before = distances[0], predecessors[0]
    starts = np.flatnonzero(inside & border & np.isfinite(reach))
    away = np.linalg.norm(points[starts] - line[0], axis=1)
    path = [int(starts[(reach[starts] + 20.0 * away).argmin()])]
    while path[-1] != last:
        path.append(int(before[path[-1]]))
    return np.array(path)


def cut_charts(field: Field, points: Floats, faces: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Chart of each face and the edges where the skin is cut.

    Parameters
    ----------
    field : Field
    points : (V, 3) float64
        Vertices on the plane of symmetry have x = 0 exactly.
    faces : (F, 3) int64

    Returns
    -------
    charts : (F,) int64
        Numbered from 0, in a fixed order.
    cut : (E,) bool
        Of the edges of `unique_edges(faces)`: slits and borders between charts.
    """
    centres = points[faces].mean(axis=1)
    parts = assign_parts(field, centres)
    right = (centres[:, 0] < 0) & np.isin(parts, _MIRRORED)
    labels = parts * 2 + right
    labels = _drop_islands(faces, _smooth_labels(faces, labels, centres[:, 0] < 0))
    edges, edge_of_half, _ = unique_edges(faces)
    cut = _borders(edge_of_half, labels, len(edges))
    cut |= _middle_slits(points, edges)
    scale = len(points)
    keys = edges[:, 0] * scale + edges[:, 1]
    border = np.zeros(len(points), bool)
    border[edges[cut]] = True
    for part, line in _SLITS.items():
        for sign in (1.0, -1.0):
            inside = np.zeros(len(points), bool)
            inside[faces[labels == (part * 2 + (sign < 0) if part in _MIRRORED else part * 2)]] = True
            path = _slit_path(points, edges, inside, border, np.array(line) * np.array([sign, 1.0, 1.0]))
            low, high = np.minimum(path[:-1], path[1:]), np.maximum(path[:-1], path[1:])
            cut[np.searchsorted(keys, low * scale + high)] = True
    return np.unique(labels, return_inverse=True)[1], cut


def _middle_slits(points: Floats, edges: Ints) -> NDArray[np.bool_]:
    """The head's slits on the plane of symmetry: up the nape to the crown, and under the chin."""
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    middle = 0.5 * (a + b)
    on_plane = (a[:, 0] == 0) & (b[:, 0] == 0)
    towards = np.array(_HEAD_TOWARDS) / np.linalg.norm(_HEAD_TOWARDS)
    in_head = (middle - np.array(_HEAD_FROM)) @ towards > -0.03
    nape = (middle[:, 1] > 0.62) & (middle[:, 2] < 0.36)
    chin = (middle[:, 1] < 0.56) & (middle[:, 2] < 0.50)
    result: NDArray[np.bool_] = on_plane & in_head & (nape | chin)
    return result


def _borders(edge_of_half: Ints, labels: Ints, num_edges: int) -> NDArray[np.bool_]:
    of_half = np.repeat(labels, 3)
    low, high = np.full(num_edges, 10**6), np.full(num_edges, -1)
    np.minimum.at(low, edge_of_half, of_half)
    np.maximum.at(high, edge_of_half, of_half)
    result: NDArray[np.bool_] = low != high
    return result


def _smooth_labels(faces: Ints, labels: Ints, right: NDArray[np.bool_], rounds: int = 6) -> Ints:
    """A face takes the label of most of its neighbours where all but one disagree, on its own side of the body."""
    _, edge_of_half, _ = unique_edges(faces)
    neighbours = _face_neighbours(edge_of_half)
    label_side = np.array([label % 2 if label // 2 in _MIRRORED else -1 for label in range(14)])
    other_side = (label_side >= 0) & (label_side != right[:, None])
    for _ in range(rounds):
        around = labels[neighbours]
        agree = (around == labels[:, None]).sum(axis=1)
        counts = np.stack([(around == label).sum(axis=1) for label in range(14)], axis=1)
        counts[other_side] = 0
        labels = np.where((agree <= 1) & (counts.max(axis=1) >= 2), counts.argmax(axis=1), labels)
    return labels


def _face_neighbours(edge_of_half: Ints) -> Ints:
    """Face across each half-edge of a closed mesh, (F, 3)."""
    order = np.argsort(edge_of_half, kind="stable").reshape(-1, 2)
    across = np.empty(len(edge_of_half), np.int64)
    across[order[:, 0]], across[order[:, 1]] = order[:, 1], order[:, 0]
    return (across // 3).reshape(-1, 3)


def _drop_islands(faces: Ints, labels: Ints) -> Ints:
    """Keep each label's largest piece; the rest join a neighbouring label, ring by ring."""
    _, edge_of_half, _ = unique_edges(faces)
    neighbours = _face_neighbours(edge_of_half)
    rows, columns = np.repeat(np.arange(len(faces)), 3), neighbours.reshape(-1)
    same = labels[rows] == labels[columns]
    graph = sparse.coo_matrix((np.ones(int(same.sum())), (rows[same], columns[same])), shape=(len(faces),) * 2)
    piece = connected_components(graph.tocsr(), directed=False)[1]
    sizes = np.bincount(piece)
    keep = np.zeros(len(sizes), bool)
    for label in np.unique(labels):
        mine = np.unique(piece[labels == label])
        keep[mine[sizes[mine].argmax()]] = True
    labels = np.where(keep[piece], labels, -1)
    while (labels < 0).any():
        best = labels[neighbours].max(axis=1)
        labels = np.where(labels < 0, best, labels)
    return labels
