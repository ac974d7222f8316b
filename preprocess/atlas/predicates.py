"""Exact signs: which way a triangle turns, from its float64 coordinates as they are.

`orient` is certain: a floating-point filter (Shewchuk 1997, the bound of his orient2d) decides almost every case, and
the rest is decided by error-free products and sums of the same differences, or by fractions in Python where even the
differences round.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from preprocess.mesh import Floats, Ints

FILTER = (3.0 + 16.0 * 2.0**-53) * 2.0**-53


def orient(a: Floats, b: Floats, c: Floats) -> NDArray[np.int8]:
    """Exact sign of twice the area of the triangles abc, each (N, 2): 1 counter-clockwise (with v up), 0 flat, -1."""
    left = (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1])
    right = (a[:, 1] - c[:, 1]) * (b[:, 0] - c[:, 0])
    det = left - right
    sign = np.sign(det).astype(np.int8)
    unsure = np.flatnonzero(np.abs(det) <= FILTER * (np.abs(left) + np.abs(right)) + 1e-300)
    for i in unsure:
        ax, ay, bx, by, cx, cy = (Fraction(float(x)) for x in (*a[i], *b[i], *c[i]))
        exact = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
        sign[i] = (exact > 0) - (exact < 0)
    return sign


def face_orientation(uvs: Floats, face_uvs: Ints) -> NDArray[np.int8]:
    """Exact orientation of every uv triangle, (F,) int8."""
    return orient(uvs[face_uvs[:, 0]], uvs[face_uvs[:, 1]], uvs[face_uvs[:, 2]])


def count_folds(uvs: Floats, face_uvs: Ints, face_charts: Ints, num_charts: int) -> Ints:
    """Faces of each chart that are flat, folded or within rounding of it, (C,) int32."""
    a, b, c = (uvs[face_uvs[:, k]] for k in range(3))
    left = (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1])
    right = (a[:, 1] - c[:, 1]) * (b[:, 0] - c[:, 0])
    longest = np.max([((x - y) ** 2).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    bad = ~(left - right > 1e-9 * longest)
    return np.bincount(face_charts[bad], minlength=num_charts).astype(np.int32)
