"""`python -m preprocess info MODEL`: what a character file holds, and what a build keeps, approximates and drops."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from preprocess.errors import InputError
from preprocess.load import load_character
from preprocess.load.character import Character, Material
from runtime.animation.clip import WEIGHTS
from runtime.errors import AssetError
from runtime.gltf.document import Document, read_document
from runtime.gltf.morph_names import morph_names, num_targets

# What becomes of extensions; of those that are not named here nothing is read.
FATES = {
    "KHR_texture_transform": "kept",
    "KHR_mesh_quantization": "kept",
    "KHR_materials_unlit": "kept",
    "KHR_materials_emissive_strength": "kept",
    "EXT_texture_webp": "kept",
    "EXT_meshopt_compression": "kept: decoded",
    "KHR_meshopt_compression": "kept: decoded",
    "KHR_draco_mesh_compression": "kept: decoded",
    "KHR_materials_pbrSpecularGlossiness": "approximated: as metallic-roughness",
    "MSFT_lod": "approximated: the finest level is built, levels are made anew",
    "VRM": "approximated: mesh, skeleton, clips and morph targets",
    "VRMC_vrm": "approximated: mesh, skeleton, clips and morph targets",
}
DROPPED = "dropped"
MOST_LISTED = 40  # rows of a kind, in print; --json has all
TEXTURES = ("base_color", "metallic_roughness", "normal", "occlusion", "emissive")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The file, and how to print."""
    parser.add_argument("model", type=Path, metavar="MODEL", help=".gltf, .glb or .vrm")
    parser.add_argument("--json", action="store_true", help="everything as JSON")


def _meshes(document: Document) -> list[dict[str, Any]]:
    """Meshes of the file, with sizes as its JSON says them."""

    def count(index: Any) -> int:
        return int(document.item("accessors", index).get("count", 0)) if index is not None else 0

    found = []
    for number, mesh in enumerate(document.items("meshes")):
        primitives = mesh.get("primitives", [])
        vertices = [count(one.get("attributes", {}).get("POSITION")) for one in primitives]
        corners = [count(one["indices"]) if "indices" in one else own for one, own in zip(primitives, vertices)]
        found.append(
            {
                "name": str(mesh.get("name") or f"mesh {number}"),
                "primitives": len(primitives),
                "vertices": sum(vertices),
                "triangles": sum(corners) // 3,
                "morph_targets": num_targets(mesh),
            }
        )
    return found


def _parts(document: Document) -> list[dict[str, Any]]:
    """Nodes that show a mesh."""
    names = morph_names(document)
    return [
        {
            "name": str(node.get("name") or f"node {number}"),
            "mesh": str(document.item("meshes", node["mesh"]).get("name") or f"mesh {node['mesh']}"),
            "skinned": "skin" in node,
            "morphs": list(names.get(number, ())),
        }
        for number, node in enumerate(document.items("nodes"))
        if "mesh" in node
    ]


def _material(material: Material) -> dict[str, Any]:
    references = {kind: getattr(material, kind) for kind in TEXTURES}
    return {
        "name": material.name,
        "alpha": material.alpha_mode,
        "double_sided": material.double_sided,
        "unlit": material.unlit,
        "textures": {kind: reference.name for kind, reference in references.items() if reference is not None},
    }


def _textures(character: Character) -> list[dict[str, Any]]:
    """Images that the materials look at, each once."""
    found: dict[int, dict[str, Any]] = {}
    for material in character.materials:
        for kind in TEXTURES:
            reference = getattr(material, kind)
            if reference is not None:
                height, width = reference.image.texels.shape[:2]
                row = {"name": reference.name, "size": [width, height], "used_as": []}
                found.setdefault(id(reference.image), row)["used_as"].append(kind)
    return [{**row, "used_as": sorted(set(row["used_as"]))} for row in found.values()]


def describe(path: Path) -> dict[str, Any]:
    """Everything that `info` tells of a file.

    Raises
    ------
    InputError
        If the file cannot be built.
    """
    character = load_character(path)
    try:
        document = read_document(path)
        parts, meshes = _parts(document), _meshes(document)
    except AssetError as error:
        raise InputError(str(error)) from None
    mesh, skeleton = character.mesh, character.skeleton
    low, high = mesh.surface.positions.min(axis=0), mesh.surface.positions.max(axis=0)
    return {
        "file": path.name,
        "generator": str(document.json.get("asset", {}).get("generator", "")),
        "triangles": mesh.num_faces,
        "vertices": mesh.num_vertices,
        "box_m": [low.tolist(), high.tolist()],
        "meshes": meshes,
        "parts": parts,
        "joints": list(skeleton.joint_names),
        "clips": [
            {
                "name": clip.name,
                "duration_s": clip.duration_s,
                "moves_joints": any(track.path != WEIGHTS for track in clip.tracks),
                "moves_morphs": any(track.path == WEIGHTS for track in clip.tracks),
            }
            for clip in character.clips
        ],
        "morphs": [
            {
                "name": morph.name,
                "default": morph.default,
                "vertices": len(morph.vertices),
                "largest_shift_m": float(np.linalg.norm(morph.shifts, axis=1).max(initial=0.0)),
            }
            for morph in mesh.morphs
        ],
        "materials": [_material(material) for material in character.materials],
        "textures": _textures(character),
        "extensions": {name: FATES.get(name, DROPPED) for name in document.json.get("extensionsUsed", [])},
        "notes": list(character.warnings),
    }


def _lines(found: dict[str, Any]) -> list[str]:
    """The same for people."""
    size = np.subtract(found["box_m"][1], found["box_m"][0])
    lines = [
        f"{found['file']}: {found['triangles']} triangles, {found['vertices']} points, "
        + " × ".join(f"{side:.3g}" for side in size)
        + " m"
    ]

    def table(title: str, rows: list[str]) -> None:
        lines.append(f"{title}: {len(rows)}")
        lines.extend(f"  {row}" for row in rows[:MOST_LISTED])
        if len(rows) > MOST_LISTED:
            lines.append(f"  … and {len(rows) - MOST_LISTED} more (--json has all)")

    table("meshes", [f"{one['name']}: {one['triangles']} triangles" for one in found["meshes"]])
    table("parts", [f"{one['name']}{'' if one['skinned'] else ' (rigid)'}" for one in found["parts"]])
    table("joints", found["joints"])
    moves = {(True, True): " (joints and morphs)", (False, True): " (morphs)"}
    table(
        "clips",
        [
            f"{one['name']}: {one['duration_s']:.2f} s{moves.get((one['moves_joints'], one['moves_morphs']), '')}"
            for one in found["clips"]
        ],
    )
    table(
        "morph targets",
        [
            f"{one['name']}: {one['vertices']} points, up to {one['largest_shift_m']:.3g} m, {one['default']:g} at rest"
            for one in found["morphs"]
        ],
    )
    table(
        "materials",
        [
            ", ".join(
                [f"{one['name']}: {one['alpha'].lower()}", *(["unlit"] if one["unlit"] else []), *one["textures"]]
            )
            for one in found["materials"]
        ],
    )
    table("textures", [f"{one['name']}: {one['size'][0]} × {one['size'][1]}" for one in found["textures"]])
    table("extensions", [f"{name}: {fate}" for name, fate in found["extensions"].items()])
    table("what a build changes", found["notes"])
    return lines


def run(arguments: argparse.Namespace) -> int:
    """Print what the file holds."""
    found = describe(arguments.model)
    print(json.dumps(found, indent=1, ensure_ascii=False) if arguments.json else "\n".join(_lines(found)))
    return 0
