"""Positions as words: bits where they are needed, whole steps that the file says exactly, vertices and seams kept."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.erase import measure_seams
from preprocess.fit import packed_positions as stage
from preprocess.fit.packed_positions import are_worth_it, round_positions
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import px_to_uv, sample_bilinear
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


@pytest.mark.parametrize("jump_weight", [1e-6, 1.0, 1e6])
def test_vertices_and_seams_are_better_than_rounded(monkeypatch: pytest.MonkeyPatch, jump_weight: float) -> None:
    monkeypatch.setattr("runtime.asset.packed_positions.WORD_BITS", 18)  # steps of a thirtieth of the size
    monkeypatch.setattr(stage, "JUMP_WEIGHT", jump_weight)
    surface, texels = two_charts(), smooth_texels()
    seams = find_seams(surface)
    assert len(seams.uv_pairs) == 1
    uvs = surface.uvs[[0, 1, 2, 3, 5, 6]]
    wanted = sample_bilinear(texels, uvs)
    rounded, words = round_positions(texels, surface, seams, uvs, wanted)
    plain = words.metres(words.numbers(texels))
    assert np.abs(rounded - words.metres(words.numbers(rounded))).max() < 1e-12  # whole steps
    assert (np.abs(rounded - texels) <= stage.REACH * words.steps_m + 1e-12).all()

    def costs(stored: np.ndarray) -> np.ndarray:
        apart = sample_bilinear(stored, uvs) - wanted
        return np.array([(apart**2).sum() / len(uvs), measure_seams(stored, surface, seams).total.sum()])

    before, after = costs(plain), costs(rounded)
    assert after @ (1.0, jump_weight) < before @ (1.0, jump_weight)
    if jump_weight < 1.0:
        assert after[0] < 0.5 * before[0]
    if jump_weight > 1.0:
        assert after[1] < before[1]


def test_nothing_that_vertices_and_seams_do_not_read_moves() -> None:
    surface, texels = two_charts(), smooth_texels()
    nothing = np.zeros((0, 2)), np.zeros((0, 3))
    rounded, words = round_positions(texels, surface, find_seams(surface), *nothing)
    read = np.zeros((SIDE, SIDE), bool)
    ends = np.concatenate([surface.uvs[pair] for pair in find_seams(surface).uv_pairs.reshape(-1, 2)])
    low, high = np.floor(ends.min(axis=0) * SIDE - 1).astype(int), np.ceil(ends.max(axis=0) * SIDE + 1).astype(int)
    read[low[1] : high[1], low[0] : high[0]] = True
    assert np.array_equal(rounded[~read], words.metres(words.numbers(texels))[~read])


def test_the_kernel_does_what_the_formula_says() -> None:
    """One sweep over dense random rows, texel by texel, beside the objective's own minimum."""
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(9, 6))
    off, left = rng.uniform(-0.5, 0.5, 6), 3.0 * rng.normal(size=9)
    stay = 0.01

    def cost(off: np.ndarray, left: np.ndarray) -> float:
        return float((left**2).sum() + stay * (off**2).sum())

    moved, rest = off.copy(), left.copy()
    starts = np.arange(0, rows.size + 1, len(rows), dtype=np.int32)
    entries = np.tile(np.arange(len(rows), dtype=np.int32), rows.shape[1])
    sweeps = stage._settle(starts, entries, rows.T.ravel().copy(), stay, moved, rest)
    slow, slow_left = off.copy(), left.copy()
    for _ in range(sweeps):
        for texel in range(6):
            steps = [s for s in range(-3, 4) if abs(slow[texel] + s) <= stage.REACH]
            trial = [cost(slow + s * (np.arange(6) == texel), slow_left + s * rows[:, texel]) for s in steps]
            best = steps[int(np.argmin(trial))]
            slow[texel] += best
            slow_left += best * rows[:, texel]
    assert np.allclose(moved, slow) and np.allclose(rest, slow_left)
    assert np.allclose(rest, left + rows @ (moved - off))
    assert cost(moved, rest) < cost(off, left)


def test_words_are_for_small_characters() -> None:
    """A fox of 1,400 vertices in all levels; a man of 34,000 and a robot of 6,500 keep their 16 bits."""
    assert are_worth_it((92, 92), 1_400)
    assert not are_worth_it((192, 192), 6_466)
    assert not are_worth_it((272, 272), 34_000)
    assert not are_worth_it((192, 192), 11_000)
