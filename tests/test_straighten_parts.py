"""The parts of straightening against slow twins: chains, runs, crossings, distortion energy, warp, command."""

from __future__ import annotations

import itertools
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from preprocess.__main__ import main
from preprocess.files.images import Image, read_image, write_image
from preprocess.files.obj import read_obj, write_obj
from preprocess.mesh.edges import chart_of_faces
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from preprocess.straighten import straighten
from preprocess.straighten.chains import Chains, find_chains
from preprocess.straighten.overlap import find_meeting_segments, find_swept_runs
from preprocess.straighten.remap import AREA_WEIGHT, _energy, find_rest_shapes, relative_areas
from preprocess.straighten.simplify import simplify_chains, straight_points
from preprocess.straighten.warp import find_warp
from tests.builders_straighten import moebius, ring_in_square, tube, two_charts, with_dart


def edges_of(chains: Chains) -> list[tuple[int, ...]]:
    """Every silhouette edge that the chains hold, as its two surface vertices and four texture vertices, sorted."""
    edges = []
    for low, high in itertools.pairwise(chains.offsets):
        for k in range(low, high - 1):
            sides = sorted(tuple(sorted(chains.uv_ids[[k, k + 1], s])) for s in range(2) if chains.uv_ids[k, s] >= 0)
            edges.append((*sorted(chains.vertices[[k, k + 1]]), *itertools.chain(*sides)))
    return sorted(tuple(int(i) for i in e) for e in edges)


@pytest.mark.parametrize("make", [two_charts, tube, ring_in_square, moebius, with_dart])
def test_chains_hold_every_silhouette_edge_once(make: Any) -> None:
    surface = make()
    seams, chains = find_seams(surface), find_chains(surface)
    expected = [
        (*sorted(v), *itertools.chain(*sorted(tuple(sorted(pair)) for pair in uv)))
        for v, uv in zip(seams.vertices, seams.uv_pairs, strict=True)
    ]
    expected += [(*sorted(v), *sorted(uv)) for v, uv in zip(seams.boundary_vertices, seams.boundary_uvs, strict=True)]
    assert edges_of(chains) == sorted(tuple(int(i) for i in e) for e in expected)


def test_chain_kinds() -> None:
    """Counted by hand."""
    chains = find_chains(two_charts())  # the cut, and the outline of either half
    assert sorted(chains.is_seam.tolist()) == [False, False, True]
    chains = find_chains(ring_in_square())  # the seam and the rim: both closed
    assert chains.is_loop.tolist().count(True) == 2
    assert chains.is_seam.tolist().count(True) == 1
    chains = find_chains(with_dart())  # the dart from its mouth to its tip, and the rim
    assert sorted(chains.is_seam.tolist()) == [False, True]
    assert not chains.is_loop.any()
    chains = find_chains(tube())  # the long cut in two halves, the cut around, two rims
    assert sorted(chains.is_seam.tolist()) == [False, False, True, True, True]


def slow_fewest_runs(joint: np.ndarray, limit: float, must_keep: np.ndarray) -> int:
    """Twin: least number of runs, by dynamic programming over all pairs, with the run's rule written out again."""
    n = len(joint)
    steps = np.linalg.norm(np.diff(joint, axis=0), axis=1)
    length = np.r_[0.0, np.cumsum(steps)]

    def allowed(i: int, j: int) -> bool:
        if j == i + 1:
            return True
        if must_keep[i + 1 : j].any():
            return False
        along = joint[j] - joint[i]
        for s in range(joint.shape[1] // 2):
            path = np.linalg.norm(np.diff(joint[i : j + 1, 2 * s : 2 * s + 2], axis=0), axis=1).sum()
            if np.linalg.norm(along[2 * s : 2 * s + 2]) < 0.05 * path:
                return False
        t = (joint[i : j + 1] - joint[i]) @ along / (along @ along)
        share = np.diff(length[i : j + 1]) / (length[j] - length[i])
        gap = np.diff(t)
        short = gap < 0.25 * share
        blend = ((0.25 * share - gap)[short] / (share - gap)[short]).max(initial=0.0)
        t = t + blend * ((length[i : j + 1] - length[i]) / (length[j] - length[i]) - t)
        moved = np.linalg.norm(joint[i] + t[:, None] * along - joint[i : j + 1], axis=1)
        return bool((moved[1:-1] <= limit).all())

    best = [0] + [n] * (n - 1)
    for j in range(1, n):
        best[j] = min(best[i] + 1 for i in range(j) if allowed(i, j))
    return best[-1]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("dims", [2, 4])
def test_fewest_runs(seed: int, dims: int) -> None:
    rng = np.random.default_rng(seed)
    n = 30
    joint = np.zeros((n, 4))
    joint[:, :dims] = np.cumsum(rng.uniform(-0.3, 1.0, (n, dims)), axis=0)
    keep = rng.uniform(size=n) < 0.05
    keep[[0, -1]] = True
    uv_ids = np.arange(2 * n, dtype=np.int32).reshape(n, 2)
    if dims == 2:
        uv_ids[:, 1] = -1
    chains = Chains(
        np.array([0, n], np.int32), np.arange(n, dtype=np.int32), uv_ids, np.array([dims == 4]), np.array([False])
    )
    for limit in (1e-9, 0.2, 0.6, 2.0):
        blank = np.ones(n, bool), np.zeros(n)
        kept, fractions = simplify_chains(chains, joint, np.full(n, limit), keep, *blank, np.array([True]))
        assert kept[keep].all()
        moved = straight_points(joint, kept, fractions)
        assert np.linalg.norm(moved - joint, axis=1).max() <= limit * (1 + 1e-12)
        assert kept.sum() - 1 == slow_fewest_runs(joint[:, :dims], limit, keep)


def slow_meet(p: np.ndarray, q: np.ndarray, shared: list[tuple[int, int]]) -> bool:
    """Twin in exact arithmetic: whether closed segments have a point in common besides a shared end."""
    a, b, c, d = ([Fraction(float(x)) for x in point] for point in (*p, *q))

    def turn(o: list[Fraction], u: list[Fraction], v: list[Fraction]) -> Fraction:
        return (u[0] - o[0]) * (v[1] - o[1]) - (u[1] - o[1]) * (v[0] - o[0])

    if len(shared) == 2:
        return True
    if shared:
        i, j = shared[0]
        o, u, v = (a, b)[i], (b, a)[i], (d, c)[j]
        return turn(o, u, v) == 0 and sum((u[k] - o[k]) * (v[k] - o[k]) for k in range(2)) > 0
    boxes = all(max(min(a[k], b[k]), min(c[k], d[k])) <= min(max(a[k], b[k]), max(c[k], d[k])) for k in range(2))
    return boxes and turn(a, b, c) * turn(a, b, d) <= 0 and turn(c, d, a) * turn(c, d, b) <= 0


@pytest.mark.parametrize("seed", range(6))
def test_crossings_against_exact_twin(seed: int) -> None:
    """Segments between points of a small integer grid: crossings, touches, shared ends and overlaps all happen."""
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 9, (40, 2)).astype(float)
    points = points[np.unique(points, axis=0, return_index=True)[1]]
    ids = np.array([rng.choice(len(points), 2, replace=False) for _ in range(25)])
    charts = rng.integers(0, 2, len(ids))
    for keep_apart in (False, True):
        expected = np.zeros(len(ids), bool)
        for i, j in itertools.combinations(range(len(ids)), 2):
            shared = [(a, b) for a in range(2) for b in range(2) if ids[i, a] == ids[j, b]]
            if (keep_apart or charts[i] == charts[j]) and slow_meet(points[ids[i]], points[ids[j]], shared):
                expected[[i, j]] = True
        np.testing.assert_array_equal(find_meeting_segments(points[ids], ids, charts, keep_apart), expected)
    together = np.zeros_like(charts)  # the gap is between charts alone
    alike = [find_meeting_segments(points[ids], ids, together, True, gap) for gap in (0.0, 3.0)]
    np.testing.assert_array_equal(*alike)


def test_gap_between_charts() -> None:
    ends = np.array([[[0.0, 0], [1, 0]], [[0, 0.3], [1, 0.3]], [[2.0, 0], [2, 1]]])
    ids = np.arange(6).reshape(3, 2)
    near = [find_meeting_segments(ends, ids, np.array([0, 1, 2]), True, gap).tolist() for gap in (0.29, 0.31, 1.01)]
    assert near == [[False] * 3, [True, True, False], [True] * 3]
    assert not find_meeting_segments(ends, ids, np.zeros(3, int), True, 0.31).any()


def test_swept_points() -> None:
    """A bay flattened from (0, 0)-(1, 1)-(2, 0) sweeps the points between: not its own chart's, not those outside."""
    joint = np.array([[0.0, 0, 0, 0], [1, 1, 0, 0], [2, 0, 0, 0]])
    run = (np.array([0]), np.array([2]), np.array([0]), np.array([0]))
    for point, chart, swept in (([1.0, 0.5], 1, True), ([1.0, 0.5], 0, False), ([0.2, 0.9], 1, False)):
        found = find_swept_runs(joint, *run, np.array([point]), np.array([chart]))
        assert found.tolist() == [swept]


def slow_energy(points: np.ndarray, surface: TexturedSurface, rest: Any, areas: np.ndarray, epsilon: float) -> float:
    total = 0.0
    for f, (i, j, k) in enumerate(surface.face_uvs):
        matrix = np.stack([points[j] - points[i], points[k] - points[i]], axis=1) @ rest.inverse[f]
        det = np.linalg.det(matrix)
        chi = 0.5 * (det + np.hypot(epsilon, det))
        total += areas[f] * (0.5 * (matrix**2).sum() + AREA_WEIGHT * 0.5 * (det**2 + 1.0)) / chi
    return total


@pytest.mark.parametrize("epsilon", [1e-3, 0.1])
def test_energy_and_gradient(epsilon: float) -> None:
    surface = two_charts(4)
    rest = find_rest_shapes(surface)
    rng = np.random.default_rng(1)
    points = surface.uvs + 0.01 * rng.normal(size=surface.uvs.shape)
    ids = surface.face_uvs.astype(np.int64)
    areas = np.ones(len(ids))
    gradient = np.zeros_like(points)
    energy = _energy(points, ids, rest.inverse, areas, epsilon, gradient)
    assert energy == pytest.approx(slow_energy(points, surface, rest, areas, epsilon), rel=1e-12)
    for _ in range(10):
        direction = rng.normal(size=points.shape)
        step = 1e-7
        ahead, behind = (
            _energy(points + s * direction, ids, rest.inverse, areas, epsilon, np.zeros_like(points))
            for s in (step, -step)
        )
        assert (ahead - behind) / (2 * step) == pytest.approx((gradient * direction).sum(), rel=1e-4)


def test_rest_shapes() -> None:
    """The uvs as they are have relative area one in charts of either orientation; folded faces are told."""
    for mirrored in (False, True):
        surface = two_charts(mirrored=mirrored)
        rest = find_rest_shapes(surface)
        np.testing.assert_allclose(relative_areas(surface, surface.uvs, rest), 1.0, rtol=1e-9)
        assert not rest.was_folded.any()
    uvs = surface.uvs.copy()
    inside = np.bincount(surface.face_uvs.ravel()).argmax()
    uvs[inside] += (0.0, 0.3)
    folded = TexturedSurface(surface.positions, surface.faces, uvs, surface.face_uvs)
    rest = find_rest_shapes(folded)
    assert rest.was_folded.any()
    assert (relative_areas(folded, uvs, rest)[rest.was_folded] <= 0).all()
    assert chart_of_faces(folded).max() == 1


def smooth_image(width: int, height: int) -> np.ndarray:
    v, u = np.mgrid[:height, :width] / max(width, height)
    return np.stack([0.5 + 0.5 * np.sin(20 * u + 7 * v), 0.5 + 0.4 * np.cos(25 * v) * np.sin(9 * u), u], axis=2)


@pytest.mark.parametrize("size", [(512, 512), (700, 400)])
@pytest.mark.parametrize("make", [two_charts, with_dart, ring_in_square])
def test_warped_image_agrees_on_the_surface(make: Any, size: tuple[int, int]) -> None:
    """Sampled at the same surface points, the old image in the old uvs and the warped one in the new agree."""
    surface = make()
    result = straighten(surface, 0.05)
    old, new = result.split.surface, result.surface
    assert not np.array_equal(old.uvs, new.uvs)
    image = smooth_image(*size)
    warped = find_warp(old, new, *size).apply(image)
    rng = np.random.default_rng(0)
    faces = rng.integers(0, len(new.faces), 4000)
    weights = rng.dirichlet([1.0, 1.0, 1.0], 4000)
    at_old, at_new = (np.einsum("nk,nkc->nc", weights, s.uvs[s.face_uvs[faces]]) for s in (old, new))
    difference = np.abs(sample_bilinear(image, at_old) - sample_bilinear(warped, at_new))
    assert difference.max() <= 1.0 / 255.0
    assert warped.min() >= image.min() and warped.max() <= image.max()


def test_warp_by_nothing_keeps_every_covered_texel() -> None:
    surface = two_charts()
    image = np.random.default_rng(0).uniform(size=(64, 64, 2))
    warp = find_warp(surface, surface, 64, 64)
    inside = warp.coverage.inside
    np.testing.assert_allclose(warp.apply(image)[inside], image[inside], atol=1e-6)
    with pytest.raises(ValueError, match="faces"):
        find_warp(surface, tube(), 64, 64)


def test_warp_to_fewer_texels_averages() -> None:
    """A checkerboard of single texels shrunk four times is its mean, not one of its colours."""
    surface = two_charts(wave=0.0)
    board = (np.indices((256, 256)).sum(axis=0) % 2).astype(float)[:, :, None]
    small = find_warp(surface, surface, 64, 64)
    assert np.abs(small.apply(board)[small.coverage.inside] - 0.5).max() < 0.05


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surface = two_charts()
    write_obj(tmp_path / "part.obj", surface)
    write_image(tmp_path / "color.png", Image(smooth_image(64, 64)))
    arguments = ["straighten", str(tmp_path / "part.obj"), str(tmp_path / "color.png"), "-o", str(tmp_path / "out")]
    assert main([*arguments, "--tolerance", "0.1"]) == 0
    straight = read_obj(tmp_path / "out" / "part.obj")
    np.testing.assert_allclose(straight.uvs, straighten(read_obj(tmp_path / "part.obj"), 0.1).surface.uvs, atol=1e-15)
    assert read_image(tmp_path / "out" / "color.png").texels.shape == (64, 64, 3)
    report = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert report["straighten"]["straight_runs"] < report["straighten"]["silhouette_edges"]
    assert "straight runs" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--tolerance", "-1"], "tolerance"),
        (["--tolerance", "much"], "tolerance"),
        (["--most-distortion", "0.5"], "distortion"),
        (["nowhere.png"], "nowhere.png"),
        (["part.obj"], "part.obj"),
    ],
)
def test_command_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], message: str) -> None:
    write_obj(tmp_path / "part.obj", two_charts(4))
    assert main(["straighten", str(tmp_path / "part.obj"), *extra, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error and "\n" not in error
    assert not (tmp_path / "out").exists()


def test_human(asset_path: Any) -> None:
    """The paper's case: most of the seams' length can collapse at the default tolerance, and the floor is low."""
    from preprocess.load.read_surface import read_surface

    surface = read_surface(asset_path("human.glb"))
    result = straighten(surface)
    assert result.collapsible_fraction >= 0.9
    assert result.floor_faces <= 0.03 * len(surface.faces)
    assert result.folded == 0
    assert result.distortion <= 4.0
    rest = find_rest_shapes(result.split.surface)
    assert relative_areas(result.surface, result.surface.uvs, rest).min() > 0.05
