"""Automatic sizes: the first that is good enough, judged at vertices and between them."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.arrays import Floats
from preprocess.fit.position_sizes import (
    GEOMETRY_SIZES_PX,
    STRIDE,
    WEIGHT_SIZES_PX,
    Positions,
    smallest_positions,
    stray_rms,
    weight_side,
)
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import px_to_uv


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


def test_stray_is_the_distance_between_vertices() -> None:
    surface = a_square()
    assert stray_rms(flat_texels(32), surface) < 1e-12
    assert np.isclose(stray_rms(flat_texels(32, 0.25), surface), 0.25)
    lifted_m = 1e-3  # one of two faces, at places where that corner counts 2, 1, 1 and 4 sixths
    expected = lifted_m * np.sqrt((4 + 1 + 1 + 16) / 36 / 4 / 2)
    assert np.isclose(stray_rms(flat_texels(32), a_square(lifted_m)), expected, rtol=1e-5)


def test_the_first_good_size_is_taken() -> None:
    surface, tried = a_square(), []

    def bake(side: int) -> Positions:
        tried.append(side)
        return Positions(flat_texels(side), flat_texels(side, 0.0 if side >= 80 else 0.05), 0.0)

    positions = smallest_positions(surface, surface.positions, bake)
    assert tried == [48, 64, 80, 72, 76]
    assert positions.baked.shape == positions.erased.shape == (80, 80, 3)


def test_open_seams_ask_for_more_texels() -> None:
    surface = a_square()

    def bake(side: int) -> Positions:
        return Positions(flat_texels(side), flat_texels(side), 1e-3 if side < 192 else 1e-5)

    assert smallest_positions(surface, surface.positions, bake).erased.shape[0] == 192


@pytest.mark.parametrize("least", GEOMETRY_SIZES_PX)
def test_the_smallest_good_size_is_found(least: int) -> None:
    """Where all larger sizes are good too; with few more tries than steps."""
    square, tried = a_square(), []
    positions = np.r_[np.zeros((4, 3)), np.ones((1, 3))]  # all in one place, but for one that no face has
    surface = TexturedSurface(positions, square.faces, square.uvs, square.face_uvs)

    def bake(side: int) -> Positions:
        tried.append(side)
        return Positions(np.zeros((1, side, 3)), np.zeros((1, side, 3)), 0.0 if side >= least else 1.0)

    found = smallest_positions(surface, np.zeros((4, 3)), bake)
    assert found.erased.shape[1] == least
    assert len(tried) <= GEOMETRY_SIZES_PX.index(least) / STRIDE + 4


def test_dense_meshes_do_not_try_what_cannot_hold_them() -> None:
    surface, tried = a_square(), []
    many = TexturedSurface(surface.positions, surface.faces, np.tile(surface.uvs, (2500, 1)), surface.face_uvs)

    def bake(side: int) -> Positions:
        tried.append(side)
        return Positions(flat_texels(side), flat_texels(side), 0.0)

    smallest_positions(many, np.tile(surface.positions, (2500, 1)), bake)
    assert tried == [176]  # 10,000 texture vertices


def test_weight_maps_grow_with_the_vertices() -> None:
    sides = [weight_side(count) for count in (1, 300, 3_000, 13_000, 100_000, 10_000_000)]
    assert sides == sorted(sides) and sides[0] == WEIGHT_SIZES_PX[0] and sides[-1] == WEIGHT_SIZES_PX[-1]
    assert weight_side(13_396) == 48
