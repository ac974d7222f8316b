"""Jumps within limits and texels within range by a direct solution: for the few samples that projection is slow with.

What a straight seam may carry is a curve whose curvature is limited, and paint that bends too much must be spread over
many texels along it. Projections carry it one texel at a time; a factored system does so at once. Seams are strips a
few texels wide, so the factor of one is hardly larger than its matrix, and only what lies near the offending samples is
solved. The alternating direction method of multipliers (Boyd et al. 2011, section 5.2) splits off two copies: the
jumps, clipped to their limits, and the texels, clipped to their range; the same factor serves all repetitions and all
channels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Bools, Floats
from preprocess.erase.local.band import Band
from preprocess.numerics.cholesky import factor_symmetric

RINGS = 12  # samples sharing a texel, ring by ring, that are solved with those beyond their limits
PENALTY = 3e5  # of a jump per texel of seam, in units of the gradient's
RANGE_PENALTY = 3.0
RELAXATION = 1.7
REPEATS, MOST_REPEATS = 8, 32  # after the first it ends as soon as all is within limits
FEW_TEXELS, REPEATS_OF_FEW = 8000, 56  # coarse mips, where limits are hard to keep and repetitions cost little
# Where charts are a few texels wide, each texel is read along several seams, and these tie texels from all over the
# texture: the factor fills. By entries per row of the system, CPU s of its factor: 14.0, 0.4 (BrainStem, 178,000 texels
# at 1024 x 1024); 14.6, 0.8 (97,000 at 512 x 512); 17.1, 24 (41,000 at 256 x 256). Beyond this many projection must do.
ENTANGLED = 16
AIM = 0.8  # of the limits: the method comes close to what it is asked for, not quite there


def solve_near(
    band: Band, given: Floats, values: Floats, jumps: Floats, limits: Floats, low: float, high: float
) -> None:
    """Bring samples that are beyond their limits into them; the texels around them change.

    Nothing changes where seams are too entangled for a direct solution (`ENTANGLED`).

    Parameters
    ----------
    band : Band
    given : (N, C) float64
        What the texels are held to.
    values, jumps : (N, C), (P, C) float64
        The texels and their jumps: changed in place.
    limits : (P,) float64
    low, high : float
        Range of the texels; infinite for none.
    """
    exceeds: Bools = np.any(np.abs(jumps) > limits[:, None], axis=1)
    near = band.samples_near(exceeds, RINGS)
    is_free = np.zeros(len(values), np.bool_)
    reads = band.sample_weights != 0.0
    is_free[band.sample_texels[near][reads[near]]] = True
    free = np.flatnonzero(is_free)
    samples = np.flatnonzero((is_free[band.sample_texels] & reads).any(axis=1))
    number = np.full(len(values), -1)
    number[free] = np.arange(len(free))
    rows = _rows(number[band.sample_texels[samples]], band.sample_weights[samples], len(free))
    columns = sparse.csr_array(rows.T)
    penalty = PENALTY * band.sample_lengths[samples].astype(np.float64)
    matrix, force = _energy(band, given, values, free, number)
    range_penalty = RANGE_PENALTY if np.isfinite(low) or np.isfinite(high) else 0.0
    system = matrix + columns @ sparse.diags_array(penalty) @ rows + range_penalty * sparse.eye_array(len(free))
    if len(free) > FEW_TEXELS and system.nnz > ENTANGLED * len(free):
        return
    factor = factor_symmetric(sparse.csc_array(system))

    start, jump = values[free], jumps[samples]
    most = AIM * limits[samples, None]
    allowed, dual = np.zeros_like(jump), np.zeros_like(jump)  # closing all is always possible: from there outwards
    inside, range_dual = np.clip(start, low, high), np.zeros_like(start)
    change = np.zeros_like(start)
    for repeat in range(REPEATS_OF_FEW if len(free) <= FEW_TEXELS else MOST_REPEATS):
        pull = columns @ (penalty[:, None] * (jump - allowed + dual)) + range_penalty * (start - inside + range_dual)
        change = factor.solve(force - pull)
        reached = jump + rows @ change
        kept = np.clip(start + change, low, high)
        if repeat >= REPEATS and (np.abs(jump + rows @ (kept - start)) <= limits[samples, None]).all():
            break
        ahead = RELAXATION * reached + (1.0 - RELAXATION) * allowed
        allowed = np.clip(ahead + dual, -most, most)
        dual += ahead - allowed
        ahead = RELAXATION * (start + change) + (1.0 - RELAXATION) * inside
        inside = np.clip(ahead + range_dual, low, high)
        range_dual += ahead - inside
    values[free] = np.clip(start + change, low, high)
    jumps[samples] = jump + rows @ (values[free] - start)


def _rows(texels: NDArray[np.integer], weights: NDArray[np.floating], num: int) -> sparse.csr_array:
    """Sparse rows of weights (P, 8) at unknowns (P, 8), those that are not -1: (P, num)."""
    counts = (texels >= 0) & (weights != 0.0)
    row = np.broadcast_to(np.arange(len(texels))[:, None], texels.shape)
    return sparse.csr_array((weights[counts].astype(np.float64), (row[counts], texels[counts])), (len(texels), num))


def _energy(
    band: Band, given: Floats, values: Floats, free: NDArray[np.int64], number: NDArray[np.int64]
) -> tuple[sparse.csr_array, Floats]:
    """Matrix of the energies of change and differences over some texels, and the force of their present values."""
    stiffness = band.stiffness[free].astype(np.float64)
    mass = band.mass[free].astype(np.float64)
    neighbours = band.neighbours[free]
    others = number[neighbours]
    force = mass[:, None] * (given[free] - values[free])
    for k in range(4):
        there = neighbours[:, k]
        target = np.where(band.keeps_difference[free, k, None], given[free] - given[there], 0.0)
        force += stiffness[:, k, None] * (target - (values[free] - values[there]))
    linked = (stiffness > 0.0) & (others >= 0)
    row = np.broadcast_to(np.arange(len(free))[:, None], others.shape)
    between = sparse.csr_array((-stiffness[linked], (row[linked], others[linked])), (len(free), len(free)))
    return sparse.csr_array(between + sparse.diags_array(mass + stiffness.sum(axis=1))), force
