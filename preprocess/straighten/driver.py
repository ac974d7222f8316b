"""Straightens the seams of a parametrisation so that they can be decimated (paper, section 6).

silhouette > chains > runs (joint simplification, no crossings) > split edges > fold-free interior.

Where a run crosses another one or leaves a fold, its tolerance is given up locally: the point that moved farthest stays
and the run becomes two. In the limit that restores the chart's own outline, so that the loop ends.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.mesh import Floats, Ints, TexturedSurface
from preprocess.split_edges import EdgeSplit, split_edges
from preprocess.straighten.chains import Chains, find_chains
from preprocess.straighten.overlap import find_meeting_segments
from preprocess.straighten.remap import chart_of_faces, find_rest_shapes, relative_areas, remap_interior
from preprocess.straighten.simplify import (
    chain_extents_uv,
    joint_points,
    run_ends,
    simplify_chains,
    straight_points,
)

log = logging.getLogger(__name__)

Bools = NDArray[np.bool_]

DEFAULT_TOLERANCE_REL = 0.01  # the paper's, of the diagonal of a component's bounding box
MOST_ROUNDS = 24  # of giving points back; what still fails then keeps its whole outline
THIN_AREA = 0.05  # of its rest area: a triangle with three fixed corners below gets free ones


@dataclass(frozen=True)
class Straightened:
    """A surface whose seams run straight, with how it came about.

    Attributes
    ----------
    surface : TexturedSurface
        New uvs; where edges were split, more vertices and faces (the input's come first, in order).
    split : EdgeSplit
        Where new faces, corners and vertices come from; its surface has the uvs as they were, at the new vertices too.
    chains : Chains
        The silhouette paths (they are those of both surfaces).
    kept : (P,) bool
        Points of the chains that are ends of straight runs.
    fractions : (P,) float64
        Where a removed point lies on its run, the same on both sides.
    num_runs : int
        Straight runs over all chains: the fewest segments that decimation can leave.
    num_edges : int
        Silhouette edges.
    collapsible_fraction : float
        Share of the silhouette's length in space that lies in runs of two edges or more; 1 without silhouette.
    reduced_charts : (R,) int32
        Charts (of `chart_of_faces`) where points were given back because of a fold or a crossing.
    """

    surface: TexturedSurface
    split: EdgeSplit
    chains: Chains
    kept: Bools
    fractions: Floats
    num_runs: int
    num_edges: int
    collapsible_fraction: float
    reduced_charts: Ints


def straighten(
    surface: TexturedSurface, tolerance_rel: float = DEFAULT_TOLERANCE_REL, *, keep_packing: bool = True
) -> Straightened:
    """Make seams and boundaries straight where they nearly are, equally on both sides.

    Parameters
    ----------
    surface : TexturedSurface
        Edge-manifold. Folded uvs are unfolded as far as possible.
    tolerance_rel : float
        Farthest that a silhouette vertex may move in the joint uv space of its copies, as a fraction of the diagonal
        of its chain's bounding box there. 0 leaves the uvs alone.
    keep_packing : bool
        Keep charts apart that are apart now. Give False where they are packed anew afterwards.

    Returns
    -------
    Straightened
        No face is folded that was not before.

    Raises
    ------
    ValueError
        If the tolerance is negative or not finite.
    InputError
        If an edge has three or more faces.

    References
    ----------
    Liu, Ferguson, Jacobson, Gingold 2017: Seamless, section 6.
    """
    if not (np.isfinite(tolerance_rel) and tolerance_rel >= 0.0):
        raise ValueError(f"tolerance_rel must be a finite number of at least 0, not {tolerance_rel}")
    chains = find_chains(surface)
    joint = joint_points(chains, surface.uvs)
    limits = tolerance_rel * chain_extents_uv(chains, joint)
    face_charts = chart_of_faces(surface)
    uv_charts = np.zeros(len(surface.uvs), np.int64)
    uv_charts[surface.face_uvs] = face_charts[:, None]
    groups = np.zeros_like(uv_charts) if keep_packing and not _charts_meet(chains, surface.uvs) else uv_charts

    must_keep = np.zeros(len(joint), bool)
    must_keep[chains.offsets[:-1]] = must_keep[chains.offsets[1:] - 1] = True
    ends = must_keep.copy()
    if tolerance_rel == 0.0:
        must_keep[:] = True
    kept, fractions = np.ones(len(joint), bool), np.zeros(len(joint))
    todo = np.ones(chains.num_chains, bool)
    given_back = np.zeros(len(joint), bool)
    for round_number in range(MOST_ROUNDS):
        kept, fractions = simplify_chains(chains, joint, limits, must_keep, kept, fractions, todo)
        moved = straight_points(joint, kept, fractions)
        bad = _crossing_points(chains, moved, kept, groups)
        if not bad.any():
            split, uvs, folded_uvs = _remap(surface, chains, moved, kept)
            bad = _points_near_folds(chains, kept, folded_uvs, uv_charts)
            if not bad.any():
                break
        back = bad if round_number >= MOST_ROUNDS - 4 else _farthest_points(joint, moved, kept, bad)
        given_back |= back
        must_keep |= back
        todo = np.zeros(chains.num_chains, bool)
        todo[chains.point_chains[back]] = True
    else:
        raise AssertionError("giving points back did not restore the outline")

    edge_runs = _edges_in_long_runs(chains, kept)
    lengths = _edge_lengths(chains, surface.positions)
    total = float(lengths.sum())
    result = Straightened(
        surface=TexturedSurface(split.surface.positions, split.surface.faces, uvs, split.surface.face_uvs),
        split=split,
        chains=chains,
        kept=kept,
        fractions=fractions,
        num_runs=int(kept.sum()) - chains.num_chains,
        num_edges=len(lengths),
        collapsible_fraction=float(lengths[edge_runs].sum()) / total if total > 0.0 else 1.0,
        reduced_charts=np.unique(uv_charts[chains.uv_ids[given_back & ~ends, 0]]).astype(np.int32),
    )
    log.info(
        "straighten: %d silhouette edges in %d straight runs, %.1f %% of the length collapsible, %d edges split, "
        "%d charts reduced",
        result.num_edges,
        result.num_runs,
        100.0 * result.collapsible_fraction,
        split.num_edges,
        len(result.reduced_charts),
    )
    return result


def _inner_edges(chains: Chains) -> NDArray[np.int64]:
    """First point of every silhouette edge: all points but the last of each chain."""
    last = np.zeros(len(chains.vertices), bool)
    last[chains.offsets[1:] - 1] = True
    return np.flatnonzero(~last)


def _edge_lengths(chains: Chains, positions: Floats) -> Floats:
    """Lengths of the silhouette edges in space, in the order of the points, (E,) float64 metres."""
    first = _inner_edges(chains)
    return np.linalg.norm(positions[chains.vertices[first + 1]] - positions[chains.vertices[first]], axis=1)


def _edges_in_long_runs(chains: Chains, kept: Bools) -> Bools:
    """Which silhouette edges lie in runs of two edges or more, (E,) bool."""
    first = _inner_edges(chains)
    return ~(kept[first] & kept[first + 1])


def _silhouette_segments(
    chains: Chains, moved: Floats, kept: Bools
) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
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


def _charts_meet(chains: Chains, uvs: Floats) -> bool:
    """Whether silhouettes cross in the input already: such a layout is no one-to-one map that could be kept."""
    whole = np.ones(len(chains.vertices), bool)
    ends, ids, _ = _silhouette_segments(chains, joint_points(chains, uvs), whole)
    return bool(find_meeting_segments(ends, ids, np.zeros(len(ids), np.int64)).any())


def _crossing_points(chains: Chains, moved: Floats, kept: Bools, groups: NDArray[np.int64]) -> Bools:
    """Removed points of the runs that meet another run of their group, (P,) bool."""
    ends, ids, firsts = _silhouette_segments(chains, moved, kept)
    meets = find_meeting_segments(ends, ids, groups[ids[:, 0]])
    bad_first = np.zeros(len(kept), bool)
    bad_first[firsts[meets]] = True
    before, _ = run_ends(kept)
    return bad_first[before] & ~kept


def _farthest_points(joint: Floats, moved: Floats, kept: Bools, bad: Bools) -> Bools:
    """Of every run with bad points, the one that moved farthest, (P,) bool."""
    points = np.flatnonzero(bad)
    distance = np.linalg.norm(moved[points] - joint[points], axis=1)
    run = run_ends(kept)[0][points]
    order = np.lexsort((points, -distance, run))
    first = np.r_[True, run[order][1:] != run[order][:-1]]
    result = np.zeros(len(kept), bool)
    result[points[order][first]] = True
    return result


def _remap(surface: TexturedSurface, chains: Chains, moved: Floats, kept: Bools) -> tuple[EdgeSplit, Floats, Ints]:
    """Split the edges that would lose their face, then move the interior.

    Returns the split, the new uvs (T', 2), and the texture vertices of faces that remain folded (N,).
    """
    boundary = surface.uvs.copy()
    fixed = np.zeros(len(boundary), bool)
    for side in range(2):
        has = chains.uv_ids[:, side] >= 0
        boundary[chains.uv_ids[has, side]] = moved[has, 2 * side : 2 * side + 2]
        fixed[chains.uv_ids[has, side]] = True
    edges = _edges_on_one_run(surface, chains, kept, fixed)
    thin = fixed[surface.face_uvs].all(axis=1)
    thin[thin] = relative_areas(surface, boundary, find_rest_shapes(surface))[thin] < THIN_AREA
    edges = np.concatenate([edges, _interior_edges(surface, chains, np.flatnonzero(thin))])
    split = split_edges(surface, edges)
    added = len(split.surface.uvs) - len(fixed)
    boundary = np.concatenate([boundary, np.zeros((added, 2))])
    fixed = np.concatenate([fixed, np.zeros(added, bool)])
    rest = find_rest_shapes(split.surface)
    uvs, folded = remap_interior(split.surface, boundary, fixed, rest)
    folded &= ~rest.was_folded
    return split, uvs, np.unique(split.surface.face_uvs[folded])


def _face_edges(surface: TexturedSurface) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ends of every face's edges: surface vertices and texture vertices, each (F, 3, 2) int64."""
    corners, uv_corners = surface.faces.astype(np.int64), surface.face_uvs.astype(np.int64)
    return (
        np.stack([corners, np.roll(corners, -1, axis=1)], axis=2),
        np.stack([uv_corners, np.roll(uv_corners, -1, axis=1)], axis=2),
    )


def _silhouette_keys(chains: Chains, num_uvs: int) -> NDArray[np.int64]:
    """One number for every silhouette edge on every side, sorted."""
    first = _inner_edges(chains)
    pairs = np.concatenate([np.stack([chains.uv_ids[first, s], chains.uv_ids[first + 1, s]], axis=1) for s in (0, 1)])
    pairs = pairs[pairs[:, 0] >= 0].astype(np.int64)
    return np.unique(pairs.min(axis=1) * num_uvs + pairs.max(axis=1))


def _interior_edges(surface: TexturedSurface, chains: Chains, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Surface vertices of some faces' edges that are no silhouette, (E, 2) int64."""
    ends, uv_ends = (a[faces].reshape(-1, 2) for a in _face_edges(surface))
    keys = uv_ends.min(axis=1) * len(surface.uvs) + uv_ends.max(axis=1)
    return ends[~np.isin(keys, _silhouette_keys(chains, len(surface.uvs)))]


def _edges_on_one_run(surface: TexturedSurface, chains: Chains, kept: Bools, fixed: Bools) -> NDArray[np.int64]:
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


def _points_near_folds(chains: Chains, kept: Bools, folded_uvs: Ints, uv_charts: NDArray[np.int64]) -> Bools:
    """Removed points of the runs that touch folded faces; of the whole chart where none does. (P,) bool."""
    result = np.zeros(len(kept), bool)
    if not len(folded_uvs):
        return result
    folded_uvs = folded_uvs[folded_uvs < len(uv_charts)]
    before, _ = run_ends(kept)
    touched = np.isin(chains.uv_ids, folded_uvs).any(axis=1)
    runs = np.zeros(len(kept), bool)
    runs[before[touched]] = True
    runs[before[np.maximum(np.flatnonzero(touched) - 1, 0)]] = True
    result = runs[before] & ~kept
    charts = np.unique(uv_charts[folded_uvs])
    of_chart = np.isin(np.where(chains.uv_ids >= 0, uv_charts[chains.uv_ids], -1), charts)
    reached = np.unique(np.where(chains.uv_ids >= 0, uv_charts[chains.uv_ids], -1)[result])
    lone = np.setdiff1d(charts, reached)
    return result | (np.isin(np.where(of_chart, uv_charts[chains.uv_ids], -1), lone).any(axis=1) & ~kept)
