"""How a map to the plane treats each triangle, and which charts overlap themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats
from preprocess.mesh.uv_overlap import find_overlap

APART = 1.02
"""Charts are tested for overlap beside one another, in boxes this much longer than they are."""


def sums(owners: NDArray[np.integer], values: NDArray[np.floating], count: int) -> Floats:
    """Sum of the values (N,) of each owner (N,), (count,) float64."""
    return np.asarray(np.bincount(owners, values, count), np.float64)


def turned_areas(triangles: Floats) -> Floats:
    """Area of plane triangles (F, 3, 2), negative where clockwise, (F,)."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def singular_values(flat: Floats, uvs: Floats) -> tuple[Floats, Floats]:
    """Largest and smallest growth of lengths from triangles laid flat to the plane, (F,) each.

    Parameters
    ----------
    flat : (F, 3, 2) float64
        As `local_triangles` gives them, none without area.
    uvs : (F, 3, 2) float64
    """
    along = (uvs[:, 1] - uvs[:, 0]) / flat[:, 1, :1]
    across = (uvs[:, 2] - uvs[:, 0] - flat[:, 2, :1] * along) / flat[:, 2, 1:]
    e, g, f = (along**2).sum(axis=1), (across**2).sum(axis=1), (along * across).sum(axis=1)
    root = np.sqrt((e - g) ** 2 + 4.0 * f * f)
    return np.sqrt(0.5 * (e + g + root)), np.sqrt(np.maximum(0.5 * (e + g - root), 0.0))


def overlapping_faces(corner_uvs: Floats, face_charts: NDArray[np.integer], num_charts: int) -> Bools:
    """Faces that overlap another one of their own chart or are flat, (F,) bool.

    Charts are laid side by side and tested at once. Sizes change by powers of two; places round in the last bits, which
    moves vertices that coincide alike.

    Parameters
    ----------
    corner_uvs : (F, 3, 2) float64
    face_charts : (F,) int
        Charts that no face names are left out.
    num_charts : int
    """
    low, high = np.full((num_charts, 2), np.inf), np.full((num_charts, 2), -np.inf)
    np.minimum.at(low, face_charts, corner_uvs.min(axis=1))
    np.maximum.at(high, face_charts, corner_uvs.max(axis=1))
    counts = np.bincount(face_charts, minlength=num_charts)
    used = counts > 0
    extent = np.where(used, (high - low).max(axis=1, initial=0.0), 1.0)
    factor = np.exp2(np.round(np.log2(np.sqrt(np.maximum(counts, 1)) / np.maximum(extent, 1e-290))))
    size = np.where(used, APART * extent * factor, 0.0)
    order = np.argsort(-size, kind="stable")
    before = np.cumsum(size[order]) - size[order]
    width = max(float(np.sqrt((size**2).sum())), float(size.max(initial=0.0)), 1e-300)
    row = np.floor(before / width).astype(np.int64)
    heights = np.zeros(int(row.max(initial=0)) + 1)
    np.maximum.at(heights, row, size[order])
    place = np.empty((num_charts, 2))
    place[order] = np.stack([before - row * width, (np.cumsum(heights) - heights)[row]], axis=1)
    place[~used] = low[~used] = 0.0
    apart = (corner_uvs - low[face_charts][:, None]) * factor[face_charts][:, None, None] + place[face_charts][:, None]
    ids = np.arange(3 * len(apart), dtype=np.int32).reshape(-1, 3)
    return find_overlap(apart.reshape(-1, 2), ids).faces


def overlapping_charts(corner_uvs: Floats, face_charts: NDArray[np.integer], num_charts: int) -> Bools:
    """Charts with a face that overlaps another one of the chart or is flat, (C,) bool."""
    hit = overlapping_faces(corner_uvs, face_charts, num_charts)
    return np.bincount(face_charts[hit], minlength=num_charts) > 0
