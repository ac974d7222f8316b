"""What a choice of straight runs means for the mesh: crossings, edges that come to lie on one, points to give back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.mesh import Floats, TexturedSurface
from preprocess.straighten.chains import Chains
from preprocess.straighten.overlap import find_meeting_segments
from preprocess.straighten.simplify import joint_points, run_ends

Bools = NDArray[np.bool_]

SEARCH_RINGS = 8  # of faces between a face and the silhouette that spoils it


def first_points_of_edges(chains: Chains) -> NDArray[np.int64]:
    """First point of every silhouette edge: all points but the last of each chain."""
    last = np.zeros(len(chains.vertices), bool)
    last[chains.offsets[1:] - 1] = True
    return np.flatnonzero(~last)


def edge_lengths_m(chains: Chains, positions: Floats) -> Floats:
    """Lengths of the silhouette edges in space, in the order of the points, (E,) float64 metres."""
    first = first_points_of_edges(chains)
    return np.linalg.norm(positions[chains.vertices[first + 1]] - positions[chains.vertices[first]], axis=1)


def find_edges_in_long_runs(chains: Chains, kept: Bools) -> Bools:
    """Which silhouette edges lie in runs of two edges or more, (E,) bool."""
    first = first_points_of_edges(chains)
    return ~(kept[first] & kept[first + 1])


def run_segments(chains: Chains, moved: Floats, kept: Bools) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Straight segments of all runs on both sides: ends (S, 2, 2), texture vertices (S, 2), first points (S,)."""
    starts = np.flatnonzero(kept)
    chain = chains.point_chains[starts]
    same = np.flatnonzero(chain[1:] == chain[:-1])
    a, b = starts[same], starts[same + 1]
    ends, ids, firsts = [], [], []
    for side in range(2):
        has = chains.uv_ids[a, side] >= 0
        columns = slice(2 * side, 2 * side + 2)
        ends.append(np.stack([moved[a[has], columns], moved[b[has], columns]], axis=1))
        ids.append(np.stack([chains.uv_ids[a[has], side], chains.uv_ids[b[has], side]], axis=1))
        firsts.append(a[has])
    return np.concatenate(ends), np.concatenate(ids).astype(np.int64), np.concatenate(firsts).astype(np.int64)


@dataclass(frozen=True)
class Apartness:
    """What straight runs must keep clear of.

    Attributes
    ----------
    uv_charts : (T,) int64
        Chart of every texture vertex.
    keep_apart : bool
        Runs of different charts may not meet either.
    gap_uv : float
        Least distance between them.
    """

    uv_charts: NDArray[np.int64]
    keep_apart: bool
    gap_uv: float


def find_apartness(
    chains: Chains, uvs: Floats, uv_charts: NDArray[np.int64], keep_packing: bool, gap_uv: float
) -> Apartness:
    """How far charts are apart now, up to `gap_uv` (halved until it holds); not at all where some overlap already."""
    whole = np.ones(len(chains.vertices), bool)
    ends, ids, _ = run_segments(chains, joint_points(chains, uvs), whole)
    charts = uv_charts[ids[:, 0]]
    if not keep_packing or find_meeting_segments(ends, ids, charts, True).any():
        return Apartness(uv_charts, False, 0.0)
    gaps = [gap_uv * 0.5**k for k in range(6)]
    held = (gap for gap in gaps if not find_meeting_segments(ends, ids, charts, True, gap).any())
    return Apartness(uv_charts, True, next(held, 0.0))


def find_crossing_points(chains: Chains, moved: Floats, kept: Bools, apartness: Apartness) -> Bools:
    """Removed points of the runs that meet another run, (P,) bool."""
    ends, ids, firsts = run_segments(chains, moved, kept)
    charts = apartness.uv_charts[ids[:, 0]]
    meets = find_meeting_segments(ends, ids, charts, apartness.keep_apart, apartness.gap_uv)
    bad_first = np.zeros(len(kept), bool)
    bad_first[firsts[meets]] = True
    before, _ = run_ends(kept)
    return bad_first[before] & ~kept


def pick_farthest_points(joint: Floats, moved: Floats, kept: Bools, bad: Bools) -> Bools:
    """Of every run with bad points, the one that moved farthest, (P,) bool."""
    points = np.flatnonzero(bad)
    distance = np.linalg.norm(moved[points] - joint[points], axis=1)
    run = run_ends(kept)[0][points]
    order = np.lexsort((points, -distance, run))
    first = np.r_[True, run[order][1:] != run[order][:-1]]
    result = np.zeros(len(kept), bool)
    result[points[order][first]] = True
    return result


def _face_edges(surface: TexturedSurface) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ends of every face's edges: surface vertices and texture vertices, each (F, 3, 2) int64."""
    corners, uv_corners = surface.faces.astype(np.int64), surface.face_uvs.astype(np.int64)
    return (
        np.stack([corners, np.roll(corners, -1, axis=1)], axis=2),
        np.stack([uv_corners, np.roll(uv_corners, -1, axis=1)], axis=2),
    )


def _silhouette_keys(chains: Chains, num_uvs: int) -> NDArray[np.int64]:
    """One number for every silhouette edge on every side, sorted."""
    first = first_points_of_edges(chains)
    pairs = np.concatenate([np.stack([chains.uv_ids[first, s], chains.uv_ids[first + 1, s]], axis=1) for s in (0, 1)])
    pairs = pairs[pairs[:, 0] >= 0].astype(np.int64)
    return np.unique(pairs.min(axis=1) * num_uvs + pairs.max(axis=1))


def interior_edges(surface: TexturedSurface, chains: Chains, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Surface vertices of some faces' edges that are no silhouette, (E, 2) int64."""
    ends, uv_ends = (a[faces].reshape(-1, 2) for a in _face_edges(surface))
    keys = uv_ends.min(axis=1) * len(surface.uvs) + uv_ends.max(axis=1)
    return ends[~np.isin(keys, _silhouette_keys(chains, len(surface.uvs)))]


def find_edges_on_one_run(surface: TexturedSurface, chains: Chains, kept: Bools, fixed: Bools) -> NDArray[np.int64]:
    """Interior edges with both ends on one straight run: they would lie on the silhouette. (E, 2) surface vertices."""
    ends, uv_ends = (a.reshape(-1, 2) for a in _face_edges(surface))
    chord = fixed[uv_ends].all(axis=1) & (uv_ends[:, 0] < uv_ends[:, 1])
    keys = uv_ends.min(axis=1) * len(surface.uvs) + uv_ends.max(axis=1)
    chord &= ~np.isin(keys, _silhouette_keys(chains, len(surface.uvs)))
    ends, uv_ends = ends[chord], uv_ends[chord]
    # A texture vertex lies on the run that its point belongs to; a kept one on the runs before and after it.
    before, _ = run_ends(kept)
    index = np.arange(len(kept))
    not_first = np.ones(len(kept), bool)
    not_first[chains.offsets[:-1]] = False
    ending = np.flatnonzero(kept & not_first)  # kept points where a run ends: the run of the point before
    points = np.concatenate([index, ending])
    runs = np.concatenate([before[index], before[ending - 1]]).astype(np.int64)
    vertex = np.concatenate([chains.uv_ids[points, 0], chains.uv_ids[points, 1]]).astype(np.int64)
    run_sides = np.concatenate([2 * runs, 2 * runs + 1])
    real = vertex >= 0
    order = np.argsort(vertex[real], kind="stable")
    vertex, run_sides = vertex[real][order], run_sides[real][order]

    def pairs(column: NDArray[np.int64]) -> NDArray[np.int64]:
        """All (edge, run side) that the edges' ends in `column` lie on, as one number each."""
        low, high = np.searchsorted(vertex, column), np.searchsorted(vertex, column, side="right")
        count = high - low
        edge = np.repeat(np.arange(len(column)), count)
        slot = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)
        return edge * (2 * len(kept)) + run_sides[slot]

    common = np.intersect1d(pairs(uv_ends[:, 0]), pairs(uv_ends[:, 1]))
    return ends[np.unique(common // (2 * len(kept)))]


def find_points_near_faces(surface: TexturedSurface, chains: Chains, kept: Bools, faces: NDArray[np.int64]) -> Bools:
    """Removed points that are the nearest to some faces, by rings of faces; of the whole surface where none is near.

    Parameters
    ----------
    surface : TexturedSurface
    chains : Chains
    kept : (P,) bool
    faces : (N,) int64

    Returns
    -------
    (P,) bool
    """
    points = np.flatnonzero(~kept)
    owner = np.full(len(surface.uvs), -1, np.int64)  # of a texture vertex: the nearest removed point
    for side in range(2):
        has = chains.uv_ids[points, side] >= 0
        owner[chains.uv_ids[points[has], side]] = points[has]
    ids = surface.face_uvs.astype(np.int64)
    result = np.zeros(len(kept), bool)
    lone = np.asarray(faces)
    for _ in range(SEARCH_RINGS):
        found = owner[ids[lone]]
        result[found[found >= 0]] = True
        lone = lone[(found < 0).all(axis=1)]
        if not len(lone):
            return result
        best = owner[ids].max(axis=1)
        spread = owner.copy()
        np.maximum.at(spread, ids.ravel(), np.repeat(best, 3))
        owner = np.where(owner >= 0, owner, spread)
    return ~kept
