"""The source's normals as the benchmark computes them, and that built characters are near them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from builders_gltf import cube, grid

from benchmarks._drawn_points import find_drawn_points, single_faces
from benchmarks._source_normals import SourceNormals, cofactors, mikk_tangents, sample_texture, unit, wrap
from benchmarks.accuracy import fetched_vertices
from benchmarks.normals import measure, pick_points
from preprocess.files.images import Image
from preprocess.files.resample import sample_footprints
from preprocess.load import load_character
from preprocess.load.character import TextureRef
from preprocess.load.tangents import compute_tangents
from runtime.asset.asset import load

RNG = np.random.default_rng(4)


def bent_grid() -> tuple[np.ndarray, ...]:
    """A curved sheet with a fold in its picture, turned and mirrored in part."""
    shape = grid(9, 7)
    x, y = shape["positions"][:, :2].T
    points = np.stack([x, y, 0.2 * np.sin(4 * x) * np.cos(3 * y)], axis=1)
    normals = unit(np.stack([-0.8 * np.cos(4 * x) * np.cos(3 * y), 0.6 * np.sin(4 * x) * np.sin(3 * y), 1 + 0 * x], 1))
    faces = shape["faces"]
    uvs = shape["uvs"] @ np.array([[0.8, 0.3], [-0.4, 0.9]])
    uvs[:, 0] = np.abs(uvs[:, 0] - uvs[:, 0].mean())  # mirrored on one side
    return points, faces, normals[faces], uvs[faces]


def test_tangents_are_those_of_the_pipeline(asset_path: Callable[[str], Path]) -> None:
    """Two programs from one specification."""
    box = cube()
    shapes = [
        bent_grid(),
        (box["positions"], box["faces"], box["normals"][box["faces"]], box["uvs"][box["faces"]]),
    ]
    for shape in shapes:
        ours, theirs = mikk_tangents(*shape), compute_tangents(*shape)
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    mesh = load_character(asset_path("human.glb")).mesh
    real = (mesh.surface.positions, mesh.surface.faces, mesh.corner_normals, mesh.corner_texcoords[:, :, 0])
    ours, theirs = mikk_tangents(*real), compute_tangents(*real)
    apart = np.linalg.norm(ours - theirs, axis=2)
    assert (apart > 1e-6).mean() < 1e-3  # faces without area in uv take any neighbour's


@pytest.mark.parametrize("modes", [("REPEAT", "CLAMP_TO_EDGE"), ("MIRRORED_REPEAT", "REPEAT")])
@pytest.mark.parametrize("nearest", [False, True])
def test_samples_are_those_of_the_pipeline(modes: tuple[str, str], nearest: bool) -> None:
    image = Image(RNG.uniform(size=(5, 7, 3)), "uint8")
    transform = np.array([[1.5, 0.2, -0.3], [-0.1, 0.7, 0.4], [0, 0, 1.0]])
    ref = TextureRef(image, "a", 0, modes[0], modes[1], nearest, transform)
    uvs = RNG.uniform(-2, 3, (200, 2))
    moved = uvs @ transform[:2, :2].T + transform[:2, 2]
    none = np.zeros_like(uvs)
    expected = sample_footprints(image.texels, moved, none, none, modes[0], modes[1], nearest)
    np.testing.assert_allclose(sample_texture(ref, uvs), expected, atol=1e-6)


def test_wrap_modes() -> None:
    index = np.arange(-4, 8)
    assert wrap(index, 3, "REPEAT").tolist() == [2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1]
    assert wrap(index, 3, "CLAMP_TO_EDGE").tolist() == [0, 0, 0, 0, 0, 1, 2, 2, 2, 2, 2, 2]
    assert wrap(index, 3, "MIRRORED_REPEAT").tolist() == [2, 2, 1, 0, 0, 1, 2, 2, 1, 0, 0, 1]


def test_cofactors_keep_normals_across_their_plane() -> None:
    matrices = RNG.normal(size=(50, 3, 3))
    a, b = RNG.normal(size=(2, 50, 3))
    turned = np.einsum("nij,nj->ni", cofactors(matrices), np.cross(a, b))
    moved = np.cross(*(np.einsum("nij,nj->ni", matrices, edge) for edge in (a, b)))
    sign = np.sign(np.linalg.det(matrices))[:, None]  # a mirror turns the plane over, not its outside
    np.testing.assert_allclose(turned, sign * moved, atol=1e-10)


def test_both_ways_to_pose_agree_where_all_moves_as_one(asset_path: Callable[[str], Path]) -> None:
    character = load_character(asset_path("human.glb"))
    source = SourceNormals(character, *pick_points(character, 500))
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    skin = np.tile(np.concatenate([turn, np.ones((3, 1))], axis=1), (character.mesh.num_vertices, 1, 1))
    expected = source.at_rest() @ turn.T
    np.testing.assert_allclose(source.skinned_points(skin), expected, atol=1e-9)
    np.testing.assert_allclose(source.skinned_vertices(skin), expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Fox.glb", "robot.glb"])
def test_points_are_found_where_they_are_drawn(
    name: str, built: Callable[[str], Path], asset_path: Callable[[str], Path]
) -> None:
    asset, mesh = load(built(name)), load_character(asset_path(name)).mesh
    faces = np.repeat(single_faces(mesh), 5)
    shares = RNG.dirichlet((1, 1, 1), len(faces))
    points = find_drawn_points(asset, mesh, faces, shares)
    wanted = np.einsum("nk,nki->ni", shares, mesh.surface.positions[mesh.surface.faces[faces]])
    positions, _ = fetched_vertices(asset)
    _, place = np.unique(asset.lods[0].canonical_uvs, axis=0, return_inverse=True)
    drawn = np.einsum("nk,nki->ni", points.shares, positions[place.ravel()[points.triangles]])
    assert np.linalg.norm(wanted - drawn, axis=1).max() < 1e-3 * mesh.surface.diagonal_m
    assert points.own.mean() > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("name", ["human.glb", "Fox.glb", "robot.glb"])
def test_normals_of_real_characters_are_within_a_degree(
    name: str, built: Callable[[str], Path], asset_path: Callable[[str], Path]
) -> None:
    """Points at random; posed, what a texture turned by the blend is off, and not what the blend is on large faces."""
    asset, character = load(built(name)), load_character(asset_path(name))
    asset = dataclasses.replace(asset, clips=asset.clips[:2])
    at_rest, posed = measure(asset, character, 20_000, 2)
    assert at_rest["points rms"] < 1.0 and at_rest["median"] < 0.4
    assert min(posed["by points"], posed["by vertices"]) < 1.0 + posed["ways apart"] / 2
