"""Triangles from the implicit body: marching cubes on the left half, to be mirrored later.

The lattice's first layer lies on the plane of symmetry, so the half mesh is open there and ends in a clean line of
vertices with x = 0. Far from the skin a coarse lattice stands in for the fine one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from demos.creature.field import Field
from demos.creature.surface import Floats, Ints

_COARSE = 4  # fine cells a coarse cell spans


def _sample_lattice(field: Field, axes: list[Floats]) -> Floats:
    """Distances on the lattice; far from the skin the nearest coarse node's value, of the right sign."""
    coarse_axes = [axis[::_COARSE] for axis in axes]
    values = field.distance(_grid_points(coarse_axes)).reshape([len(axis) for axis in coarse_axes])
    for k, axis in enumerate(axes):
        nearest = np.minimum((np.arange(len(axis)) + _COARSE // 2) // _COARSE, len(coarse_axes[k]) - 1)
        values = np.take(values, nearest, axis=k)
    spacing = float(axes[1][1] - axes[1][0])
    near = np.abs(values) < np.sqrt(3.0) * _COARSE * spacing
    where = np.argwhere(near)
    points = np.stack([axes[k][where[:, k]] for k in range(3)], axis=1)
    values[near] = field.distance(points)
    return values


def _grid_points(axes: list[Floats]) -> Floats:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def polygonise_half(field: Field, cell_m: float, low: Floats, high: Floats) -> tuple[Floats, Ints]:
    """Mesh the half x >= 0 of a mirrored field.

    Parameters
    ----------
    field : Field
    cell_m : float
        Edge of a grid cell.
    low, high : (3,) float64
        Box that holds the body; low's x is taken as 0.

    Returns
    -------
    points : (V, 3) float64
        Those on the plane of symmetry have x = 0 exactly.
    faces : (F, 3) int64
        Counter-clockwise seen from outside.
    """
    axes = [np.arange(start, end + cell_m, cell_m) for start, end in zip((0.0, low[1], low[2]), high)]
    values = _sample_lattice(field, axes)
    values[np.abs(values) < 1e-6] = 1e-6  # a crossing on a node would make triangles of no area
    points, faces, _, _ = marching_cubes(values, 0.0, spacing=(cell_m,) * 3, allow_degenerate=False)
    points = points.astype(np.float64) + np.array([0.0, low[1], low[2]])
    points[points[:, 0] < 1e-6, 0] = 0.0
    return points, faces.astype(np.int64)


def mirror_half(points: Floats, faces: Ints) -> tuple[Floats, Ints, NDArray[np.int64]]:
    """The whole mesh from its left half, joined along x = 0; also the mirror image of each vertex, (V,)."""
    middle = points[:, 0] == 0.0
    image = np.where(middle, np.arange(len(points)), -1)
    image[~middle] = len(points) + np.arange(int((~middle).sum()))
    whole = np.concatenate([points, points[~middle] * np.array([-1.0, 1.0, 1.0])])
    partner = np.concatenate([image, np.flatnonzero(~middle)])
    return whole, np.concatenate([faces, image[faces[:, ::-1]]]), partner
