"""Polygons of a mesh file into triangles: a fan where that is sound, ear clipping where it would turn triangles over.

A fan from a polygon's first corner covers it once if no triangle of the fan is turned against the polygon's own
normal. Concave and dart-shaped polygons where one is go through mapbox_earcut. That leaves out corners on a straight
line; they are put back by cutting the triangle beside the line, so that neighbours that use them still fit.
"""

from __future__ import annotations

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices

Triangle = tuple[int, int, int]


def _fans(sizes: NDArray[np.int64]) -> tuple[Indices, Indices]:
    """Corner numbers of the triangles that fan out from polygons' first corners, (F, 3), and their polygon, (F,)."""
    first = np.r_[0, np.cumsum(sizes)][:-1]
    counts = sizes - 2
    polygon = np.repeat(np.arange(len(sizes)), counts)
    step = np.arange(len(polygon)) - np.repeat(np.r_[0, np.cumsum(counts)][:-1], counts)
    origin = first[polygon]
    return np.stack([origin, origin + step + 1, origin + step + 2], axis=1), polygon


def _flatten(corners: Floats, normal: Floats) -> Floats:
    """The corners (K, 3) seen from where the normal points, counter-clockwise, (K, 2)."""
    axis = np.eye(3)[np.argmin(np.abs(normal))]
    right = np.cross(axis, normal)
    plane = np.stack([right / np.linalg.norm(right), np.cross(normal, right) / np.linalg.norm(np.cross(normal, right))])
    return np.ascontiguousarray((corners - corners.mean(axis=0)) @ plane.T)


def _put_back(triangles: list[Triangle], size: int) -> list[Triangle]:
    """Triangles cut where left-out corners lie on their sides: those between two kept corners of the polygon."""
    kept = {corner for triangle in triangles for corner in triangle}
    done: list[Triangle] = []
    stack = triangles[::-1]
    while stack:
        triangle = stack.pop()
        for turn in range(3):
            a, b, c = (triangle[(turn + k) % 3] for k in range(3))
            between = (a + 1) % size
            if between in kept or _next_kept(between, size, kept) != b:
                continue
            kept.add(between)  # the rest may have more on this side or on its others
            stack += [(between, b, c), (a, between, c)]
            break
        else:
            done.append(triangle)
    return done


def _next_kept(corner: int, size: int, kept: set[int]) -> int:
    while corner not in kept:
        corner = (corner + 1) % size
    return corner


def _clip(corners: Floats, normal: Floats) -> list[Triangle] | None:
    """Triangles of one polygon by ear clipping, counter-clockwise; None where it is no simple polygon."""
    size = len(corners)
    flat = _flatten(corners, normal)
    found = mapbox_earcut.triangulate_float64(flat, np.array([size], np.uint32)).reshape(-1, 3).astype(int)
    a, b, c = flat[found[:, 0]], flat[found[:, 1]], flat[found[:, 2]]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    found = np.where((area < 0)[:, None], found[:, ::-1], found)
    triangles = _put_back([(a, b, c) for a, b, c in found.tolist()], size)
    return triangles if len(triangles) == size - 2 else None


def cut_polygons(corners: Floats, sizes: NDArray[np.int64]) -> Indices:
    """Cut polygons into triangles without new corners.

    Parameters
    ----------
    corners : (C, 3) float64
        Positions of all polygons' corners, one polygon after the other.
    sizes : (P,) int64
        Corners of each polygon, three or more.

    Returns
    -------
    (F, 3) int64, into the corners
        `size - 2` for each polygon, in the polygons' order. None is turned against its polygon, where that is simple.
    """
    triangles, polygon = _fans(sizes)
    if (sizes == 3).all():
        return triangles
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    normals = np.zeros((len(sizes), 3))
    np.add.at(normals, polygon, areas)  # twice the area vector, whatever the shape
    turned = np.unique(polygon[np.einsum("fk,fk->f", areas, normals[polygon]) < 0])
    starts = np.r_[0, np.cumsum(sizes)][:-1]
    rows = np.r_[0, np.cumsum(sizes - 2)][:-1]
    for which in turned.tolist():  # few: the others stay fans
        start, size = int(starts[which]), int(sizes[which])
        cut = _clip(corners[start : start + size], normals[which]) if normals[which].any() else None
        if cut is not None:
            triangles[rows[which] : rows[which] + size - 2] = start + np.array(cut)
    return triangles
