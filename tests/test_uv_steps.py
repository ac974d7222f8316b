"""Uvs in 16-bit steps: what is stored is what textures were made for, and nothing is turned or joined."""

from __future__ import annotations

import dataclasses

import numpy as np

from preprocess.decimate import Lod
from preprocess.fit.uv_quantisation import snap_levels, snap_mesh
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import UV_STEPS
from runtime.asset.lod_mesh import LodMesh
from runtime.gpu.vertex_layout import uv_attributes, vertex_bytes

CORNERS = np.array([(0.1, 0.2), (0.9, 0.2), (0.4, 0.8), (0.1 + 1e-6, 0.7)])
FACES = np.array([(0, 1, 2), (0, 2, 3)], np.int32)


def a_mesh(uvs: np.ndarray) -> SkinnedMesh:
    surface = TexturedSurface(np.c_[uvs, np.zeros(len(uvs))], FACES, uvs, FACES)
    count = len(uvs)
    return SkinnedMesh(
        surface=surface,
        corner_normals=np.zeros((len(FACES), 3, 3)),
        corner_tangents=None,
        corner_texcoords=np.zeros((len(FACES), 3, 0, 2)),
        corner_colors=None,
        joint_indices=np.zeros((count, 1), np.int32),
        joint_weights=np.ones((count, 1)),
        face_materials=np.zeros(len(FACES), np.int32),
        face_parts=np.zeros(len(FACES), np.int32),
        has_uvs=True,
    )


def a_level(uvs: np.ndarray) -> Lod:
    return Lod(
        uvs=uvs,
        face_uvs=FACES,
        faces=FACES,
        canonical_uvs=np.arange(len(uvs), dtype=np.int32),
        face_source=np.zeros(len(FACES), np.int32),
        positions=np.zeros((len(uvs), 3)),
        error_m=0.0,
    )


def drawn(uvs: np.ndarray) -> LodMesh:
    own = uvs.astype(np.float32)
    return LodMesh(own, own, FACES.astype(np.uint32), (), 0.0)


def test_uvs_become_the_nearest_steps() -> None:
    mesh = a_mesh(CORNERS)
    snapped = snap_mesh(mesh).surface
    assert np.array_equal(np.rint(snapped.uvs * UV_STEPS) / UV_STEPS, snapped.uvs)
    assert 0.0 < np.abs(snapped.uvs - CORNERS).max() <= 0.5 / UV_STEPS
    assert np.array_equal(mesh.surface.uvs, CORNERS)
    assert np.array_equal(snap_levels([a_level(CORNERS)])[0].uvs, snapped.uvs)


def test_snapping_again_changes_nothing() -> None:
    once = snap_mesh(a_mesh(CORNERS))
    assert np.array_equal(snap_mesh(once).surface.uvs, once.surface.uvs)


def test_faces_keep_their_side() -> None:
    # At row 15 the edge from (10, 10) to (13, 21) is at column 11.36: 11.42 is to the right of it, 11 to the left.
    thin = np.array([(10, 10), (4000, 15), (13, 21), (11.42, 15)]) / UV_STEPS
    mesh = a_mesh(thin)
    assert snap_mesh(mesh) is mesh


def test_vertices_stay_apart() -> None:
    close = CORNERS.copy()
    close[3] = close[2] + 1e-7
    mesh, level = a_mesh(close), a_level(close)
    assert snap_mesh(mesh) is mesh
    assert snap_levels([level])[0] is level


def test_uvs_outside_the_atlas_stay() -> None:
    mesh, level = a_mesh(CORNERS + 0.5), a_level(CORNERS + 0.5)
    assert snap_mesh(mesh) is mesh and snap_levels([level])[0] is level


def test_a_vertex_takes_eight_bytes_in_steps_and_sixteen_in_floats() -> None:
    fine, coarse = drawn(snap_mesh(a_mesh(CORNERS)).surface.uvs), drawn(CORNERS)
    sizes = {}
    for name, own, owner in [
        ("steps", fine, fine),
        ("owner", coarse, fine),
        ("own", fine, coarse),
        ("none", coarse, coarse),
    ]:
        level = dataclasses.replace(own, canonical_uvs=owner.canonical_uvs)
        attributes = uv_attributes([level])
        content = vertex_bytes(level, attributes)
        assert [attribute.name for attribute in attributes] == [
            "in_uv_steps" if own is fine else "in_uv",
            "in_canonical_steps" if owner is fine else "in_canonical_uv",
        ]
        sizes[name] = len(content) // len(CORNERS)
        assert uv_attributes([fine, level]) == attributes  # all levels of a model are alike
    assert sizes == {"steps": 8, "owner": 12, "own": 12, "none": 16}
    steps = np.frombuffer(vertex_bytes(fine, uv_attributes([fine])), np.uint16).reshape(-1, 4)
    assert np.array_equal((steps / UV_STEPS).astype(np.float32), np.c_[fine.uvs, fine.canonical_uvs])
