"""Erasure of a band beside seams: compiled steps against obvious twins, and what a build stores."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from preprocess.erase import LOCAL, EraseOptions, erase, measure_seams
from preprocess.erase.local.band import plan_band
from preprocess.erase.local.closing import JUMP_LIMIT, UNIT, close_seams
from preprocess.erase.local.constrained import solve_near
from preprocess.erase.local.mips import close_mips
from preprocess.erase.local.relax import project, relax
from preprocess.erase.local.rounding import round_texels
from preprocess.mesh.seams import find_seams
from tests.builders_erase import MESHES, paint

SIZE = 48


def band_of(name: str = "cube", size: int = SIZE, options: EraseOptions | None = None):
    surface = MESHES[name]
    return plan_band(surface, find_seams(surface), size, size, options or EraseOptions())


def test_samples_see_the_same_jump_as_the_measure_by_quadrature():
    surface, image = MESHES["cube"], paint(SIZE, SIZE)
    band = band_of()
    found = band.measure(band.jumps(image.reshape(-1, image.shape[2])[band.texels]))
    expected = measure_seams(image, surface, find_seams(surface))
    np.testing.assert_allclose(found.total, expected.total, rtol=1e-5)
    np.testing.assert_allclose(found.seam_rms, expected.seam_rms, rtol=1e-4, atol=1e-6)
    assert (found.max >= expected.max - 1e-6).all() and (found.max <= 1.02 * expected.max + 1e-6).all()


def energy(band, given, values, jumps, penalty, limit):
    """What relaxation minimises, (C,): each pair of neighbours once."""
    apart = np.zeros(given.shape[1])
    for k in range(4):
        there = band.neighbours[:, k]
        target = np.where(band.keeps_difference[:, k, None], given - given[there], 0.0)
        apart += 0.5 * (band.stiffness[:, k, None] * (values - values[there] - target) ** 2).sum(axis=0)
    over = np.maximum(np.abs(jumps) - limit, 0.0)
    kept = (band.mass[:, None] * (values - given) ** 2).sum(axis=0)
    return kept + apart + penalty * (band.sample_lengths[:, None] * over**2).sum(axis=0)


def relaxed(band, given, order, penalty, limit, times=1):
    values, jumps = given.copy(), band.jumps(given)
    pull = np.zeros_like(given)
    for k in range(4):
        weight = np.where(band.keeps_difference[:, k], band.stiffness[:, k], 0.0)[:, None]
        pull += weight * (given - given[band.neighbours[:, k]])
    for _ in range(times):
        relax(
            order, values, given, pull, band.mass, band.neighbours, band.stiffness, band.starts, band.samples,
            band.shares, jumps, np.float32(penalty) * band.sample_lengths, limit, 1.0, 0.0, UNIT,
        )  # fmt: skip
    return values, jumps


def test_relaxation_moves_a_texel_to_the_minimum_of_the_energy():
    band, image = band_of(), paint(SIZE, SIZE)
    given = UNIT * image.reshape(-1, image.shape[2])[band.texels]
    texel = band.seam_texels[:1].astype(np.int32)
    values, jumps = relaxed(band, given, texel, 2.0, 0.0)
    best = energy(band, given, values, jumps, 2.0, 0.0)
    for step in (-0.5, 0.5):
        other = values.copy()
        other[texel] += step
        assert (energy(band, given, other, band.jumps(other), 2.0, 0.0) > best).all()


def test_relaxation_keeps_its_jumps_up_to_date_and_lowers_the_energy():
    band, image = band_of(), paint(SIZE, SIZE)
    given = UNIT * image.reshape(-1, image.shape[2])[band.texels]
    every = np.arange(len(given), dtype=np.int32)
    before = energy(band, given, given, band.jumps(given), 2.0, 0.2)
    for times in (1, 3):
        values, jumps = relaxed(band, given, every, 2.0, 0.2, times)
        np.testing.assert_allclose(jumps, band.jumps(values), atol=1e-3)
        after = energy(band, given, values, jumps, 2.0, 0.2)
        assert (after < before).all()
        before = after


@pytest.mark.parametrize("by", ["projection", "solution"])
def test_samples_come_within_their_limits(by):
    band = band_of("cube")
    given = UNIT * (0.5 + 0.01 * paint(SIZE, SIZE).reshape(-1, 3)[band.texels])
    values, jumps = given.copy(), band.jumps(given)
    limits = np.full(len(jumps), 0.5)
    assert np.abs(jumps).max() > 0.5
    if by == "solution":
        solve_near(band, given, values, jumps, limits, 0.0, UNIT)
    else:
        room = np.empty(len(limits), np.int32), np.empty(len(limits), np.bool_)
        left = project(
            values, jumps, band.sample_texels, band.sample_weights, band.starts, band.samples, band.shares, limits,
            0.0, UNIT, 2000, *room,
        )  # fmt: skip
        assert left == 0
    np.testing.assert_allclose(jumps, band.jumps(values), atol=2e-3)
    assert np.abs(jumps).max() <= 0.505
    assert values.min() >= 0.0 and values.max() <= UNIT


def test_rounding_keeps_to_whole_numbers_near_what_is_wanted():
    band, image = band_of(), 0.4 + 0.2 * paint(SIZE, SIZE)
    closed = close_seams(image, band)
    assert closed is not None
    wanted = np.clip(UNIT * closed.texels.reshape(-1, 3)[band.texels].astype(np.float64), 0.0, UNIT)
    stored = round_texels(wanted, band, np.full(len(band.sample_lengths), 0.48), 255)
    assert (stored == np.rint(stored)).all() and stored.min() >= 0 and stored.max() <= 255
    assert np.abs(stored - wanted).max() <= 8.5
    plain = np.abs(band.jumps(np.rint(wanted)))
    assert (np.abs(band.jumps(stored)) > 0.48).sum() < 0.1 * (plain > 0.48).sum()


@pytest.mark.parametrize("name", sorted(MESHES))
@pytest.mark.parametrize("levels", [255, 65535])
def test_what_is_stored_is_seamless_on_every_mesh(name, levels):
    surface, image = MESHES[name], paint(SIZE, SIZE)
    for level in close_mips(image, surface, find_seams(surface), levels=levels):
        assert level.texels.dtype == (np.uint8 if levels == 255 else np.uint16)
        measured = measure_seams(level.texels.astype(np.float64), surface, find_seams(surface))
        assert measured.max.max(initial=0.0) <= 0.52 * levels / 255


def test_texels_beyond_the_band_stay():
    surface, image = MESHES["cube"], paint(96, 96)
    weights = dataclasses.replace(LOCAL, change=1e6)
    band = band_of("cube", 96, EraseOptions(weights=weights))
    closed = close_seams(image, band, levels=255)
    assert closed is not None
    far = np.ones(96 * 96, bool)
    far[band.texels] = False
    assert far.sum() > 1000
    np.testing.assert_array_equal(closed.texels.reshape(-1, 3)[far], np.rint(255 * image.reshape(-1, 3)[far]))
    assert len(surface.faces)


def test_it_moves_texels_hardly_more_than_the_exact_solution_with_the_same_weights():
    surface, image = MESHES["cube"], 0.4 + 0.2 * paint(64, 64)
    seams = find_seams(surface)
    options = EraseOptions()
    band = plan_band(surface, seams, 64, 64, options)
    ours = close_seams(image, band)
    assert ours is not None
    exact = erase(image, surface, seams, dataclasses.replace(options, seam_weight=1e10)).texels
    inside = band.region.inside
    moved = [np.sqrt(((texels - image)[inside] ** 2).mean()) for texels in (ours.texels, exact)]
    assert moved[0] <= 1.1 * moved[1]
    assert ours.after.max.max() <= 1.3 * JUMP_LIMIT / 255


def test_no_seams_and_levels_that_would_change_too_much():
    surface, image = MESHES["cube"], paint(32, 32)
    seams = find_seams(surface)
    none = EraseOptions(joined=np.zeros(len(seams.vertices), bool))
    untouched = close_seams(image, plan_band(surface, seams, 32, 32, none), levels=255)
    assert untouched is not None and (untouched.texels == np.rint(255 * image)).all() and untouched.change == 0.0
    assert close_seams(image, band_of(size=32), levels=255, most_change=1e-6) is None
    assert len(close_mips(image, surface, seams, levels=255, most_change=0.0)) == 1  # the full size always is
