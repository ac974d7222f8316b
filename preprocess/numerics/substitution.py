"""Back substitution of many right-hand sides at once: the compiled part of `cholesky`."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def substitute(starts, rows, values, pivots, x):
    """Solve L D Lᵀ x = x in place. L by columns, its unit diagonal left out."""
    num, channels = x.shape
    for j in range(num):
        for k in range(starts[j], starts[j + 1]):
            i, value = rows[k], values[k]
            for c in range(channels):
                x[i, c] -= value * x[j, c]
    for j in range(num - 1, -1, -1):
        for c in range(channels):
            x[j, c] /= pivots[j]
        for k in range(starts[j], starts[j + 1]):
            i, value = rows[k], values[k]
            for c in range(channels):
                x[j, c] -= value * x[i, c]
