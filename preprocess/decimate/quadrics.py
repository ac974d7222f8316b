"""Quadrics in five dimensions: position and uv together (Garland and Heckbert 1998; paper, section 5.2).

The quadric of a triangle in R5 is the squared distance to the plane through its corners,
`x A x + 2 b x + c` with `A = I - e1 e1' - e2 e2'` for two orthonormal directions in the plane. The 21 numbers of one
quadric lie in a row: the upper triangle of A (15), b (5), c. With both uvs of a vertex held, what is left is a quadric
of its position alone: 10 numbers, the upper triangle of A (6), b (3), c.

All kernels work in normalised units: positions centred and divided by the bounding diagonal, uvs scaled so that they
are lengths on the surface (see `state.py`).
"""

from __future__ import annotations

import math

import numpy as np

from preprocess.decimate.topology import TAIL, TWIN, WEDGE
from preprocess.numerics.jit import fixed_memory_entry as entry
from preprocess.numerics.jit import fixed_memory_helper as helper

SIZE = 21
SYSTEM_ROW = 8  # of the scratch table, see rules.Mesh

# As NumPy integers, constants do not make numba compile a kernel once for each value.
FIRST, THREE, FOUR, FIVE = (np.int64(number) for number in (0, 3, 4, 5))
# A little of the plain squared distance to the edge's middle, as a fraction of the quadric's trace: decides where
# the quadric is flat (a plane), and is far below any real curvature elsewhere.
REGULARISE_REL = 1e-6


@helper
def _orthonormal(p, q, r, e):
    """Two orthonormal directions of the plane through three points of R5 into the rows of e; zeros where none."""
    length = 0.0
    for i in range(5):
        e[0, i] = q[i] - p[i]
        length += e[0, i] * e[0, i]
    inverse = 1.0 / math.sqrt(length) if length > 0.0 else 0.0
    along = 0.0
    for i in range(5):
        e[0, i] *= inverse
        along += e[0, i] * (r[i] - p[i])
    length = 0.0
    for i in range(5):
        e[1, i] = r[i] - p[i] - along * e[0, i]
        length += e[1, i] * e[1, i]
    inverse = 1.0 / math.sqrt(length) if length > 1e-30 else 0.0
    for i in range(5):
        e[1, i] *= inverse


@entry
def accumulate_faces(links, num_faces, xyz, uv, uv_scale, boundary_weight, quadric, points, e):
    """Add a third of each face's area-weighted quadric to its three wedges, and hold open boundaries in place.

    An open edge adds the squared distance to the plane through it that stands on its face, so that it keeps its shape
    where the surface is flat. `points` (3, 5) and `e` (2, 5) are scratch.
    """
    for f in range(num_faces):
        for k in range(3):
            h = 3 * f + k
            for i in range(3):
                points[k, i] = xyz[links[h, TAIL], i]
            for i in range(2):
                points[k, 3 + i] = uv[links[h, WEDGE], i] * uv_scale
        ax, ay, az = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
        bx, by, bz = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if norm == 0.0:
            continue
        _orthonormal(points[0], points[1], points[2], e)
        weight = norm / 6.0
        along0 = 0.0
        along1 = 0.0
        square = 0.0
        for i in range(5):
            along0 += points[0, i] * e[0, i]
            along1 += points[0, i] * e[1, i]
            square += points[0, i] * points[0, i]
        for k in range(3):
            row = quadric[links[3 * f + k, WEDGE]]
            n = 0
            for i in range(5):
                for j in range(i, 5):
                    a = -e[0, i] * e[0, j] - e[1, i] * e[1, j]
                    if i == j:
                        a += 1.0
                    row[n] += weight * a
                    n += 1
            for i in range(5):
                row[15 + i] += weight * (along0 * e[0, i] + along1 * e[1, i] - points[0, i])
            row[20] += weight * (square - along0 * along0 - along1 * along1)
        for k in range(3):
            h = 3 * f + k
            if links[h, TWIN] < 3 * num_faces:
                continue
            end = (k + 1) % 3
            dx, dy, dz = points[end, 0] - points[k, 0], points[end, 1] - points[k, 1], points[end, 2] - points[k, 2]
            mx, my, mz = dy * nz - dz * ny, dz * nx - dx * nz, dx * ny - dy * nx
            square = mx * mx + my * my + mz * mz
            if square == 0.0:
                continue
            weight = boundary_weight * (dx * dx + dy * dy + dz * dz) / square
            d = -(mx * points[k, 0] + my * points[k, 1] + mz * points[k, 2])
            for w in (links[h, WEDGE], links[3 * f + end, WEDGE]):
                row = quadric[w]
                row[0] += weight * mx * mx
                row[1] += weight * mx * my
                row[2] += weight * mx * mz
                row[5] += weight * my * my
                row[6] += weight * my * mz
                row[9] += weight * mz * mz
                row[15] += weight * mx * d
                row[16] += weight * my * d
                row[17] += weight * mz * d
                row[20] += weight * d * d


@helper
def clear(q):
    """Set a row to zero."""
    for i in range(len(q)):
        q[i] = 0.0


@helper
def add_rows(rows, to, other):
    """Add one row of a table to another."""
    for i in range(rows.shape[1]):
        rows[to, i] += rows[other, i]


@helper
def add_with_uv_held(quadric, w, u, v, out):
    """Add what wedge w's quadric says of the position alone, at a fixed uv, to ten numbers."""
    n, k = 0, 0
    for i in range(3):
        for _ in range(i, 3):
            out[k] += quadric[w, n]
            n += 1
            k += 1
        out[6 + i] += quadric[w, 15 + i] + quadric[w, n] * u + quadric[w, n + 1] * v
        n += 2
    out[9] += quadric[w, 20] + u * (2.0 * quadric[w, 18] + quadric[w, 12] * u + 2.0 * quadric[w, 13] * v)
    out[9] += v * (2.0 * quadric[w, 19] + quadric[w, 14] * v)


@helper
def evaluate_position(q, o, x, y, z):
    """Value of a position quadric, ten numbers from q[o] on."""
    value = x * (q[o] * x + 2.0 * (q[o + 1] * y + q[o + 2] * z + q[o + 6]))
    value += y * (q[o + 3] * y + 2.0 * (q[o + 4] * z + q[o + 7]))
    return value + z * (q[o + 5] * z + 2.0 * q[o + 8]) + q[o + 9]


@helper
def solve(work, size):
    """Solve a symmetric positive definite system in place by LDL'.

    Parameters
    ----------
    work : (16, 8) float64
        From row 8 on, the upper triangle of the matrix; column `size` holds the right-hand side and gets the solution.
    size : int

    Returns
    -------
    bool
        False where a pivot is not clearly positive; the content is then meaningless.
    """
    matrix = work[SYSTEM_ROW:]
    largest = 0.0
    for i in range(size):
        largest = max(largest, matrix[i, i])
    for k in range(size):
        pivot = matrix[k, k]
        if not pivot > 1e-13 * largest:
            return False
        for i in range(k + 1, size):
            factor = matrix[k, i] / pivot
            for j in range(i, size):
                matrix[i, j] -= factor * matrix[k, j]
            matrix[i, size] -= factor * matrix[k, size]
    for k in range(size - 1, -1, -1):
        value = matrix[k, size]
        for j in range(k + 1, size):
            value -= matrix[k, j] * matrix[j, size]
        matrix[k, size] = value / matrix[k, k]
    return True
