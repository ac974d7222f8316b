"""Automatic sizes: the first that is good enough, judged at vertices and between them."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.arrays import Floats
from preprocess.bake.geometry import vertex_values
from preprocess.fit.positions import (
    SIZES_PX,
    STRIDE,
    Positions,
    deviation_rms,
    fit_positions,
    points_along_seams,
    smallest_positions,
)
from preprocess.fit.weight_map import WEIGHT_SIZES_PX, weight_side
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import px_to_uv, sample_bilinear


def a_square(height_m: float = 0.0) -> TexturedSurface:
    """A unit square over most of the atlas, its last corner lifted."""
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    heights = np.array([0.0, 0.0, 0.0, height_m])
    return TexturedSurface(np.c_[corners, heights], faces, 0.1 + 0.8 * corners, faces)


def flat_texels(side: int, offset_m: float = 0.0) -> Floats:
    """The flat square as a texture, moved off it."""
    row, column = np.indices((side, side)).reshape(2, -1)
    uvs = px_to_uv(np.stack([column, row], axis=1).astype(np.float64), side, side)
    return np.c_[(uvs - 0.1) / 0.8, np.full(len(uvs), offset_m)].reshape(side, side, 3)


def test_deviation_is_the_distance_between_vertices() -> None:
    surface = a_square()
    assert deviation_rms(flat_texels(32), surface) < 1e-12
    assert np.isclose(deviation_rms(flat_texels(32, 0.25), surface), 0.25)
    lifted_m = 1e-3  # one of two faces, at places where that corner counts 2, 1, 1 and 4 sixths
    expected = lifted_m * np.sqrt((4 + 1 + 1 + 16) / 36 / 4 / 2)
    assert np.isclose(deviation_rms(flat_texels(32), a_square(lifted_m)), expected, rtol=1e-5)


def search(num_vertices: int, least: int) -> tuple[int, list[int]]:
    """The side found where all from a certain one are good, and the sides tried."""
    tried: list[int] = []

    def fit(side: int) -> Positions:
        tried.append(side)
        return Positions(np.zeros((side, 1, 3)), np.zeros((side, 1, 3)))

    found = smallest_positions(num_vertices, fit, lambda positions: len(positions.fitted) >= least)
    return len(found.fitted), tried


def test_the_first_good_size_is_taken() -> None:
    assert search(700, 80) == (80, [48, 64, 80, 72, 76])


@pytest.mark.parametrize("least", [side for side in SIZES_PX if 128 <= side <= 640])
def test_the_smallest_good_size_is_found_with_few_more_tries_than_steps(least: int) -> None:
    found, tried = search(int(least**2 / 10), least)
    assert found == least
    assert len(tried) <= SIZES_PX.index(least) / STRIDE + 4


def test_sizes_go_by_the_vertices() -> None:
    """Neither what cannot hold them is tried, nor maps of a thousand texels a side for a few thousand of them."""
    assert search(10_000, 0)[1] == [176]
    assert search(2_770, 5_000)[0] <= np.sqrt(48 * 2_770)
    assert search(4, 5_000)[0] == SIZES_PX[0]
    assert search(10_000_000, 0)[0] == SIZES_PX[-1]


def a_bent_strip() -> SkinnedMesh:
    """Two squares that meet at a right angle, charts of their own that touch in the atlas, as cards do."""
    positions = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 1), (1, 1, 1)], np.float64)
    faces = np.array([(0, 1, 2), (0, 2, 3), (1, 4, 5), (1, 5, 2)], np.int32)
    uvs = np.array([(0, 0), (0.5, 0), (0.5, 1), (0, 1), (0.5, 0), (1, 0), (1, 1), (0.5, 1)], np.float64)
    face_uvs = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)], np.int32)
    surface = TexturedSurface(positions, faces, 0.05 + 0.9 * uvs, face_uvs)
    return SkinnedMesh(
        surface=surface,
        corner_normals=np.tile((0.0, 0.0, 1.0), (4, 3, 1)),
        corner_tangents=None,
        corner_texcoords=np.zeros((4, 3, 0, 2)),
        corner_colors=None,
        joint_indices=np.zeros((6, 1), np.int32),
        joint_weights=np.ones((6, 1)),
        face_materials=np.zeros(4, np.int32),
        face_parts=np.zeros(4, np.int32),
        has_uvs=True,
    )


def test_points_along_seams_lie_on_both_sides_and_on_the_surface() -> None:
    surface = a_bent_strip().surface
    uvs, positions = points_along_seams(surface, find_seams(surface), 64)
    one, other = np.split(positions, 2)
    np.testing.assert_array_equal(one, other)
    assert (one[:, 0] == 1.0).all() and (np.diff(np.sort(one[:, 1])) < 1.01 / 57).all()
    np.testing.assert_allclose(uvs[:, 0], 0.5)


def test_positions_stay_within_the_surface_box_and_are_right_at_vertices() -> None:
    mesh = a_bent_strip()
    found = fit_positions(mesh, find_seams(mesh.surface)).fitted
    assert found.min() >= -0.05 * np.sqrt(3) and found.max() <= 1 + 0.05 * np.sqrt(3)
    wanted = vertex_values(mesh, mesh.surface.positions)
    assert np.abs(sample_bilinear(found, mesh.surface.uvs) - wanted).max() < 1e-3


def test_weight_maps_grow_with_the_vertices() -> None:
    sides = [weight_side(count) for count in (1, 300, 3_000, 13_000, 100_000, 10_000_000)]
    assert sides == sorted(sides) and sides[0] == WEIGHT_SIZES_PX[0] and sides[-1] == WEIGHT_SIZES_PX[-1]
    assert weight_side(13_396) == 48
