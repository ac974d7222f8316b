"""Decimation: what must hold of every level of every surface, and of real characters."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from preprocess.arrays import Floats
from preprocess.decimate import (
    Chain,
    DecimateOptions,
    decimate,
    decimate_to,
    decimate_within,
    floor_faces,
)
from preprocess.decimate.levels import PEAK_WEIGHT
from preprocess.decimate.measure import make_reference, measure
from preprocess.erase import erase, measure_seams
from preprocess.load.read_surface import read_surface
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.vertex_cache import cache_order, miss_ratio
from preprocess.straighten import straighten
from tests.builders_decimate import box, parts, square, waves
from tests.builders_straighten import moebius, ring_in_square, tube, two_charts, with_dart
from tests.uv_measures import distance_to_segments, outline, uv_areas

FAMILY: dict[str, Callable[[], TexturedSurface]] = {
    "square": lambda: square(8, 0.3),
    "box": lambda: box(6),
    "ball": lambda: box(6, 1.0),
    "ball, charts turned over": lambda: box(6, 1.0, mirrored=True),
    "parts": lambda: parts(box(4, 0.5), 3),
    "two charts": lambda: waves(straighten(two_charts(), 0.05).surface),
    "two charts, crooked": lambda: waves(two_charts()),
    "tube": lambda: straighten(tube(), 0.05).surface,
    "closed loop": lambda: straighten(ring_in_square(), 0.01).surface,
    "moebius": lambda: straighten(moebius(), 0.05).surface,
    "dart": lambda: waves(straighten(with_dart(), 0.05).surface),
}
EXACT = DecimateOptions(relaxed_px=0.0, min_faces=1)


@pytest.fixture(scope="module", params=list(FAMILY))
def case(request: pytest.FixtureRequest) -> tuple[TexturedSurface, Chain]:
    surface = FAMILY[request.param]()
    return surface, decimate(surface, EXACT)


def partner(surface: TexturedSurface, points: Floats) -> Floats:
    """The other side's uv of points on seams, by linear interpolation along the seam edge they lie on."""
    seams = find_seams(surface)
    sides = surface.uvs[np.concatenate([seams.uv_pairs, seams.uv_pairs[:, ::-1]])]  # [edge, side, end, 2]
    start, line = sides[None, :, 0, 0], (sides[:, 0, 1] - sides[:, 0, 0])[None]
    t = ((points[:, None] - start) * line).sum(2) / (line**2).sum(2)
    t = np.clip(t, 0.0, 1.0)
    away = np.linalg.norm(points[:, None] - start - t[..., None] * line, axis=2)
    edge = away.argmin(axis=1)
    t = t[np.arange(len(points)), edge][:, None]
    return (1.0 - t) * sides[edge, 1, 0] + t * sides[edge, 1, 1]


def test_levels_are_sound_meshes(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    for lod in chain.lods:
        lod.surface.validate()
        assert lod.canonical_uvs.shape == (len(lod.positions),)
        # Compact, no face twice, each directed edge once: an oriented manifold.
        assert len(np.unique(lod.faces)) == len(lod.positions)
        assert len(np.unique(lod.face_uvs)) == len(lod.uvs)
        edges = np.stack([lod.faces, np.roll(lod.faces, -1, axis=1)], axis=2).reshape(-1, 2)
        assert len(np.unique(edges, axis=0)) == len(edges)
        # Every surface vertex is owned by one of its own copies.
        copies = set(zip(lod.faces.ravel().tolist(), lod.face_uvs.ravel().tolist(), strict=True))
        assert all((vertex, int(owner)) in copies for vertex, owner in enumerate(lod.canonical_uvs))
        assert len(np.unique(lod.face_source)) == lod.num_faces
        assert 0 <= lod.face_source.min() and lod.face_source.max() < len(surface.faces)


def test_chart_outlines_stay(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    full = outline(surface)
    length = np.linalg.norm(full[:, 1] - full[:, 0], axis=1).sum()
    for lod in chain.lods:
        now = outline(lod.surface)
        assert np.linalg.norm(now[:, 1] - now[:, 0], axis=1).sum() == pytest.approx(length, rel=1e-9)
        between = np.concatenate([(1 - t) * now[:, 0] + t * now[:, 1] for t in (0.0, 0.21, 0.5, 0.83)])
        assert distance_to_segments(between, full).max() < 2e-9
        assert distance_to_segments(full.reshape(-1, 2), now).max() < 2e-9


def test_map_stays_one_to_one(case: tuple[TexturedSurface, Chain]) -> None:
    """The outline is the same and no triangle is turned over, so every point is covered once: equal areas prove it."""
    surface, chain = case
    full = uv_areas(surface)
    for lod in chain.lods:
        now = uv_areas(lod.surface)
        assert (np.sign(now) == np.sign(full[lod.face_source])).all()
        assert np.abs(now).min() > 1e-12
        assert np.abs(now).sum() == pytest.approx(np.abs(full).sum(), rel=1e-9)


def test_both_sides_of_seams_keep_their_timing(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    if not len(find_seams(surface).vertices):
        return
    for lod in chain.lods:
        seams = find_seams(lod.surface)
        sides = lod.uvs[seams.uv_pairs]
        for t in (0.0, 0.3, 0.5, 0.9, 1.0):
            first, second = ((1 - t) * sides[:, k, 0] + t * sides[:, k, 1] for k in range(2))
            if t not in (0.0, 1.0):  # at a corner another seam's partner is as near
                np.testing.assert_allclose(partner(surface, first), second, rtol=0, atol=5e-9)


def test_erased_textures_stay_seamless(case: tuple[TexturedSurface, Chain]) -> None:
    """The integral along a level's seams is that along the full mesh's, whose integrand is zero everywhere."""
    surface, chain = case
    seams = find_seams(surface)
    if not len(seams.vertices):
        return
    rows, columns = np.mgrid[0:48, 0:48]
    texels = np.sin(0.7 * columns + 0.4 * rows)[..., None] * 0.4 + 0.5
    erased = erase(texels, surface, seams).texels
    full = measure_seams(erased, surface, seams)
    for lod in chain.lods:
        now = measure_seams(erased, lod.surface, find_seams(lod.surface))
        assert np.max(now.max) <= np.max(full.max) + 1e-7


def test_errors_grow_and_faces_fall(case: tuple[TexturedSurface, Chain]) -> None:
    _, chain = case
    faces = [lod.num_faces for lod in chain.lods]
    errors = [lod.error_m for lod in chain.lods]
    assert faces == sorted(set(faces), reverse=True)
    assert errors == sorted(errors)
    assert chain.lods[0].error_m < 1e-12
    for lod in chain.lods:
        assert lod.exact and lod.uv_bound_px < 1e-5
        assert lod.mean_error_m <= lod.error_m


def test_two_runs_agree_to_the_bit(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    for lod, again in zip(chain.lods, decimate(surface, EXACT).lods, strict=True):
        for name in ("uvs", "face_uvs", "faces", "canonical_uvs", "face_source", "positions"):
            assert getattr(lod, name).tobytes() == getattr(again, name).tobytes()
        assert (lod.error_m, lod.mean_error_m) == (again.error_m, again.mean_error_m)


def test_the_floor_is_the_charts_own(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    bound = floor_faces(surface)
    for reached in (decimate_to(surface, 1).floor_faces, chain.floor_faces):
        assert reached == -1 or bound <= reached <= 1.15 * bound + 8
    assert decimate_to(surface, 1).lods[0].num_faces >= bound


def test_ratios_and_error_targets() -> None:
    surface = box(8, 1.0)
    chain = decimate(surface, DecimateOptions(ratios=(1.0, 0.5, 0.1)))
    assert [lod.num_faces for lod in chain.lods] == [768, 384, 76]
    close = decimate_within(surface, 0.02).lods[0]
    far = decimate_within(surface, 0.1).lods[0]
    assert close.error_m <= 0.02 < 0.1 and far.error_m <= 0.1
    assert far.num_faces < close.num_faces < 768
    # Not much coarser would have done: a tenth fewer faces are beyond the bound.
    coarser = decimate_to(surface, round(0.85 * close.num_faces), DecimateOptions(peak_weight=PEAK_WEIGHT)).lods[0]
    assert measure(make_reference(surface), coarser).largest_m > 0.02


def test_cache_order_is_a_permutation_with_few_misses() -> None:
    faces = square(24).faces
    shuffled = faces[np.random.default_rng(0).permutation(len(faces))]
    order = cache_order(shuffled, int(faces.max()) + 1)
    assert np.sort(order).tolist() == list(range(len(faces)))
    assert miss_ratio(shuffled) > 1.5 and miss_ratio(shuffled[order]) < 0.8
    one = cache_order(np.array([[0, 1, 2]], np.int32), 3)
    assert one.tolist() == [0]


@pytest.mark.parametrize("name", ["human.glb", "Fox.glb", "blub.obj"])
def test_characters_reach_their_floor(name: str, asset_path: Callable[[str], Path]) -> None:
    surface = straighten(read_surface(asset_path(name)), 0.01).surface
    bound = floor_faces(surface)
    chain = decimate_to(surface, 1)
    assert bound <= chain.floor_faces <= 1.12 * bound
    lod = chain.lods[0]
    # Charts that are folded over in the source stay so; no other triangle turns over.
    before, now = uv_areas(surface), uv_areas(lod.surface)
    assert ((np.sign(now) == np.sign(before[lod.face_source])) | (np.abs(before[lod.face_source]) < 1e-9)).all()
    full = outline(surface)
    now_outline = outline(lod.surface)
    assert distance_to_segments(now_outline.reshape(-1, 2), full).max() < 1e-8


def test_few_faces_are_halved_in_three_steps_and_no_level_is_useless() -> None:
    """From half of the faces on each level has about 2^(-1/3) of them, and says that it is further off."""
    surface = box(16, 1.0)
    chain = decimate(surface, DecimateOptions(relaxed_px=0.0))
    faces = [lod.num_faces for lod in chain.lods]
    errors = [lod.error_m for lod in chain.lods]
    assert faces[:5] == [3072, 1536, 1218, 968, 768]
    assert errors[0] == 0.0 and all(finer < 0.9 * coarser for finer, coarser in itertools.pairwise(errors))
    exact = decimate(surface, DecimateOptions(ratios=(1.0, 0.5))).lods
    assert [lod.num_faces for lod in exact] == [3072, 1536]
