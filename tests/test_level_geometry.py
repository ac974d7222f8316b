"""Levels fitted to the textures that they are drawn from: their errors are those of what is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.arrays import Floats
from preprocess.bake.geometry import bake_surface_positions
from preprocess.decimate import DecimateOptions, Lod, decimate
from preprocess.decimate.measure import Reference, make_reference, measure
from preprocess.fit.level_geometry import fit_levels
from preprocess.fit.stored_texture import StoredTexture
from preprocess.fit.weight_quadtree import sample_weights
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import sample_bilinear
from runtime.asset.weight_stack import unpack_weights
from tests.builders_decimate import box

POSITION_PX, WEIGHTS_PX = 48, 16


def skinned_ball() -> SkinnedMesh:
    """A ball of six charts between two joints, its lower half on the first."""
    surface = box(16, 1.0)
    share = np.clip(0.5 + surface.positions[:, 1], 0.0, 1.0)
    corners = surface.positions[surface.faces]
    return SkinnedMesh(
        surface=surface,
        corner_normals=corners / np.linalg.norm(corners, axis=2, keepdims=True),
        corner_tangents=None,
        corner_texcoords=np.zeros((len(corners), 3, 0, 2)),
        corner_colors=None,
        joint_indices=np.tile(np.array([0, 1], np.int32), (len(share), 1)),
        joint_weights=np.stack([1.0 - share, share], axis=1),
        face_materials=np.zeros(len(corners), np.int32),
        face_parts=np.zeros(len(corners), np.int32),
        has_uvs=True,
    )


def two_poses() -> Floats:
    """At rest, and with the upper joint turned by a right angle about x, (2, 2, 4, 4)."""
    poses = np.tile(np.eye(4), (2, 2, 1, 1))
    poses[1, 1, :3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    return poses


Fitted = tuple[SkinnedMesh, Reference, dict[str, StoredTexture], tuple[Lod, ...], tuple[Lod, ...]]


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """The mesh, what levels are measured against, the textures, the levels as decimated and as fitted."""
    mesh, poses = skinned_ball(), two_poses()
    blended = np.einsum("vj,pjik->pvik", mesh.dense_weights(2), poses[:, :, :3])
    surface_texture = bake_surface_positions(mesh, (256, 256))
    options = DecimateOptions(min_faces=40)
    lods = decimate(mesh.surface, options, position_texture=surface_texture, poses=blended).lods
    textures, levels = fit_levels(mesh, lods, poses, POSITION_PX, WEIGHTS_PX)
    return mesh, make_reference(mesh.surface, blended), {t.name: t for t in textures}, lods, levels


def drawn_matrices(textures: dict[str, StoredTexture], lod: Lod) -> Floats:
    """What the shaders blend at a level's vertices, (P, V, 3, 4)."""
    weights = textures["weights"]
    stored = unpack_weights(np.rint(weights.levels[0] * 255).astype(np.uint8), weights.size, 2)
    assert lod.fetch_uvs is not None
    if weights.details is None:
        blended = sample_bilinear(stored, lod.fetch_uvs)
    else:
        blended = sample_weights(stored, weights.details, lod.fetch_uvs)
    return np.einsum("vj,pjik->pvik", blended, two_poses()[:, :, :3])


def test_a_level_says_how_far_it_is_as_it_is_drawn(fitted: Fitted) -> None:
    _, reference, textures, lods, levels = fitted
    assert len(levels) == len(lods) > 4 and lods[2].exact
    finer = levels[0]
    for lod, before in zip(levels[1:], lods[1:], strict=True):
        found = measure(reference, lod, drawn_matrices(textures, lod))
        assert lod.mean_error_m == found.mean_m and lod.normal_error_rad == found.normal_rad
        at_least = finer.error_m if lod.exact else max(finer.error_m, before.error_m)
        assert lod.error_m == max(found.largest_m, at_least)
        finer = lod


def test_positions_are_those_that_the_texture_holds(fitted: Fitted) -> None:
    _, _, textures, _, levels = fitted
    for lod in levels:
        assert lod.fetch_uvs is not None
        np.testing.assert_array_equal(sample_bilinear(textures["position"].levels[0], lod.fetch_uvs), lod.positions)
