"""Factorisation of symmetric systems against dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from preprocess.numerics.cholesky import factor_symmetric


def _laplacian(side: int, damping: float) -> sparse.csc_array:
    line = sparse.diags_array([[-1.0] * (side - 1), [2.0] * side, [-1.0] * (side - 1)], offsets=[-1, 0, 1])
    eye = sparse.eye_array(side)
    return sparse.csc_array(sparse.kron(line, eye) + sparse.kron(eye, line) + damping * sparse.eye_array(side * side))


@pytest.mark.parametrize("channels", [1, 3, 50])
def test_solution_is_the_dense_one(channels: int) -> None:
    matrix = _laplacian(13, 1e-3)
    right = np.random.default_rng(1).normal(size=(169, channels))
    expected = np.linalg.solve(matrix.toarray(), right)
    np.testing.assert_allclose(factor_symmetric(matrix).solve(right), expected, rtol=0, atol=1e-11)


def test_every_channel_is_solved_alone() -> None:
    factor = factor_symmetric(_laplacian(9, 0.1))
    right = np.random.default_rng(2).normal(size=(81, 7))
    together = factor.solve(right)
    alone = np.concatenate([factor.solve(right[:, c : c + 1]) for c in range(7)], axis=1)
    np.testing.assert_allclose(together, alone, rtol=1e-14, atol=1e-14)


def test_right_hand_side_is_left_alone() -> None:
    right = np.ones((4, 2))
    np.testing.assert_array_equal(factor_symmetric(sparse.csc_array(sparse.eye_array(4) * 2.0)).solve(right), 0.5)
    np.testing.assert_array_equal(right, 1.0)


def test_independent_blocks_and_a_single_unknown() -> None:
    blocks = sparse.csc_array(sparse.block_diag([np.array([[4.0]]), np.array([[2.0, 1.0], [1.0, 3.0]])]))
    solution = factor_symmetric(blocks).solve(np.array([[4.0], [3.0], [4.0]]))
    np.testing.assert_allclose(solution, [[1.0], [1.0], [1.0]], atol=1e-15)


def test_singular_matrix_is_refused() -> None:
    with pytest.raises(RuntimeError, match="singular"):
        factor_symmetric(sparse.csc_array(np.array([[1.0, -1.0], [-1.0, 1.0]])))
