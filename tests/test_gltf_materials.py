"""Materials: factors, textures, samplers, transforms and extensions as the file has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, grid
from conftest import asset

from preprocess.errors import InputError
from preprocess.load import Character, load_character
from preprocess.load.materials import texture_transform

TEXELS = np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5


def with_material(tmp_path: Path, spec: dict[str, Any], builder: GltfBuilder | None = None) -> Character:
    builder = builder or GltfBuilder()
    shape = grid(1, 1)
    primitive = builder.primitive(
        shape["positions"], shape["faces"], TEXCOORD_0=shape["uvs"], TEXCOORD_1=shape["uvs"] * 0.5
    )
    primitive["material"] = builder.add("materials", **spec)
    builder.node(mesh=builder.mesh(primitive))
    return load_character(builder.write(tmp_path / "a.glb"))


def test_defaults_are_those_of_gltf(tmp_path: Path) -> None:
    material = with_material(tmp_path, {}).materials[0]
    assert material.base_color_factor == (1, 1, 1, 1) and material.metallic_factor == material.roughness_factor == 1
    assert material.emissive_factor == (0, 0, 0) and material.alpha_mode == "OPAQUE" and material.alpha_cutoff == 0.5
    assert not material.double_sided and not material.unlit and material.base_color is None
    assert material.name == "material 0"


def test_factors_and_modes(tmp_path: Path) -> None:
    material = with_material(
        tmp_path,
        {
            "name": "leaf",
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.1, 0.2, 0.3, 0.4],
                "metallicFactor": 0,
                "roughnessFactor": 0.5,
            },
            "emissiveFactor": [1, 0.5, 0],
            "alphaMode": "MASK",
            "alphaCutoff": 0.25,
            "doubleSided": True,
            "extensions": {"KHR_materials_unlit": {}, "KHR_materials_emissive_strength": {"emissiveStrength": 3}},
        },
    ).materials[0]
    assert material.base_color_factor == (0.1, 0.2, 0.3, 0.4) and material.metallic_factor == 0
    assert material.roughness_factor == 0.5 and material.emissive_factor == (3, 1.5, 0)
    assert (material.alpha_mode, material.alpha_cutoff) == ("MASK", 0.25)
    assert material.double_sided and material.unlit and material.name == "leaf"


def test_textures_samplers_and_transforms(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = builder.texture(TEXELS, wrapS=33071, wrapT=33648, magFilter=9728)
    info = {
        "index": texture,
        "texCoord": 0,
        "extensions": {"KHR_texture_transform": {"offset": [0.5, 0.25], "scale": [2, 3], "texCoord": 1}},
    }
    character = with_material(
        tmp_path,
        {"pbrMetallicRoughness": {"baseColorTexture": info}, "normalTexture": {"index": texture, "scale": 0.5}},
        builder,
    )
    material = character.materials[0]
    ref, normal = material.base_color, material.normal
    assert ref is not None and normal is not None
    assert (ref.texcoord, ref.wrap_s, ref.wrap_t, ref.nearest) == (1, "CLAMP_TO_EDGE", "MIRRORED_REPEAT", True)
    np.testing.assert_allclose(ref.transform, [[2, 0, 0.5], [0, 3, 0.25], [0, 0, 1]])
    np.testing.assert_allclose(ref.image.texels[..., :3] * 255, TEXELS, atol=1e-4)
    assert normal.image is ref.image  # decoded once
    assert material.normal_scale == 0.5 and normal.texcoord == 0 and (normal.transform == np.eye(3)).all()
    assert character.mesh.corner_texcoords.shape[2] == 2


def test_rotation_turns_the_uvs_as_the_khronos_viewer_does() -> None:
    """A quarter turn, counter-clockwise in the image (v down): u' = v, v' = -u, then the offset brings it back."""
    matrix = texture_transform({"rotation": np.pi / 2, "offset": [0, 1], "scale": [1, 1]}, "here")
    np.testing.assert_allclose(matrix @ [0.25, 0.5, 1], [0.5, 0.75, 1], atol=1e-12)
    # scale comes first, then rotation, then offset
    matrix = texture_transform({"rotation": np.pi / 2, "scale": [2, 1], "offset": [0.1, 0.2]}, "here")
    np.testing.assert_allclose(matrix @ [1, 0, 1], [0.1, 0.2 - 2, 1], atol=1e-12)


def test_specular_glossiness_is_approximated(tmp_path: Path) -> None:
    glossy = {"diffuseFactor": [0.5, 0.25, 0, 1], "glossinessFactor": 0.75, "specularFactor": [1, 1, 1]}
    character = with_material(tmp_path, {"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}})
    material = character.materials[0]
    assert material.base_color_factor == (0.5, 0.25, 0, 1)
    assert material.metallic_factor == 0 and material.roughness_factor == 0.25
    assert any("specular-glossiness" in warning for warning in character.warnings)


def test_other_material_extensions_are_dropped_with_a_warning(tmp_path: Path) -> None:
    character = with_material(tmp_path, {"name": "car", "extensions": {"KHR_materials_clearcoat": {}}})
    assert "material car: KHR_materials_clearcoat dropped" in character.warnings


def test_a_set_that_no_mesh_has_falls_back(tmp_path: Path) -> None:
    builder = GltfBuilder()
    info = {"index": builder.texture(TEXELS), "texCoord": 3}
    character = with_material(tmp_path, {"emissiveTexture": info}, builder)
    assert character.materials[0].emissive is not None and character.materials[0].emissive.texcoord == 0
    assert any("TEXCOORD_3" in warning for warning in character.warnings)


def test_parts_without_material_get_the_default(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    red = builder.primitive(shape["positions"], shape["faces"])
    red["material"] = builder.add("materials", name="red")
    plain = builder.primitive(shape["positions"] + 2, shape["faces"])
    builder.node(mesh=builder.mesh(red, plain))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert [material.name for material in character.materials] == ["red", "default"]
    assert character.mesh.face_materials.tolist() == [0, 0, 1, 1]


def test_unused_materials_and_their_images_are_not_read(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.add("images", uri="missing.png")
    builder.add("textures", source=0)
    builder.add("materials", name="unused", emissiveTexture={"index": 0})
    assert [material.name for material in with_material(tmp_path, {"name": "used"}, builder).materials] == ["used"]


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ({"alphaMode": "GLASS"}, "alphaMode GLASS"),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1]}}, "4 finite numbers"),
        ({"emissiveTexture": {"index": 7}}, r"textures\[7\] does not exist"),
        ({"normalTexture": 3}, "must be an object"),
    ],
)
def test_bad_materials_are_refused(tmp_path: Path, spec: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        with_material(tmp_path, spec)
    assert "\n" not in str(caught.value)


def test_bad_textures_are_refused(tmp_path: Path) -> None:
    def textured(**texture: Any) -> None:
        builder = GltfBuilder()
        builder.add("images", uri="missing.png")
        builder.add("images", bufferView=builder.view(b"this is no image"), mimeType="image/png")
        builder.add("textures", **texture)
        with_material(tmp_path, {"emissiveTexture": {"index": 0}}, builder)

    with pytest.raises(InputError, match=r"missing\.png"):
        textured(source=0)
    with pytest.raises(InputError, match="no image of a known format"):
        textured(source=1)
    with pytest.raises(InputError, match="no image"):
        textured()
    with pytest.raises(InputError, match="PNG or JPEG"):
        textured(extensions={"KHR_texture_basisu": {"source": 0}})


def test_vertex_colours_are_white_where_a_part_has_none(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    tinted = builder.primitive(shape["positions"], shape["faces"], COLOR_0=np.tile([0.5, 0.25, 0.125], (4, 1)))
    plain = builder.primitive(shape["positions"] + 2, shape["faces"])
    builder.node(mesh=builder.mesh(tinted, plain))
    colors = load_character(builder.write(tmp_path / "a.glb")).mesh.corner_colors
    assert colors is not None and colors.dtype == np.float32
    np.testing.assert_array_equal(colors[:2], np.broadcast_to(np.float32([0.5, 0.25, 0.125, 1]), (2, 3, 4)))
    np.testing.assert_array_equal(colors[2:], 1)


def test_tangents_of_some_parts_are_kept(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    common = {"NORMAL": np.tile([0, 0, 1.0], (4, 1)), "TEXCOORD_0": shape["uvs"]}
    own = np.tile([0, 1, 0, -1.0], (4, 1))
    first = builder.primitive(shape["positions"], shape["faces"], TANGENT=own, **common)
    second = builder.primitive(shape["positions"] + 2, shape["faces"], **common)
    builder.node(mesh=builder.mesh(first, second))
    tangents = load_character(builder.write(tmp_path / "a.glb")).mesh.corner_tangents
    assert tangents is not None
    np.testing.assert_allclose(tangents[:2], np.broadcast_to([0, 1, 0, -1.0], (2, 3, 4)))
    assert np.isnan(tangents[2:]).all()  # made where their normal texture is known (bake/materials.py)


def test_morph_channels_of_a_mesh_without_targets_move_nothing(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    primitive = builder.primitive(shape["positions"], shape["faces"])
    node = builder.node(mesh=builder.mesh(primitive))
    builder.clip(
        "smile",
        (node, "translation", "LINEAR", [0, 1], [[0, 0, 0], [1, 0, 0]]),
        (node, "weights", "LINEAR", [0, 1], [0, 1]),
    )
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert len(character.clips[0].tracks) == 1


def test_materials_of_the_characters() -> None:
    human = load_character(asset("human.glb")).materials[0]
    assert human.base_color is not None and human.normal is not None and human.metallic_roughness is not None
    assert human.base_color.image.texels.shape[0] >= 256
    knight = load_character(asset("Knight.glb"))
    assert knight.materials[0].double_sided and knight.materials[0].base_color is not None
    assert {m.base_color_factor for m in load_character(asset("robot.glb")).materials} != {(1, 1, 1, 1)}
