"""Rounding to integers that keeps seams closed (docs/method.md, section 3: what is stored is seamless).

Plain rounding moves each of the eight texels that meet at a seam point by up to half a step, so the two sides may
part by a whole one. Here every texel of the seam strip may take any integer near its wanted value, and a local search
finds those for which the jump along the seams is small everywhere. The objective, over points P along the seams (see
`strip`):

    Σ_P weight · jump²  +  Σ_P peak · max(|jump| - TOLERATED, 0)²  +  STAY Σ (stored - wanted)²

Each texel in turn takes the step that lowers the objective most; when one moves, all texels that share a point with it
are visited again. Where a point still jumps by more than `LIMIT` when nothing moves any more, its peak weight grows
and the search goes on (guided local search, Voudouris and Tsang 1999). Values never leave the range, nor go further
than `REACH` steps from what is wanted.

Texels that share no point move independently, so many are visited at once, group by group (`SeamStrip.groups`); of
several that do share one only that with the largest gain moves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats, Singles
from preprocess.erase.seam_samples import SeamStrip
from preprocess.erase.two_opt import best_pair

# Jumps, in steps of the format. The aim is 0.5 at every point of every seam.
LIMIT = 0.42
TOLERATED = 0.3
PEAK = 100.0
STAY = 0.005
REACH = 4.0

# Peak weights grow by this factor a round, for at most so many rounds, or so many without a smaller peak. After the
# first, a peak of `ENOUGH` will do, pairs of texels move too, and now and then texels may go twice as far.
GROWTH = 1.5
MAX_ROUNDS = 60
MAX_IDLE_ROUNDS = 20
MAX_SWEEPS = 24  # a round
PATIENT_ROUNDS = 5
ENOUGH = 0.48
WIDER_ROUNDS = (9, 15)
FEW_POINTS = 64
PAIRS_A_ROUND = 24
MAX_PAIRS = 300

# Where the wanted values themselves jump by so many 16-bit steps (a finite seam weight), rounding adds nothing.
MANY_STEPS = 8.0

AT_A_TIME = 1536  # visits: their points fit the processor's cache
SMALLEST_GAIN = 1e-5
MANY = 0.05  # share of texels that wait from which sorting out the hopeless ones first pays


def _excess(jump: Singles) -> Singles:
    """How far jumps exceed what is tolerated, with their sign."""
    return jump - np.clip(jump, np.float32(-TOLERATED), np.float32(TOLERATED))


def _best_steps(
    jump: Singles,
    share: Singles,
    weights: Singles,
    peaks: Singles,
    off: Singles,
    low: Singles,
    high: Singles,
    longest: int,
) -> tuple[Singles, Singles]:
    """The step that lowers each texel's cost most, zero where none does, and by how much.

    The cost is convex in the step, so only steps down its slope can lower it.

    Parameters
    ----------
    jump, share, weights, peaks : (M, D) float32
        Of the points of each texel: jump, the texel's weight in it, the point's own weight and peak weight.
    off, low, high : (M,) float32
        What is stored less what is wanted, and the least and the most that this may be.
    longest : int
        Steps of up to so many are tried.

    Returns
    -------
    step, gain : (M,) float32
    """
    stay = np.float32(STAY)
    over = _excess(jump)
    peak_before = np.einsum("md,md,md->m", peaks, over, over)
    slope = np.einsum("md,md,md->m", weights, jump, share)
    bend = np.einsum("md,md,md->m", weights, share, share)
    down = -np.sign(slope + np.einsum("md,md,md->m", peaks, over, share) + stay * off)
    best, gain = np.zeros_like(off), np.full_like(off, -SMALLEST_GAIN)
    for length in range(1, longest + 1):
        step = down * np.float32(length)
        over = _excess(jump + step[:, None] * share)
        change = step * (2 * slope + step * bend) + np.einsum("md,md,md->m", peaks, over, over) - peak_before
        change += stay * step * (step + 2 * off)
        better = (off + step <= high) & (off + step >= low) & (change < gain)
        gain[better], best[better] = change[better], step[better]
    return best, gain


class _Search:
    """The integers of a strip's texels on their way. C channels, N texels, P points.

    Texels and points have one more row, of no meaning, that short rows of the strip's tables refer to.
    """

    def __init__(self, wanted: Floats, strip: SeamStrip, levels: int) -> None:
        """Start at plain rounding; wanted is (C, N), in steps."""
        self.strip = strip
        self.num_channels, self.num_texels = wanted.shape
        num_points = len(strip.weights)
        # The points of texel t and its weights in them are numbers starts[t] to starts[t + 1].
        columns = sparse.csr_array(strip.rows.T)
        self.starts = columns.indptr
        self.points = np.append(columns.indices, np.int32(num_points))
        self.shares = np.append(columns.data, 0.0).astype(np.float32)
        self.weights = np.append(strip.weights, 0.0).astype(np.float32)
        self.columns = sparse.csr_array((self.shares[:-1], columns.indices, columns.indptr), shape=columns.shape)
        self.bend = np.asarray(self.columns.power(2).dot(self.weights[:-1])) + np.float32(STAY)
        self.wanted = wanted
        self.stored = np.rint(wanted)
        self.jump = np.zeros((self.num_channels, num_points + 1), np.float32)
        self.jump[:, :-1] = (strip.rows @ self.stored.T).T
        self.peaks = np.full_like(self.jump, PEAK)
        self.off = (self.stored - wanted).astype(np.float32)
        self.levels = levels
        self._set_reach(REACH)
        self.waits = np.ones((self.num_channels, self.num_texels + 1), np.bool_)
        self.waits[:, -1] = False
        self.owner = np.zeros(self.jump.size, np.int32)
        self.stirred = np.zeros_like(self.jump, np.bool_)  # points whose jump has changed in this sweep
        # Group by group, those with few points first, so that tables can be cut to the longest row in use.
        self.degree = np.diff(self.starts)
        self.turn = np.argsort(np.lexsort((self.degree, strip.groups)))

    def sweep(self, longest: int) -> bool:
        """Visit all texels that wait; return whether any moved."""
        if np.count_nonzero(self.waits) > MANY * self.waits.size:
            self.waits[:, :-1] &= self._can_gain()
        channel, texel = np.nonzero(self.waits)
        self.waits[:] = False
        order = np.argsort(self.turn[texel], kind="stable")
        channel, texel = channel[order], texel[order]
        ends = np.searchsorted(self.strip.groups[texel], np.arange(1, 9))
        moved = False
        for first, last in zip([0, *ends[:-1]], ends, strict=True):
            for start in range(first, last, AT_A_TIME):
                part = slice(start, min(start + AT_A_TIME, last))
                moved |= self._visit(texel[part], channel[part], longest)
        self.stirred[:, -1] = False
        self._wait_near(*np.nonzero(self.stirred))
        self.stirred[:] = False
        return moved

    def _can_gain(self) -> NDArray[np.bool_]:
        """Texels that a step may help, (C, N): the cost falls faster than the least curvature makes up for."""
        force = self.weights * self.jump + self.peaks * _excess(self.jump)
        slope = (self.columns @ force[:, :-1].T).T + np.float32(STAY) * self.off
        return np.asarray(2 * np.abs(slope) > self.bend)

    def _wait_near(self, channel: NDArray[np.int64], point: NDArray[np.int64]) -> None:
        """Let the texels of some points be visited."""
        self.waits[channel[:, None], self.strip.texels_of_point[point]] = True
        self.waits[:, -1] = False

    def _visit(self, texel: NDArray[np.int64], channel: NDArray[np.int64], longest: int) -> bool:
        degree = self.degree[texel][:, None]
        places = np.arange(degree.max(initial=1))
        entry = np.where(places < degree, self.starts[texel][:, None] + places, len(self.points) - 1)
        points, share = self.points[entry], self.shares[entry]
        at = points + (channel * self.jump.shape[1])[:, None]
        jump = self.jump.ravel()[at]
        step, gain = _best_steps(
            jump, share, self.weights[points], self.peaks.ravel()[at],
            self.off[channel, texel], self.low[channel, texel], self.high[channel, texel], longest,
        )  # fmt: skip
        moving = np.flatnonzero(step)
        if not len(moving):
            return False
        moving = moving[np.argsort(-gain[moving], kind="stable")]
        # The last to claim a point has it: that with the largest gain.
        rank = np.arange(len(moving), dtype=np.int32)[:, None]
        self.owner[at[moving]] = rank
        wins = ((self.owner[at[moving]] == rank) | (share[moving] == 0)).all(axis=1)
        loses = moving[~wins]
        self.waits[channel[loses], texel[loses]] = True
        moving = moving[wins]
        texel, channel, step, at = texel[moving], channel[moving], step[moving], at[moving]
        self.stored[channel, texel] += step
        self.off[channel, texel] += step
        self.jump.ravel()[at] = jump[moving] + step[:, None] * share[moving]
        self.jump[:, -1] = 0.0
        self.stirred.ravel()[at] = True
        return True

    def run(self) -> Floats:
        """Search until no point exceeds the limit or nothing helps; the integers with the smallest peak, (C, N)."""
        best, best_peak = self.stored.copy(), np.full(self.num_channels, np.inf)
        idle, longest, pairs_left = 0, 1, MAX_PAIRS
        for turn in range(MAX_ROUNDS):
            for _ in range(MAX_SWEEPS):
                if not self.sweep(longest):
                    break
            peak = np.abs(self.jump).max(axis=1, initial=0.0)
            lower = peak < best_peak
            best[lower], best_peak[lower] = self.stored[lower], peak[lower]
            idle = 0 if lower.any() else idle + 1
            limit = LIMIT if turn < PATIENT_ROUNDS else ENOUGH
            is_open = best_peak > limit
            jump = np.abs(self.jump[:, :-1]) * is_open[:, None]
            num_open = np.count_nonzero(jump > ENOUGH)
            if not is_open.any() or idle >= (MAX_IDLE_ROUNDS if num_open <= FEW_POINTS else PATIENT_ROUNDS):
                break
            if turn >= PATIENT_ROUNDS and num_open <= FEW_POINTS:
                pairs_left -= self._move_pairs(jump > ENOUGH, pairs_left)
            channel, point = np.nonzero(jump > LIMIT)
            self.peaks[channel, point] *= GROWTH
            self._wait_near(channel, point)
            longest = 2
            if turn in WIDER_ROUNDS:
                self._set_reach(2.0 * self.reach)
        return best

    def _set_reach(self, reach: float) -> None:
        """How far texels may go from what is wanted."""
        self.reach = reach
        self.low = np.maximum(-reach, -self.wanted - 0.01).astype(np.float32)
        self.high = np.minimum(reach, self.levels - self.wanted + 0.01).astype(np.float32)

    def _move_pairs(self, chosen: NDArray[np.bool_], at_most: int) -> int:
        """Move pairs of texels for those of the chosen points (C, P) that jump most; return for how many."""
        channel, point = np.nonzero(chosen)
        order = np.argsort(-np.abs(self.jump[channel, point]), kind="stable")[: min(at_most, PAIRS_A_ROUND)]
        for c, p in zip(channel[order], point[order], strict=True):
            if abs(self.jump[c, p]) <= ENOUGH:
                continue
            texels = self.strip.texels_of_point[p]
            first = np.unique(texels[texels < self.num_texels])
            points = np.unique(self.columns[first].indices)
            near = np.unique(self.strip.texels_of_point[points])
            near = near[near < self.num_texels]
            block = self.columns[near]
            points = np.unique(block.indices)
            shares = block[:, points].toarray()
            found = best_pair(
                np.searchsorted(near, first), shares, self.jump[c, points], self.weights[points], self.peaks[c, points],
                self.off[c, near], self.low[c, near], self.high[c, near], TOLERATED, STAY,
            )  # fmt: skip
            if found is None:
                continue
            for texel, step in zip(*found, strict=True):
                self.stored[c, near[texel]] += step
                self.off[c, near[texel]] += step
                self.jump[c, points] += np.float32(step) * shares[texel]
                touched = points[shares[texel] != 0]
                self._wait_near(np.full(len(touched), c), touched)
        return len(order)


def round_strip(values: Floats, strip: SeamStrip, levels: int) -> Floats:
    """Integers for the texels of a seam strip.

    Parameters
    ----------
    values : (N, C) float64
        Wanted values, in [0, 1], at `strip.texels`; values beyond are brought to the nearest in range first.
    strip : SeamStrip
    levels : int
        Largest integer: 255 or 65535.

    Returns
    -------
    (N, C) float64
        Whole numbers from 0 to levels.
    """
    wanted = np.ascontiguousarray(np.clip(values, 0, 1).T) * levels
    result = np.rint(wanted)
    jumps = np.abs(strip.rows @ wanted.T).max(axis=0, initial=0.0)
    sought = (jumps <= MANY_STEPS) | (levels <= 255)
    if len(strip.weights) and sought.any():
        result[sought] = _Search(wanted[sought], strip, levels).run()
    return result.T


def quantise(texels: Floats, strip: SeamStrip, levels: int) -> NDArray[Any]:
    """Round a texture to integers such that the stored texels are seamless.

    Parameters
    ----------
    texels : (H, W, C) float
        In [0, 1]; values beyond are brought to the nearest in range before the search.
    strip : SeamStrip
        Of the joined seams at this size.
    levels : int
        Largest stored integer: 255 or 65535.

    Returns
    -------
    (H, W, C) uint8 or uint16
        Texels that no seam reads are rounded to the nearest integer.
    """
    height, _, channels = texels.shape
    stored = np.empty(texels.shape, np.uint8 if levels <= 255 else np.uint16)
    for row in range(height):
        stored[row] = np.clip(np.rint(texels[row] * float(levels)), 0, levels)
    flat = stored.reshape(-1, channels)
    wanted = np.asarray(texels.reshape(-1, channels)[strip.texels], np.float64)
    flat[strip.texels] = round_strip(wanted, strip, levels)
    return stored
