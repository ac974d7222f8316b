"""The linear system of the change, its factorisation and its constrained solution.

Unknown: the change y of the grid's free nodes; the texels become p = p0 + S y. All energies but the seam's add up to
a quadratic with matrix A and right-hand side b; the seam rows J must vanish on p. The penalty alone (the paper's
weight of 1e10) leaves a small jump and a badly conditioned matrix. The method of multipliers takes a moderate penalty
ρ and repeats, with the same factor of A + ρ JᵀJ,

    (A + ρ JᵀJ) y = b - ρ Jᵀ J p0 - Jᵀ λ,        λ ← λ + ρ J (p0 + S y)

until |J p|² is at rounding level (Hestenes 1969; Powell 1969). Each repetition costs one back substitution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.seam_samples import SeamStrip
from preprocess.mesh.grouping import connected_groups
from preprocess.numerics import cholesky
from preprocess.numerics.cholesky import factor_symmetric
from preprocess.numerics.nested_dissection import order_by_dissection

MAX_REPEATS = 60

# Systems of more unknowns are dissected where they lie and solved once: not within a range, nor with tighter limits.
MANY_UNKNOWNS = 300_000

# Bounds: weight of the pull towards the range (times the squared change), over-relaxation, when to stop.
BOUND_WEIGHT = 50.0
RELAXATION = 1.7
BOUND_TOLERANCE_REL = 1e-5
MAX_BOUND_REPEATS = 150

# Repetitions towards limited jumps: after as many, the worst is a third above its limit and the rest below.
LIMIT_REPEATS = 10


class NotConvergedError(RuntimeError):
    """The seam constraint could not be met to the tolerance asked for."""


@dataclass(frozen=True)
class Factor:
    """Factorised system over the free unknowns. Solve with `solve_change`.

    Attributes
    ----------
    lu : cholesky.Factor
        Of A + ρ JᵀJ.
    assemble : function
        Makes A + ρ JᵀJ, (U, U) sparse, again: seldom wanted, and large.
    jump : (R, U) sparse
        Seam rows J on the free unknowns.
    row_scales : (R,) float64
        Of each row against the jump at its point: the root of the length that it stands for.
    penalty : float
        ρ.
    """

    lu: cholesky.Factor
    assemble: Callable[[], sparse.csr_array]
    jump: sparse.csr_array
    row_scales: Floats
    penalty: float

    @property
    def is_large(self) -> bool:
        """Whether it takes so long that it is solved once."""
        return self.jump.shape[1] > MANY_UNKNOWNS


def factorise(
    assemble: Callable[[], sparse.csr_array],
    jump: sparse.csr_array,
    row_scales: Floats,
    penalty: float,
    locate: Callable[[], Floats] | None = None,
) -> Factor:
    """Factor A + ρ JᵀJ once for all channels and repetitions.

    Parameters
    ----------
    assemble : function
        Returns A + ρ JᵀJ, (U, U) sparse, symmetric positive definite.
    jump : (R, U) sparse
        J.
    row_scales : (R,) float64
        See `Factor`.
    penalty : float
        ρ.
    locate : function, optional
        Returns where the unknowns lie on the surface, (U, 3): asked of systems with many.
    """
    matrix = _by_columns(assemble())
    order = None
    if locate is not None and matrix.shape[0] > MANY_UNKNOWNS:
        order = order_by_dissection(matrix, locate())
    return Factor(factor_symmetric(matrix, order), assemble, jump, row_scales, penalty)


def _by_columns(matrix: sparse.csr_array) -> sparse.csc_array:
    """A symmetric matrix, whose rows are its columns."""
    return sparse.csc_array((matrix.data, matrix.indices, matrix.indptr), shape=matrix.shape)


def solve_change(factor: Factor, force: Floats, jump_before: Floats, tolerance: float) -> tuple[Floats, Floats, int]:
    """Solve for the change of every channel.

    Parameters
    ----------
    factor : Factor
    force : (U, C) float64
        b.
    jump_before : (R, C) float64
        J p0.
    tolerance : float
        Mean squared jump at which to stop, for each channel.

    Returns
    -------
    change : (U, C) float64
    seam_energy : (C,) float64
        |J p|² of the solution.
    repeats : int

    Raises
    ------
    NotConvergedError
        If the jump stays above the tolerance.
    """
    multiplier = np.zeros_like(jump_before)
    seam_energy = np.full(force.shape[1], np.inf)
    for repeat in range(1, MAX_REPEATS + 1):
        change = factor.lu.solve(force - factor.jump.T @ (factor.penalty * jump_before + multiplier))
        jump = jump_before + factor.jump @ change
        seam_energy = np.einsum("rc,rc->c", jump, jump)
        if (seam_energy <= tolerance).all():
            return change, seam_energy, repeat
        multiplier += factor.penalty * jump
    raise NotConvergedError(
        f"seam energy {seam_energy.max():.1e} after {MAX_REPEATS} repetitions, wanted {tolerance:.1e}"
    )


def solve_limited(factor: Factor, force: Floats, jump_before: Floats, limit: Floats) -> tuple[Floats, Floats, Floats]:
    """Solve for the change of every channel with jumps that cost nothing up to a limit.

    The alternating direction method of multipliers (Boyd et al. 2011, section 5.2) on the seam rows: solutions whose
    jump is pulled to a goal alternate with clipping the jump to the limit, the same factor throughout.

    Parameters
    ----------
    factor : Factor
    force : (U, C) float64
        b.
    jump_before : (R, C) float64
        J p0.
    limit : (C,) float64
        Largest jump at a point.

    Returns
    -------
    change : (U, C) float64
    seam_energy : (C,) float64
        |J p|² of the solution.
    goal : (R, C) float64
        What the jump of this solution is pulled to instead of to zero.
    """
    most = factor.row_scales[:, None] * limit
    allowed, dual = np.zeros_like(jump_before), np.zeros_like(jump_before)
    for _ in range(LIMIT_REPEATS):
        goal = allowed - dual
        change = factor.lu.solve(force - factor.jump.T @ (factor.penalty * (jump_before - goal)))
        jump = jump_before + factor.jump @ change
        relaxed = RELAXATION * jump + (1 - RELAXATION) * allowed
        allowed = np.clip(relaxed + dual, -most, most)
        dual += relaxed - allowed
    return change, np.einsum("rc,rc->c", jump, jump), goal


def factorise_bounded(factor: Factor, bounded: NDArray[np.int32]) -> cholesky.Factor:
    """Factor the system with a pull on some unknowns, for `solve_bounded`.

    Parameters
    ----------
    factor : Factor
    bounded : (N,) int32
        Unknowns that have bounds.
    """
    pull = np.zeros(factor.jump.shape[1])
    pull[bounded] = BOUND_WEIGHT
    return factor_symmetric(_by_columns(sparse.csr_array(factor.assemble() + sparse.diags_array(pull, format="csr"))))


def solve_bounded(
    factor: Factor,
    pulled: cholesky.Factor,
    force: Floats,
    jump_before: Floats,
    change: Floats,
    bounded: NDArray[np.int32],
    lower: Floats,
    upper: Floats,
) -> tuple[Floats, float]:
    """Bring some unknowns into a range and keep the seams closed.

    The alternating direction method of multipliers (Boyd et al. 2011, section 5.2): solutions of the linear system,
    pulled towards a copy of the bounded unknowns, alternate with clipping that copy. Every solution is seamless; the
    limit is also in range. It may take more repetitions than there are: `keep_by_contrast` ends it then.

    Parameters
    ----------
    factor : Factor
    pulled : cholesky.Factor
        From `factorise_bounded`.
    force : (U, C) float64
    jump_before : (R, C) float64
    change : (U, C) float64
        The solution without bounds.
    bounded : (N,) int32
        Unknowns that have bounds.
    lower, upper : (N, C) float64
        Bounds of their change.

    Returns
    -------
    change : (U, C) float64
    excess : float
        How far the worst one still lies outside.
    """
    base = force - factor.jump.T @ (factor.penalty * jump_before)
    change = change.copy()
    copy = np.clip(change[bounded], lower, upper)
    dual = np.zeros_like(copy)
    excess = np.full(force.shape[1], np.inf)
    left = np.arange(force.shape[1])  # channels that are not there yet
    for _ in range(MAX_BOUND_REPEATS):
        target = base[:, left]
        target[bounded] += BOUND_WEIGHT * (copy[:, left] - dual[:, left])
        change[:, left] = pulled.solve(target)
        here = change[np.ix_(bounded, left)]
        excess[left] = np.maximum(lower[:, left] - here, here - upper[:, left]).max(axis=0)
        relaxed = RELAXATION * here + (1 - RELAXATION) * copy[:, left]
        copy[:, left] = np.clip(relaxed + dual[:, left], lower[:, left], upper[:, left])
        dual[:, left] += relaxed - copy[:, left]
        left = np.flatnonzero(excess > BOUND_TOLERANCE_REL)
        if not len(left):
            break
    return change, float(excess.max())


def keep_by_contrast(values: Floats, strip: SeamStrip, lower: Floats, upper: Floats) -> Floats:
    """Bring a seamless strip into a range by lowering its contrast, each connected part by as much as it needs.

    Moving all values of a part towards one constant by one fraction scales every jump by that fraction: closed seams
    stay closed. This is the answer that always exists where `solve_bounded` has not come to its limit.

    Parameters
    ----------
    values : (N, C) float64
        At the strip's texels.
    strip : SeamStrip
    lower, upper : (C,) float64

    Returns
    -------
    (N, C) float64
        Within the range.
    """
    # Texels and points as one graph, an edge wherever a point reads a texel.
    reads = sparse.coo_array(strip.rows)
    num_points, num_both = reads.shape[0], sum(reads.shape)
    num, part = connected_groups(num_both, reads.row, reads.col + num_points)
    part = part[num_points:]
    count = np.maximum(np.bincount(part, minlength=num), 1)
    result = np.empty_like(values)
    for channel in range(values.shape[1]):
        low, high, value = lower[channel], upper[channel], values[:, channel]
        center = np.clip(np.bincount(part, value, num) / count, low, high)
        # Next to an end of the range there is no room for any contrast: the middle of the range has some.
        center = 0.5 * (center + 0.5 * (low + high))
        away = value - center[part]
        room = np.where(away > 0, high - center[part], center[part] - low)
        kept = np.ones(num)
        np.minimum.at(kept, part, room / np.maximum(np.abs(away), room))
        result[:, channel] = np.clip(center[part] + kept[part] * away, low, high)
    return result
