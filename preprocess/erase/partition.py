"""Rounding of weights: whole numbers that sum to the same total in every texel and keep seams closed.

Joint weights are a partition of unity. What is stored must be one too, exactly, or the skinned surface shrinks; and
both sides of a seam must agree, or it opens. So the search of `quantise` moves here in pairs: one channel of a texel
gains a step while another loses one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from preprocess.erase.quantise import GROWTH, LIMIT, MAX_ROUNDS, TOLERATED, _gain
from preprocess.erase.strip import SeamStrip
from preprocess.mesh import Floats

# Weights are also known at the vertices, and where a map is too coarse to meet both, a jump that nobody sees (shared
# points are skinned once) is better than a limb that moves with the wrong joint. So peaks count less than in `quantise`
# and staying near the solution more: on human at 384², mean error at the vertices 0.012 instead of 0.023. Peaks grow
# only where the first search leaves less than HOPELESS steps.
PEAK = 10.0
STAY = 0.3
HOPELESS = 2.0


@njit(cache=True, error_model="numpy")
def _round_to_total(values, total, stored):
    """Round every row to whole numbers that sum to total: down, then up where the remainders are largest."""
    num_channels = values.shape[1]
    remainder = np.empty(num_channels)
    for t in range(values.shape[0]):
        whole = 0.0
        for c in range(num_channels):
            remainder[c] = max(values[t, c], 0.0)
            whole += remainder[c]
        missing = total
        for c in range(num_channels):
            wanted = remainder[c] * total / whole if whole > 0.0 else (total if c == 0 else 0.0)
            kept = np.floor(wanted + 1e-9)
            stored[t, c] = kept
            remainder[c] = wanted - kept
            missing -= kept
        while missing > 0.5:
            best = 0
            for c in range(1, num_channels):
                if remainder[c] > remainder[best]:
                    best = c
            stored[t, best] += 1.0
            remainder[best] -= 1.0
            missing -= 1.0


@njit(cache=True, error_model="numpy")
def _search_pairs(
    texel_at,
    texels,
    point_at,
    points,
    point_weight,
    weights,
    wanted,
    stored,
    jump,
    peaks,
    queue,
    waiting,
    top,
    settings,
):
    """Move stored integers (C, N; changed in place) between channels until no jump exceeds the limit or none helps."""
    tolerated, stay, limit, growth, max_rounds, hopeless = settings
    num_channels, num_texels = stored.shape
    num_points = len(weights)
    head, count, visits, rounds = 0, num_texels, 0, 0
    while rounds < max_rounds and visits < 1000 * num_texels:
        if count == 0:
            rounds += 1
            violated = 0
            worst = 0.0
            for c in range(num_channels):
                for p in range(num_points):
                    worst = max(worst, abs(jump[c, p]))
            if worst > hopeless:
                break
            for c in range(num_channels):
                for p in range(num_points):
                    if abs(jump[c, p]) > limit:
                        violated += 1
                        peaks[c, p] *= growth
                        for k in range(texel_at[p], texel_at[p + 1]):
                            u = texels[k]
                            if not waiting[u]:
                                waiting[u] = True
                                queue[(head + count) % num_texels] = u
                                count += 1
            if violated == 0:
                break
        t = queue[head]
        head = (head + 1) % num_texels
        count -= 1
        visits += 1
        waiting[t] = False
        gain_up, gain_down, up, down = np.inf, np.inf, -1, -1
        for c in range(num_channels):
            moving = stored[c, t] > 0.0
            for k in range(point_at[t], point_at[t + 1]):
                moving = moving or jump[c, points[k]] != 0.0
            if not moving:
                continue
            for step in (-1.0, 1.0):
                if not 0.0 <= stored[c, t] + step <= top:
                    continue
                gain = _gain(t, step, points, point_at, point_weight, weights, peaks[c], jump[c], stored[c], wanted[c],
                             tolerated, stay)  # fmt: skip
                if step > 0.0 and gain < gain_up:
                    gain_up, up = gain, c
                if step < 0.0 and gain < gain_down:
                    gain_down, down = gain, c
        if up < 0 or down < 0 or up == down or gain_up + gain_down > -1e-9:
            continue
        stored[up, t] += 1.0
        stored[down, t] -= 1.0
        for k in range(point_at[t], point_at[t + 1]):
            p = points[k]
            jump[up, p] += point_weight[k]
            jump[down, p] -= point_weight[k]
            for n in range(texel_at[p], texel_at[p + 1]):
                u = texels[n]
                if not waiting[u]:
                    waiting[u] = True
                    queue[(head + count) % num_texels] = u
                    count += 1


def quantise_weights(texels: Floats, strip: SeamStrip, levels: int = 255) -> NDArray[Any]:
    """Round weights to integers that sum to `levels` in every texel and keep seams closed.

    Parameters
    ----------
    texels : (H, W, J) float
        Weights. Negative ones count as zero, and every texel is scaled to sum to one; where all are zero the first
        joint takes the whole weight.
    strip : SeamStrip
        Of all seams at this size.
    levels : int
        Sum of a texel's integers: 255 or 65535.

    Returns
    -------
    (H, W, J) uint8 or uint16
    """
    num_channels = texels.shape[2]
    stored = np.empty(texels.shape, np.uint8 if levels <= 255 else np.uint16)
    flat_stored, flat = stored.reshape(-1, num_channels), texels.reshape(-1, num_channels)
    _round_to_total(flat, float(levels), flat_stored)
    near = np.clip(np.asarray(flat[strip.texels], np.float64), 0, None)
    total = near.sum(axis=1, keepdims=True)
    wanted = np.ascontiguousarray((near / np.where(total > 0, total, 1.0)).T) * levels
    found = np.ascontiguousarray(flat_stored[strip.texels].T.astype(np.float64))
    rows, columns = strip.rows, strip.columns
    num_texels, num_points = len(strip.texels), len(strip.weights)
    _search_pairs(
        rows.indptr, rows.indices, columns.indptr, columns.indices, columns.data,
        strip.weights, wanted, found,
        np.ascontiguousarray((rows @ found.T).T), np.full((num_channels, num_points), PEAK),
        np.arange(num_texels), np.ones(num_texels, np.bool_), float(levels),
        (TOLERATED, STAY, LIMIT, GROWTH, MAX_ROUNDS, HOPELESS),
    )  # fmt: skip
    flat_stored[strip.texels] = found.T
    return stored
