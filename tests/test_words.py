"""Positions as words: bits where they are needed, whole steps that the file says exactly, vertices and seams kept."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import px_to_uv
from runtime.asset.packed_positions import MOST_BITS, WORD_BITS, choose_words, read_words
from runtime.errors import AssetError

SIDE = 24


def two_charts() -> TexturedSurface:
    """A strip of two squares in two charts: their common edge is a seam."""
    positions = np.array([(x, y, 0.3 * x * y) for y in (0.0, 1.0) for x in (0.0, 1.0, 2.0)])
    faces = np.array([(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)], np.int32)
    left = np.array([(0.1, 0.1), (0.4, 0.13), (0.41, 0.52), (0.12, 0.5)])
    right = np.array([(0.55, 0.2), (0.9, 0.2), (0.93, 0.66), (0.58, 0.61)])
    face_uvs = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)], np.int32)
    return TexturedSurface(positions, faces, np.r_[left, right], face_uvs)


def smooth_texels() -> np.ndarray:
    row, column = np.indices((SIDE, SIDE)).reshape(2, -1)
    u, v = px_to_uv(np.stack([column, row], axis=1).astype(np.float64), SIDE, SIDE).T
    return np.stack([2.1 * u, v + 0.1 * u * v, 0.4 * u * v], axis=1).reshape(SIDE, SIDE, 3)


@pytest.mark.parametrize("extent", [(1.0, 1.0, 1.0), (1.1, 1.7, 0.5), (100.0, 1.0, 1e-3), (1.0, 1.0, 0.0), (0, 0, 0)])
def test_bits_go_where_steps_are_longest(extent: tuple[float, float, float]) -> None:
    words = choose_words(np.zeros(3), np.array(extent, float))
    assert words.bits.sum() == WORD_BITS and words.bits.min() >= 1
    steps, fine = words.steps_m, words.bits < MOST_BITS
    if fine.any() and min(extent) > 0:  # another bit would have gone there
        assert steps[fine].max() <= 2.1 * steps.min() or (words.bits[~fine] == MOST_BITS).all()


def test_words_hold_what_was_rounded_to_them() -> None:
    rng = np.random.default_rng(2)
    low, high = np.array([-1.0, 0.5, 2.0]), np.array([3.0, 0.75, 9.0])
    words = choose_words(low, high)
    numbers = rng.integers(0, words.masks + 1, (7, 5, 3))
    stored = words.metres(numbers).astype(np.float32)  # as the file has them
    assert np.array_equal(words.numbers(stored), numbers)
    packed = words.pack(stored)
    assert packed.dtype == np.uint32 and packed.shape == (7, 5, 1)
    assert np.array_equal((packed >> words.shifts) & words.masks, numbers)
    assert np.array_equal(words.numbers(np.array([low - 1, high + 1])), [np.zeros(3), words.masks])


def test_the_manifest_tells_words_again() -> None:
    words = choose_words(np.zeros(3), np.array([1.0, 2.0, 0.5]))
    entry = {"bits": words.bits.tolist(), "low": words.low.tolist(), "high": words.high.tolist()}
    again = read_words(entry, "here")
    assert again is not None and read_words(None, "here") is None
    assert all(np.array_equal(getattr(words, part), getattr(again, part)) for part in ("bits", "low", "high"))


@pytest.mark.parametrize(
    "change",
    [
        {"bits": [11, 11, 11]},
        {"bits": [11, 11]},
        {"bits": [32, 0, 0]},
        {"bits": "many"},
        {"low": [0, 0, float("nan")]},
        {"low": [2, 2, 2]},
        {"high": None},
    ],
)
def test_words_that_make_no_sense_are_refused(change: dict[str, object]) -> None:
    entry = {"bits": [11, 11, 10], "low": [0, 0, 0], "high": [1, 1, 1], **change}
    with pytest.raises(AssetError, match="over there are not three axes"):
        read_words(entry, "over there")
    with pytest.raises(AssetError):
        read_words([], "a list")
