"""A character file into one welded, oriented, manifold, skinned mesh with its skeleton, clips and materials.

Everything that changes what the file says is counted in the character's warnings.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from pathlib import Path

from preprocess.errors import InputError
from preprocess.load.character import Character
from preprocess.load.materials import note_missing_texcoords, read_materials
from preprocess.load.mirrored import show_both_sides
from preprocess.load.scene import read_scene
from preprocess.load.unify import unify
from runtime.animation.clip import WEIGHTS, Clip, read_clips
from runtime.animation.skeleton import distinct_names, read_skeleton
from runtime.errors import AssetError
from runtime.gltf.document import Document, read_document
from runtime.gltf.limits import LIMITS, Limits

log = logging.getLogger(__name__)

# Extensions that a file may require: read, or safe to leave out of a character.
SUPPORTED_EXTENSIONS = (
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_clearcoat",
    "KHR_materials_sheen",
    "KHR_materials_transmission",
    "KHR_materials_volume",
    "KHR_materials_anisotropy",
    "KHR_materials_iridescence",
    "KHR_materials_variants",
    "KHR_lights_punctual",
    "KHR_xmp_json_ld",
    "EXT_texture_webp",
    "KHR_draco_mesh_compression",  # refused at the primitive, unless it has an uncompressed copy
    "EXT_meshopt_compression",  # refused at the buffer view
    "VRM",
    "VRMC_vrm",
    "VRMC_materials_mtoon",
    "VRMC_springBone",
    "VRMC_node_constraint",
    "MSFT_lod",
)


def _dropped_channels(document: Document, clips: tuple[Clip, ...]) -> list[str]:
    """What the file's animations move and the clips do not: cameras, lights, other extensions."""
    paths = [one.get("target", {}).get("path") for a in document.items("animations") for one in a.get("channels", [])]
    channels = sum(path != WEIGHTS for path in paths)
    kept = sum(track.path != WEIGHTS for clip in clips for track in clip.tracks)
    return [f"{channels - kept} animation channels dropped: they move no joint"] if kept < channels else []


def _distinct_clips(clips: tuple[Clip, ...], warnings: list[str]) -> tuple[Clip, ...]:
    """Clips that move a joint, each with a name of its own: what glTF can hold, and what names can tell apart."""
    moving = [clip for clip in clips if clip.tracks]
    still = [clip.name for clip in clips if not clip.tracks]
    if still:
        warnings.append(f"{len(still)} clips left out (the first: {still[0]!r}): they move no joint and no morph")
    names = distinct_names([clip.name for clip in moving])
    changed = [(clip.name, name) for clip, name in zip(moving, names) if clip.name != name]
    if changed:
        old, new = changed[0]
        warnings.append(f"{len(changed)} clips called like others renamed (the first: {old!r} is now {new!r})")
    return tuple(dataclasses.replace(clip, name=name) for clip, name in zip(moving, names))


def _load(document: Document) -> Character:
    document.require_extensions(SUPPORTED_EXTENSIONS)
    scene = read_scene(document)
    warnings = [*document.notes, *scene.warnings]
    if all(part.skin is None for part in scene.parts):
        warnings.append("the file has no skin: its parts move with their nodes")
    used = list(dict.fromkeys(part.source.material for part in scene.parts))
    num_texcoords = max(part.source.texcoords.shape[1] for part in scene.parts)
    materials, notes = read_materials(document, used, num_texcoords)
    warnings += notes
    mesh, materials = unify(
        scene, materials, {index: at for at, index in enumerate(used)}, document.path.name, warnings
    )
    mesh.validate()
    warnings += note_missing_texcoords(materials, mesh)
    skeleton = dataclasses.replace(
        read_skeleton(document, scene.joint_nodes.tolist(), scene.inverse_bind),
        morphs=tuple(scene.morphs),
        morph_weights=tuple(scene.morphs.values()),
    )
    faults: list[str] = []
    clips = read_clips(document, skeleton, faults=faults)
    warnings += [fault.replace(f"{document.path}: ", "") for fault in faults]
    warnings += _dropped_channels(document, clips)
    clips = _distinct_clips(clips, warnings)
    mesh, materials = show_both_sides(mesh, materials, scene.parts, skeleton, clips, warnings)
    return Character(
        name=document.path.stem.encode("utf-8", "replace").decode(),
        source=document.path,
        source_hash=hashlib.sha256(document.path.read_bytes()).hexdigest(),
        mesh=mesh,
        skeleton=skeleton,
        clips=clips,
        materials=materials,
        warnings=tuple(warnings),
    )


def load_character(path: Path | str, limits: Limits = LIMITS) -> Character:
    """Load a .gltf, .glb or .vrm file as one character.

    Everything in the default scene that has a mesh becomes one welded mesh in bind pose (binding.py says what that
    is) with one joint list: skinned primitives keep their weights, rigid parts get weight one on their node.
    Vertices weld by position and weights (weld.py), non-manifold places are split (manifold.py), missing normals are
    made (normals.py). Skinning the result in any pose gives the file's own picture.

    Parameters
    ----------
    path : Path or str
    limits : Limits
        What a file may ask for.

    Returns
    -------
    Character

    Raises
    ------
    InputError
        If the file is missing, not glTF 2.0, damaged, compressed, or has no mesh: one line that says what to do.
    """
    try:
        character = _load(read_document(path, limits))
    except AssetError as error:
        raise InputError(str(error)) from None
    log.info(
        "loaded %s: %d faces, %d vertices, %d joints, %d clips, %d materials",
        character.name,
        character.mesh.num_faces,
        character.mesh.num_vertices,
        character.skeleton.num_joints,
        len(character.clips),
        len(character.materials),
    )
    return character
