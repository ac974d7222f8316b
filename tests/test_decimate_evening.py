"""Levels made over again with more weight on what was far off: nearer in the worst spot, and never further."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from preprocess.decimate import DecimateOptions
from preprocess.decimate.deviation_samples import WEIGHT_COLUMN
from preprocess.decimate.levels import PEAK_WEIGHT
from preprocess.decimate.measure import make_reference, measure
from preprocess.decimate.minimax import make_even_level, make_level
from preprocess.decimate.state import make_engine
from preprocess.mesh.surface import TexturedSurface
from tests.builders_decimate import box, square, waves

OPTIONS = DecimateOptions(relaxed_px=0.0, min_faces=1, peak_weight=PEAK_WEIGHT)


def knobbly() -> TexturedSurface:
    """A rounded box with ripples, and a small knob that has hardly any area."""
    surface = waves(box(14, 0.7), 0.08)
    positions = surface.positions.copy()
    away = np.linalg.norm(positions - positions[np.argmax(positions[:, 0])], axis=1)
    return replace(surface, positions=positions * (1.0 + 0.3 * np.exp(-((away / 0.15) ** 2)))[:, None])


@pytest.mark.parametrize("surface", [knobbly(), waves(square(24), 0.1)], ids=["box", "square"])
def test_more_tries_are_nearer(surface: TexturedSurface) -> None:
    reference = make_reference(surface)
    engine = make_engine(surface, OPTIONS)
    engine.run_to(len(surface.faces) // 2)
    target = len(surface.faces) // 12
    largest = [make_even_level(engine, reference, target, tries).largest_m for tries in (1, 3, 6)]
    assert largest[0] >= largest[1] >= largest[2]
    assert largest[2] < 0.95 * largest[0]


def test_the_state_to_go_on_from() -> None:
    """The engine given is untouched; that of the level is where the level is, and all its witnesses weigh alike."""
    surface = knobbly()
    reference, engine = make_reference(surface), make_engine(surface, OPTIONS)
    engine.run_to(600)
    before = [array.copy() for array in engine.mesh]
    level = make_even_level(engine, reference, 150)
    for array, old in zip(engine.mesh, before, strict=True):
        np.testing.assert_array_equal(array, old)
    assert level.engine.num_faces <= 150 and (level.engine.mesh.points[:, WEIGHT_COLUMN] == 1.0).all()
    np.testing.assert_array_equal(level.engine.snapshot().positions, level.lod.positions)
    assert level.largest_m == measure(reference, level.lod).largest_m
    again = make_even_level(engine, reference, 150)
    np.testing.assert_array_equal(again.lod.positions, level.lod.positions)  # the same bits


def test_one_try_is_the_plain_level() -> None:
    surface = knobbly()
    reference, engine = make_reference(surface), make_engine(surface, OPTIONS)
    even = make_even_level(engine, reference, 200, tries=1)
    plain = make_level(engine.copy(), reference, 200)
    np.testing.assert_array_equal(even.lod.positions, plain.lod.positions)


def test_weight_is_what_a_spot_counts() -> None:
    """Witnesses of one half that weigh a hundredfold bring that half nearer, at the other's cost."""
    surface = waves(square(30), 0.1)
    reference = make_reference(surface)
    sums = {}
    for weight in (1.0, 100.0):
        engine = make_engine(surface, OPTIONS)
        engine.weigh_witnesses(np.where(engine.witness_places()[:, 0] < 0.5, weight, 1.0))
        distances = make_level(engine, reference, 120).distances
        assert distances is not None
        left = distances.places[:, 0] < 0.45
        sums[weight] = distances.each_m[left].mean(), distances.each_m[~left].mean()
    assert sums[100.0][0] < 0.8 * sums[1.0][0] and sums[100.0][1] > sums[1.0][1]


def test_distances_say_where() -> None:
    """Samples of a flat square lifted by a tenth lie a tenth away, everywhere, both ways."""
    surface = square(6)
    lod = make_engine(surface, OPTIONS).snapshot()
    lifted = replace(lod, positions=lod.positions + np.array([0.0, 0.0, 0.1]))
    distances = measure(make_reference(surface), lifted)
    np.testing.assert_allclose(distances.each_m, 0.1, atol=1e-12)
    assert np.abs(distances.places[:, 2]).max() < 1e-12 and distances.places[:, :2].min() >= 0.0
    assert np.ptp(distances.places[:, :2], axis=0).min() > 0.99
