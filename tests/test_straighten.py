"""Straightening: what must hold of every result, on surfaces that are hard for it in different ways."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest

from preprocess.errors import InputError
from preprocess.mesh.edges import chart_of_faces
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten import straighten
from preprocess.straighten.chains import find_chains
from preprocess.straighten.driver import Straightened
from preprocess.straighten.overlap import find_meeting_segments
from preprocess.straighten.runs import run_segments
from preprocess.straighten.simplify import chain_extents_uv, joint_points, run_ends
from tests.builders_straighten import moebius, random_charts, ring_in_square, tube, two_charts, weld_uvs, with_dart

FAMILY: dict[str, Callable[[], TexturedSurface]] = {
    "two charts": two_charts,
    "two charts, much crooked": lambda: two_charts(20, 0.06, 3),
    "two charts, one mirrored": lambda: two_charts(mirrored=True),
    "tube": tube,
    "closed loop": ring_in_square,
    "moebius": moebius,
    "dart": with_dart,
}
TOLERANCES = (0.01, 0.05, 0.3)
CASES = [(name, tolerance) for name in FAMILY for tolerance in TOLERANCES]


def signed_area(surface: TexturedSurface, face: int) -> Fraction:
    """Exact: rationals of the very numbers."""
    (ax, ay), (bx, by), (cx, cy) = (
        (Fraction(float(u)), Fraction(float(v))) for u, v in surface.uvs[surface.face_uvs[face]]
    )
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def signed_areas(surface: TexturedSurface) -> np.ndarray:
    p, q, r = surface.uvs[surface.face_uvs].transpose(1, 0, 2)
    return ((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0]) / 2


def check_everything(before: TexturedSurface, result: Straightened, tolerance: float) -> None:
    """All that straightening promises."""
    after, chains = result.surface, result.chains
    after.validate()
    check_runs(result)
    check_no_folds(before, result)
    check_split(before, result)
    # Nothing on the silhouette moved farther than the tolerance allows.
    old = joint_points(chains, before.uvs)
    moved = np.linalg.norm(joint_points(chains, after.uvs) - old, axis=1)
    limit = tolerance * chain_extents_uv(chains, old)
    assert (moved <= limit[chains.point_chains] * (1 + 1e-9) + 1e-15).all()
    assert (moved[result.kept] == 0.0).all()
    # A chart's area changes by no more than its outline times the tolerance.
    charts = chart_of_faces(before)
    new_charts = charts[result.split.face_source]
    area = np.bincount(charts, np.abs(signed_areas(before)))
    new_area = np.bincount(new_charts, np.abs(signed_areas(after)))
    uv_charts = np.zeros(len(before.uvs), int)
    uv_charts[before.face_uvs] = charts[:, None]
    for chart in range(len(area)):
        bound = sum(
            limit[c] * np.linalg.norm(np.diff(old[low:high, 2 * side : 2 * side + 2], axis=0), axis=1).sum()
            for c, (low, high) in enumerate(itertools.pairwise(chains.offsets))
            for side in range(2)
            if chains.uv_ids[low, side] >= 0 and uv_charts[chains.uv_ids[low, side]] == chart
        )
        assert abs(new_area[chart] - area[chart]) <= 2 * bound + 1e-12
    # No two runs meet, within a chart or between charts.
    runs = run_segments(chains, joint_points(chains, after.uvs), result.kept)
    assert not find_meeting_segments(runs.ends, runs.uv_ids, uv_charts[runs.uv_ids[:, 0]], True).any()


def check_runs(result: Straightened) -> None:
    """Every removed point is on its run on both sides, at the same fraction, in order."""
    chains, uvs = result.chains, result.surface.uvs
    before, after = run_ends(result.kept)
    removed = np.flatnonzero(~result.kept)
    fractions = []
    for side in range(2):
        here = removed[chains.uv_ids[removed, side] >= 0]
        p, a, b = (uvs[chains.uv_ids[i, side]] for i in (here, before[here], after[here]))
        along, offset = b - a, p - a
        length_sq = (along**2).sum(axis=1)
        assert (length_sq > 0).all()
        cross = along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]
        assert (np.abs(cross) <= 1e-9 * length_sq).all(), "collinear"
        fraction = np.full(len(chains.vertices), np.nan)
        fraction[here] = (offset * along).sum(axis=1) / length_sq
        fractions.append(fraction)
    both = removed[(chains.uv_ids[removed] >= 0).all(axis=1)]
    assert np.abs(fractions[0][both] - fractions[1][both]).max(initial=0.0) <= 1e-9, "ratios agree"
    for low, high in itertools.pairwise(chains.offsets):
        position = before[low:high] + result.fractions[low:high]
        assert (np.diff(position) > 0).all(), "points stay in order"


def check_no_folds(before: TexturedSurface, result: Straightened) -> None:
    charts = chart_of_faces(before)
    areas = signed_areas(before)
    sign = np.sign(np.bincount(charts, areas))
    assert (areas * sign[charts] > 0).all(), "the builder's own uvs are sound"
    new_charts = charts[result.split.face_source]
    for face in range(len(result.surface.faces)):
        assert signed_area(result.surface, face) * int(sign[new_charts[face]]) > 0
    assert result.folded == 0


def check_split(before: TexturedSurface, result: Straightened) -> None:
    """The split surface is the old one: every new corner lies where its weights say, in space and in uv."""
    split = result.split
    for points, ids, old_points, old_ids in (
        (split.surface.positions, split.surface.faces, before.positions, before.faces),
        (split.surface.uvs, split.surface.face_uvs, before.uvs, before.face_uvs),
    ):
        expected = np.einsum("fck,fkd->fcd", split.corner_weights, old_points[old_ids[split.face_source]])
        np.testing.assert_allclose(points[ids], expected, atol=1e-14)
    assert len(find_seams(split.surface).vertices) == len(find_seams(before).vertices)


@pytest.mark.parametrize(("name", "tolerance"), CASES)
def test_promises(name: str, tolerance: float) -> None:
    surface = FAMILY[name]()
    copies = [a.copy() for a in (surface.positions, surface.faces, surface.uvs, surface.face_uvs)]
    result = straighten(surface, tolerance)
    check_everything(surface, result, tolerance)
    for copy, array in zip(copies, (surface.positions, surface.faces, surface.uvs, surface.face_uvs), strict=True):
        np.testing.assert_array_equal(copy, array)


@pytest.mark.parametrize("seed", range(24))
def test_promises_on_random_charts(seed: int) -> None:
    surface = random_charts(seed)
    tolerance = (0.005, 0.05, 0.4)[seed % 3]
    bound = (1.3, 4.0, 50.0)[seed % 5 % 3]
    result = straighten(surface, tolerance, most_distortion=bound)
    check_everything(surface, result, tolerance)
    assert result.distortion <= bound


@pytest.mark.parametrize("name", FAMILY)
def test_enough_tolerance_straightens_nearly_everything(name: str) -> None:
    """The crooks are small against 0.3 of the chains' boxes, so runs are few and nearly all length is in long ones."""
    result = straighten(FAMILY[name](), 0.3)
    assert result.num_runs <= 0.3 * result.num_edges + 6
    assert result.collapsible_fraction > 0.9


def test_cut_becomes_one_run() -> None:
    """A crooked cut from border to border, ends on one line: one run, all of it collapsible, and corners stay."""
    surface = two_charts(wave=0.02)
    result = straighten(surface, 0.1)
    seam_runs = result.kept[result.chains.uv_ids[:, 1] >= 0].sum() - 1
    assert seam_runs == 1
    assert find_chains(surface).is_seam.sum() == 1


def test_zero_tolerance_changes_nothing() -> None:
    surface = two_charts()
    result = straighten(surface, 0.0)
    np.testing.assert_array_equal(result.surface.uvs, surface.uvs)
    np.testing.assert_array_equal(result.surface.face_uvs, surface.face_uvs)
    assert result.num_runs == result.num_edges
    assert result.collapsible_fraction == 0.0


def test_straight_seams_stay_where_they_are() -> None:
    """Straight and matched already: every vertex may go, none has to move."""
    surface = two_charts(wave=0.0)
    result = straighten(surface, 0.01)
    np.testing.assert_allclose(result.surface.uvs[: len(surface.uvs)], surface.uvs, atol=1e-12)
    assert result.collapsible_fraction == 1.0
    assert result.num_runs == 7  # the cut, and three sides of either half


def test_uneven_ratios_are_evened() -> None:
    """One side's points bunched up: both sides are straight already, yet no vertex could collapse before."""
    surface = two_charts(wave=0.0)
    uvs = surface.uvs.copy()
    seams = find_seams(surface)
    side = np.unique(seams.uv_pairs[:, 1])
    v = (uvs[side, 1] - 0.05) / 0.9
    uvs[side, 1] = 0.05 + 0.9 * (v + 0.02 * np.sin(2 * np.pi * v))
    bunched = TexturedSurface(surface.positions, surface.faces, uvs, surface.face_uvs)
    result = straighten(bunched, 0.1)
    check_everything(bunched, result, 0.1)
    assert result.kept[result.chains.uv_ids[:, 1] >= 0].sum() == 2


def test_ears_are_split_and_no_corners() -> None:
    """A fan of ears along a crooked edge: each tip would flatten its triangle; the edge behind it is split instead."""
    num = 6
    base = np.stack([np.arange(num + 1.0), np.zeros(num + 1)], axis=1)
    tips = np.stack([np.arange(num) + 0.5, np.full(num, 0.05)], axis=1)
    top = np.array([[num / 2, -4.0]])
    flat = np.concatenate([base, tips, top]) / (2 * num) + 0.4
    faces = [[i, i + 1, num + 1 + i] for i in range(num)] + [[i + 1, i, 2 * num + 1] for i in range(num)]
    surface = weld_uvs(np.column_stack([flat, 0 * flat[:, 0]]), np.array(faces, np.int32), flat[np.array(faces)])
    result = straighten(surface, 0.05, most_distortion=1e6)
    check_runs(result)
    check_no_folds(surface, result)
    assert result.split.num_edges >= num
    assert result.num_runs == 3


@pytest.mark.parametrize("wave", [0.0, 0.02, 0.05])
def test_loops_keep_three_points(wave: float) -> None:
    result = straighten(ring_in_square(wave=wave), 0.9, most_distortion=1e6)
    for c in np.flatnonzero(result.chains.is_loop):
        low, high = result.chains.offsets[c : c + 2]
        assert result.kept[low : high - 1].sum() >= 3
    check_no_folds(ring_in_square(wave=wave), result)


def test_lens_keeps_its_area() -> None:
    """Two chains between the same two corners may not both become the one segment between them."""
    t = np.linspace(0.0, 1.0, 9)
    upper = np.stack([t, 0.02 * np.sin(np.pi * t)], axis=1)
    lower = np.stack([t, -0.02 * np.sin(np.pi * t)], axis=1)[1:-1]
    flat = 0.1 + 0.8 * np.concatenate([upper, lower])
    low = np.r_[0, np.arange(9, 16), 8]
    quads = [(low[i], low[i + 1], i + 1, i) for i in range(8)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d)) if len(set(f)) == 3], np.int32)
    surface = weld_uvs(np.column_stack([flat, 0 * flat[:, 0]]), faces, flat[faces])
    result = straighten(surface, 0.5, most_distortion=1e6)
    check_no_folds(surface, result)
    assert result.num_runs >= 3


@pytest.mark.parametrize("num_faces", [0, 1, 2])
def test_tiniest_surfaces(num_faces: int) -> None:
    flat = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)[:num_faces]
    surface = TexturedSurface(np.column_stack([flat, [0.0] * 4]), faces, flat, faces)
    result = straighten(surface, 0.5)
    assert len(result.surface.faces) >= num_faces
    if num_faces:
        check_runs(result)
        check_no_folds(surface, result)
        assert result.num_runs == 3 if num_faces == 1 else result.num_runs in (3, 4)


def test_no_silhouette_at_all() -> None:
    """A closed surface with continuous uvs has nothing to straighten (and folds that are not ours)."""
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    uvs = np.array([[0.3, 0.3], [0.9, 0.1], [0.1, 0.9], [0.4, 0.45]])
    result = straighten(TexturedSurface(positions, faces, uvs, faces))
    assert result.num_edges == result.num_runs == 0
    assert result.collapsible_fraction == 1.0


def test_thousands_of_tiny_charts() -> None:
    """Every triangle its own chart: all is corner, all is kept, in bounded time."""
    base = two_charts(32, 0.0)
    corner = base.uvs[base.face_uvs]
    uvs = (0.9 * corner + 0.1 * corner.mean(axis=1, keepdims=True)).reshape(-1, 2)
    face_uvs = np.arange(len(uvs), dtype=np.int32).reshape(-1, 3)
    result = straighten(TexturedSurface(base.positions, base.faces, uvs, face_uvs), 0.05)
    np.testing.assert_array_equal(result.surface.uvs, uvs)
    assert result.floor_faces == len(base.faces)


def test_degenerate_uvs_end() -> None:
    """All uvs one point, or folded over: nothing hangs, nothing is worse than before."""
    base = two_charts(6)
    for uvs in (np.full_like(base.uvs, 0.5), base.uvs[::-1].copy()):
        folded = TexturedSurface(base.positions, base.faces, uvs, base.face_uvs)
        result = straighten(folded, 0.05)
        result.surface.validate()


def test_overlapping_charts_do_not_hold_each_other_back() -> None:
    """Two charts on one another (a mirrored half) are straightened as if alone."""
    apart = two_charts(wave=0.02)
    charts = chart_of_faces(apart)
    uvs = apart.uvs.copy()
    uvs[np.unique(apart.face_uvs[charts == 1])] -= (0.4, 0.0)
    result = straighten(TexturedSurface(apart.positions, apart.faces, uvs, apart.face_uvs), 0.1)
    assert result.num_runs == straighten(apart, 0.1, keep_packing=False).num_runs


def test_neighbours_keep_charts_apart() -> None:
    """A chart that lies in another one's bay keeps the bay from being straightened over it."""
    cells = 16
    bay = two_charts(cells, 0.0)
    uvs = bay.uvs.copy()
    seams = find_seams(bay)
    right = np.unique(seams.uv_pairs[:, 1])
    is_right = uvs[:, 0] > uvs[right, 0].min() - 1e-9
    ramp = 1.0 - (uvs[is_right, 0] - uvs[right, 0].min()) / 0.2
    uvs[is_right, 0] += 0.15 * ramp.clip(0.0, 1.0) * np.sin(np.pi * (uvs[is_right, 1] - 0.05) / 0.9)
    chip = np.array([[0.78, 0.45], [0.84, 0.5], [0.78, 0.55]])
    surface = TexturedSurface(
        np.concatenate([bay.positions, [[5.0, 0, 0], [6, 0, 0], [5, 1, 0]]]),
        np.concatenate([bay.faces, [np.arange(3) + len(bay.positions)]]).astype(np.int32),
        np.concatenate([uvs, chip]),
        np.concatenate([bay.face_uvs, [np.arange(3) + len(uvs)]]).astype(np.int32),
    )
    free = straighten(surface, 0.2, keep_packing=False, most_distortion=1e6)
    kept = straighten(surface, 0.2, most_distortion=1e6)
    check_no_folds(surface, kept)
    assert free.kept[free.chains.uv_ids[:, 1] >= 0].sum() == 2
    assert kept.kept[kept.chains.uv_ids[:, 1] >= 0].sum() > 2
    charts = np.zeros(len(surface.uvs), int)
    charts[surface.face_uvs] = chart_of_faces(surface)[:, None]
    runs = run_segments(kept.chains, joint_points(kept.chains, kept.surface.uvs), kept.kept)
    assert not find_meeting_segments(runs.ends, runs.uv_ids, charts[runs.uv_ids[:, 0]], True).any()
    inside = [c for c in range(2) if _holds(kept.surface, chart_of_faces(kept.surface) == c, chip.mean(axis=0))]
    assert not inside


def _holds(surface: TexturedSurface, faces: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point lies in one of some faces."""
    p, q, r = surface.uvs[surface.face_uvs[faces]].transpose(1, 0, 2) - point
    sides = np.stack([a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] for a, b in ((p, q), (q, r), (r, p))])
    return bool(((sides > 0).all(axis=0) | (sides < 0).all(axis=0)).any())


def test_distortion_is_bounded() -> None:
    surface = two_charts(20, 0.06, 3)
    loose = straighten(surface, 0.3, most_distortion=100.0)
    tight = straighten(surface, 0.3, most_distortion=1.5)
    assert tight.distortion <= 1.5
    assert tight.num_runs >= loose.num_runs


def test_same_bytes_every_time() -> None:
    first, second = (straighten(tube(24, 8, 0.02), 0.03).surface.uvs.tobytes() for _ in range(2))
    assert first == second


@pytest.mark.parametrize("tolerance", [-0.1, np.nan, np.inf])
def test_refuses_bad_tolerance(tolerance: float) -> None:
    with pytest.raises(ValueError, match="tolerance_rel"):
        straighten(two_charts(), tolerance)
    with pytest.raises(ValueError, match="most_distortion"):
        straighten(two_charts(), 0.01, most_distortion=1.0)


def test_refuses_edges_of_three_faces() -> None:
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]], np.int32)
    with pytest.raises(InputError, match="three or more faces"):
        straighten(TexturedSurface(positions, faces, positions[:, :2].copy(), faces))
