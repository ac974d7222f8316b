"""Straightens the seams of a parametrisation so that they can be decimated (paper, section 6).

silhouette > chains > runs (joint simplification, no crossings) > split edges > fold-free interior.

Where a run crosses another one, or leaves a face folded or badly distorted, the tolerance is halved for the points near
there alone. (The paper's authors halve a whole chart's.) In the limit that restores the outline as it was, so that the
loop ends.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats, Ints
from preprocess.mesh.edges import chart_of_faces
from preprocess.mesh.split_edges import EdgeSplit, split_edges
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten.chains import Chains, find_chains
from preprocess.straighten.remap import (
    LEAST_AREA,
    find_rest_shapes,
    relative_areas,
    remap_interior,
    shape_distortions,
)
from preprocess.straighten.runs import (
    edge_lengths_m,
    find_apartness,
    find_crossing_points,
    find_edges_in_long_runs,
    find_edges_on_one_run,
    find_points_near_faces,
    interior_edges,
    tighten_limits,
)
from preprocess.straighten.simplify import chain_extents_uv, joint_points, simplify_chains, straight_points

log = logging.getLogger(__name__)

DEFAULT_TOLERANCE_REL = 0.01  # the paper's, of the diagonal of a component's bounding box
DEFAULT_DISTORTION = 4.0  # a face may become eight times as long as wide, measured against its shape before
DEFAULT_GAP_UV = 1.0 / 64.0  # four texels at 256 a side, the least that geometry gets: a bilinear cell on either side
MOST_ROUNDS = 40  # of halving tolerances
LAST_ROUNDS = 4  # of them, in which everything near a fault stays, and then everything
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
    floor_faces : int
        Faces that remain when every run is one edge and no chart has a vertex inside: what decimation can reach.
    collapsible_fraction : float
        Share of the silhouette's length in space that lies in runs of two edges or more; 1 without silhouette.
    reduced_charts : (R,) int32
        Charts (of `chart_of_faces`) where the tolerance was reduced because of a crossing, a fold or distortion.
    distortion : float
        Largest |J|² / (2 det J) of a face against its shape before: 1 where angles are kept.
    folded : int
        Faces that are folded or have no area in uv; they were before.
    """

    surface: TexturedSurface
    split: EdgeSplit
    chains: Chains
    kept: Bools
    fractions: Floats
    num_runs: int
    num_edges: int
    floor_faces: int
    collapsible_fraction: float
    reduced_charts: Ints
    distortion: float
    folded: int


@dataclass(frozen=True)
class _Remapped:
    """One attempt: the split, the new uvs (T', 2), and the faces (F',) with the worst of what was done to them."""

    split: EdgeSplit
    uvs: Floats
    is_folded: Bools
    is_bad: Bools
    distortion: float


def straighten(
    surface: TexturedSurface,
    tolerance_rel: float = DEFAULT_TOLERANCE_REL,
    *,
    keep_packing: bool = True,
    gap_uv: float = DEFAULT_GAP_UV,
    most_distortion: float = DEFAULT_DISTORTION,
    most_rounds: int = MOST_ROUNDS,
) -> Straightened:
    """Make seams and boundaries straight where they nearly are, equally on both sides.

    Parameters
    ----------
    surface : TexturedSurface
        Edge-manifold. Faces that are folded or have no area in uv stay so.
    tolerance_rel : float
        Farthest that a silhouette vertex may move in the joint uv space of its copies, as a fraction of the diagonal
        of its chain's bounding box there. 0 leaves the uvs alone.
    keep_packing : bool
        Keep charts apart that are apart now. Give False where they are packed anew afterwards.
    gap_uv : float
        Least distance between two charts that is kept then, or what the layout has where that is less.
    most_distortion : float
        Bound of |J|² / (2 det J) of every face against its shape before, 1 and up; 4 is a stretch of about 8 to 1.
    most_rounds : int
        Of halving tolerances; what is then still at fault stays as it was.

    Returns
    -------
    Straightened
        No face is folded that was not before.

    Raises
    ------
    ValueError
        If the tolerance is negative or the distortion not above 1.
    InputError
        If an edge has three or more faces.

    References
    ----------
    Liu, Ferguson, Jacobson, Gingold 2017: Seamless, section 6.
    """
    if not (np.isfinite(tolerance_rel) and tolerance_rel >= 0.0):
        raise ValueError(f"tolerance_rel must be a finite number of at least 0, not {tolerance_rel}")
    if not most_distortion > 1.0:
        raise ValueError(f"most_distortion must be above 1, not {most_distortion}")
    chains = find_chains(surface)
    joint = joint_points(chains, surface.uvs)
    limits = tolerance_rel * chain_extents_uv(chains, joint)[chains.point_chains]
    face_charts = chart_of_faces(surface)
    uv_charts = np.zeros(len(surface.uvs), np.int64)
    uv_charts[surface.face_uvs] = face_charts[:, None]
    apartness = find_apartness(chains, surface.uvs, uv_charts, keep_packing, gap_uv)

    must_keep = np.zeros(len(joint), bool)
    must_keep[chains.offsets[:-1]] = must_keep[chains.offsets[1:] - 1] = True
    must_keep |= tolerance_rel == 0.0
    reduced = np.zeros(len(joint), bool)
    kept, fractions = np.ones(len(joint), bool), np.zeros(len(joint))
    pending = np.ones(chains.num_chains, bool)
    guess = surface.uvs
    for round_number in range(most_rounds):
        kept, fractions = simplify_chains(chains, joint, limits, must_keep, kept, fractions, pending)
        moved = straight_points(joint, kept, fractions)
        spoiled = find_crossing_points(chains, joint, moved, kept, apartness)
        if not spoiled.any():
            result = _remap(surface, chains, moved, kept, most_distortion, guess)
            guess = result.uvs[: len(guess)]
            if not result.is_bad.any() or kept.all():
                break
            bad_faces = np.unique(result.split.face_source[result.is_bad]).astype(np.int64)
            spoiled = find_points_near_faces(surface, chains, kept, bad_faces)
        tightened = tighten_limits(limits, joint, moved, kept, spoiled)
        reduced |= spoiled
        must_keep = must_keep | (spoiled & (tightened >= limits))
        limits = tightened
        if round_number >= most_rounds - LAST_ROUNDS:
            must_keep |= spoiled if round_number < most_rounds - 2 else ~kept
        pending = np.zeros(chains.num_chains, bool)
        pending[chains.point_chains[spoiled]] = True
    reduced_ids = chains.uv_ids[reduced]
    return _describe(surface, chains, kept, fractions, result, uv_charts[reduced_ids[reduced_ids >= 0]])


def _remap(
    surface: TexturedSurface, chains: Chains, moved: Floats, kept: Bools, most_distortion: float, guess: Floats
) -> _Remapped:
    """Split the edges that would lose their face, then move the interior, from a guess (T, 2)."""
    goal = guess.copy()
    fixed = np.zeros(len(goal), bool)
    for side in range(2):
        has = chains.uv_ids[:, side] >= 0
        goal[chains.uv_ids[has, side]] = moved[has, 2 * side : 2 * side + 2]
        fixed[chains.uv_ids[has, side]] = True
    edges = find_edges_on_one_run(surface, chains, kept, fixed)
    cornered = np.flatnonzero(fixed[surface.face_uvs].all(axis=1))
    thin = cornered[relative_areas(surface, goal, find_rest_shapes(surface))[cornered] < THIN_AREA]
    edges = np.concatenate([edges, interior_edges(surface, chains, thin)])
    split = split_edges(surface, edges)
    added = split.surface.uvs[len(fixed) :]
    goal = np.concatenate([goal, added])
    fixed = np.concatenate([fixed, np.zeros(len(added), bool)])
    rest = find_rest_shapes(split.surface)
    uvs = remap_interior(split.surface, goal, fixed, rest)
    is_folded = relative_areas(split.surface, uvs, rest) < LEAST_AREA
    shape = shape_distortions(split.surface, uvs, rest)
    is_bad = (is_folded | (shape > most_distortion)) & ~rest.was_folded
    return _Remapped(split, uvs, is_folded, is_bad, float(shape[~rest.was_folded].max(initial=1.0)))


def _describe(
    surface: TexturedSurface,
    chains: Chains,
    kept: Bools,
    fractions: Floats,
    remapped: _Remapped,
    reduced_charts: NDArray[np.int64],
) -> Straightened:
    """The result with its figures."""
    lengths_m = edge_lengths_m(chains, surface.positions)
    total_m = float(lengths_m.sum())
    straight_m = float(lengths_m[find_edges_in_long_runs(chains, kept)].sum())
    new = remapped.split.surface
    result = Straightened(
        surface=TexturedSurface(new.positions, new.faces, remapped.uvs, new.face_uvs),
        split=remapped.split,
        chains=chains,
        kept=kept,
        fractions=fractions,
        num_runs=int(kept.sum()) - chains.num_chains,
        num_edges=len(lengths_m),
        floor_faces=_count_floor_faces(surface, chains, kept),
        collapsible_fraction=straight_m / total_m if total_m > 0.0 else 1.0,
        reduced_charts=np.unique(reduced_charts).astype(np.int32),
        distortion=remapped.distortion,
        folded=int(remapped.is_folded.sum()),
    )
    log.info(
        "straighten: %d silhouette edges in %d straight runs (%.1f %% of the length collapsible), %d edges split, "
        "%d charts reduced, distortion up to %.1f",
        result.num_edges,
        result.num_runs,
        100.0 * result.collapsible_fraction,
        result.split.num_edges,
        len(result.reduced_charts),
        result.distortion,
    )
    return result


def _count_floor_faces(surface: TexturedSurface, chains: Chains, kept: Bools) -> int:
    """Faces of all charts when each is a polygon of its runs: corners - 2 · Euler characteristic, a chart."""
    charts = chart_of_faces(surface)
    num_charts = int(charts.max(initial=-1)) + 1
    ids = surface.face_uvs.astype(np.int64)
    ends = np.stack([ids, np.roll(ids, -1, axis=1)], axis=2)
    edges = np.unique(ends.min(axis=2) * max(len(surface.uvs), 1) + ends.max(axis=2), return_index=True)[1]
    vertices = np.unique(ids, return_index=True)[1]
    euler = (
        np.bincount(charts[vertices // 3], minlength=num_charts)
        - np.bincount(charts[edges // 3], minlength=num_charts)
        + np.bincount(charts, minlength=num_charts)
    )
    uv_charts = np.zeros(len(surface.uvs), np.int64)
    uv_charts[ids] = charts[:, None]
    starts = kept.copy()
    starts[chains.offsets[1:] - 1] = False
    runs = chains.uv_ids[starts]
    corners = np.bincount(uv_charts[runs[runs >= 0]], minlength=num_charts)
    return int(np.maximum(corners - 2 * euler, np.where(corners > 0, 1, 4)).sum())
