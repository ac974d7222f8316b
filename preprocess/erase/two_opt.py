"""Two texels moved at once, where no single step helps a rounding search any more (see `quantise`).

A point that still jumps too much sits in a valley of the cost: each of its texels spoils another point when it moves.
Then one of them is moved all the same, and the texel that answers best is moved with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Singles

STEPS = (-2.0, -1.0, 1.0, 2.0)
ANSWERS = 6  # texels whose answer to a first move is worked out, those with the steepest cost


def best_pair(
    first: NDArray[np.int64],
    shares: Singles,
    jump: Singles,
    weights: Singles,
    peaks: Singles,
    off: Singles,
    low: Singles,
    high: Singles,
    tolerated: float,
    stay: float,
) -> tuple[list[int], list[float]] | None:
    """The two steps that lower the cost most.

    Parameters
    ----------
    first : (K,) int64
        Texels that one of the steps is for.
    shares : (M, P) float32
        Weight of each texel in each point.
    jump, weights, peaks : (P,) float32
        Of the points: jump, weight and peak weight.
    off, low, high : (M,) float32
        What is stored less what is wanted, and the least and the most that this may be.
    tolerated, stay : float
        See `quantise`.

    Returns
    -------
    texels, steps : list
        Two of each; None where no pair helps.
    """

    def cost(at: Singles) -> Singles:
        over = np.maximum(np.abs(at) - np.float32(tolerated), np.float32(0))
        return np.asarray((weights * at * at + peaks * over * over).sum(axis=-1))

    before = cost(jump)
    squares = shares * shares
    best, answer = -1e-4, None
    for texel in first:
        for step in STEPS:
            if not low[texel] <= off[texel] + step <= high[texel]:
                continue
            moved = jump + np.float32(step) * shares[texel]
            own = stay * step * (step + 2 * off[texel])
            over = moved - np.clip(moved, -tolerated, tolerated)
            slope = shares @ (weights * moved + peaks * over) + stay * off
            bend = squares @ (weights + np.where(over != 0, peaks, np.float32(0))) + stay
            promise = slope * slope / bend
            promise[texel] = -1.0
            chosen = np.argpartition(-promise, min(ANSWERS, len(promise) - 1))[:ANSWERS]
            for length in (1.0, 2.0):
                reply = -np.sign(slope[chosen]) * np.float32(length)
                change = cost(moved + reply[:, None] * shares[chosen]) - before + own
                change += stay * reply * (reply + 2 * off[chosen])
                there = off[chosen] + reply
                change[(there < low[chosen]) | (there > high[chosen]) | (chosen == texel)] = np.inf
                k = int(change.argmin())
                if change[k] < best:
                    best, answer = float(change[k]), ([int(texel), int(chosen[k])], [step, float(reply[k])])
    return answer
