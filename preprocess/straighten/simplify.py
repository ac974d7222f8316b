"""Joint simplification of both sides of a chain (paper, section 6; Ramer 1972, Douglas and Peucker 1973).

A chain is a polyline in the joint space of its uv copies: 4D for a seam, 2D for a boundary. A run replaces the points
i..j by the straight segment from i to j; a removed point moves to the same fraction of it on both sides, so that the
length ratios agree. Ramer, Douglas and Peucker's rule (no point farther than the tolerance from its segment) says which
runs are allowed; among them the fewest are taken, by a breadth-first search over the points (Imai and Iri 1988), and of
the equally few those with the least squared displacement.

Fractions are projections onto the joint segment, blended with chord lengths just as far as it takes to keep the points
in order and no gap below a quarter of its share.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Bools, Floats, Ints
from preprocess.numerics.jit import entry, helper
from preprocess.straighten.chains import Chains

LEAST_GAP = 0.25  # of the share by chord length: keeps the triangles along a run from being squeezed
LEAST_CHORD = 0.05  # a side's segment may not be shorter than this fraction of the path it replaces


@helper
def _run_fractions(joint, length, i, j, fractions):  # type: ignore[no-untyped-def]
    """Fractions of the points between i and j on the segment i..j, in order; False where the segment has no length."""
    dims = joint.shape[1]
    square = 0.0
    for d in range(dims):
        square += (joint[j, d] - joint[i, d]) ** 2
    span = length[j] - length[i]
    if square <= 0.0 or span <= 0.0:
        return False
    blend = 0.0
    before = 0.0
    for k in range(i + 1, j + 1):
        dot = 0.0
        for d in range(dims):
            dot += (joint[k, d] - joint[i, d]) * (joint[j, d] - joint[i, d])
        after = 1.0 if k == j else dot / square
        share = (length[k] - length[k - 1]) / span
        gap = after - before
        if gap < LEAST_GAP * share:
            blend = max(blend, (LEAST_GAP * share - gap) / (share - gap))
        fractions[k] = after
        before = after
    for k in range(i + 1, j):
        fractions[k] += blend * ((length[k] - length[i]) / span - fractions[k])
    return True


@helper
def _run_cost(joint, length, sides, i, j, limits_sq, fractions, suspect):  # type: ignore[no-untyped-def]
    """Sum of squared displacements of the run i..j, or -1 - k where point k moves farther than allowed."""
    dims = joint.shape[1]
    if j == i + 1:
        return 0.0
    for side in range(dims // 2):
        x = joint[j, 2 * side] - joint[i, 2 * side]
        y = joint[j, 2 * side + 1] - joint[i, 2 * side + 1]
        if x * x + y * y < (LEAST_CHORD * (sides[j, side] - sides[i, side])) ** 2:
            return -1.0 - (i + j) // 2
    square = 0.0
    for d in range(dims):
        square += (joint[j, d] - joint[i, d]) ** 2
    if i < suspect < j and square > 0.0:  # the point that failed last is likely to fail again
        dot, far = 0.0, 0.0
        for d in range(dims):
            dot += (joint[suspect, d] - joint[i, d]) * (joint[j, d] - joint[i, d])
            far += (joint[suspect, d] - joint[i, d]) ** 2
        if far - dot * dot / square > limits_sq[suspect]:
            return -1.0 - suspect
    if not _run_fractions(joint, length, i, j, fractions):
        return -1.0 - (i + j) // 2
    total = 0.0
    for k in range(i + 1, j):
        moved = 0.0
        for d in range(dims):
            moved += (joint[i, d] + fractions[k] * (joint[j, d] - joint[i, d]) - joint[k, d]) ** 2
        if moved > limits_sq[k]:
            return -1.0 - k
        total += moved
    return total


@helper
def _simplify(joint, length, sides, must_keep, limits_sq):  # type: ignore[no-untyped-def]
    """Fewest runs that cover a chain: kept points (n,) bool and the fraction of every point on its run (n,).

    Breadth-first search: layer r holds the points that r runs reach. No run crosses a point that must stay.
    """
    n = len(joint)
    layer = np.empty(n, np.int64)
    layer[:] = -1
    cost = np.zeros(n)
    previous = np.zeros(n, np.int64)
    fractions = np.zeros(n)
    layer[0] = 0
    current = 0
    while layer[n - 1] < 0:
        for i in range(n):
            if layer[i] != current:
                continue
            suspect = np.int64(-1)
            for j in range(i + 1, n):
                if layer[j] < 0 or layer[j] == current + 1:
                    moved = _run_cost(joint, length, sides, i, j, limits_sq, fractions, suspect)
                    if moved < 0.0:
                        suspect = np.int64(-moved - 1.0)
                    elif layer[j] < 0 or cost[i] + moved < cost[j]:
                        layer[j] = current + 1
                        cost[j] = cost[i] + moved
                        previous[j] = i
                if must_keep[j]:
                    break
        current += 1
    kept = np.zeros(n, np.bool_)
    kept[n - 1] = True
    fractions[:] = 0.0
    j = n - 1
    while j > 0:
        i = previous[j]
        kept[i] = True
        if j > i + 1:
            _run_fractions(joint, length, i, j, fractions)
        fractions[j] = 0.0
        j = i
    return kept, fractions


@entry
def _simplify_all(offsets, joint, is_seam, must_keep, limits_sq, kept, fractions, pending):  # type: ignore[no-untyped-def]
    """`_simplify` for every chain that is marked, into `kept` and `fractions`."""
    for c in range(len(offsets) - 1):
        if not pending[c]:
            continue
        low, n = offsets[c], offsets[c + 1] - offsets[c]
        dims = 4 if is_seam[c] else 2
        chain, limits = np.empty((n, dims)), np.empty(n)
        keep, length, sides = np.zeros(n, np.bool_), np.zeros(n), np.zeros((n, 2))
        for k in range(n):
            keep[k], limits[k] = must_keep[low + k], limits_sq[low + k]
            square = 0.0
            for d in range(dims):
                chain[k, d] = joint[low + k, d]
                if k > 0:
                    step = chain[k, d] - chain[k - 1, d]
                    square += step * step
                    sides[k, d // 2] += step * step
            if k > 0:
                length[k] = length[k - 1] + np.sqrt(square)
                for side in range(2):
                    sides[k, side] = sides[k - 1, side] + np.sqrt(sides[k, side])
        chain_kept, chain_fractions = _simplify(chain, length, sides, keep, limits)
        for k in range(n):
            kept[low + k], fractions[low + k] = chain_kept[k], chain_fractions[k]


def joint_points(chains: Chains, uvs: Floats) -> Floats:
    """Points of all chains in the joint space, (P, 4) float64; the last two columns are 0 on boundaries."""
    joint = np.zeros((len(chains.vertices), 4))
    joint[:, :2] = uvs[chains.uv_ids[:, 0]]
    two = chains.uv_ids[:, 1] >= 0
    joint[two, 2:] = uvs[chains.uv_ids[two, 1]]
    return joint


def chain_extents_uv(chains: Chains, joint: Floats) -> Floats:
    """Diagonal of every chain's bounding box in the joint space, (C,) float64."""
    if not chains.num_chains:
        return np.zeros(0)
    starts = chains.offsets[:-1].astype(np.int64)
    box = np.maximum.reduceat(joint, starts) - np.minimum.reduceat(joint, starts)
    result: Floats = np.linalg.norm(box, axis=1)
    return result


def simplify_chains(
    chains: Chains,
    joint: Floats,
    limits_uv: Floats,
    must_keep: Bools,
    kept: Bools,
    fractions: Floats,
    pending: Bools,
) -> tuple[Bools, Floats]:
    """Choose the points of the marked chains that stay.

    Parameters
    ----------
    chains : Chains
    joint : (P, 4) float64
        From `joint_points`.
    limits_uv : (P,) float64
        Farthest that each point may move in the joint space.
    must_keep : (P,) bool
        Points that stay whatever the tolerance.
    kept : (P,) bool
    fractions : (P,) float64
        The result so far, for the chains that are not marked.
    pending : (C,) bool

    Returns
    -------
    kept : (P,) bool
        Ends of chains are always kept.
    fractions : (P,) float64
        Of a removed point, between the kept points before and after it; 0 at kept points.
    """
    kept, fractions = kept.copy(), fractions.copy()
    _simplify_all(chains.offsets, joint, chains.is_seam, must_keep, limits_uv**2, kept, fractions, pending)
    return kept, fractions


def run_ends(kept: Bools) -> tuple[Ints, Ints]:
    """Kept points before and after every point, each (P,) int32; both are the point itself where it is kept."""
    index = np.arange(len(kept))
    before = np.maximum.accumulate(np.where(kept, index, 0))
    after = np.minimum.accumulate(np.where(kept, index, len(kept))[::-1])[::-1]
    return before.astype(np.int32), after.astype(np.int32)


def straight_points(joint: Floats, kept: Bools, fractions: Floats) -> Floats:
    """Where the points go: kept ones stay, removed ones lie on their run's segment, (P, 4) float64."""
    before, after = run_ends(kept)
    t = fractions[:, None]
    return np.where(kept[:, None], joint, (1.0 - t) * joint[before] + t * joint[after])
