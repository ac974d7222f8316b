"""What a choice of straight runs means for the mesh: crossings, edges that come to lie on one, points to give back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten.chains import Chains
from preprocess.straighten.overlap import find_meeting_segments, find_swept_runs
from preprocess.straighten.simplify import joint_points, run_ends

LEAST_LIMIT = 1e-3  # of a limit: below, points stay rather than move less
GAP_STEPS = 16  # down to a thirtieth of the gap asked for
SEARCH_RINGS = 8  # of faces between a face and the silhouette that spoils it


def first_points_of_edges(chains: Chains) -> NDArray[np.int64]:
    """First point of every silhouette edge: all points but the last of each chain."""
    last = np.zeros(len(chains.vertices), bool)
    last[chains.offsets[1:] - 1] = True
    return np.flatnonzero(~last)


def edge_lengths_m(chains: Chains, positions: Floats) -> Floats:
    """Lengths of the silhouette edges in space, in the order of the points, (E,) float64 metres."""
    first = first_points_of_edges(chains)
    result: Floats = np.linalg.norm(positions[chains.vertices[first + 1]] - positions[chains.vertices[first]], axis=1)
    return result


def find_edges_in_long_runs(chains: Chains, kept: Bools) -> Bools:
    """Which silhouette edges lie in runs of two edges or more, (E,) bool."""
    first = first_points_of_edges(chains)
    return ~(kept[first] & kept[first + 1])


@dataclass(frozen=True)
class Segments:
    """The straight segments of all runs, one for each side.

    Attributes
    ----------
    ends : (S, 2, 2) float64
    uv_ids : (S, 2) int64
        Texture vertices at the ends.
    first, last : (S,) int64
        Points of the chains at the ends.
    sides : (S,) int64
        0 or 1: which copy of the chain.
    """

    ends: Floats
    uv_ids: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    sides: NDArray[np.int64]


def run_segments(chains: Chains, moved: Floats, kept: Bools) -> Segments:
    """Segments between kept points, from points in the joint space (P, 4)."""
    starts = np.flatnonzero(kept)
    chain = chains.point_chains[starts]
    same = np.flatnonzero(chain[1:] == chain[:-1])
    first, last = np.tile(starts[same], 2), np.tile(starts[same + 1], 2)
    sides = np.repeat([0, 1], len(same))
    uv_ids = np.stack([chains.uv_ids[first, sides], chains.uv_ids[last, sides]], axis=1).astype(np.int64)
    has = uv_ids[:, 0] >= 0
    first, last, sides, uv_ids = first[has], last[has], sides[has], uv_ids[has]
    by_side = moved.reshape(-1, 2, 2)
    ends = np.stack([by_side[first, sides], by_side[last, sides]], axis=1)
    return Segments(ends, uv_ids, first, last, sides)


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
    """How far charts are apart now, up to `gap_uv`, in steps of a fifth; not at all where some overlap already."""
    whole = np.ones(len(chains.vertices), bool)
    segments = run_segments(chains, joint_points(chains, uvs), whole)
    ends, ids, charts = segments.ends, segments.uv_ids, uv_charts[segments.uv_ids[:, 0]]
    if not keep_packing or find_meeting_segments(ends, ids, charts, True).any():
        return Apartness(uv_charts, False, 0.0)
    gaps = [gap_uv * 0.8**k for k in range(GAP_STEPS)]
    held = (gap for gap in gaps if not find_meeting_segments(ends, ids, charts, True, gap).any())
    return Apartness(uv_charts, True, next(held, 0.0))


def find_crossing_points(chains: Chains, joint: Floats, moved: Floats, kept: Bools, apartness: Apartness) -> Bools:
    """Removed points of the runs that meet another run or passed over a chart on their way, (P,) bool."""
    segments = run_segments(chains, moved, kept)
    charts = apartness.uv_charts[segments.uv_ids[:, 0]]
    bad = find_meeting_segments(segments.ends, segments.uv_ids, charts, apartness.keep_apart, apartness.gap_uv)
    if apartness.keep_apart:
        _, one = np.unique(charts, return_index=True)  # a point for each chart will do where no outlines meet
        points = np.ascontiguousarray(segments.ends[one, 0])
        bad |= find_swept_runs(joint, segments.first, segments.last, segments.sides, charts, points, charts[one])
    is_bad = np.zeros(len(kept), bool)
    is_bad[segments.first[bad]] = True
    before, _ = run_ends(kept)
    return is_bad[before] & ~kept


def tighten_limits(limits_uv: Floats, joint: Floats, moved: Floats, kept: Bools, spoiled: Bools) -> Floats:
    """Allow spoiled points half of what the farthest of them moved on their run, where that is not next to nothing.

    Parameters
    ----------
    limits_uv : (P,) float64
        How far every point might move.
    joint, moved : (P, 4) float64
        Points before and after.
    kept, spoiled : (P,) bool

    Returns
    -------
    (P,) float64
    """
    points = np.flatnonzero(spoiled)
    run = run_ends(kept)[0][points]
    farthest = np.zeros(len(kept))
    np.maximum.at(farthest, run, np.linalg.norm(moved[points] - joint[points], axis=1))
    half = 0.5 * farthest[run]
    result = limits_uv.copy()
    result[points] = np.where(
        half > LEAST_LIMIT * limits_uv[points], np.minimum(half, limits_uv[points]), limits_uv[points]
    )
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
        result: NDArray[np.int64] = edge * (2 * len(kept)) + run_sides[slot]
        return result

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
