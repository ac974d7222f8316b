"""MikkTSpace tangents against cases whose answer is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from builders_gltf import cube, grid
from conftest import asset

from preprocess.load import load_character
from preprocess.load.tangents import compute_tangents, corner_tangents


def flat(shape, turn=None):
    """Tangents of a flat grid facing +z, its uvs changed by `turn`."""
    faces = shape["faces"]
    uvs = shape["uvs"][faces]
    normals = np.broadcast_to([0, 0, 1.0], (*faces.shape, 3))
    return compute_tangents(shape["positions"], faces, normals, uvs if turn is None else turn(uvs))


def test_a_plain_picture_has_its_tangent_along_u() -> None:
    """u runs along x and v against y (v is down): the tangent is x, and n x t * w = y points against v."""
    np.testing.assert_allclose(flat(grid(3, 2)), np.broadcast_to([1, 0, 0, 1.0], (12, 3, 4)), atol=1e-12)


def test_a_mirrored_picture_has_handedness_minus_one() -> None:
    mirrored = flat(grid(3, 2), lambda uvs: uvs * (-1, 1))
    np.testing.assert_allclose(mirrored, np.broadcast_to([-1, 0, 0, -1.0], (12, 3, 4)), atol=1e-12)


@pytest.mark.parametrize("degrees", [30, 90, 200, 333])
def test_turning_the_picture_turns_the_tangent(degrees: float) -> None:
    a = np.deg2rad(degrees)
    turned = flat(grid(2, 2), lambda uvs: uvs @ np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]).T)
    # u' = u cos a - v sin a rises along (cos a, sin a) in (u, -v) = (x, y) up to the grid's own scale
    np.testing.assert_allclose(turned, np.broadcast_to([np.cos(a), np.sin(a), 0, 1], turned.shape), atol=1e-12)


def test_scale_and_shear_of_the_uvs_do_not_matter_to_direction_of_u() -> None:
    stretched = flat(grid(2, 2), lambda uvs: uvs * (7, 0.01) + 3)
    np.testing.assert_allclose(stretched[..., :3], np.broadcast_to([1, 0, 0.0], (8, 3, 3)), atol=1e-12)
    # With u = x + y the direction of rising u at constant v is still x: it is dP/du.
    sheared = flat(grid(2, 2), lambda uvs: uvs @ np.array([[1, 0], [-1, 1.0]]))
    np.testing.assert_allclose(sheared[..., :3], np.broadcast_to([1, 0, 0.0], (8, 3, 3)), atol=1e-12)


def test_a_cylinder_has_the_analytic_tangent() -> None:
    shape = grid(64, 4, (2 * np.pi, 1.0))
    angle, height = shape["positions"][:, 0], shape["positions"][:, 1]
    points = np.stack([np.sin(angle), height, np.cos(angle)], axis=1)
    normals = points * (1, 0, 1)
    faces = shape["faces"]
    tangents = compute_tangents(points, faces, normals[faces], shape["uvs"][faces])
    expected = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)[faces]
    inner = (angle[faces] > 0.2) & (angle[faces] < 6)  # at the cut, one-sided
    # Each vertex averages six triangles around it, symmetric to second order in the step of 0.1.
    assert np.abs(tangents[inner][:, :3] - expected[inner]).max() < 0.003
    assert (tangents[..., 3] == 1).all()


def test_mirror_halves_do_not_mix_at_their_common_line() -> None:
    """The usual game character: both halves show one picture. At the middle the two sides keep their own tangent."""
    left, right = grid(2, 2), grid(2, 2)
    left["positions"] = left["positions"] * (-1, 1, 1)
    positions = np.concatenate([right["positions"], left["positions"]])
    uvs = np.concatenate([right["uvs"], left["uvs"]])
    faces = np.concatenate([right["faces"], left["faces"][:, ::-1] + 9])
    # weld the middle column, as loading does: same position, normal and uv
    middle = np.flatnonzero(right["positions"][:, 0] == 0)
    faces = np.where(np.isin(faces, middle + 9), faces - 9, faces)
    tangents = compute_tangents(positions, faces, np.broadcast_to([0, 0, 1.0], (16, 3, 3)), uvs[faces])
    np.testing.assert_allclose(tangents[:8], np.broadcast_to([1, 0, 0, 1.0], (8, 3, 4)), atol=1e-12)
    np.testing.assert_allclose(tangents[8:], np.broadcast_to([-1, 0, 0, -1.0], (8, 3, 4)), atol=1e-12)


def test_hard_edges_keep_tangents_apart() -> None:
    shape = cube()
    faces = shape["faces"]
    tangents = compute_tangents(shape["positions"], faces, shape["normals"][faces], shape["uvs"][faces])
    directions = tangents[..., :3]
    assert np.abs(np.einsum("fkc,fkc->fk", directions, shape["normals"][faces])).max() < 1e-12
    assert (np.ptp(directions, axis=1) < 1e-12).all()  # one direction a face
    d_u = np.einsum("fkc,fjc->fkj", directions, np.roll(shape["positions"][faces], -1, 1) - shape["positions"][faces])
    du = (np.roll(shape["uvs"][faces], -1, 1) - shape["uvs"][faces])[..., 0]
    np.testing.assert_allclose(d_u[:, 0], 3 * du, atol=1e-12)  # u rises by 1/3 along each side of length 1


def test_angles_weigh_the_mean() -> None:
    """Two triangles at a vertex with angles 90 and 45 degrees, uv directions x and y in the normal's plane."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = np.zeros((2, 3, 2))
    uvs[0] = [[0, 0], [1, 0], [0, -1]]  # u = x
    # u is 0 at vertices 0 and 2 (as the first triangle has it) and -1 at vertex 3
    uvs[1] = [[0, 0], [0, -1], [-1, -1]]
    tangents = compute_tangents(positions, faces, np.broadcast_to([0, 0, 1.0], (2, 3, 3)), uvs)
    np.testing.assert_allclose(tangents[..., :3], np.broadcast_to([1, 0, 0.0], (2, 3, 3)), atol=1e-12)
    uvs[1] = [[0, 0], [0, -1], [-1, -2]]  # now u falls along (-1, 1) while v is level there: dP/du = (1, -1) / sqrt 2
    tangents = compute_tangents(positions, faces, np.broadcast_to([0, 0, 1.0], (2, 3, 3)), uvs)
    mean = np.pi / 2 * np.array([1, 0, 0]) + np.pi / 4 * np.array([1, 0, 0])
    second = compute_tangents(positions, faces[1:], np.broadcast_to([0, 0, 1.0], (1, 3, 3)), uvs[1:])[0, 0, :3]
    mean = np.pi / 2 * np.array([1, 0, 0]) + np.pi / 4 * second
    np.testing.assert_allclose(tangents[0, 0, :3], mean / np.linalg.norm(mean), atol=1e-12)


def test_triangles_without_uv_area_take_a_neighbours_tangent() -> None:
    shape = grid(2, 2)
    uvs = shape["uvs"].copy()
    uvs[[0, 1, 4]] = uvs[0]  # the first triangle shrinks to a point in uv
    shape["uvs"] = uvs
    tangents = flat(shape)
    assert np.isfinite(tangents).all()
    assert np.allclose(np.linalg.norm(tangents[..., :3], axis=2), 1)
    assert np.allclose(tangents[0, :, 2], 0)


def test_no_uv_direction_anywhere_still_gives_unit_vectors_across_the_normal() -> None:
    tangents = flat(grid(2, 2), lambda uvs: uvs * 0)
    assert np.allclose(np.linalg.norm(tangents[..., :3], axis=2), 1) and np.allclose(tangents[..., 2], 0)
    assert compute_tangents(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3, 3)), np.zeros((0, 3, 2))).size == 0


@pytest.mark.parametrize("name", ["human.glb", "Knight.glb", "mannequiny.glb"])
def test_frames_of_the_characters_are_orthonormal(name: str) -> None:
    mesh = load_character(asset(name)).mesh
    tangents = corner_tangents(mesh, np.arange(mesh.num_faces), mesh.corner_texcoords[:, :, 0])
    assert np.abs(np.einsum("fkc,fkc->fk", tangents[..., :3], mesh.corner_normals)).max() < 1e-9
    np.testing.assert_allclose(np.linalg.norm(tangents[..., :3], axis=2), 1, atol=1e-12)
    uvs = mesh.corner_texcoords[:, :, 0] * (1, -1)
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    assert (tangents[area > 0][..., 3] == 1).all() and (tangents[area < 0][..., 3] == -1).all()


def test_the_files_own_tangents_come_first() -> None:
    mesh = load_character(asset("human.glb")).mesh
    own = np.broadcast_to([0, 1.0, 0, -1], (mesh.num_faces, 3, 4))
    faces, uvs = np.arange(mesh.num_faces), mesh.corner_texcoords[:, :, 0]
    made = corner_tangents(mesh, faces, uvs)
    np.testing.assert_array_equal(corner_tangents(dataclasses.replace(mesh, corner_tangents=own), faces, uvs), own)
    part = np.where(faces[:, None, None] < 9, own, np.nan)
    mixed = corner_tangents(dataclasses.replace(mesh, corner_tangents=part), faces, uvs)
    np.testing.assert_array_equal(mixed[:9], own[:9])
    np.testing.assert_array_equal(mixed[9:], made[9:])
