"""A character file into one welded, oriented, manifold, skinned mesh with its skeleton, clips and materials.

Everything that changes what the file says is counted in the character's warnings.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from pathlib import Path

import numpy as np

from preprocess.errors import InputError
from preprocess.load.character import Character
from preprocess.load.materials import note_missing_texcoords, read_materials
from preprocess.load.mirrored import show_both_sides
from preprocess.load.scene import read_scene
from preprocess.load.unify import unify
from preprocess.mesh.surface import SkinnedMesh
from runtime.animation.clip import WEIGHTS, Clip, read_clips
from runtime.animation.pose import Pose, rest_pose, sample, skinning_matrices
from runtime.animation.skeleton import Skeleton, distinct_names, read_skeleton
from runtime.errors import AssetError
from runtime.gltf.document import Document, read_document
from runtime.gltf.limits import LIMITS, Limits

log = logging.getLogger(__name__)

KEYS_TO_LOOK_AT = 32  # of a clip: whether it moves parts within reach

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
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
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


def _within_reach(
    clips: tuple[Clip, ...], skeleton: Skeleton, mesh: SkinnedMesh, document: Document, warnings: list[str]
) -> tuple[Clip, ...]:
    """Clips that keep all parts within reach, at some of their keys; a warning for each of the others.

    Raises
    ------
    InputError
        If the rest pose does not.
    """
    positions, moving, size_m = mesh.surface.positions, mesh.num_moving_joints, mesh.surface.diagonal_m
    middle = np.append(positions.min(axis=0) + 0.5 * np.ptp(positions, axis=0), 1.0)
    reach_m = min(document.limits.reach * size_m, document.limits.number)

    def furthest_m(pose: Pose) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            matrices = skinning_matrices(skeleton, pose)[:, :moving, :3]
            return float(np.abs(matrices @ middle - middle[:3]).max())

    at_rest_m = furthest_m(rest_pose(skeleton))
    if not at_rest_m <= reach_m:
        raise InputError(
            f"{document.path.name}: its joints at rest move parts by {at_rest_m / size_m:.0e} times the mesh's size: "
            "give mesh and joints one scale and export again"
        )
    kept = []
    for clip in clips:
        times = clip.key_times[:: -(-len(clip.key_times) // KEYS_TO_LOOK_AT)]
        moved_m = furthest_m(sample(clip, skeleton, times))
        if moved_m <= reach_m:
            kept.append(clip)
        else:
            warnings.append(f"clip {clip.name!r} left out: it moves parts by {moved_m / size_m:.0e} times their size")
    return tuple(kept)


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
    clips = _within_reach(clips, skeleton, mesh, document, warnings)
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
