"""Rounding to integers that keeps seams closed (method: what is stored is seamless).

Plain rounding moves each of the eight texels that meet at a seam point by up to half a step, so the two sides may part
by a whole one. Here every texel beside a seam may take any integer near its wanted value, and a local search finds
those for which the jump is small at every sample of the seams (see `band`). The objective, in steps:

    Σ_P length · jump²  +  Σ_P peak · max(|jump| - TOLERATED, 0)²  +  STAY Σ (stored - wanted)²

First each texel in turn takes the step that lowers it, until none does. Then only samples are looked at that still
jump by more than their limit: of the texels that one reads, that moves whose step lowers the objective most; where none
does, the sample's peak weight grows (guided local search, Voudouris and Tsang 1999). Values never leave the range, nor
go further than `REACH` steps from what is wanted. A step changes the sums of a few samples alone, so it costs what
these cost.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.erase.local.band import Band
from preprocess.numerics.jit import fixed_memory_entry, fixed_memory_helper

TOLERATED = 0.3
PEAK, GROWTH = 100.0, 1.5
STAY = 0.005
REACH = 4.0
SMALLEST_GAIN = 1e-5
MAX_SWEEPS, MAX_ROUNDS = 8, 1000
MAX_IDLE = 60  # rounds without fewer samples beyond their limits than ever
WIDER_ROUND = 300  # from here on texels may go twice as far


@fixed_memory_helper
def _gain(t, step, away, jump, peak, lengths, starts, samples, shares):  # type: ignore[no-untyped-def]
    """How much the objective falls if a texel `away` from what is wanted moves by a step."""
    change = STAY * step * (step + 2.0 * away)
    for e in range(starts[t], starts[t + 1]):
        s = samples[e]
        before, after = abs(jump[s]), abs(jump[s] + step * shares[e])
        over, left = max(before - TOLERATED, 0.0), max(after - TOLERATED, 0.0)
        change += lengths[s] * (after * after - before * before) + peak[s] * (left * left - over * over)
    return -change


@fixed_memory_entry
def _search(  # type: ignore[no-untyped-def]
    wanted, stored, jump, peak, limits, texels, weights, lengths, starts, samples, shares, most, queue, following, waits
):
    """One channel: `stored` (N,) from plain rounding to what is found; returns how many samples exceed their limit."""
    for _ in range(MAX_SWEEPS):
        moved = 0
        for t in range(len(stored)):
            if starts[t] == starts[t + 1]:
                continue
            away = stored[t] - wanted[t]
            slope = STAY * away
            for e in range(starts[t], starts[t + 1]):
                s = samples[e]
                over = jump[s] - min(max(jump[s], -TOLERATED), TOLERATED)
                slope += (lengths[s] * jump[s] + peak[s] * over) * shares[e]
            step = -1.0 if slope > 0.0 else 1.0
            if abs(away + step) > REACH or stored[t] + step < 0.0 or stored[t] + step > most:
                continue
            if _gain(t, step, away, jump, peak, lengths, starts, samples, shares) > SMALLEST_GAIN:
                moved += 1
                stored[t] += step
                for e in range(starts[t], starts[t + 1]):
                    jump[samples[e]] += step * shares[e]
        if moved == 0:
            break
    waiting = 0
    for s in range(len(jump)):
        waits[s] = abs(jump[s]) > limits[s]
        if waits[s]:
            queue[waiting] = s
            waiting += 1
    fewest, since = waiting, 0
    for turn in range(MAX_ROUNDS):
        if waiting < fewest:
            fewest, since = waiting, turn
        if waiting == 0 or turn > since + MAX_IDLE:
            break
        reach = REACH if turn < WIDER_ROUND else 2.0 * REACH
        for q in range(waiting):
            waits[queue[q]] = False
        num = 0
        for q in range(waiting):
            s = queue[q]
            if abs(jump[s]) <= limits[s]:
                continue
            best, best_step, best_gain = -1, 0.0, SMALLEST_GAIN
            for k in range(8):
                if weights[s, k] == 0.0:
                    continue
                t = texels[s, k]
                step = -1.0 if jump[s] * weights[s, k] > 0.0 else 1.0
                away = stored[t] - wanted[t]
                if abs(away + step) > reach or stored[t] + step < 0.0 or stored[t] + step > most:
                    continue
                gain = _gain(t, step, away, jump, peak, lengths, starts, samples, shares)
                if gain > best_gain:
                    best, best_step, best_gain = t, step, gain
            if best < 0:
                peak[s] *= GROWTH
            else:
                stored[best] += best_step
                for e in range(starts[best], starts[best + 1]):
                    other = samples[e]
                    jump[other] += best_step * shares[e]
                    if abs(jump[other]) > limits[other] and not waits[other]:
                        waits[other] = True
                        following[num] = other
                        num += 1
            if abs(jump[s]) > limits[s] and not waits[s]:
                waits[s] = True
                following[num] = s
                num += 1
        queue, following = following, queue
        waiting = num
    return waiting


def round_texels(wanted: Floats, band: Band, limits: Floats, most: int) -> Floats:
    """Integers for a band's texels.

    Parameters
    ----------
    wanted : (N, C) float64
        In steps.
    band : Band
    limits : (P,) float64
        Of the jump at each sample, steps; kept wherever the search finds a way.
    most : int
        Largest integer: 255, say.

    Returns
    -------
    (N, C) float64
        Whole numbers from 0 to `most`.
    """
    stored = np.clip(np.rint(wanted), 0, most)
    jumps = band.jumps(stored)
    num = len(limits)
    queue, following, waits = np.empty(num, np.int32), np.empty(num, np.int32), np.empty(num, np.bool_)
    for channel in range(wanted.shape[1]):
        one = np.ascontiguousarray(stored[:, channel])
        _search(
            np.ascontiguousarray(wanted[:, channel]), one, np.ascontiguousarray(jumps[:, channel]),
            np.full(num, PEAK), limits, band.sample_texels, band.sample_weights, band.sample_lengths,
            band.starts, band.samples, band.shares, float(most), queue, following, waits,
        )  # fmt: skip
        stored[:, channel] = one
    return stored
