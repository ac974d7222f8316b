"""Triangles that tessellation leaves whole: those whose inside the textures do not show."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.mesh.texels import sample_bilinear
from runtime.asset.texel_footprint import fetch_bilinear
from runtime.gpu.patch_validation import SEGMENTS, _grid, distance_to_triangles, faulty_faces, keep_flat
from runtime.gpu.patches import build_patches, corner_uvs, place_corners, surface_copies

SIZE = 33


def sheet() -> np.ndarray:
    """Positions of a flat sheet over the whole atlas: x = u, y = v, z = 0. (H, W, 3)"""
    centres = ((np.arange(SIZE) + 0.5) / SIZE).astype(np.float32)
    u, v = np.meshgrid(centres, centres)
    return np.stack([u, v, np.zeros_like(u)], axis=-1)


UVS = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [2, 1, 3]], np.uint32)
PATCHES = place_corners(build_patches(UVS, UVS, TRIANGLES), np.arange(4), np.zeros(4, bool))


def test_fetching_is_the_projects_bilinear_rule() -> None:
    rng = np.random.default_rng(0)
    texels = rng.normal(size=(7, 5, 3)).astype(np.float32)
    uvs = rng.uniform(-0.1, 1.1, (500, 2)).astype(np.float32)
    assert np.allclose(fetch_bilinear(texels, uvs), sample_bilinear(texels.astype(np.float64), uvs), atol=1e-5)


def test_the_grid_covers_a_triangle_once() -> None:
    shares, small = _grid()
    assert len(small) == SEGMENTS**2 and np.allclose(shares.sum(axis=1), 1)
    a, b, c = (shares[small[:, corner], 1:] for corner in range(3))
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert np.allclose(doubled, 1 / SEGMENTS**2, atol=1e-6)


def test_distances_are_those_to_the_nearest_of_many_points() -> None:
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(6, 3, 3)).astype(np.float32)
    points = rng.normal(size=(6, 20, 3)).astype(np.float32)
    many = np.einsum("sk,fki->fsi", rng.dirichlet((0.5, 0.5, 0.5), 20_000), corners)
    slow = np.array([np.linalg.norm(p[:, None] - m[None], axis=-1).min(axis=1) for p, m in zip(points, many)])
    found = distance_to_triangles(points, corners)
    assert (found <= slow + 1e-5).all() and np.allclose(found, slow, atol=0.05)


def test_a_flat_triangle_without_area_has_distances_too() -> None:
    corners = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]]], np.float32)
    points = np.array([[[1, 3, 0], [-1, 0, 0], [0.5, 0, 0]]], np.float32)
    assert np.allclose(distance_to_triangles(points, corners), [[3, 1, 0]])


def test_a_good_sheet_has_no_faults() -> None:
    assert not faulty_faces(sheet(), UVS, UVS, PATCHES, 1e-4).any()


@pytest.mark.parametrize(("where", "expected"), [((8, 8), [True, False]), ((24, 24), [False, True])])
def test_a_spike_is_a_fault_of_the_triangle_it_is_in(where: tuple[int, int], expected: list[bool]) -> None:
    texels = sheet()
    texels[where[0] - 2 : where[0] + 3, where[1] - 2 : where[1] + 3, 2] = 0.3
    assert faulty_faces(texels, UVS, UVS, PATCHES, 0.1).tolist() == expected


def test_a_part_that_faces_backwards_is_a_fault_however_near_it_lies() -> None:
    texels = sheet()
    texels[6:12, 6:12, 0] = texels[6:12, 6:12, 0][:, ::-1]
    assert faulty_faces(texels, UVS, UVS, PATCHES, 10.0)[0]


def test_edges_of_faulty_faces_stay_whole_seen_from_both_sides() -> None:
    kept = keep_flat(PATCHES, np.arange(4), np.array([True, False]))
    whole = kept[:, 3:9:2] == kept[:, 4:9:2]
    assert whole[0].all() and whole[1].sum() == 1
    shared = next(side for side in range(3) if {TRIANGLES[1, side], TRIANGLES[1, (side + 1) % 3]} == {1, 2})
    assert whole[1, shared]
    assert (keep_flat(PATCHES, np.arange(4), np.zeros(2, bool)) == PATCHES).all()


def test_corners_are_fetched_at_one_copy_whichever_face_asks() -> None:
    """Two triangles over a seam: the smallest uvs among a point's copies are its place."""
    uvs = np.array([[0.1, 0.1], [0.4, 0.1], [0.1, 0.4], [0.6, 0.1], [0.3, 0.4], [0.9, 0.9]], np.float32)
    canonical = np.array([[0.1, 0.1], [0.8, 0.2], [0.8, 0.3], [0.8, 0.2], [0.8, 0.3], [0.9, 0.9]], np.float32)
    copies = surface_copies(uvs, canonical)
    assert copies.tolist() == [0, 1, 2, 1, 2, 5]
    triangles = np.array([[0, 1, 2], [4, 3, 5]], np.uint32)
    moved = np.array([True, True, False, True, False, False])
    patches = place_corners(build_patches(uvs, canonical, triangles), copies, moved)
    assert patches.shape == (2, 12)
    places = corner_uvs(uvs, canonical, patches)
    assert np.array_equal(places[0], [uvs[0], uvs[1], canonical[2]])
    assert np.array_equal(places[1], [canonical[2], uvs[1], canonical[5]])


def test_a_corner_off_the_surface_does_not_count_where_it_is_drawn_on_it() -> None:
    """A lifted corner is parked in the sheet's last texel; divided, the triangle lies in the sheet but for nothing."""
    texels = sheet()
    texels[-1, -1] = (0.1, 0.1, 0.05)
    parked = UVS.copy()
    parked[0] = (SIZE - 0.5) / SIZE
    for moved in (False, True):
        patches = place_corners(build_patches(UVS, parked, TRIANGLES), np.arange(4), np.array([moved, 0, 0, 0], bool))
        assert faulty_faces(texels, UVS, parked, patches, 0.051).tolist() == [False, False]
        drawn = fetch_bilinear(texels, corner_uvs(UVS, parked, patches))
        assert np.allclose(drawn[0, 0, 2], 0.0 if moved else 0.05)
