"""glTF materials of a built character: the few ways its faces are drawn, over the shared textures of the folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Indices
from preprocess.load.character import Material

ALPHA_ORDER = ("OPAQUE", "MASK", "BLEND")
CLAMP_TO_EDGE, LINEAR, LINEAR_MIPMAP_LINEAR = 33071, 9729, 9987
# Those that glTF knows; "tangent_normal" stands for the object-space normals, which it does not.
MODEL_TEXTURES = ("base_color", "orm", "emissive", "tangent_normal")


def _is_baked(textures: Mapping[str, Mapping[str, Any]], name: str) -> bool:
    """Whether a texture holds the materials' factors already. One copied from the source does not."""
    return name in textures and not textures[name].get("copied", False)


def uv_set(entry: Mapping[str, Any]) -> int:
    """Which TEXCOORD samples a texture: 1 if it was made for the places of the normals, else 0."""
    return int(entry.get("uvs") == "normal")


def describe_material(material: Material, textures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The glTF description of a material over the folder's textures, without its name.

    Parameters
    ----------
    material : Material
    textures : mapping of texture name to its manifest entry
        `copied` in an entry says that it is the source's own image, so that the source's factors apply.
    """
    pbr: dict[str, Any] = {
        "baseColorFactor": list(material.base_color_factor),
        "metallicFactor": material.metallic_factor,
        "roughnessFactor": material.roughness_factor,
    }
    emissive = np.array(material.emissive_factor)
    occlusion_strength = material.occlusion_strength
    if _is_baked(textures, "base_color"):
        pbr["baseColorFactor"] = [1.0, 1.0, 1.0, 1.0]
    if _is_baked(textures, "orm"):
        pbr["metallicFactor"] = pbr["roughnessFactor"] = occlusion_strength = 1.0
    if _is_baked(textures, "emissive"):
        emissive = np.full(3, textures["emissive"].get("scale", 1.0))
    index = texture_indices(textures)

    def texture(name: str) -> dict[str, int]:
        which = uv_set(textures[name])
        return {"index": index[name], "texCoord": which} if which else {"index": index[name]}

    spec: dict[str, Any] = {"pbrMetallicRoughness": pbr}
    if "base_color" in index:
        pbr["baseColorTexture"] = texture("base_color")
    if "orm" in index:
        pbr["metallicRoughnessTexture"] = texture("orm")
        spec["occlusionTexture"] = {**texture("orm"), "strength": occlusion_strength}
    if "emissive" in index:
        spec["emissiveTexture"] = texture("emissive")
    if "tangent_normal" in index:
        spec["normalTexture"] = texture("tangent_normal")
    strength = max(1.0, float(emissive.max()))
    spec["emissiveFactor"] = (emissive / strength).tolist()
    extensions: dict[str, Any] = {}
    if strength > 1.0:
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
    if material.unlit:
        extensions["KHR_materials_unlit"] = {}
    if extensions:
        spec["extensions"] = extensions
    spec["alphaMode"] = material.alpha_mode
    if material.alpha_mode == "MASK":
        spec["alphaCutoff"] = material.alpha_cutoff
    spec["doubleSided"] = material.double_sided
    return spec


def texture_indices(textures: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Index of each texture that the model refers to among the file's textures."""
    return {name: index for index, name in enumerate(n for n in MODEL_TEXTURES if n in textures)}


def describe_textures(textures: Mapping[str, Mapping[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Images (by file name relative to the model), one sampler and textures, in the order of `texture_indices`."""
    names = list(texture_indices(textures))
    if not names:
        return {}
    return {
        "images": [{"uri": str(textures[name]["file"]), "name": name} for name in names],
        "samplers": [
            {
                "magFilter": LINEAR,
                "minFilter": LINEAR_MIPMAP_LINEAR,
                "wrapS": CLAMP_TO_EDGE,
                "wrapT": CLAMP_TO_EDGE,
            }
        ],
        "textures": [{"source": index, "sampler": 0, "name": name} for index, name in enumerate(names)],
    }


def plan_draws(
    materials: tuple[Material, ...], used: NDArray[np.integer], textures: Mapping[str, Mapping[str, Any]]
) -> tuple[list[dict[str, Any]], Indices]:
    """The distinct ways to draw the used materials, opaque ones first.

    Parameters
    ----------
    materials : tuple of Material
    used : (U,) int
        Indices of the materials that faces use.
    textures : mapping

    Returns
    -------
    descriptions : list of dict
        Named after the first material of each; alike materials share one.
    draw_of_material : (M,) int64
        Index of the description of each material, -1 where it is not used.
    """
    order = sorted(used.tolist(), key=lambda m: (ALPHA_ORDER.index(materials[m].alpha_mode), m))
    draw_of_material = np.full(len(materials), -1, np.int64)
    known: dict[str, int] = {}
    descriptions: list[dict[str, Any]] = []
    for index in order:
        spec = describe_material(materials[index], textures)
        key = json.dumps(spec, sort_keys=True)
        if key not in known:
            known[key] = len(descriptions)
            descriptions.append({"name": materials[index].name, **spec})
        draw_of_material[index] = known[key]
    return descriptions, draw_of_material
