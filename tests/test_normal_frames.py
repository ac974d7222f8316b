"""Normals of the source's normal maps as glTF 2.0 (3.7.2.1, 3.9.3) and KHR_texture_transform define them.

A flat square in the xy plane faces +z; its map says one tangent-space direction everywhere, (0.5, 0, 0.866) within an
8-bit step. So the normal is that direction in the frame of the uvs that the map is sampled at.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, grid

from preprocess.bake.materials import bake_materials, normal_tangents, normals_at
from preprocess.export.materials import describe_material
from preprocess.load import Character, load_character
from preprocess.mesh.raster import Coverage, rasterise

TILT = (191, 128, 239)  # (0.498, 0.004, 0.875)
SLACK = 0.01  # the map's 8-bit steps
PLAIN = grid(2, 2)["uvs"]
TURNED = PLAIN @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # (u, v) to (-v, u)


def square(builder: GltfBuilder, normal: dict[str, Any], offset: float = 0.0, **attributes: Any) -> dict[str, Any]:
    """A square whose material has a normal texture, described by `normal` beyond its index."""
    texture = builder.texture(np.full((4, 4, 3), TILT, np.uint8))
    shape = grid(2, 2)
    facing = np.tile([0, 0, 1.0], (9, 1))
    part = builder.primitive(shape["positions"] + [offset, 0, 0], shape["faces"], NORMAL=facing, **attributes)
    return part | {"material": builder.add("materials", normalTexture={"index": texture, **normal})}


def load(builder: GltfBuilder, *parts: dict[str, Any], folder: Path) -> Character:
    builder.node(mesh=builder.mesh(*parts))
    return load_character(builder.write(folder / "a.glb"))


def normals_of(character: Character, material: int = 0) -> np.ndarray:
    """The normal in the middle of each of a material's triangles; all must agree."""
    mesh = character.mesh
    faces = np.flatnonzero(mesh.face_materials == material)
    thirds = np.full((len(faces), 3), 1 / 3)
    normals = normals_at(character, mesh, normal_tangents(character, mesh), faces, thirds, (64, 64))
    assert np.ptp(normals, axis=0).max() < 1e-9
    return normals[0]


def transform(**values: Any) -> dict[str, Any]:
    return {"extensions": {"KHR_texture_transform": values}}


@pytest.mark.parametrize(
    ("normal", "expected"),
    [
        ({}, (0.5, 0, 0.866)),
        # The picture turned by a quarter: what it calls right is the surface's up or down. u' = u cos a + v sin a.
        (transform(rotation=np.pi / 2), (0, -0.5, 0.866)),
        (transform(rotation=-np.pi / 2), (0, 0.5, 0.866)),
        (transform(rotation=np.pi), (-0.5, 0, 0.866)),
        (transform(scale=[-1, 1]), (-0.5, 0, 0.866)),
        (transform(scale=[3, 0.5], offset=[0.2, 7]), (0.5, 0, 0.866)),
    ],
)
def test_frames_follow_what_the_textures_uvs_go_through(tmp_path: Path, normal: dict[str, Any], expected) -> None:
    builder = GltfBuilder()
    character = load(builder, square(builder, normal, TEXCOORD_0=PLAIN), folder=tmp_path)
    np.testing.assert_allclose(normals_of(character), expected, atol=SLACK)


def test_each_texture_has_the_frame_of_its_own_transform(tmp_path: Path) -> None:
    builder = GltfBuilder()
    parts = [
        square(builder, transform(rotation=angle), 3 * number, TEXCOORD_0=PLAIN)
        for number, angle in enumerate((0, np.pi / 2))
    ]
    character = load(builder, *parts, folder=tmp_path)
    np.testing.assert_allclose(normals_of(character, 0), (0.5, 0, 0.866), atol=SLACK)
    np.testing.assert_allclose(normals_of(character, 1), (0, -0.5, 0.866), atol=SLACK)


@pytest.mark.parametrize("other_has_tangents", [False, True])
def test_the_set_that_the_map_uses_counts_whatever_other_parts_have(tmp_path: Path, other_has_tangents: bool) -> None:
    """The second set is the first turned by a quarter: u rises along y."""
    builder = GltfBuilder()
    first = square(builder, {"texCoord": 1}, TEXCOORD_0=PLAIN, TEXCOORD_1=TURNED)
    own = {"TANGENT": np.tile([1, 0, 0, 1.0], (9, 1))} if other_has_tangents else {}
    second = square(builder, {}, 3, TEXCOORD_0=PLAIN, **own)
    character = load(builder, first, second, folder=tmp_path)
    np.testing.assert_allclose(normals_of(character, 0), (0, 0.5, 0.866), atol=SLACK)
    np.testing.assert_allclose(normals_of(character, 1), (0.5, 0, 0.866), atol=SLACK)


def test_the_files_tangents_count_as_they_are(tmp_path: Path) -> None:
    builder = GltfBuilder()
    own = np.tile([0, -1, 0, 1.0], (9, 1))
    character = load(builder, square(builder, {}, TEXCOORD_0=PLAIN, TANGENT=own), folder=tmp_path)
    np.testing.assert_allclose(normals_of(character), (0, -0.5, 0.866), atol=SLACK)


@pytest.mark.parametrize("another_part", [False, True])
def test_a_texture_without_uvs_does_not_tilt_normals(tmp_path: Path, another_part: bool) -> None:
    builder = GltfBuilder()
    parts = [square(builder, {})]
    if another_part:
        parts.append(square(builder, {}, 3, TEXCOORD_0=PLAIN))
    character = load(builder, *parts, folder=tmp_path)
    np.testing.assert_allclose(normals_of(character), (0, 0, 1), atol=1e-12)
    said = [line for line in character.warnings if "no TEXCOORD_0 for its normal texture: drawn without it" in line]
    assert len(said) == 1 and "8 triangles" in said[0]
    if another_part:
        np.testing.assert_allclose(normals_of(character, 1), (0.5, 0, 0.866), atol=SLACK)


def test_colours_without_uvs_are_the_factor(tmp_path: Path) -> None:
    """Where another part has uvs: the first texel of the picture is not the answer."""
    builder = GltfBuilder()
    texture = builder.texture(np.full((4, 4, 3), (255, 0, 0), np.uint8))
    pbr = {"baseColorTexture": {"index": texture}, "baseColorFactor": [0.25, 1, 1, 1]}
    material = builder.add("materials", pbrMetallicRoughness=pbr)
    shape = grid(2, 2)
    bare = builder.primitive(shape["positions"], shape["faces"]) | {"material": material}
    dressed = builder.primitive(shape["positions"] + [3, 0, 0], shape["faces"], TEXCOORD_0=PLAIN)
    character = load(builder, bare, dressed | {"material": material}, folder=tmp_path)
    assert any("no TEXCOORD_0 for its base color texture" in line for line in character.warnings)
    mesh = character.mesh
    uvs = np.concatenate([PLAIN * 0.4 + 0.05, PLAIN * 0.4 + 0.55])  # two squares on the diagonal
    atlas = mesh.with_surface(type(mesh.surface)(mesh.surface.positions, mesh.surface.faces, uvs, mesh.surface.faces))

    def cover(width: int, height: int) -> Coverage:
        return rasterise(atlas.surface.uvs, atlas.surface.face_uvs, width, height)

    (texture_baked,) = bake_materials(character, atlas, True, 64, cover)
    np.testing.assert_allclose(texture_baked.texels[16, 16], (0.5371, 1, 1), atol=1e-3)  # sRGB of 0.25
    np.testing.assert_allclose(texture_baked.texels[48, 48], (0.5371, 0, 0), atol=1e-3)


def test_emission_above_one_keeps_its_strength_and_hue(tmp_path: Path) -> None:
    """Factor (1, 1/2, 0) and strength 4 under a half-bright texture: (4, 2, 0) times its linear value."""
    builder = GltfBuilder()
    texture = builder.texture(np.full((4, 4, 3), 188, np.uint8))  # 0.503 in linear light
    material = builder.add(
        "materials",
        emissiveTexture={"index": texture},
        emissiveFactor=[1, 0.5, 0],
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
    )
    shape = grid(2, 2)
    part = builder.primitive(shape["positions"], shape["faces"], TEXCOORD_0=PLAIN) | {"material": material}
    character = load(builder, part, folder=tmp_path)
    mesh = character.mesh

    def cover(width: int, height: int) -> Coverage:
        return rasterise(mesh.surface.uvs, mesh.surface.face_uvs, width, height)

    textures = {one.name: one for one in bake_materials(character, mesh, True, 64, cover)}
    emissive = textures["emissive"]
    spec = describe_material(character.materials[0], {"emissive": {"file": "e.png", "scale": emissive.scale}})
    strength = spec["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"]
    linear = ((emissive.texels[32, 32] + 0.055) / 1.055) ** 2.4
    light = np.where(emissive.texels[32, 32] > 0, linear, 0) * spec["emissiveFactor"] * strength
    np.testing.assert_allclose(light, 0.503 * np.array([4, 2, 0]), rtol=0.01)
    assert emissive.texels.max() <= 1.0
