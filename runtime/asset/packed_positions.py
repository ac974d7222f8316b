"""Positions as one 32-bit word a texel: three whole numbers of steps, as many bits to each axis as its extent asks for.

Textures that were rounded to such steps when they were built (preprocess/fit/packed_positions.py) lose nothing here. A
folder says so in `textures.position.words`; others are held in 16 bits a channel, four channels, twice the memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import REBUILD, AssetError

WORD_BITS = 32
MOST_BITS = 16  # of an axis: beyond, it is exact to what a character is known to


@dataclass(frozen=True)
class PositionWords:
    """What the words mean: along each axis, 0 is `low` and all bits set is `high`, metres.

    Attributes
    ----------
    bits : (3,) int64
        Of x, the lowest, y and z.
    low, high : (3,) float64
    """

    bits: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def steps_m(self) -> NDArray[np.float64]:
        """Length of a step along each axis, (3,)."""
        return (self.high - self.low) / self.masks

    @property
    def masks(self) -> NDArray[np.int64]:
        """Largest number along each axis, (3,)."""
        return (1 << self.bits) - 1

    @property
    def shifts(self) -> NDArray[np.int64]:
        """Lowest bit of each axis, (3,)."""
        return np.cumsum(self.bits) - self.bits

    def numbers(self, positions: NDArray[np.floating]) -> NDArray[np.int64]:
        """Positions (..., 3) in metres as the nearest whole steps."""
        steps = (positions - self.low) / np.maximum(self.steps_m, 1e-30)
        return np.clip(np.rint(steps), 0, self.masks).astype(np.int64)

    def metres(self, numbers: NDArray[np.number]) -> NDArray[np.float64]:
        """The inverse of `numbers`, (..., 3)."""
        return np.asarray(self.low + numbers * self.steps_m, np.float64)

    def pack(self, texels: NDArray[np.floating]) -> NDArray[np.uint32]:
        """Texels (H, W, 3) as words, (H, W, 1)."""
        return np.bitwise_or.reduce(self.numbers(texels) << self.shifts, axis=2, keepdims=True).astype(np.uint32)


def choose_words(low: NDArray[np.floating], high: NDArray[np.floating]) -> PositionWords:
    """Bits for positions between `low` and `high`, (3,) each: every one goes to the axis with the longest step."""
    bits = np.ones(3, np.int64)
    for _ in range(WORD_BITS - len(bits)):
        steps = np.where(bits < MOST_BITS, (high - low) / ((1 << bits) - 1), -1.0)
        bits[int(steps.argmax())] += 1
    return PositionWords(bits, np.asarray(low, np.float64), np.asarray(high, np.float64))


def read_words(entry: Any, where: str) -> PositionWords | None:
    """What `textures.position.words` of a manifest says, None for nothing.

    Raises
    ------
    AssetError
        If it makes no sense.
    """
    if entry is None:
        return None
    try:
        words = PositionWords(
            np.array([int(bits) for bits in entry["bits"]]), *(np.array(entry[key], float) for key in ("low", "high"))
        )
        shapes = {part.shape for part in (words.bits, words.low, words.high)}
        fits = shapes == {(3,)} and (words.bits > 0).all() and words.bits.sum() <= WORD_BITS
        holds = fits and np.isfinite([words.low, words.high]).all() and (words.low <= words.high).all()
    except (KeyError, TypeError, ValueError):
        holds = False
    if not holds:
        raise AssetError(f"{where} are not three axes of bits, low and high: {REBUILD}")
    return words
