"""Rounding: stored integers are seamless, near the solution and in range; the search gains what it says."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.erase import (
    plan_erasure,
    quantise,
)
from preprocess.erase.quantise import PEAK, REACH, STAY, TOLERATED, _best_steps, _Search
from preprocess.erase.solve import keep_by_contrast
from preprocess.erase.two_opt import best_pair
from preprocess.mesh.seams import find_seams
from tests.builders_erase import MESHES, paint


@pytest.mark.parametrize("levels", [255, 65535])
@pytest.mark.parametrize("name", MESHES)
def test_stored_integers_are_seamless(name, levels):
    surface = MESHES[name]
    seams = find_seams(surface)
    image = paint(96, 96)
    plan = plan_erasure(surface, seams, 96, 96)
    solution = plan.erase(image, bounds=(0.0, 1.0)).texels
    rounded = np.clip(np.rint(solution * levels), 0, levels)
    stored = quantise(solution, plan.strip, levels)
    assert stored.dtype == (np.uint8 if levels == 255 else np.uint16)
    ours, plain = plan.measure(stored), plan.measure(rounded)
    assert np.sqrt(ours.total.sum()) <= 0.5 * np.sqrt(plain.total.sum())
    if levels == 255:
        assert ours.max.max() <= 0.5
    else:  # the format's floor: unorm16 textures measure 1.5e-11
        assert (ours.total / levels**2).max() <= 1.5e-11 and ours.max.max() <= 2.0
    away = np.ones(96 * 96, bool)
    away[plan.strip.texels] = False
    np.testing.assert_array_equal(stored.reshape(-1, 3)[away], rounded.reshape(-1, 3)[away])
    direct = plan.erase_stored(np.rint(image * levels).astype(stored.dtype))
    assert plan.measure(direct.texels).max.max() <= (0.5 if levels == 255 else 2.0)


def test_rounding_stays_in_range_where_the_solution_leaves_it():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = (paint(96, 96, seed=4) > 0.5).astype(float)
    plan = plan_erasure(surface, seams, 96, 96)
    solution = plan.erase(image).texels
    assert solution.min() < -0.01 and solution.max() > 1.01
    bounded = plan.erase(image, bounds=(0.0, 1.0))
    assert bounded.texels.min() > -1e-4 and bounded.texels.max() < 1 + 1e-4
    assert plan.measure(bounded.texels).total.max() < 1e-11
    stored = plan.erase_stored((image * 255).astype(np.uint8)).texels
    assert plan.measure(stored).max.max() <= 0.5


def test_channels_come_into_range_each_by_itself():
    surface = MESHES["cube"]
    image = (paint(96, 96, seed=4) > 0.5).astype(float)
    image[..., 1] = 0.25 + 0.5 * image[..., 1]  # sooner in range than the others
    plan = plan_erasure(surface, find_seams(surface), 96, 96)
    together = plan.erase(image, bounds=(0.0, 1.0)).texels
    for channel in range(3):
        alone = plan.erase(image[..., channel : channel + 1], bounds=(0.0, 1.0)).texels
        np.testing.assert_allclose(alone[..., 0], together[..., channel], rtol=0, atol=2e-7)  # what is negligible


def test_range_is_kept_where_the_bounded_solution_does_not_converge(monkeypatch):
    """What is left outside after too few repetitions goes by contrast: in range, seams as closed as before."""
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = (paint(96, 96, seed=4) > 0.5).astype(float)
    plan = plan_erasure(surface, seams, 96, 96)
    converged = plan.erase(image, bounds=(0.0, 1.0)).texels
    monkeypatch.setattr("preprocess.erase.solve.MAX_BOUND_REPEATS", 3)
    erased = plan.erase(image, bounds=(0.0, 1.0))
    assert erased.texels.min() >= 0 and erased.texels.max() <= 1
    assert plan.measure(erased.texels).total.max() < 1e-11
    assert np.abs(erased.texels - image).mean() < 2 * np.abs(converged - image).mean()


def test_contrast_is_lowered_part_by_part():
    surface = MESHES["pair"]
    strip = plan_erasure(surface, find_seams(surface), 32, 32).strip
    rng = np.random.default_rng(0)
    within = rng.uniform(0.2, 0.8, (len(strip.texels), 2))
    np.testing.assert_allclose(keep_by_contrast(within, strip, np.zeros(2), np.ones(2)), within, atol=1e-15)
    beyond = within * (1.0, 1.5)
    kept = keep_by_contrast(beyond, strip, np.zeros(2), np.ones(2))
    assert kept.min() >= 0 and kept.max() <= 1
    np.testing.assert_allclose(kept[:, 0], within[:, 0], atol=1e-15)
    jumps = strip.rows @ beyond[:, 1], strip.rows @ kept[:, 1]
    ratio = jumps[1] / jumps[0]
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-9)  # one part, one factor
    assert 0.3 < ratio.mean() < 1


def test_gain_equals_the_objective():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    plan = plan_erasure(surface, seams, 24, 24)
    strip = plan.strip
    rng = np.random.default_rng(0)
    wanted = rng.uniform(0, 20, len(strip.texels))
    stored = np.rint(wanted)

    def objective(values):
        jump = strip.rows @ values
        over = np.maximum(np.abs(jump) - TOLERATED, 0)
        return strip.weights @ jump**2 + PEAK * np.sum(over**2) + STAY * np.sum((values - wanted) ** 2)

    jump = np.append(strip.rows @ stored, 0.0).astype(np.float32)
    search = _Search(wanted[None], strip, 255)
    width = np.arange(search.degree.max())
    entry = np.where(width < search.degree[:, None], search.starts[:-1, None] + width, -1)
    points, shares = search.points[entry], search.shares[entry]
    texels = rng.integers(0, len(wanted), 40)
    off = (stored - wanted)[texels].astype(np.float32)
    weights = np.append(strip.weights, 0.0).astype(np.float32)[points[texels]]
    peaks = np.where(points[texels] < len(strip.weights), np.float32(PEAK), np.float32(0))
    reach = np.full(40, REACH, np.float32)
    steps, gains = _best_steps(
        jump[points[texels]], shares[texels], weights, peaks, off, -reach, reach, 2
    )  # fmt: skip
    assert np.count_nonzero(steps) > 5
    for texel, step, gain in zip(texels, steps, gains, strict=True):
        costs = []
        for candidate in range(-2, 3):
            moved = stored.copy()
            moved[texel] += candidate
            costs.append(objective(moved) - objective(stored))
        assert costs[int(step) + 2] == pytest.approx(min(costs), abs=1e-3)
        assert step == 0 or gain == pytest.approx(min(costs), rel=1e-3, abs=1e-3)


def test_the_best_pair_is_that_of_all_pairs():
    rng = np.random.default_rng(3)
    shares = rng.uniform(-1, 1, (5, 12)).astype(np.float32)
    weights, peaks = rng.uniform(0.5, 2, 12).astype(np.float32), rng.uniform(50, 400, 12).astype(np.float32)
    off = rng.uniform(-0.5, 0.5, 5).astype(np.float32)
    reach = np.full(5, 2.0, np.float32)

    def cost(values, jump):
        over = np.maximum(np.abs(jump) - TOLERATED, 0)
        return weights @ jump**2 + peaks @ over**2 + STAY * np.sum(values**2)

    num_found = 0
    for _ in range(20):
        jump = rng.uniform(-1.5, 1.5, 12).astype(np.float32)
        found = best_pair(np.array([1, 3]), shares, jump, weights, peaks, off, -reach, reach, TOLERATED, STAY)
        if found is None:
            continue
        num_found += 1
        (a, b), steps = found
        assert a in (1, 3) and a != b and np.abs(off[[a, b]] + steps).max() <= 2
        moved = off.copy()
        moved[[a, b]] += steps
        gain = cost(moved, jump + np.array(steps) @ shares[[a, b]]) - cost(off, jump)
        for other in range(5):  # one step of either length of each other texel, downhill from the first
            for step in (-2, -1, 1, 2):
                if other == a or abs(off[other] + step) > 2:
                    continue
                rival = off.copy()
                rival[[a, other]] += [steps[0], step]
                rival_jump = jump + np.array([steps[0], step]) @ shares[[a, other]]
                assert gain <= cost(rival, rival_jump) - cost(off, jump) + 1e-2
    assert num_found >= 5


@pytest.mark.parametrize("levels", [255, 65535])
def test_rounding_stays_near_and_in_range(levels):
    """The search may take any integer within reach of the wanted value, and none beyond the range."""
    surface = MESHES["cube"]
    plan = plan_erasure(surface, find_seams(surface), 64, 64)
    image = np.round(paint(64, 64, seed=2) * 1.2 - 0.1, 3)  # out of range at both ends
    strip = plan.strip
    wanted = np.clip(image.reshape(-1, 3)[strip.texels], 0, 1) * levels
    stored = quantise(image, strip, levels).reshape(-1, 3)[strip.texels]
    assert np.abs(stored - wanted).max() <= REACH
