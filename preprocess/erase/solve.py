"""The linear system of the change, its factorisation and its constrained solution.

Unknown: the change y of the grid's free nodes; the texels become p = p0 + S y. All energies but the seam's add up to
a quadratic with matrix A and right-hand side b; the seam rows J must vanish on p. The penalty alone (the paper's
weight of 1e10) leaves a small jump and a badly conditioned matrix. The method of multipliers takes a moderate penalty
ρ and repeats, with the same factor of A + ρ JᵀJ,

    (A + ρ JᵀJ) y = b - ρ Jᵀ J p0 - Jᵀ λ,        λ ← λ + ρ J (p0 + S y)

until |J p|² is at rounding level (Hestenes 1969; Powell 1969). Each repetition costs one back substitution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess import cholesky
from preprocess.cholesky import factor_symmetric
from preprocess.erase.grid import Grid
from preprocess.mesh import Floats

# Weight of one grid edge in the gradient energies, as in the authors' program, where the four edges round an
# interior texel add up to a diagonal of one.
GRADIENT_MASS = 0.25

SIDES = 24  # sides of squares: powers of two below this one

# Weight of any node's squared change, so that outside texels with no inside texel near them have an answer too.
TIE = 1e-8

MAX_REPEATS = 60

# Bounds: weight of the pull towards the range (times the squared change), over-relaxation, when to stop.
BOUND_WEIGHT = 50.0
RELAXATION = 1.7
BOUND_TOLERANCE_REL = 1e-5
MAX_BOUND_REPEATS = 300


class NotConvergedError(RuntimeError):
    """The seam constraint could not be met to the tolerance asked for."""


@dataclass(frozen=True)
class Factor:
    """Factorised system over the free unknowns. Solve with `solve_change`.

    Attributes
    ----------
    lu : cholesky.Factor
        Of A + ρ JᵀJ.
    matrix : (U, U) sparse
        A + ρ JᵀJ, for the residual.
    jump : (R, U) sparse
        Seam rows J on the free unknowns.
    penalty : float
        ρ.
    """

    lu: cholesky.Factor
    matrix: sparse.csc_array
    jump: sparse.csr_array
    penalty: float


def _square_elements(sides: NDArray[np.int64], mass: float, stiffness: float) -> Floats:
    """Energy matrices of squares of the given sides, (Q, 4, 4).

    One axis of a square of side h has h + 1 texels, the two outer ones counting half, and h grid edges. With hat
    functions a = 1 - k/h and b = k/h: Σ a² = h/3 + 1/(6h), Σ ab = h/6 - 1/(6h), and differences squared sum to 1/h.
    """
    h = np.asarray(sides, np.float64)
    same, cross = h / 3 + 1 / (6 * h), h / 6 - 1 / (6 * h)
    m = np.stack([same, cross, cross, same], axis=1).reshape(-1, 2, 2)
    k = np.stack([1 / h, -1 / h, -1 / h, 1 / h], axis=1).reshape(-1, 2, 2)

    def product(rows: Floats, columns: Floats) -> Floats:
        return np.einsum("qij,qkl->qikjl", rows, columns).reshape(-1, 4, 4)

    return mass * product(m, m) + stiffness * (product(k, m) + product(m, k))


def grid_matrix(grid: Grid, change_weight: float, inside_weight: float, outside_weight: float) -> sparse.csr_array:
    """Matrix of the change and gradient energies over all nodes, (N, N).

    Parameters
    ----------
    grid : Grid
    change_weight : float
        Of one inside texel's squared change.
    inside_weight, outside_weight : float
        Of one grid edge between inside texels, and of one that touches an outside texel.
    """
    first, second = grid.edge_nodes.T
    both_inside = grid.inside[first] & grid.inside[second]
    weight = grid.edge_mass * np.where(both_inside, inside_weight, outside_weight)
    num = len(grid.nodes)
    diagonal = change_weight * grid.texel_mass * grid.inside + TIE
    for end in (first, second):
        diagonal += np.bincount(end, weight, num)
    # All squares of a side have the same energy, with one entry for a corner, one for a side, one for a diagonal.
    elements = _square_elements(np.array([1], np.int64) << np.arange(SIDES), change_weight, inside_weight)
    element = elements[np.log2(grid.square_sides).astype(np.int64)]
    diagonal += np.bincount(grid.squares.ravel(), np.repeat(element[:, 0, 0], 4), num)
    a, b = np.triu_indices(4, 1)
    rows = np.concatenate([first, grid.squares[:, a].ravel()]).astype(np.int32)
    columns = np.concatenate([second, grid.squares[:, b].ravel()]).astype(np.int32)
    values = np.concatenate([-weight, element[:, a, b].ravel()])
    upper = sparse.csr_array(sparse.coo_array((values, (rows, columns)), shape=(num, num)))
    return sparse.csr_array(upper + upper.T + sparse.diags_array(diagonal, format="csr"))


def outside_force(grid: Grid, node_values: Floats, outside_weight: float) -> Floats:
    """What the outside gradient energy adds to the right-hand side for the original texels, (N, C)."""
    first, second = grid.edge_nodes.T
    touches = ~(grid.inside[first] & grid.inside[second])
    first, second = first[touches], second[touches]
    weight = (grid.edge_mass[touches] * outside_weight)[:, None]
    pull = weight * (node_values[second] - node_values[first])
    num = len(grid.nodes)
    ones = np.ones(len(first))
    edges = np.arange(len(first))
    shape = (num, len(first))
    scatter = sparse.csr_array((ones, (first, edges)), shape) - sparse.csr_array((ones, (second, edges)), shape)
    return np.asarray(scatter @ pull)


def factorise(matrix: sparse.csr_array, jump: sparse.csr_array, penalty: float) -> Factor:
    """Factor A + ρ JᵀJ once for all channels and repetitions.

    Parameters
    ----------
    matrix : (U, U) sparse
        A, symmetric positive definite.
    jump : (R, U) sparse
        J.
    penalty : float
        ρ.
    """
    full = sparse.csc_array(matrix + penalty * (jump.T @ jump))
    del matrix  # half of what the factorisation needs beside its result
    return Factor(factor_symmetric(full), full, jump, penalty)


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
    change = np.zeros_like(force)
    for repeat in range(1, MAX_REPEATS + 1):
        target = force - factor.jump.T @ (factor.penalty * jump_before + multiplier)
        residual = target if repeat == 1 else target - factor.matrix @ change
        change = change + factor.lu.solve(residual)
        jump = jump_before + factor.jump @ change
        seam_energy = np.einsum("rc,rc->c", jump, jump)
        if (seam_energy <= tolerance).all():
            return change, seam_energy, repeat
        multiplier += factor.penalty * jump
    raise NotConvergedError(
        f"seam energy {seam_energy.max():.1e} after {MAX_REPEATS} repetitions, wanted {tolerance:.1e}"
    )


def solve_bounded(
    factor: Factor,
    force: Floats,
    jump_before: Floats,
    change: Floats,
    bounded: NDArray[np.int64],
    lower: Floats,
    upper: Floats,
) -> tuple[Floats, float]:
    """Bring some unknowns into a range and keep the seams closed.

    The alternating direction method of multipliers (Boyd et al. 2011, section 5.2): solutions of the linear system,
    pulled towards a copy of the bounded unknowns, alternate with clipping that copy. Every solution is seamless; the
    limit is also in range.

    Parameters
    ----------
    factor : Factor
    force : (U, C) float64
    jump_before : (R, C) float64
    change : (U, C) float64
        The solution without bounds.
    bounded : (N,) int64
        Unknowns that have bounds.
    lower, upper : (N, C) float64
        Bounds of their change.

    Returns
    -------
    change : (U, C) float64
    excess : float
        How far the worst one still lies outside.
    """
    pull = np.zeros(len(force))
    pull[bounded] = BOUND_WEIGHT
    lu = factor_symmetric(sparse.csc_array(factor.matrix + sparse.diags_array(pull, format="csc")))
    base = force - factor.jump.T @ (factor.penalty * jump_before)
    copy = np.clip(change[bounded], lower, upper)
    dual = np.zeros_like(copy)
    excess = np.inf
    for _ in range(MAX_BOUND_REPEATS):
        target = base.copy()
        target[bounded] += BOUND_WEIGHT * (copy - dual)
        change = lu.solve(target)
        here = change[bounded]
        excess = float(max((lower - here).max(), (here - upper).max()))
        if excess <= BOUND_TOLERANCE_REL:
            break
        relaxed = RELAXATION * here + (1 - RELAXATION) * copy
        copy = np.clip(relaxed + dual, lower, upper)
        dual += relaxed - copy
    return change, excess
