"""Stage "words": positions rounded to what the GPU holds, one 32-bit word a texel (runtime/asset/packed_positions.py).

A step is about 0.03 % of the diagonal, so plain rounding would cost half of the accuracy that vertices have, and open
seams twice as far. But of the eight texels at a seam point, or the four of a vertex, any may give way: texel by texel
each takes the whole number that lowers

    Σ (vertex's error)² / vertices  +  JUMP_WEIGHT · mean jump²  +  a little for what it moves,

until none moves. Vertices come out better than they were, seams about as closed. Between them the surface moves by a
step or two at most.
Divided surfaces show that step or two at their outlines, as a jitter. So words are for the small characters whose
texels would weigh more than the vertices that they stand for; all others keep 16 bits a channel.
Letters in shapes: N points, T texels that any of them or a seam reads, R rows (points, and three a seam interval).
"""

from __future__ import annotations

import logging

import numpy as np
import scipy.sparse as sp
from numba import njit

from preprocess.arrays import Floats, Ints
from preprocess.bake.geometry import stencil_matrix
from preprocess.erase.energies import jump_weights, to_rows
from preprocess.erase.intervals import cut_into_intervals
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from runtime.asset.packed_positions import PositionWords, choose_words

log = logging.getLogger(__name__)

CLASSIC_VERTEX_BYTES = 68  # position, normal, tangent, uv, joints and weights, as glTF has them
CHANNELS_BYTES = 8  # of a texel in 16 bits a channel
WORTH_REL = 0.7  # share of the classic vertices' bytes from which on such texels are too heavy
JUMP_WEIGHT = 1.0
STAY = 1e-3  # of a median texel's own weight, for every squared step away from what is wanted
REACH = 1.5  # steps that a texel may be from what is wanted
MAX_SWEEPS = 40  # a dozen do


def are_worth_it(size: tuple[int, int], num_vertices: int) -> bool:
    """Whether a position texture of this size should be in words, for so many vertices in all levels together."""
    return size[0] * size[1] * CHANNELS_BYTES > WORTH_REL * num_vertices * CLASSIC_VERTEX_BYTES


@njit(cache=True)  # type: ignore[untyped-decorator]
def _settle(  # type: ignore[no-untyped-def]
    starts, rows, shares, stay, off, left
) -> int:
    """Move texels by whole steps in turn until none gains; `off` (T,) and `left` (R,) change in place. Sweeps made.

    `starts` (T + 1,), `rows`, `shares` hold the columns of the weighted rows; `left` is what rows are off, `off` what
    texels are from what is wanted.
    """
    for sweep in range(MAX_SWEEPS):
        moved = False
        for texel in range(len(off)):
            slope, bend = stay * off[texel], stay
            for entry in range(starts[texel], starts[texel + 1]):
                slope += shares[entry] * left[rows[entry]]
                bend += shares[entry] * shares[entry]
            step = np.rint(-slope / bend)
            step = min(max(step, np.ceil(-REACH - off[texel])), np.floor(REACH - off[texel]))
            if step != 0.0:
                moved = True
                off[texel] += step
                for entry in range(starts[texel], starts[texel + 1]):
                    left[rows[entry]] += step * shares[entry]
        if not moved:
            return sweep + 1
    return MAX_SWEEPS


def _weighted_rows(
    surface: TexturedSurface, seams: Seams, uvs: Floats, size: tuple[int, int]
) -> tuple[sp.csr_matrix, Floats]:
    """Rows whose squares sum to the objective, over all texels, (R, H * W), and those weights of the points, (N,)."""
    width, height = size
    pull = np.full(len(uvs), 1.0 / np.sqrt(max(len(uvs), 1)))
    points = sp.diags(pull) @ stencil_matrix(uvs, width, height)
    if not len(seams.uv_pairs):
        return points.tocsr(), pull
    intervals = cut_into_intervals(surface.uvs[seams.uv_pairs], width, height)
    gamma, weights = intervals.gauss(3)
    lengths = seams.lengths_m[intervals.edges][:, None] / max(float(seams.lengths_m.sum()), 1e-30)
    jumps = to_rows(intervals.texels.reshape(-1, 8), jump_weights(intervals, gamma), width * height)
    jumps = sp.diags(np.sqrt(JUMP_WEIGHT * (weights * lengths).ravel())) @ jumps
    return sp.vstack([points, jumps]).tocsr(), pull


def round_positions(
    texels: Floats, surface: TexturedSurface, seams: Seams, uvs: Floats, positions: Floats
) -> tuple[Floats, PositionWords]:
    """Positions in whole steps.

    Parameters
    ----------
    texels : (H, W, 3) float64
        Metres.
    surface : TexturedSurface
    seams : Seams
        Of the surface.
    uvs, positions : (N, 2), (N, 3) float64
        Where vertices are fetched, and what they should be.

    Returns
    -------
    texels : (H, W, 3) float64
        Metres that `words` can say.
    words : PositionWords
    """
    height, width = texels.shape[:2]
    words = choose_words(texels.min(axis=(0, 1)), texels.max(axis=(0, 1)))
    steps_m = np.maximum(words.steps_m, 1e-30)
    wanted = ((texels - words.low) / steps_m).reshape(-1, 3)
    numbers = np.rint(wanted)
    weighted, pull = _weighted_rows(surface, seams, uvs, (width, height))
    columns = weighted.tocsc()
    columns.sum_duplicates()
    read: Ints = np.flatnonzero(np.diff(columns.indptr)).astype(np.int64)
    columns = columns[:, read]
    own = np.asarray(columns.power(2).sum(axis=0)).ravel()
    stay = STAY * float(np.median(own)) if len(read) else 0.0
    for axis in range(3 if stay > 0.0 else 0):
        asked = np.zeros(weighted.shape[0])
        asked[: len(uvs)] = pull * (positions[:, axis] - words.low[axis]) / steps_m[axis]
        left = columns @ numbers[read, axis] - asked
        before = numbers[read, axis] - wanted[read, axis]
        off = before.copy()
        sweeps = _settle(columns.indptr, columns.indices, columns.data, stay, off, left)
        numbers[read, axis] += np.rint(off - before)
        log.debug("positions, axis %d: %d sweeps", axis, sweeps)
    rounded = words.metres(np.clip(numbers, 0, words.masks)).reshape(texels.shape)
    log.info("positions in %d + %d + %d bits, steps of %.2g m", *words.bits, words.steps_m.max())
    return rounded, words
