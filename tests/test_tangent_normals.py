"""The tangent-space normal map of model.glb: what an engine makes of it is the stored normal again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from test_model_glb import full_lod, half_lod

from preprocess.export.glb import build_levels
from preprocess.export.lod_vertices import LodMesh
from preprocess.export.tangent_normals import atlas_tangents, bake_tangent_normals, to_frame
from preprocess.load import load_character
from preprocess.mesh.raster import cover_atlas, fill_outside, interpolate_corners
from preprocess.mesh.texels import sample_bilinear
from runtime.gltf.document import read_document


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def seen(local: np.ndarray, normals: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """What an engine shades with: glTF 2.0, 3.7.2.1 and 3.9.3."""
    n, t = unit(normals), unit(tangents[:, :3])
    b = np.cross(n, t) * tangents[:, 3:]
    return unit(local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * n)


def test_a_frame_and_back() -> None:
    rng = np.random.default_rng(3)
    directions, normals = unit(rng.normal(size=(500, 3))), rng.normal(size=(500, 3))
    tangents = np.c_[rng.normal(size=(500, 3)), rng.choice([-1.0, 1.0], 500)]
    local = to_frame(directions, normals, tangents)
    np.testing.assert_allclose(seen(local, normals, tangents), directions, atol=1e-6)
    np.testing.assert_allclose(to_frame(unit(normals), normals, tangents), np.tile((0, 0, 1.0), (500, 1)), atol=1e-9)


def test_no_frame_is_the_normal_itself() -> None:
    parallel = to_frame(np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 0]]), np.array([[1.0, 0, 0, 1]]))
    np.testing.assert_array_equal(parallel, [[0, 0, 1]])


def uv_shares(level: LodMesh) -> np.ndarray:
    """Each face's share of the atlas: faces smaller than a texel have no normals of their own in any map."""
    corners = level.uvs.astype(np.float64)[level.faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return areas / areas.sum()


def test_an_engine_sees_the_stored_normals(asset_path: Any) -> None:
    """At points of the finest level, from the 8-bit map and the vertices' frames; and of a coarse level nearly so."""
    character = load_character(asset_path("human.glb"))
    mesh, lod = character.mesh, full_lod(character)
    tangents = atlas_tangents(mesh)
    fine, coarse = build_levels(character, mesh, [lod, half_lod(lod)], tangents=tangents)
    size = 512
    # Object-space normals with relief: the interpolated ones, tilted by waves over the atlas.
    rng = np.random.default_rng(4)
    texel = (np.indices((size, size))[::-1].transpose(1, 2, 0) + 0.5) / size
    tilt = 0.25 * np.sin(40.0 * texel @ rng.normal(size=(2, 3)))
    coverage = cover_atlas(mesh, size, size)
    smooth = unit(interpolate_corners(coverage, mesh.corner_normals) + 1e-9)
    normals = 0.5 * fill_outside(unit(smooth + tilt), coverage.faces >= 0) + 0.5
    image = np.rint(bake_tangent_normals(fine, normals) * 255.0) / 255.0

    for level, limit_deg in ((fine, 1.2), (coarse, 1.2)):
        faces = rng.choice(len(level.faces), 4000, p=uv_shares(level))
        weights = rng.dirichlet((1, 1, 1), 4000)
        corner = level.faces[faces]

        def blend(values: np.ndarray) -> np.ndarray:
            return np.einsum("nk,nkc->nc", weights, values.astype(np.float64)[corner])  # noqa: B023

        uvs = blend(level.uvs)
        local = 2.0 * sample_bilinear(image, uvs) - 1.0
        expected = unit(2.0 * sample_bilinear(normals, uvs) - 1.0)
        assert level.tangents is not None
        found = seen(local, blend(level.normals), blend(level.tangents))
        angles = np.degrees(np.arccos(np.clip((found * expected).sum(axis=1), -1, 1)))
        assert np.sqrt((angles**2).mean()) < limit_deg, np.sqrt((angles**2).mean())


def test_a_built_character_with_relief_names_its_map(built: Callable[[str], Path]) -> None:
    folder = built("human.glb")
    document = read_document(folder / "model.glb")
    uris = [image["uri"] for image in document.items("images")]
    material = document.items("materials")[0]
    source = document.items("textures")[material["normalTexture"]["index"]]["source"]
    assert uris[source] == "tangent_normal.png" and (folder / "tangent_normal.png").is_file()
    for mesh in document.items("meshes"):
        assert all("TANGENT" in primitive["attributes"] for primitive in mesh["primitives"])
    assert "tangent_normal.png" in json.loads((folder / "manifest.json").read_text())["files"]
