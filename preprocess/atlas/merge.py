"""Joins charts along common borders while the joined chart stays one-to-one and nearly isometric.

Each round takes the borders that are longest against their charts' outlines, one a chart, moves one side onto the
other, lets the joined charts relax together (`flatten`), and keeps those that are sound. Charts that unfold rigidly,
like the sides of a box, need no relaxing. Fewer charts mean shorter seams to erase, fewer gutters and coarser levels:
a third to a tenth of the charts and half of the seams' length are left of what regions, or xatlas, give.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from preprocess.arrays import Bools, Floats, Ints
from preprocess.atlas.distortion import overlapping_charts, singular_values, sums, turned_areas
from preprocess.atlas.flatten import flatten_free, local_triangles
from preprocess.mesh.edges import MeshEdges, label_faces

log = logging.getLogger(__name__)

MOST_STRETCH = 2.0
"""A joined chart's lengths may grow or shrink by this factor (so stretch is 4 : 1 and density a quarter at most) …"""

STRETCHED_SHARE = 0.002
"""… but for this share of its area."""

MOST_L2 = (1.02, 1.1)
"""And its mean (L2) stretch, at first and then. What unfolds without stretch comes first: a box is a cross, not two
dented halves."""

POINTED = 0.35
"""Radians that the angles around a vertex may differ from a full turn by, for borders to run on across it while charts
are still joined without stretch: at a box's corner two sides can be joined to a third, along one edge each."""

LEAST_SHARE = 0.15
"""Of the outline of one of the two charts that a border has to be: charts that hang by a thread pack badly."""

NARROW_REL = 0.2
"""Of its length that a slit between two borders of one chart may be wide for closing it to be tried."""

GAP_REL = 1e-4
"""Of a chart's size: borders that are nearer once moved need no relaxing."""

RELAX_STEPS = 4
MOST_ROUNDS = 60


@dataclass(frozen=True)
class _Joins:
    """Borders to be joined in one round, M of them, no two with a chart in common.

    charts (M, 2): first and second chart, equal for a slit; edges (N,) and edge_joins (N,): their edges.
    """

    charts: NDArray[np.int64]
    edges: NDArray[np.int64]
    edge_joins: NDArray[np.int64]


def merge_charts(
    positions: Floats, faces: Ints, edges: MeshEdges, cut: Bools, corner_uvs: Floats, barred: Bools
) -> tuple[Bools, Floats]:
    """Join charts as far as they stay sound.

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int32
    edges : MeshEdges
    cut : (E,) bool
        Borders of the charts.
    corner_uvs : (F, 3, 2) float64
        Each chart in a frame of its own at the surface's scale, counter-clockwise.
    barred : (E,) bool
        Edges that stay cut.

    Returns
    -------
    cut, corner_uvs : of the joined charts
    """
    cut, corner_uvs = cut.copy(), corner_uvs.copy()
    flat = local_triangles(positions, faces)
    ends = positions[edges.vertices]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    pointed = np.abs(_angle_sums(flat, faces, len(positions)) - 2.0 * np.pi) > POINTED
    closed = barred | ~edges.glued  # to joining: also what has been tried in vain
    most_l2 = list(MOST_L2)
    for _ in range(MOST_ROUNDS):
        num_charts, face_charts = label_faces(edges, cut)
        breaks = pointed if len(most_l2) > 1 else np.zeros_like(pointed)
        joins = _choose_joins(edges, cut & ~closed, cut, lengths, breaks, face_charts, num_charts, corner_uvs)
        if not len(joins.charts):
            del most_l2[0]
            if not most_l2:
                break
            closed = barred | ~edges.glued
            continue
        chart_joins = np.full(num_charts, -1)
        chart_joins[joins.charts] = np.arange(len(joins.charts))[:, None]
        chosen = np.flatnonzero(chart_joins[face_charts] >= 0)
        face_joins = chart_joins[face_charts[chosen]]
        moved = _move_second(edges, joins, face_charts, chosen, face_joins, corner_uvs)
        opened = cut.copy()
        opened[joins.edges] = False
        mapped = _relax(edges, opened, chosen, face_joins, len(joins.charts), moved, flat[chosen])
        good = _are_sound(mapped, flat[chosen], face_joins, len(joins.charts), most_l2[0])
        taken = good[face_joins]
        corner_uvs[chosen[taken]] = mapped[taken]
        cut[joins.edges[good[joins.edge_joins]]] = False
        closed[joins.edges[~good[joins.edge_joins]]] = True
        log.debug("%d charts: %d of %d joins are sound", num_charts, good.sum(), len(good))
    return cut, corner_uvs


def _choose_joins(
    edges: MeshEdges,
    candidates: Bools,
    cut: Bools,
    lengths: Floats,
    breaks: Bools,
    face_charts: Ints,
    num_charts: int,
    corner_uvs: Floats,
) -> _Joins:
    """Borders in the order of their share of an outline, as long as none of their charts is taken."""
    charts = face_charts[edges.halves // 3].astype(np.int64)
    charts.sort(axis=1)
    outline = np.bincount(face_charts.repeat(3), (lengths * cut)[edges.face_edges.ravel()], num_charts)
    rows = np.flatnonzero(candidates)
    within = charts[rows, 0] == charts[rows, 1]
    rows = np.concatenate([rows[~within], rows[within][_are_narrow(edges, rows[within], lengths, corner_uvs)]])
    if not len(rows):
        return _Joins(np.zeros((0, 2), np.int64), rows, rows)
    paths = _connected_paths(edges.vertices[rows], charts[rows, 0] * num_charts + charts[rows, 1], breaks)
    pairs = charts[rows[np.unique(paths, return_index=True)[1]]]
    share = np.bincount(paths, lengths[rows]) / outline[pairs].min(axis=1)
    order = np.argsort(-share, kind="stable")
    order = order[(share[order] >= LEAST_SHARE) | (pairs[order, 0] == pairs[order, 1])]
    free, chosen = np.ones(num_charts, bool), []
    for path, (first, second) in zip(order.tolist(), pairs[order].tolist(), strict=True):
        if free[first] and free[second]:
            free[first] = free[second] = False
            chosen.append(path)
    number = np.full(len(pairs), -1)
    number[chosen] = np.arange(len(chosen))
    kept = number[paths] >= 0
    return _Joins(pairs[chosen], rows[kept], number[paths][kept])


def _angle_sums(flat: Floats, faces: Ints, num_vertices: int) -> Floats:
    """Sum of the angles of all faces at each vertex, (V,)."""
    after, before = np.roll(flat, -1, axis=1) - flat, np.roll(flat, 1, axis=1) - flat
    cosine = (after * before).sum(axis=2)
    sine = after[..., 0] * before[..., 1] - after[..., 1] * before[..., 0]
    return sums(faces.ravel(), np.arctan2(sine, cosine).ravel(), num_vertices)


def _are_narrow(edges: MeshEdges, rows: NDArray[np.int64], lengths: Floats, corner_uvs: Floats) -> Bools:
    """Whether the two sides of edges lie nearly on one another."""
    flat = corner_uvs.reshape(-1, 2)
    left, right = edges.halves[rows].T
    gap = np.linalg.norm(flat[left] - flat[_next(right)], axis=1) + np.linalg.norm(
        flat[_next(left)] - flat[right], axis=1
    )
    result: Bools = gap <= NARROW_REL * lengths[rows]
    return result


def _connected_paths(vertices: Ints, keys: NDArray[np.int64], breaks: Bools) -> NDArray[np.int64]:
    """Edges (N, 2) joined at vertices, but for breaks (V,), where their keys (N,) are equal, numbered, (N,)."""
    num = len(vertices)
    _, nodes = np.unique(keys[:, None] * len(breaks) + vertices, return_inverse=True)
    nodes = nodes.reshape(-1, 2)
    size = num + int(nodes.max()) + 1
    rows, ends = np.nonzero(~breaks[vertices])
    graph = sp.coo_array((np.ones(len(rows), np.int8), (rows, num + nodes[rows, ends])), (size, size))
    return np.unique(connected_components(graph, directed=False)[1][:num], return_inverse=True)[1].reshape(-1)


def _move_second(
    edges: MeshEdges,
    joins: _Joins,
    face_charts: Ints,
    chosen: NDArray[np.int64],
    face_joins: NDArray[np.int64],
    corner_uvs: Floats,
) -> Floats:
    """Corners of the chosen faces, every second chart moved rigidly to where its border fits the first one's best."""
    flat = corner_uvs.reshape(-1, 2)
    halves = edges.halves[joins.edges]
    swap = face_charts[halves[:, 0] // 3] != joins.charts[joins.edge_joins, 0]
    first, second = np.where(swap, halves[:, 1], halves[:, 0]), np.where(swap, halves[:, 0], halves[:, 1])
    goal = np.concatenate([flat[first], flat[_next(first)]])
    start = np.concatenate([flat[_next(second)], flat[second]])
    owner, num = np.tile(joins.edge_joins, 2), len(joins.charts)
    goal_mean, start_mean = _means(goal, owner, num), _means(start, owner, num)
    g, s = goal - goal_mean[owner], start - start_mean[owner]
    cosine = sums(owner, (s * g).sum(axis=1), num)
    sine = sums(owner, s[:, 0] * g[:, 1] - s[:, 1] * g[:, 0], num)
    length = np.hypot(cosine, sine)
    cosine, sine = np.where(length > 0, cosine, 1.0), sine / np.where(length > 0, length, 1.0)
    cosine = cosine / np.where(length > 0, length, 1.0)
    slit = joins.charts[:, 0] == joins.charts[:, 1]
    moves = (face_charts[chosen] == joins.charts[face_joins, 1]) & ~slit[face_joins]
    result, j = corner_uvs[chosen], face_joins[moves]
    x, y = np.moveaxis(result[moves] - start_mean[j][:, None], 2, 0)
    c, s = cosine[j][:, None], sine[j][:, None]
    result[moves] = np.stack([c * x - s * y, s * x + c * y], axis=2) + goal_mean[j][:, None]
    return result


def _relax(
    edges: MeshEdges,
    cut: Bools,
    chosen: NDArray[np.int64],
    face_joins: NDArray[np.int64],
    num_joins: int,
    moved: Floats,
    flat: Floats,
) -> Floats:
    """Corners of the joined charts, each texture vertex in one place."""
    count, face_uvs = _label_corners(edges, cut, chosen)
    corners = np.bincount(face_uvs.ravel(), minlength=count)
    uvs = np.stack([sums(face_uvs.ravel(), moved[..., k].ravel(), count) for k in range(2)], axis=1)
    uvs /= corners[:, None]
    gap = np.zeros(num_joins)
    np.maximum.at(gap, face_joins, np.abs(uvs[face_uvs] - moved).max(axis=(1, 2)))
    area = np.bincount(face_joins, turned_areas(flat), num_joins)
    rows = np.flatnonzero((gap > GAP_REL * np.sqrt(area))[face_joins])
    if len(rows):
        ids, local = np.unique(face_uvs[rows], return_inverse=True)
        local = local.reshape(-1, 3).astype(np.int32)
        uvs[ids] = flatten_free(uvs[ids], flat[rows], local, face_joins[rows], RELAX_STEPS)
    return uvs[face_uvs]


def _label_corners(edges: MeshEdges, cut: Bools, chosen: NDArray[np.int64]) -> tuple[int, Ints]:
    """Texture vertices of some faces, whole charts: their count, and (len(chosen), 3) int32."""
    number = np.full(len(edges.face_edges), -1)
    number[chosen] = np.arange(len(chosen))
    halves = edges.halves[edges.glued & ~cut]
    halves = halves[number[halves[:, 0] // 3] >= 0]
    left, right = (3 * number[halves // 3] + halves % 3).T
    starts, ends = np.r_[left, _next(left)], np.r_[_next(right), right]
    size = 3 * len(chosen)
    graph = sp.coo_array((np.ones(len(starts), np.int8), (starts, ends)), (size, size))
    count, labels = connected_components(graph, directed=False)
    return int(count), labels.reshape(-1, 3).astype(np.int32)


def _are_sound(mapped: Floats, flat: Floats, face_joins: NDArray[np.int64], num_joins: int, most_l2: float) -> Bools:
    """Joined charts that are one-to-one and little stretched, (M,)."""
    largest, smallest = singular_values(flat, mapped)
    weights = turned_areas(flat)
    area = np.bincount(face_joins, weights, num_joins)
    stretched = (largest > MOST_STRETCH) | (smallest * MOST_STRETCH < 1.0)
    sound = np.bincount(face_joins, weights * stretched, num_joins) <= STRETCHED_SHARE * area
    safe = np.maximum(smallest, 1e-3)
    inverse_sq = np.bincount(face_joins, weights * 0.5 * (largest**-2.0 + safe**-2.0), num_joins) / area
    scale_sq = np.bincount(face_joins, weights * largest * smallest, num_joins) / area
    sound &= inverse_sq * scale_sq <= most_l2**2
    edge = np.linalg.norm(mapped - np.roll(mapped, -1, axis=1), axis=2).max(axis=1)
    sound &= np.bincount(face_joins, turned_areas(mapped) <= 1e-9 * edge**2, num_joins) == 0
    tested = np.flatnonzero(sound[face_joins])
    if len(tested):
        sound &= ~overlapping_charts(mapped[tested], face_joins[tested], num_joins)
    return sound


def _means(points: Floats, owners: NDArray[np.int64], num: int) -> Floats:
    sums = np.stack([np.bincount(owners, points[:, k], num) for k in range(2)], axis=1)
    return np.asarray(sums / np.bincount(owners, minlength=num)[:, None])


def _next(half: NDArray[np.integer]) -> NDArray[np.integer]:
    result: NDArray[np.integer] = half - half % 3 + (half + 1) % 3
    return result
