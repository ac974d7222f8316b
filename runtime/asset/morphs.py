"""Morph targets (blend shapes) as displacement maps over the position texture, and their sum for given weights.

A target says for some texels of the position texture how far they shift, and how normals there turn: three rows of
four numbers, [T | d], for a normal n + T n and a position p + d, the whole times the target's weight. Most targets
touch a small part, so each is a list of its texels. All lists lie in one image of 16-bit numbers, four pixels a texel:
its number (low, high half), the shift, the turn, two spare numbers; counts from the middle, times the target's scales.

The sum for an actor's weights is made here, once for every texel rather than once for every vertex that reads it, and
costs by how many targets are active. `texel_numbers` is what shaders find the sum's texels by: of every 2 x 2 cell the
numbers of its four texels, 0 where nothing ever moves.
Letters in shapes: A actors, M targets, E texels of a target, T texels of any target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import REBUILD, AssetError

ENTRIES_A_ROW = 256  # of the image
PIXELS_AN_ENTRY = 4
MIDDLE = 32768  # the stored number of nothing
STEPS = 32767  # either way


@dataclass(frozen=True)
class MorphTarget:
    """One target.

    Attributes
    ----------
    name : str
    default : float
        Weight at rest.
    texels : (E,) int64, rising
        Row times width plus column in the position texture.
    rows : (E, 3, 4) float32
        Turn and shift, metres.
    """

    name: str
    default: float
    texels: NDArray[np.int64]
    rows: NDArray[np.float32]


def morphs_size(num_entries: int) -> tuple[int, int]:
    """Width and height of the image that holds so many texels of targets."""
    return ENTRIES_A_ROW * PIXELS_AN_ENTRY, max(1, -(-num_entries // ENTRIES_A_ROW))


def _scales(target: MorphTarget) -> tuple[float, float]:
    """The largest shift, metres, and the largest number of a turn."""
    rows = np.abs(target.rows.astype(np.float64))
    return float(rows[..., 3].max(initial=0.0)), float(rows[..., :3].max(initial=0.0))


def pack_morphs(targets: Sequence[MorphTarget]) -> tuple[NDArray[np.uint16], list[dict[str, Any]]]:
    """The image (H, W, 4) of all targets, and what the manifest says of each: name, default, texels and scales."""
    entries, blocks = [], []
    for target in targets:
        shift_m, turn = _scales(target)
        block = np.full((len(target.texels), 16), MIDDLE, np.int64)
        block[:, 0], block[:, 1] = target.texels & 0xFFFF, target.texels >> 16
        rows = target.rows.astype(np.float64)
        block[:, 2:5] += np.rint(rows[..., 3] * (STEPS / max(shift_m, 1e-30))).astype(np.int64)
        block[:, 5:14] += np.rint(rows[..., :3] * (STEPS / max(turn, 1e-30))).astype(np.int64).reshape(-1, 9)
        blocks.append(block)
        entries.append(
            {
                "name": target.name,
                "default": target.default,
                "texels": len(target.texels),
                "shift_m": shift_m,
                "turn": turn,
            }
        )
    stacked = np.concatenate(blocks) if blocks else np.zeros((0, 16), np.int64)
    width, height = morphs_size(len(stacked))
    image = np.zeros((height * ENTRIES_A_ROW, 16), np.uint16)
    image[: len(stacked)] = stacked
    return image.reshape(height, width, 4), entries


def unpack_morphs(
    image: NDArray[np.uint16], entries: Sequence[dict[str, Any]], num_texels: int, where: str
) -> tuple[MorphTarget, ...]:
    """The targets of an image.

    Parameters
    ----------
    image : (H, W, 4) uint16
    entries : what the manifest says of each target
    num_texels : int
        Of the position texture.
    where : str
        How messages name the image.

    Raises
    ------
    AssetError
        When texels do not lie in the texture, or in order.
    """
    stored = image.reshape(-1, 16)[: sum(entry["texels"] for entry in entries)].astype(np.int64)
    targets, first = [], 0
    for entry in entries:
        block = stored[first : first + entry["texels"]]
        first += entry["texels"]
        texels = block[:, 0] | block[:, 1] << 16
        if len(texels) and (texels.max() >= num_texels or (np.diff(texels) <= 0).any()):
            raise AssetError(f"{where} is not of this character: {REBUILD}")
        rows = np.empty((len(block), 3, 4), np.float32)
        rows[..., 3] = (block[:, 2:5] - MIDDLE) * (entry["shift_m"] / STEPS)
        rows[..., :3] = ((block[:, 5:14] - MIDDLE) * (entry["turn"] / STEPS)).reshape(-1, 3, 3)
        targets.append(MorphTarget(str(entry["name"]), float(entry["default"]), texels, rows))
    return tuple(targets)


@dataclass(frozen=True)
class Morphs:
    """All targets of a character.

    Attributes
    ----------
    targets : tuple of M MorphTarget
    size : (width, height)
        Of the position texture.
    """

    targets: tuple[MorphTarget, ...]
    size: tuple[int, int]

    @cached_property
    def texels(self) -> NDArray[np.int64]:
        """Texels that any target touches, (T,) rising: their place in it is their place in a sum."""
        empty = np.zeros(0, np.int64)
        return np.unique(np.concatenate([empty, *(target.texels for target in self.targets)]))

    @cached_property
    def _places(self) -> list[NDArray[np.int64]]:
        """Where in a sum each target's texels lie."""
        return [np.searchsorted(self.texels, target.texels) for target in self.targets]

    @cached_property
    def texel_numbers(self) -> NDArray[Any]:
        """Numbers of the four texels of every cell of the position texture, (H - 1, W - 1, 4); 0: never moves.

        One more than the texel's place in a sum; uint16 where these are enough, else uint32.
        """
        width, height = self.size
        numbers = np.zeros(width * height, np.uint16 if len(self.texels) < 0xFFFF else np.uint32)
        numbers[self.texels] = np.arange(1, len(self.texels) + 1)
        grid = np.pad(numbers.reshape(height, width), ((0, int(height == 1)), (0, int(width == 1))), mode="edge")
        return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]], axis=-1)

    def blend(self, weights: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """The sums of all targets for weights (A, M): (A, T, 3, 4)."""
        sums = np.zeros((len(weights), len(self.texels), 12), np.float32)
        for number, (target, places) in enumerate(zip(self.targets, self._places)):
            rows = target.rows.reshape(-1, 12)
            used = np.flatnonzero(weights[:, number])
            if len(used) == 1:
                sums[used[0], places] += np.float32(weights[used[0], number]) * rows
            elif len(used):
                sums[used[:, None], places] += weights[used, number].astype(np.float32)[:, None, None] * rows
        return sums.reshape(len(weights), -1, 3, 4)

    def rows_at(self, number: int, uvs: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """What a target of weight one does at places of the atlas (N, 2), read as the shaders read it: (N, 3, 4)."""
        size = np.array(self.size)
        px = np.clip(np.asarray(uvs, np.float64) * size - 0.5, 0.0, size - 1)
        corner = np.minimum(px.astype(np.int64), np.maximum(size - 2, 0))
        x, y = (px - corner).T
        far = np.minimum(corner + 1, size - 1)
        target = self.targets[number]
        found = np.zeros((len(px), 3, 4))
        for column, across in ((corner[:, 0], 1 - x), (far[:, 0], x)):
            for row, down in ((corner[:, 1], 1 - y), (far[:, 1], y)):
                texel = row * size[0] + column
                place = np.minimum(np.searchsorted(target.texels, texel), max(len(target.texels) - 1, 0))
                if len(target.texels):
                    hit = target.texels[place] == texel
                    found += np.where(hit, across * down, 0.0)[:, None, None] * target.rows[place]
        return found
