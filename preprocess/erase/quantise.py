"""Rounding to integers that keeps seams closed (method, section 3: what is stored is seamless).

Plain rounding moves each of the eight texels that meet at a seam point by up to half a step, so the two sides may
part by a whole one. Here every texel of the seam strip may take any integer, and a local search finds those for which
the jump along the seams is small everywhere. The objective, over points P along the seams (see `strip`):

    Σ_P weight · jump²  +  Σ_P peak · max(|jump| - TOLERATED, 0)²  +  STAY Σ (stored - wanted)²

Texels are visited in order; each takes the step that lowers the objective most; whenever one moves, all texels that
share a point with it are visited again. Where a point still jumps by more than `LIMIT` when nothing moves any more,
its peak weight grows and the search goes on (guided local search, Voudouris and Tsang 1999); now and then pairs of
texels around such a point are tried together. Values never leave the range: the search moves within it.
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

# Peak weights grow by this factor a round, for at most so many rounds; every so many rounds pairs are tried.
GROWTH = 2.0
MAX_ROUNDS = 40
PAIR_ROUNDS = 8


@njit(cache=True)
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


@njit(cache=True)
def _long_step(t, points, point_at, point_weight, weights, peaks, jump, tolerated):
    """The whole number of steps that would close the jumps round texel t best."""
    slope, curvature = 0.0, 1e-12
    for k in range(point_at[t], point_at[t + 1]):
        p, w = points[k], point_weight[k]
        stiffness = weights[p] + (peaks[p] if abs(jump[p]) > tolerated else 0.0)
        slope += stiffness * w * jump[p]
        curvature += stiffness * w * w
    return -np.rint(slope / curvature)


@njit(cache=True)
def _search(texel_at, texels, texel_weight, point_at, points, point_weight, weights, wanted, stored, top, settings):
    """Move the stored integers (changed in place) of one channel until no jump exceeds the limit or nothing helps.

    The first three arrays are the strip's rows (texels a point), the next three its transpose (points a texel).
    """
    tolerated, peak, stay, limit, growth, max_rounds, pair_rounds = settings
    num_points, num_texels = len(weights), len(stored)
    jump = np.zeros(num_points)
    peaks = np.full(num_points, peak)
    for p in range(num_points):
        for k in range(texel_at[p], texel_at[p + 1]):
            jump[p] += texel_weight[k] * stored[texels[k]]
    queue = np.arange(num_texels)
    waiting = np.ones(num_texels, np.bool_)
    head, count = 0, num_texels
    chosen = np.empty(2, np.int64)
    steps = np.empty(2)
    rounds, pair_point, visits = 0, num_points, 0
    while rounds < max_rounds and visits < 1000 * num_texels:
        num_moves = 0
        best = -1e-9
        if count > 0:
            t = queue[head]
            head = (head + 1) % num_texels
            count -= 1
            waiting[t] = False
            visits += 1
            far = _long_step(t, points, point_at, point_weight, weights, peaks, jump, tolerated)
            for step in (-2.0, -1.0, 1.0, 2.0, far):
                if step != 0.0 and 0.0 <= stored[t] + step <= top:
                    gain = _gain(
                        t, step, points, point_at, point_weight, weights, peaks, jump, stored, wanted, tolerated, stay
                    )
                    if gain < best:
                        best, num_moves, chosen[0], steps[0] = gain, 1, t, step
        elif pair_point < num_points:
            worst = pair_point
            pair_point += 1
            if abs(jump[worst]) <= limit:
                continue
            for k in range(texel_at[worst], texel_at[worst + 1]):
                a = texels[k]
                for step_a in (-1.0, 1.0):
                    if not 0.0 <= stored[a] + step_a <= top:
                        continue
                    first = _gain(
                        a, step_a, points, point_at, point_weight, weights, peaks, jump, stored, wanted, tolerated, stay
                    )
                    for n in range(point_at[a], point_at[a + 1]):
                        jump[points[n]] += step_a * point_weight[n]
                    for n in range(point_at[a], point_at[a + 1]):
                        q = points[n]
                        for m in range(texel_at[q], texel_at[q + 1]):
                            b = texels[m]
                            if b == a:
                                continue
                            for step_b in (-1.0, 1.0):
                                if not 0.0 <= stored[b] + step_b <= top:
                                    continue
                                gain = first + _gain(
                                    b, step_b, points, point_at, point_weight,
                                    weights, peaks, jump, stored, wanted, tolerated, stay,
                                )  # fmt: skip
                                if gain < best:
                                    best, num_moves = gain, 2
                                    chosen[0], steps[0], chosen[1], steps[1] = a, step_a, b, step_b
                    for n in range(point_at[a], point_at[a + 1]):
                        jump[points[n]] -= step_a * point_weight[n]
        else:
            rounds += 1
            violated = 0
            for p in range(num_points):
                if abs(jump[p]) > limit:
                    violated += 1
                    peaks[p] *= growth
                    for k in range(texel_at[p], texel_at[p + 1]):
                        u = texels[k]
                        if not waiting[u]:
                            waiting[u] = True
                            queue[(head + count) % num_texels] = u
                            count += 1
            if violated == 0:
                break
            if rounds % pair_rounds == 0:
                pair_point = 0
        for move in range(num_moves):
            t, step = chosen[move], steps[move]
            stored[t] += step
            for k in range(point_at[t], point_at[t + 1]):
                p = points[k]
                jump[p] += step * point_weight[k]
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
    stored = np.rint(wanted)
    rows, columns = strip.rows, strip.columns
    settings = (TOLERATED, PEAK, STAY, LIMIT, GROWTH, MAX_ROUNDS, PAIR_ROUNDS)
    for start, found in zip(wanted, stored, strict=True):
        _search(
            rows.indptr, rows.indices, rows.data,
            columns.indptr, columns.indices, columns.data,
            strip.weights, start, found, float(levels), settings,
        )  # fmt: skip
    return stored.T


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
