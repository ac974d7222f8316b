"""The matrix of all energies on the grid's unknowns, and the force of the outside gradient (docs/method.md, section 3).

Every energy is a sum over small elements: a grid edge, a square of the quadtree, an interval of a seam. Each entry of
the symmetric matrix is gathered once, for one of its two places.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.energies import to_rows
from preprocess.erase.grid import Grid

# Weight of one grid edge in the gradient energies, as in the authors' program, where the four edges round an
# interior texel add up to a diagonal of one.
GRADIENT_MASS = 0.25

SIDES = 24  # sides of squares: powers of two below this one

# Weight of any node's squared change, so that outside texels with no inside texel near them have an answer too.
TIE = 1e-8


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
        result: Floats = np.einsum("qij,qkl->qikjl", rows, columns).reshape(-1, 4, 4)
        return result

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
    return _symmetric(rows, columns, values, diagonal)


def _symmetric(
    rows: NDArray[np.int32], columns: NDArray[np.int32], values: Floats, diagonal: Floats
) -> sparse.csr_array:
    """Symmetric matrix with a diagonal and with entries that are each given for one of their two places."""
    num = len(diagonal)
    all_places = np.arange(num, dtype=np.int32)
    entries = np.concatenate([values, diagonal / 2])
    places = (np.concatenate([rows, all_places]), np.concatenate([columns, all_places]))
    half = sparse.csr_array(sparse.coo_array((entries, places), shape=(num, num)))
    del entries, places
    return sparse.csr_array(half + half.T)


def rows_matrix(texels: NDArray[np.int32], weights: Floats, num: int) -> sparse.csr_array:
    """RᵀR for rows R with the given weights at the given unknowns, a few rows on the same unknowns at a time.

    Parameters
    ----------
    texels : (I, K) int32
        Unknowns of each group of rows.
    weights : (I, Q, K) float64
    num : int
        Number of unknowns, U.

    Returns
    -------
    (U, U) sparse
    """
    # An unknown that a row reads twice gets one weight before squaring: where the two cancel, nothing may be left.
    in_order = np.sort(texels, axis=1)
    repeats = (in_order[:, 1:] == in_order[:, :-1]).any(axis=1)
    single, weights_there = texels[~repeats], weights[~repeats]
    a, b = np.triu_indices(texels.shape[1], 1)
    element = np.matmul(weights_there.transpose(0, 2, 1), weights_there)
    diagonal = np.bincount(single.ravel(), np.einsum("ikk->ik", element).ravel(), num).astype(np.float64)
    matrix = _symmetric(single[:, a].ravel(), single[:, b].ravel(), element[:, a, b].ravel(), diagonal)
    if not repeats.any():
        return matrix
    rows = to_rows(texels[repeats], weights[repeats], num)
    rows.sum_duplicates()
    return sparse.csr_array(matrix + rows.T @ rows)


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
