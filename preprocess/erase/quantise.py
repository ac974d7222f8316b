"""Rounding to integers that keeps seams closed (method, section 3: what is stored is seamless).

Plain rounding moves each of the eight texels that meet at a seam point by up to half a step, so the two sides may
part by a whole one. Here every texel of the seam strip may take any integer, and a local search finds those for which
the jump along the seams is small everywhere. The objective, over points P along the seams (see `strip`):

    Σ_P weight · jump²  +  Σ_P peak · max(|jump| - TOLERATED, 0)²  +  STAY Σ (stored - wanted)²

Texels are visited in order; each takes the step that lowers the objective most; whenever one moves, all texels that
share a point with it are visited again. Where a point still jumps by more than `LIMIT` when nothing moves any more,
its peak weight grows and the search goes on (guided local search, Voudouris and Tsang 1999). In 8 bits this ends below
the limit; in 16 bits, where a texture's slope is many steps a texel, a few points may stay between it and two steps.
Values never leave the range: the search moves within it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from preprocess.erase.strip import SeamStrip
from preprocess.mesh import Floats

# Jumps, in steps of the format. The aim is 0.5 at every point of every seam.
LIMIT = 0.42
TOLERATED = 0.3
PEAK = 100.0
STAY = 0.005

# Peak weights grow by this factor a round, for at most so many rounds; the best round counts.
GROWTH = 1.5
MAX_ROUNDS = 24
MANY_STEPS = 8.0
MAX_VISITS = 60  # a texel; 8-bit searches end after about ten


@njit(cache=True, error_model="numpy")
def _gain(t, step, points, point_at, point_weight, weights, peaks, jump, stored, wanted, tolerated, stay):
    """Change of the objective when texel t moves by step."""
    off = stored[t] - wanted[t]
    gain = stay * step * (step + 2.0 * off)
    for k in range(point_at[t], point_at[t + 1]):
        p = points[k]
        old = jump[p]
        new = old + step * point_weight[k]
        gain += weights[p] * (new * new - old * old)
        over_old, over_new = max(abs(old) - tolerated, 0.0), max(abs(new) - tolerated, 0.0)
        gain += peaks[p] * (over_new * over_new - over_old * over_old)
    return gain


@njit(cache=True, error_model="numpy")
def _long_step(t, points, point_at, point_weight, weights, peaks, jump, tolerated):
    """The whole number of steps that would close the jumps round texel t best."""
    slope, curvature = 0.0, 1e-12
    for k in range(point_at[t], point_at[t + 1]):
        p, w = points[k], point_weight[k]
        stiffness = weights[p] + (peaks[p] if abs(jump[p]) > tolerated else 0.0)
        slope += stiffness * w * jump[p]
        curvature += stiffness * w * w
    return -np.rint(slope / curvature)


@njit(cache=True, error_model="numpy")
def _search(
    texel_at, texels, point_at, points, point_weight, weights, wanted, stored, jump, peaks, queue, waiting, best_stored,
    top, settings,
):  # fmt: skip
    """Move the stored integers of one channel until no jump exceeds the limit or nothing helps.

    The first two arrays are the strip's rows (texels a point), the next three its transpose (points a texel). From
    `stored` on arrays are changed in place: the integers, their jumps, the points' peak weights, a queue of all texels
    and whether each waits in it. The result is `best_stored`.
    """
    tolerated, stay, limit, growth, max_rounds = settings
    num_points, num_texels = len(weights), len(stored)
    best_jump = np.inf
    head, count, rounds, visits = 0, num_texels, 0, 0
    while rounds < max_rounds and visits < MAX_VISITS * num_texels:
        moved, step = -1, 0.0
        if count > 0:
            t = queue[head]
            head = (head + 1) % num_texels
            count -= 1
            waiting[t] = False
            visits += 1
            far = _long_step(t, points, point_at, point_weight, weights, peaks, jump, tolerated)
            best = -1e-9
            for k in range(-2, 3):
                candidate = far if k == 0 else float(k)
                if 0.0 <= stored[t] + candidate <= top:
                    gain = _gain(t, candidate, points, point_at, point_weight, weights, peaks, jump, stored, wanted,
                                 tolerated, stay)  # fmt: skip
                    if gain < best:
                        best, moved, step = gain, t, candidate
            if moved < 0:
                continue
            stored[t] += step
            first, last = point_at[t], point_at[t + 1]
        else:
            rounds += 1
            worst = 0.0
            for p in range(num_points):
                worst = max(worst, abs(jump[p]))
            if worst < best_jump:
                best_jump = worst
                for t in range(num_texels):
                    best_stored[t] = stored[t]
            if worst <= limit:
                break
            first, last = 0, num_points
        for k in range(first, last):
            p = k
            if moved >= 0:
                p = points[k]
                jump[p] += step * point_weight[k]
            elif abs(jump[p]) > limit:
                peaks[p] *= growth
            else:
                continue
            for n in range(texel_at[p], texel_at[p + 1]):
                u = texels[n]
                if not waiting[u]:
                    waiting[u] = True
                    queue[(head + count) % num_texels] = u
                    count += 1


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
    rounded = np.rint(wanted)
    num_texels, num_points = len(strip.texels), len(strip.weights)
    rows, columns = strip.rows, strip.columns
    settings = (TOLERATED, STAY, LIMIT, GROWTH, MAX_ROUNDS)
    result = rounded.copy()
    for channel in range(len(wanted)):
        if levels > 255 and np.abs(rows @ wanted[channel]).max(initial=0.0) > MANY_STEPS:
            continue  # the solution itself jumps by many steps (a finite seam weight): rounding adds nothing
        _search(
            rows.indptr, rows.indices, columns.indptr, columns.indices, columns.data,
            strip.weights, wanted[channel], rounded[channel], rows @ rounded[channel], np.full(num_points, PEAK),
            np.arange(num_texels), np.ones(num_texels, np.bool_), result[channel], float(levels), settings,
        )  # fmt: skip
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
