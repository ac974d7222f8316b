"""The folder of a built character: images, model.glb and the manifest (docs/format.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from preprocess.arrays import Floats
from preprocess.atlas import Atlas
from preprocess.decimate import Chain, Lod
from preprocess.export.glb import build_levels, write_model_glb
from preprocess.export.ktx2 import write_ktx2
from preprocess.export.lod_vertices import LodMesh
from preprocess.export.tangent_normals import atlas_tangents, bake_tangent_normals, has_relief
from preprocess.files.images import Image, write_image
from preprocess.files.output_folder import MANIFEST, describe_contents
from preprocess.fit.stored_texture import StoredTexture
from preprocess.load import Character
from preprocess.mesh.surface import SkinnedMesh
from preprocess.settings import Settings
from runtime.animation.bounds import clip_bounds, grown_boxes, joint_boxes, weight_ranges
from runtime.asset.manifest import SCHEMA
from runtime.asset.morphs import pack_morphs
from runtime.asset.weight_quadtree import WeightDetails, pack_details

MODEL = "model.glb"
SRGB = ("base_color", "emissive")  # textures whose stored values are sRGB-encoded
DETAILS = "weight_details.png"
MORPHS = "morphs.png"
REACH_MARGIN = 0.05  # of a target's largest shift: points between vertices follow its map, not the faces
RELIEF = "tangent_normal.png"  # what model.glb has for the normal texture; the runtime reads the latter
BOUNDS_MARGIN_REL = 0.005  # of the diagonal: points between vertices follow the position texture, not the faces


@dataclass(frozen=True)
class LodRow:
    """A level of detail in the manifest.

    Attributes
    ----------
    node : str
        Mesh node in model.glb.
    faces, vertices : int
        Vertices are welded surface vertices.
    error_m, mean_error_m : float
        Largest and mean two-sided distance to the full mesh over dense samples and the sampled poses, metres.
    normal_error_rad : float
    exact : bool
        Whether its seams are those of the full mesh.
    uv_bound_px : float
        How far a relaxed level's seams stray, in texels of the finest mip.
    """

    node: str
    faces: int
    vertices: int
    error_m: float
    mean_error_m: float
    normal_error_rad: float
    exact: bool
    uv_bound_px: float


def write_folder(
    folder: Path,
    character: Character,
    atlas: Atlas,
    textures: Sequence[StoredTexture],
    chain: Chain,
    settings: Settings,
    warnings: Sequence[str],
    timings: Mapping[str, float],
    normal_uvs: Sequence[Floats | None],
) -> dict[str, Any]:
    """Write everything into an empty folder. `normal_uvs` are those of the levels, as for `write_model_glb`.

    Returns
    -------
    dict
        The manifest, as it was written.
    """
    lods = chain.lods
    rows = tuple(_row(f"{character.name}_LOD{i}", lod) for i, lod in enumerate(lods))
    entries = {texture.name: _write_texture(folder, texture) for texture in textures}
    if settings.ktx2:
        _write_ktx2(folder, textures)
    relief = has_relief(character.materials)
    tangents = atlas_tangents(atlas.mesh) if relief else None
    levels = build_levels(character, atlas.mesh, lods, settings.influences, normal_uvs, tangents)
    in_model = dict(entries)
    if relief:
        in_model["tangent_normal"] = _write_relief(folder, levels[0], textures)
    write_model_glb(folder / MODEL, character, atlas.mesh, lods, in_model, settings.influences, levels=levels)
    files = [f"model_LOD{i}.glb" for i in range(len(lods))] if settings.separate_lods else []
    for file, row, lod, level in zip(files, rows, lods, levels):
        one: dict[str, Any] = {"names": [row.node], "levels": [level]}
        write_model_glb(folder / file, character, atlas.mesh, [lod], in_model, settings.influences, **one)
    manifest: dict[str, Any] = {
        "schema": SCHEMA,
        "name": character.name,
        "source": {"file": character.source.name, "sha256": character.source_hash},
        "model": MODEL,
        **({"model_files": files} if files else {}),
        "joints": [character.skeleton.names[node] for node in character.skeleton.joint_nodes],
        "clips": [{"name": clip.name, "duration_s": clip.duration_s} for clip in character.clips],
        "bounds": _bounds(character, atlas),
        "lods": [asdict(row) for row in rows],
        "textures": entries,
        **_write_morphs(folder, atlas, textures, character.skeleton.num_joints),
        "atlas": {
            "mode": atlas.mode,
            "charts": atlas.num_charts,
            "overlap": atlas.overlap,
            "exact_floor_faces": chain.floor_faces if chain.floor_faces >= 0 else None,
            "straightened": atlas.straightened,
            "stretch_l2": atlas.stretch_l2,
            "stretch_linf": atlas.stretch_linf,
            "coverage": atlas.coverage,
            "kept_share": atlas.kept_share,
            "texels": dict(atlas.texels),
        },
        "settings": asdict(settings),
        "timings": {name: round(seconds, 3) for name, seconds in timings.items()},
        "warnings": list(warnings),
    }
    manifest |= describe_contents(folder)
    write_manifest(folder, manifest)
    return manifest


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write manifest.json."""
    text = json.dumps(_finite(manifest), indent=1, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8", errors="replace")


def _write_relief(folder: Path, finest: LodMesh, textures: Sequence[StoredTexture]) -> dict[str, Any]:
    """Write the tangent-space normal map of model.glb; its entry, as `write_model_glb` wants it."""
    normals = next(texture.levels[0] for texture in textures if texture.name == "normal")
    write_image(folder / RELIEF, Image(bake_tangent_normals(finest, np.asarray(normals, np.float64)), "uint8"))
    return {"file": RELIEF, **({"uvs": "normal"} if finest.normal_uvs is not None else {})}


def _row(node: str, lod: Lod) -> LodRow:
    return LodRow(
        node,
        lod.num_faces,
        len(lod.positions),
        float(lod.error_m),
        float(lod.mean_error_m),
        float(lod.normal_error_rad),
        bool(lod.exact),
        float(lod.uv_bound_px),
    )


def _write_texture(folder: Path, texture: StoredTexture) -> dict[str, Any]:
    extension = "png" if texture.format in ("uint8", "uint16") else "exr"
    file = f"{texture.name}.{extension}"
    mip_files = [f"mips/{texture.name}.{level}.{extension}" for level in range(1, len(texture.levels))]
    if mip_files:
        (folder / "mips").mkdir(exist_ok=True)
    for name, texels in zip([file, *mip_files], texture.levels):
        write_image(folder / name, Image(texels, texture.format))
    extra = dict(texture.extra)
    if texture.details is not None:
        extra["details"] = _write_details(folder, texture.details, texture.format)
    return {
        "file": file,
        "size": list(texture.size),
        "format": texture.format,
        "mips": len(texture.levels),
        "mip_files": mip_files,
        "seam": texture.seam,
        **extra,
    }


def _write_ktx2(folder: Path, textures: Sequence[StoredTexture]) -> None:
    """Every texture but the joint weights, whose layout is the runtime's own, with its mip levels in one file."""
    (folder / "ktx2").mkdir()
    for texture in textures:
        if texture.name != "weights":
            write_ktx2(folder / "ktx2" / f"{texture.name}.ktx2", texture.levels, texture.format, texture.name in SRGB)


def _write_details(folder: Path, details: WeightDetails, form: str) -> dict[str, Any]:
    image = pack_details(details, form == "uint16")
    write_image(folder / DETAILS, Image(image / float(np.iinfo(image.dtype).max), form))
    return {"file": DETAILS, "leaves": len(details.depths), "slots": int(details.joints.shape[-1])}


def _write_morphs(
    folder: Path, atlas: Atlas, textures: Sequence[StoredTexture], num_joints: int
) -> dict[str, dict[str, Any]]:
    """Write the displacement maps of the morph targets; their part of the manifest, empty where there are none.

    `reach` says how far a target of weight one moves what a joint carries: joint, least and greatest shift.
    """
    morphs = next((texture.morphs for texture in textures if texture.morphs is not None), None)
    if morphs is None:
        return {}
    image, entries = pack_morphs(morphs.targets)
    write_image(folder / MORPHS, Image(image / float(np.iinfo(image.dtype).max), "uint16"))
    for entry, reach in zip(entries, morph_reaches(atlas.mesh, num_joints)):
        moved = reach.any(axis=(1, 2))
        entry["reach"] = [[int(joint), *reach[joint].tolist()] for joint in np.flatnonzero(moved)]
    return {"morphs": {"file": MORPHS, "targets": entries}}


def morph_reaches(mesh: SkinnedMesh, num_joints: int) -> Floats:
    """How far each morph of weight one moves what each joint carries, (M, J, 2, 3): least and greatest shift."""
    reaches = np.zeros((len(mesh.morphs), num_joints, 2, 3))
    for number, morph in enumerate(mesh.morphs):
        shifts = morph.dense_shifts(mesh.num_vertices)
        boxes = joint_boxes(shifts, mesh.joint_indices, mesh.joint_weights, num_joints, faces=mesh.surface.faces)
        margin = REACH_MARGIN * float(np.abs(shifts).max(initial=0.0))
        moved = np.isfinite(boxes).all(axis=(1, 2)) & boxes.any(axis=(1, 2))
        reaches[number, moved] = boxes[moved] + np.array([[-margin], [margin]])
    return reaches


def _bounds(character: Character, atlas: Atlas) -> dict[str, Any]:
    """Boxes that hold the character in bind pose, a joint's part of it, and all of it over each clip."""
    mesh = atlas.mesh
    positions = mesh.surface.positions
    boxes = joint_boxes(
        positions,
        mesh.joint_indices,
        mesh.joint_weights,
        character.skeleton.num_joints,
        faces=mesh.surface.faces,
        margin_m=BOUNDS_MARGIN_REL * mesh.surface.diagonal_m,
    )
    reaches = morph_reaches(mesh, character.skeleton.num_joints)
    return {
        "bind": [positions.min(axis=0).tolist(), positions.max(axis=0).tolist()],
        "joints": [box.tolist() if np.isfinite(box).all() else None for box in boxes],
        "clips": {
            clip.name: clip_bounds(
                character.skeleton, clip, grown_boxes(boxes, reaches, weight_ranges(clip, character.skeleton))
            ).tolist()
            for clip in character.clips
        },
    }


def _finite(value: Any) -> Any:
    """JSON has no NaN or infinity: they become null."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
