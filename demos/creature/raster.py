"""Texels that triangles cover, by the half-texel rule: texel (x, y) has its centre at ((x + ½), (y + ½)) / size."""

from __future__ import annotations

import numpy as np

from demos.creature.surface import Floats, Ints


def cover_texels(uvs: Floats, faces: Ints, size: int) -> tuple[Ints, Ints, Ints, Floats]:
    """All (face, texel) pairs whose texel centre lies in the uv triangle.

    A centre exactly on an edge belongs to the face on one side only (a top-left rule), so a chart without overlaps
    covers no texel twice.

    Parameters
    ----------
    uvs : (T, 2) float64, in [0, 1]
    faces : (F, 3) int64
    size : int
        Texels a side.

    Returns
    -------
    face, x, y : (N,) int64
    barycentric : (N, 3) float64
    """
    corners = uvs[faces] * size - 0.5
    low = np.maximum(np.ceil(corners.min(axis=1)), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1)), size - 1).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    count = extent[:, 0] * extent[:, 1]
    face = np.repeat(np.arange(len(faces)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    x = low[face, 0] + step % extent[face, 0]
    y = low[face, 1] + step // extent[face, 0]
    barycentric = np.empty((len(face), 3))
    inside = np.ones(len(face), bool)
    double = np.empty(len(faces))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    double = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sign = np.where(double < 0, -1.0, 1.0)
    for k in range(3):
        start, end = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        along = (end - start) * sign[:, None]
        owns = (along[:, 1] > 0) | ((along[:, 1] == 0) & (along[:, 0] > 0))
        value = along[face, 0] * (y - start[face, 1]) - along[face, 1] * (x - start[face, 0])
        inside &= (value > 0) | ((value == 0) & owns[face])
        barycentric[:, k] = value / np.maximum(np.abs(double[face]), 1e-30)
    return face[inside], x[inside], y[inside], barycentric[inside]
