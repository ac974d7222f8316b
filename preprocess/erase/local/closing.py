"""Erasure of what lies near seams: closed, within range, and as stored integers (paper, section 4).

The change reaches a few texels, so only a band beside the seams is solved (see `band`), in steps whose cost is linear
in its texels: relaxation with a growing penalty, projection into the limits, a direct solution around what these leave,
rounding (see `relax`, `constrained`, `rounding`). Where the stored texels still jump too far, the limits there are
tightened, and the last three are done again.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.erase.local.band import Band
from preprocess.erase.local.constrained import solve_near
from preprocess.erase.local.relax import project, relax
from preprocess.erase.local.rounding import round_texels
from preprocess.erase.seam_samples import SeamMeasure

log = logging.getLogger(__name__)

UNIT = 255.0  # everything is solved in 8-bit steps
# Jump, in steps, that a solution may have: below it costs nothing, which keeps paint.
JUMP_LIMIT = 0.4
# Penalty of jumps per texel of seam, in units of the gradient's, how far beyond the minimum texels go, and whether all
# texels of the band are visited or those that seams read.
RELAXATIONS = (
    *((1.0, 1.5, True),) * 2,
    *((2.0, 1.5, True),) * 2,
    *((4.0, 1.5, True),) * 2,
    *((8.0, 1.3, True),) * 2,
    *((16.0, 1.3, True),) * 2,
    *((64.0, 1.0, False),) * 2,
    *((256.0, 1.0, False),) * 2,
)
MAX_SOLUTIONS = 2  # each after a projection
SOFT = 0.5  # of the limit: from where on jumps cost while texels are relaxed
MAX_SWEEPS = 20  # of projections: each visits those samples alone that are still beyond the limit
# Stored: at most half a step at any point of any seam, sought at the samples with a little room.
MAX_STORED, SOUGHT = 0.5, 0.48
TIGHTER, LOWER, TIGHTER_RINGS = 0.4, 0.9, 3
MAX_ROUNDS = 5


@dataclass(frozen=True)
class Closed:
    """A texture whose seams are closed.

    Attributes
    ----------
    texels : (H, W, C) float32 or uint8 or uint16
    before, after, stored : SeamMeasure
        Jump of the texels given, of the solution, and of `texels`; integers as values in [0, 1].
    change : float
        Root mean square change of the texels inside charts, of the solution.
    """

    texels: NDArray[Any]
    before: SeamMeasure
    after: SeamMeasure
    stored: SeamMeasure
    change: float


def close_seams(
    texels: NDArray[np.floating],
    band: Band,
    *,
    levels: int = 0,
    jump_limit: float = JUMP_LIMIT,
    most_change: float = np.inf,
) -> Closed | None:
    """Close the seams of one texture.

    Parameters
    ----------
    texels : (H, W, C) float
        In [0, 1] where integers are asked for; values beyond are brought to the nearest in range.
    band : Band
        For this size.
    levels : int
        Largest integer to store: 255 or 65535; 0 for float texels.
    jump_limit : float
        Of the solution, in 255ths.
    most_change : float
        Give up where texels inside charts move by more than this, root mean square.

    Returns
    -------
    Closed or None
        Jumps are within half a 255th wherever a way was found; `stored` says so.
    """
    channels = texels.shape[2]
    low, high = (0.0, UNIT) if levels else (-np.inf, np.inf)
    given = np.clip(UNIT * texels.reshape(-1, channels)[band.texels].astype(np.float64), low, high)
    before = band.jumps(given)
    limits = np.full(len(before), jump_limit)
    values, jumps = _relax(band, given, before, limits, low, high)
    if _change(band, given, values) > most_change:  # it can only grow
        return None
    _limit(band, given, values, jumps, limits, low, high)
    after = band.jumps(values)
    change = _change(band, given, values)
    if change > most_change:
        return None
    if levels == UNIT:
        kept = _round(band, given, values, after.copy(), limits)
    else:
        kept = np.rint(values * (levels / UNIT)) * (UNIT / levels) if levels else values
    seams = [_in_unit(band.measure(jumps)) for jumps in (before, after, band.jumps(kept))]
    return Closed(_put_back(texels, band, kept, levels), seams[0], seams[1], seams[2], change)


def _change(band: Band, given: Floats, values: Floats) -> float:
    """Root mean square change of the texels inside charts, all channels, as values in [0, 1]."""
    moved = (values - given)[band.region.inside.ravel()[band.texels]]
    return float(np.sqrt((moved**2).sum() / max(band.region.num_inside * given.shape[1], 1))) / UNIT


def _relax(band: Band, given: Floats, jumps: Floats, limits: Floats, low: float, high: float) -> tuple[Floats, Floats]:
    """Values as near to those given as they may be, with small jumps; and these jumps."""
    values, jumps = given.copy(), jumps.copy()
    if not len(band.seam_texels):
        return values, jumps
    pull = np.zeros_like(given)
    for k in range(4):
        weight = np.where(band.keeps_difference[:, k], band.stiffness[:, k], 0.0)[:, None]
        pull += weight * (given - given[band.neighbours[:, k]])
    every = np.arange(len(given), dtype=np.int32)
    for number, (penalty, beyond, is_all) in enumerate(RELAXATIONS):
        order = every if is_all else band.seam_texels
        relax(
            np.ascontiguousarray(order[::-1]) if number % 2 else order, values, given, pull, band.mass,
            band.neighbours, band.stiffness, band.starts, band.samples, band.shares, jumps,
            np.float32(penalty) * band.sample_lengths, SOFT * float(limits.max()), beyond, low, high,
        )  # fmt: skip
    return values, jumps


def _limit(band: Band, given: Floats, values: Floats, jumps: Floats, limits: Floats, low: float, high: float) -> None:
    """Bring samples into their limits; `values` and `jumps` change in place."""
    for _ in range(MAX_SOLUTIONS):
        left = project(
            values, jumps, band.sample_texels, band.sample_weights, band.starts, band.samples, band.shares, limits,
            low, high, MAX_SWEEPS, np.empty(len(limits), np.int32), np.empty(len(limits), np.bool_),
        )  # fmt: skip
        if not left:
            break
        solve_near(band, given, values, jumps, limits, low, high)


def _round(band: Band, given: Floats, values: Floats, jumps: Floats, limits: Floats) -> Floats:
    """Whole numbers near the values that jump by no more than is allowed; values, jumps and limits change in place."""
    stored = np.rint(values)
    sought = np.full(len(limits), SOUGHT)
    open_channels = np.arange(values.shape[1])
    for turn in range(MAX_ROUNDS):
        wanted = np.ascontiguousarray(values[:, open_channels])
        stored[:, open_channels] = round_texels(wanted, band, sought, int(UNIT))
        exceeds = band.peaks(band.jumps(stored)) > MAX_STORED
        open_channels = np.flatnonzero(exceeds.any(axis=0))
        if not len(open_channels):
            break
        wrong = np.zeros(len(limits), np.bool_)
        wrong[band.interval_samples[exceeds.any(axis=1)]] = True
        log.debug("erase: %d samples jump too far as stored, round %d", wrong.sum(), turn)
        sought[wrong] *= LOWER
        limits[band.samples_near(wrong, TIGHTER_RINGS)] *= TIGHTER
        _limit(band, given, values, jumps, limits, 0.0, UNIT)
    return stored


def _put_back(texels: NDArray[np.floating], band: Band, kept: Floats, levels: int) -> NDArray[Any]:
    """The texture with the band's texels, in the type that is stored."""
    if levels:
        stored = np.empty(texels.shape, np.uint8 if levels <= UNIT else np.uint16)
        for row, line in zip(stored, texels, strict=True):
            row[:] = np.clip(np.rint(line * levels), 0, levels)
        stored.reshape(-1, texels.shape[2])[band.texels] = np.rint(kept * (levels / UNIT))
        return stored
    result = np.array(texels, np.float32, order="C")
    result.reshape(-1, texels.shape[2])[band.texels] = kept / UNIT
    return result


def _in_unit(measure: SeamMeasure) -> SeamMeasure:
    return SeamMeasure(measure.rms / UNIT, measure.max / UNIT, measure.total / UNIT**2, measure.seam_rms / UNIT)
