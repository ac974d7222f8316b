"""The shape of a glTF file's JSON, as a table: what a reader may rely on once a file has passed.

Only what readers look at is listed, and only its type; whether an index exists is found out when it is used.
Source: Khronos Group, glTF 2.0 Specification, section 5 (properties reference).
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS, Limits


class Kind(Enum):
    """Type of a value; its own value completes the sentence "must be ..."."""

    INDEX = "a whole number, zero or more, within limits"
    NUMBER = "a finite number within limits"
    TEXT = "text"


INDEX, NUMBER, TEXT = Kind.INDEX, Kind.NUMBER, Kind.TEXT
# A rule is a Kind, a list of one rule, or a dict of rules by key; the key "*" is for all keys not named.
Rule = Any

EXTENSIONS: Rule = {"*": {}}
NODE_EXTENSIONS: Rule = {"MSFT_lod": {"ids": [INDEX]}, "*": {}}
TEXTURE_INFO: Rule = {
    "index": INDEX,
    "texCoord": INDEX,
    "scale": NUMBER,
    "strength": NUMBER,
    "extensions": {
        "KHR_texture_transform": {"offset": [NUMBER], "rotation": NUMBER, "scale": [NUMBER], "texCoord": INDEX},
        "*": {},
    },
}
SPARSE: Rule = {
    "count": INDEX,
    "indices": {"bufferView": INDEX, "byteOffset": INDEX, "componentType": INDEX},
    "values": {"bufferView": INDEX, "byteOffset": INDEX},
}
MATERIAL: Rule = {
    "pbrMetallicRoughness": {
        "baseColorFactor": [NUMBER],
        "metallicFactor": NUMBER,
        "roughnessFactor": NUMBER,
        "baseColorTexture": TEXTURE_INFO,
        "metallicRoughnessTexture": TEXTURE_INFO,
    },
    "normalTexture": TEXTURE_INFO,
    "occlusionTexture": TEXTURE_INFO,
    "emissiveTexture": TEXTURE_INFO,
    "emissiveFactor": [NUMBER],
    "alphaMode": TEXT,
    "alphaCutoff": NUMBER,
    "extensions": {
        "KHR_materials_emissive_strength": {"emissiveStrength": NUMBER},
        "KHR_materials_pbrSpecularGlossiness": {
            "diffuseFactor": [NUMBER],
            "glossinessFactor": NUMBER,
            "diffuseTexture": TEXTURE_INFO,
        },
        "*": {},
    },
}
PRIMITIVE: Rule = {
    "attributes": {"*": INDEX},
    "indices": INDEX,
    "material": INDEX,
    "mode": INDEX,
    "targets": [{"*": INDEX}],
    "extensions": EXTENSIONS,
}
SCHEMA: Rule = {
    "asset": {},
    "extensionsUsed": [TEXT],
    "extensionsRequired": [TEXT],
    "scene": INDEX,
    "scenes": [{"nodes": [INDEX]}],
    "nodes": [
        {
            "children": [INDEX],
            "mesh": INDEX,
            "skin": INDEX,
            "matrix": [NUMBER],
            "translation": [NUMBER],
            "rotation": [NUMBER],
            "scale": [NUMBER],
            "weights": [NUMBER],
            "extensions": NODE_EXTENSIONS,
        }
    ],
    "meshes": [{"primitives": [PRIMITIVE], "weights": [NUMBER]}],
    "skins": [{"joints": [INDEX], "inverseBindMatrices": INDEX}],
    "animations": [
        {
            "channels": [{"sampler": INDEX, "target": {"node": INDEX, "path": TEXT}}],
            "samplers": [{"input": INDEX, "output": INDEX, "interpolation": TEXT}],
        }
    ],
    "accessors": [
        {
            "bufferView": INDEX,
            "byteOffset": INDEX,
            "componentType": INDEX,
            "count": INDEX,
            "type": TEXT,
            "sparse": SPARSE,
        }
    ],
    "bufferViews": [
        {
            "buffer": INDEX,
            "byteOffset": INDEX,
            "byteLength": INDEX,
            "byteStride": INDEX,
            "extensions": EXTENSIONS,
        }
    ],
    "buffers": [{"uri": TEXT}],
    "images": [{"uri": TEXT, "bufferView": INDEX}],
    "textures": [{"source": INDEX, "sampler": INDEX, "extensions": {"*": {"source": INDEX}}}],
    "samplers": [{"magFilter": INDEX, "minFilter": INDEX, "wrapS": INDEX, "wrapT": INDEX}],
    "materials": [MATERIAL],
}


def _find_fault(value: Any, rule: Rule, limits: Limits) -> tuple[str, str] | None:
    """Where below a value its rule is broken and what belongs there, or None. Files hold 10^5 values: kept lean.

    JSON has one kind of number: exporters that write 3 as 3.0 mean 3, and it is made that in its place.
    """
    if isinstance(rule, dict):
        if not isinstance(value, dict):
            return "", "an object"
        other = rule.get("*")
        for key, item in value.items():
            inner = rule.get(key, other)
            if inner is not None:
                if inner is INDEX and type(item) is float and item.is_integer():
                    value[key] = item = int(item)  # no key is added: the loop goes on
                fault = _find_fault(item, inner, limits)
                if fault:
                    return f".{key}{fault[0]}", fault[1]
        return None
    if isinstance(rule, list):
        if not isinstance(value, list):
            return "", "a list"
        inner = rule[0]
        for position, item in enumerate(value):
            if inner is INDEX and type(item) is float and item.is_integer():
                value[position] = item = int(item)
            fault = _find_fault(item, inner, limits)
            if fault:
                return f"[{position}]{fault[0]}", fault[1]
        return None
    if rule is INDEX:
        return None if type(value) is int and 0 <= value <= limits.whole else ("", rule.value)
    if rule is NUMBER:
        return None if type(value) in (int, float) and abs(value) <= limits.number else ("", rule.value)
    return None if isinstance(value, str) else ("", rule.value)


def check_types(root: dict[str, Any], name: str, limits: Limits = LIMITS) -> None:
    """Check the types of everything in a glTF file's JSON that readers look at; whole numbers become ints.

    Parameters
    ----------
    root : dict
    name : str
        How the message names the file.
    limits : Limits

    Raises
    ------
    AssetError
        At the first value of a wrong type: which, and what it must be.
    """
    fault = _find_fault(root, SCHEMA, limits)
    if fault:
        raise AssetError(f"{name} is malformed: {fault[0].lstrip('.')} must be {fault[1]}: export it again")
