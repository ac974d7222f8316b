"""The prefiltered environment map: light from around, by direction, in one texture (shaders/include/lighting.glsl).

Specular radiance is there in steps by roughness, eight of them between two of the environment's levels and each ready
blended, so that one bilinear sample does instead of two. Three columns of tiles hold them, each half as wide as the one
before and with tiles half as large, because rough surfaces mirror no detail. Light on a white sheet is one more tile.
A tile is two half spheres side by side, as in `runtime.scene.lighting`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from runtime.scene.lighting import MAP_SIZE, NUM_LEVELS, Environment, map_directions

STEPS_PER_LEVEL = 8
FIRST_STEP = STEPS_PER_LEVEL  # sharper ones are for a roughness below any that is drawn
LAST_STEP = STEPS_PER_LEVEL * (NUM_LEVELS - 1)
LARGEST_TILE = MAP_SIZE // 2  # a side of a half sphere's square in the first column
COLUMN_STARTS = (8, 16, 24)  # the first step in each column
MAP_WIDTH, MAP_HEIGHT = 4 * LARGEST_TILE, STEPS_PER_LEVEL * LARGEST_TILE
DIFFUSE_TILE = 48  # what nine harmonics hold varies so slowly that a sample is off by half a percent at most
DIFFUSE_CORNER = (400, 160)  # row, column: below the last tiles of both smaller columns


def _enlarged(texels: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """A map (S, 2 S, 3) as a bilinear filter samples it at the texels of a map of another size."""
    own = len(texels)
    if own == size:
        return texels
    at = np.clip((np.arange(size) + 0.5) * own / size - 0.5, 0, own - 1)
    first = np.minimum(at.astype(int), max(own - 2, 0))
    share = at - first
    blend = np.zeros((size, own))
    blend[np.arange(size), first] = 1 - share
    blend[np.arange(size), np.minimum(first + 1, own - 1)] += share
    halves = np.stack([texels[:, :own], texels[:, own:]])  # (2, rows, columns, 3)
    wide = np.einsum("jc,hrcn->hrjn", blend, halves, optimize=True)
    return np.concatenate(list(np.einsum("ir,hrjn->hijn", blend, wide, optimize=True)), axis=1)


def tile_corner(step: int) -> tuple[int, int, int]:
    """Row and column of a step's tile, and a side of its squares."""
    column = sum(step >= start for start in COLUMN_STARTS) - 1
    size = LARGEST_TILE >> column
    return (step - COLUMN_STARTS[column]) * size, MAP_WIDTH - (MAP_WIDTH >> column), size


def specular_radiance(environment: Environment) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Each step and its tile (S, 2 S, 3): what a roughness of (step / LAST_STEP)^2 mirrors."""
    for column, start in enumerate(COLUMN_STARTS):
        end = [*COLUMN_STARTS, LAST_STEP + 1][column + 1]
        first, last = start // STEPS_PER_LEVEL, -(-(end - 1) // STEPS_PER_LEVEL)
        levels = [_enlarged(level, LARGEST_TILE >> column) for level in environment.levels[first : last + 1]]
        for step in range(start, end):
            level, between = divmod(step - start, STEPS_PER_LEVEL)
            share = between / STEPS_PER_LEVEL
            yield step, levels[level] if not share else levels[level] * (1 - share) + levels[level + 1] * share


def prefiltered_map(environment: Environment) -> NDArray[np.float32]:
    """Texels (640, 320, 3) of the whole map."""
    texels = np.zeros((MAP_HEIGHT, MAP_WIDTH, 3), np.float32)
    for step, tile in specular_radiance(environment):
        row, column, size = tile_corner(step)
        texels[row : row + size, column : column + 2 * size] = tile
    row, column = DIFFUSE_CORNER
    diffuse = environment.diffuse_light(map_directions(DIFFUSE_TILE))
    texels[row : row + DIFFUSE_TILE, column : column + 2 * DIFFUSE_TILE] = diffuse
    return texels
