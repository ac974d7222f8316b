"""Exact signs: which way a triangle turns, from its float64 coordinates as they are.

A floating-point filter decides almost every case (Shewchuk 1997, the bound of his orient2d); the rest are decided by
the exact value, summed as an expansion of floats that do not overlap. Coordinates whose products leave the range of
float64 (beyond 1e±140) are not supported; uvs never are there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.numerics.jit import entry, helper

SAFE_AREA_REL = 1e-9
"""Twice the area over the squared longest edge, above which a triangle is certainly not flat even after rounding of
its uvs by a few units in the last place."""


def face_orientation(uvs: Floats, face_uvs: Ints) -> NDArray[np.int8]:
    """Exact orientation of every uv triangle, (F,) int8: 1 where u × v of its edges is positive, 0 flat, -1."""
    if not len(face_uvs):
        return np.zeros(0, np.int8)
    sign = np.empty(len(face_uvs), np.int8)
    _orient_all(np.ascontiguousarray(uvs[face_uvs]), sign)
    return sign


def count_folds(uvs: Floats, face_uvs: Ints, face_charts: Ints, num_charts: int) -> Ints:
    """Faces of each chart that are clockwise, flat or within rounding of it, (C,) int32."""
    a, b, c = (uvs[face_uvs[:, k]] for k in range(3))
    left = (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1])
    right = (a[:, 1] - c[:, 1]) * (b[:, 0] - c[:, 0])
    longest = np.max([((x - y) ** 2).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    bad = ~(left - right > SAFE_AREA_REL * longest)
    return np.bincount(face_charts[bad], minlength=num_charts).astype(np.int32)


@helper
def _add_product(terms, size, x, y):  # type: ignore[no-untyped-def]
    """Add x * y to an expansion (smallest part first): Dekker's exact product, Shewchuk's growth, part by part."""
    product = x * y
    big = 134217729.0 * x
    xh = big - (big - x)
    xl = x - xh
    big = 134217729.0 * y
    yh = big - (big - y)
    yl = y - yh
    error = xl * yl - (((product - xh * yh) - xl * yh) - xh * yl)
    for part in range(2):
        q = error if part == 0 else product
        for i in range(size):
            total = q + terms[i]
            virtual = total - q
            terms[i] = (q - (total - virtual)) + (terms[i] - virtual)
            q = total
        terms[size] = q
        size += 1
    return size


@helper
def orient(ax, ay, bx, by, cx, cy, terms):  # type: ignore[no-untyped-def]
    """Exact sign of the turn a, b, c; `terms` is scratch space for 16 floats."""
    left, right = (ax - cx) * (by - cy), (ay - cy) * (bx - cx)
    det = left - right
    if abs(det) > 3.4e-16 * (abs(left) + abs(right)):
        return 1 if det > 0.0 else -1
    # ax by - ax cy - cx by - ay bx + ay cx + cy bx, each product exact as two floats
    size = 0
    size = _add_product(terms, size, ax, by)
    size = _add_product(terms, size, -ax, cy)
    size = _add_product(terms, size, -cx, by)
    size = _add_product(terms, size, -ay, bx)
    size = _add_product(terms, size, ay, cx)
    size = _add_product(terms, size, cy, bx)
    for i in range(size - 1, -1, -1):  # the largest part that is not zero has the sign of all
        if terms[i] != 0.0:
            return 1 if terms[i] > 0.0 else -1
    return 0


@entry
def _orient_all(triangles, sign):  # type: ignore[no-untyped-def]
    terms = np.empty(16)
    for f in range(len(triangles)):
        sign[f] = orient(
            triangles[f, 0, 0], triangles[f, 0, 1], triangles[f, 1, 0], triangles[f, 1, 1], triangles[f, 2, 0],
            triangles[f, 2, 1], terms,
        )  # fmt: skip
