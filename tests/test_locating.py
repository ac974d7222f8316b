"""Vertices of levels are found on the full mesh by their place in the atlas, however large the faces there are."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.decimate import Lod
from preprocess.fit.corner_locations import locate_corners
from preprocess.fit.level_geometry import _locate_canonical
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface


@pytest.fixture
def full() -> SkinnedMesh:
    """A large face on one joint and, beside its longest edge in the atlas, two small ones on another: one component."""
    uvs = np.array([(0.1, 0.1), (0.9, 0.1), (0.1, 0.9), (0.56, 0.56), (0.58, 0.56), (0.58, 0.58), (0.56, 0.58)])
    small = np.array([(0.9, 0.1, 0.0), (1.0, 0.1, 0.0), (1.0, 0.2, 0.0), (0.9, 0.2, 0.0)])
    surface = TexturedSurface(
        positions=np.r_[[(0.1, 0.1, 0.0)], [(0.1, 0.9, 0.0)], small],
        faces=np.array([(0, 2, 1), (2, 3, 4), (2, 4, 5)], np.int32),
        uvs=uvs,
        face_uvs=np.array([(0, 1, 2), (3, 4, 5), (3, 5, 6)], np.int32),
    )
    return SkinnedMesh(
        surface=surface,
        corner_normals=np.tile((0.0, 0.0, 1.0), (3, 3, 1)),
        corner_tangents=None,
        corner_texcoords=np.zeros((3, 3, 0, 2)),
        corner_colors=None,
        joint_indices=np.array([0, 0, 0, 1, 1, 1], np.int32)[:, None],
        joint_weights=np.ones((6, 1)),
        face_materials=np.zeros(3, np.int32),
        face_parts=np.zeros(3, np.int32),
        has_uvs=True,
    )


@pytest.fixture
def level() -> Lod:
    """One face, said to stem from a small one; its first vertex lies in the large one, and has left the surface."""
    triangle = np.array([(0, 1, 2)], np.int32)
    return Lod(
        uvs=np.array([(0.48, 0.48), (0.58, 0.56), (0.58, 0.58)]),
        face_uvs=triangle,
        faces=triangle,
        canonical_uvs=np.arange(3, dtype=np.int32),
        face_source=np.array([1], np.int32),
        positions=np.array([(0.48, 0.48, 0.3), (1.0, 0.1, 0.0), (1.0, 0.2, 0.0)]),
        error_m=0.0,
    )


def test_weights_are_those_at_the_canonical_uvs(full: SkinnedMesh, level: Lod) -> None:
    (canonical,) = _locate_canonical(full, [level])
    np.testing.assert_allclose(canonical.blend(full.dense_weights(2)), [(1, 0), (0, 1), (0, 1)], atol=1e-12)
    beneath = [(0.48, 0.48, 0.0), (1.0, 0.1, 0.0), (1.0, 0.2, 0.0)]
    np.testing.assert_allclose(canonical.blend(full.surface.positions), beneath, atol=1e-12)


def test_corners_are_found_in_a_large_face_without_a_corner_nearby(full: SkinnedMesh, level: Lod) -> None:
    places, points, _ = locate_corners(full.surface, level.surface, level.face_source)
    found = places.firsts[points[0]]
    assert places.faces[found[0]] == 0 and set(places.faces[found[1:]]) <= {1, 2}
    corners = full.surface.uvs[full.surface.face_uvs[places.faces[found]]]
    uvs = np.einsum("nk,nkc->nc", places.barycentrics[found], corners)
    np.testing.assert_allclose(uvs, level.uvs, atol=1e-3)
