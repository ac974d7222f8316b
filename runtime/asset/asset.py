"""A built character's folder, read into arrays: manifest, textures, LOD meshes, skeleton and clips (no GL here).

The folder is described in docs/format.md. `SCHEMA` is the version this program writes and the newest that it reads.
Everything is checked as it is read, so that a damaged folder is refused here, by name, and not found out in a picture.
Letters in shapes: L mip levels, C channels, N vertices, F faces.
"""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.asset.lod_mesh import LodMesh, read_lods
from runtime.asset.weight_quadtree import WeightDetails, build_quadtree, details_size, no_details, unpack_details
from runtime.errors import REBUILD, AssetError
from runtime.gltf.document import Document, read_document
from runtime.gltf.png_check import find_png_fault
from runtime.validation import shown

if TYPE_CHECKING:
    from runtime.animation.clip import Clip
    from runtime.animation.skeleton import Skeleton

SCHEMA = 2  # 2: weights may have details
GEOMETRY_TEXTURES = ("position", "normal", "weights")
COLOR_TEXTURES = ("base_color", "orm", "emissive")

_DTYPES = {"uint8": np.uint8, "uint16": np.uint16, "half": np.float16, "float": np.float32}
_READER_TYPES = {"uint8": "uint8", "uint16": "uint16", "half": "half", "float": "float"}


@dataclass(frozen=True)
class TextureData:
    """One texture with its mip levels, as stored.

    Attributes
    ----------
    name : str
    levels : tuple of L arrays (H >> k, W >> k, C) uint8, uint16, float16 or float32
        Row 0 is the top, v = 0.
    """

    name: str
    levels: tuple[NDArray[Any], ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of level 0."""
        return self.levels[0].shape[1], self.levels[0].shape[0]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.levels[0].shape[2])


@dataclass(frozen=True)
class MaterialData:
    """How one draw range is shaded; factors multiply the textures as in glTF."""

    name: str = "default"
    base_color_factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    metallic_factor: float = 1.0
    roughness_factor: float = 1.0
    emissive_factor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    occlusion_strength: float = 1.0
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False


@dataclass(frozen=True)
class Manifest:
    """The parts of manifest.json that the runtime uses, checked; everything else stays in `json`."""

    name: str
    schema: int
    joints: tuple[str, ...]
    bind_bounds: NDArray[np.float64]
    joint_bounds: tuple[NDArray[np.float64] | None, ...]
    clip_bounds: dict[str, NDArray[np.float64]]
    json: dict[str, Any] = field(repr=False)


@dataclass(frozen=True, repr=False)
class Asset:
    """A built character in memory."""

    path: Path
    manifest: Manifest
    textures: dict[str, TextureData]
    materials: tuple[MaterialData, ...]
    lods: tuple[LodMesh, ...]
    skeleton: Skeleton
    clips: tuple[Clip, ...]
    weight_size: tuple[int, int]
    weight_details: WeightDetails = field(default_factory=no_details)

    @property
    def name(self) -> str:
        """The character's name."""
        return self.manifest.name

    @property
    def clip_names(self) -> tuple[str, ...]:
        """What its clips are called, in their order."""
        return tuple(clip.name for clip in self.clips)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """What its joints are called, in their order."""
        return self.manifest.joints

    def __repr__(self) -> str:
        faces = len(self.lods[0].triangles)
        counts = f"{faces:,} faces, {len(self.lods)} levels, {self.num_joints} joints, {len(self.clips)} clips"
        return f"<Asset {self.name!r}: {counts}>"

    @property
    def colors_moved(self) -> bool:
        """Whether colour textures are sampled at normal uvs, where there are any."""
        return bool(self.manifest.json["textures"].get("base_color", {}).get("uvs") == "normal")

    @property
    def num_joints(self) -> int:
        """Number of joints, J."""
        return len(self.manifest.joints)

    @property
    def joint_bounds(self) -> tuple[NDArray[np.float64] | None, ...]:
        """Box (2, 3) at rest of what each joint moves, None for a joint that moves nothing."""
        return self.manifest.joint_bounds


def _box(value: Any, where: str) -> NDArray[np.float64]:
    try:
        box = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
        raise AssetError(f"{where} is not a box of two points: {REBUILD}")
    return box


def read_manifest(folder: Path) -> Manifest:
    """Read and check manifest.json.

    Raises
    ------
    AssetError
        If the folder or the file is missing or malformed, or of a newer schema.
    """
    path = folder / "manifest.json"
    if folder.is_file():
        raise AssetError(f"{folder} is a file, not a built character: load the folder that python -m preprocess made")
    if not folder.is_dir():
        raise AssetError(f"no such folder: {folder}: {REBUILD}, or check the path")
    if not path.is_file():
        raise AssetError(f"{folder} has no manifest.json: it is not a built character; {REBUILD}")
    try:
        data = json.loads(path.read_bytes())
    except (ValueError, UnicodeDecodeError) as error:
        raise AssetError(f"{path} is not JSON ({error}): {REBUILD}") from None
    schema = data.get("schema") if isinstance(data, dict) else None
    if not isinstance(schema, int) or schema < 1:
        raise AssetError(f"{path} names no schema: {REBUILD}")
    if schema > SCHEMA:
        raise AssetError(f"{path} has schema {schema}, this seamskin reads up to {SCHEMA}: upgrade seamskin")
    for key, kind in (("textures", dict), ("lods", list), ("joints", list)):
        if not isinstance(data.get(key), kind) or not data[key]:
            raise AssetError(f"{path} has no {key}: {REBUILD}")
    bounds = data.get("bounds")
    if not isinstance(bounds, dict):
        raise AssetError(f"{path} has no bounds: {REBUILD}")
    joints = tuple(str(name) for name in data["joints"])
    boxes = bounds.get("joints") or [None] * len(joints)
    if len(boxes) != len(joints):
        raise AssetError(f"{path}: bounds.joints has {len(boxes)} entries for {len(joints)} joints: {REBUILD}")
    return Manifest(
        name=str(data.get("name") or folder.stem),
        schema=schema,
        joints=joints,
        bind_bounds=_box(bounds.get("bind"), f"{path}: bounds.bind"),
        joint_bounds=tuple(
            None if box is None else _box(box, f"{path}: bounds.joints[{i}]") for i, box in enumerate(boxes)
        ),
        clip_bounds={
            str(name): _box(box, f"{path}: bounds.clips[{name}]") for name, box in (bounds.get("clips") or {}).items()
        },
        json=data,
    )


def _read_texels(path: Path, what: str, dtype: str, size: tuple[int, int]) -> NDArray[Any]:
    """Decode one image file in its stored type, (H, W, C)."""
    import OpenImageIO as oiio

    if not path.is_file():
        raise AssetError(f"{what}: {path} is missing: {REBUILD}")
    fault = find_png_fault(path.read_bytes())
    if fault:
        raise AssetError(f"{what}: {path} does not decode: {fault}: {REBUILD}")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), config)
    if reader is None:
        reason = (oiio.geterror() or "unknown format").splitlines()[0]
        raise AssetError(f"{what}: {path} does not decode ({reason}): {REBUILD}")
    try:
        spec = reader.spec()
        if (spec.width, spec.height) != size:
            raise AssetError(f"{what}: {path} is {spec.width} x {spec.height}, not {size[0]} x {size[1]}: {REBUILD}")
        texels = reader.read_image(0, 0, 0, spec.nchannels, _READER_TYPES[dtype])
        error = reader.geterror()
    finally:
        reader.close()
    if texels is None or error:
        reason = error.splitlines()[0] if error else "no texels"
        raise AssetError(f"{what}: {path} is cut short or damaged ({reason}): {REBUILD}")
    return np.ascontiguousarray(texels, _DTYPES[dtype]).reshape(size[1], size[0], -1)


def _whole_number(value: Any, where: str, least: int = 1) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise AssetError(f"{where} must be a whole number of at least {least}: {REBUILD}")
    return value


def _texture_jobs(folder: Path, manifest: Manifest) -> list[tuple[str, Path, str, tuple[int, int]]]:
    """File, stored type and size of every level of every texture that the runtime knows, level 0 first."""
    jobs = []
    entries = manifest.json["textures"]
    for name in GEOMETRY_TEXTURES:
        if name not in entries:
            raise AssetError(f"{folder / 'manifest.json'} lists no {name} texture: {REBUILD}")
    for name in (*GEOMETRY_TEXTURES, *COLOR_TEXTURES):
        entry = entries.get(name)
        if entry is None:
            continue
        where = f"{folder / 'manifest.json'}: textures.{name}"
        if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
            raise AssetError(f"{where} names no file: {REBUILD}")
        size = entry.get("size")
        if not isinstance(size, list) or len(size) != 2:
            raise AssetError(f"{where}.size is not [width, height]: {REBUILD}")
        width, height = (_whole_number(value, f"{where}.size") for value in size)
        if entry.get("format") not in _DTYPES:
            raise AssetError(f"{where}.format is not one of {', '.join(_DTYPES)}: {REBUILD}")
        if name == "weights":
            slots = _whole_number(entry.get("slots"), f"{where}.slots")
            jobs.append((name, folder / entry["file"], entry["format"], (width, 2 * -(-slots // 4) * height)))
            continue
        files = [entry["file"], *entry.get("mip_files", [])]
        for level, file in enumerate(files):
            jobs.append((name, folder / str(file), entry["format"], (max(1, width >> level), max(1, height >> level))))
    return jobs


def _read_textures(folder: Path, manifest: Manifest) -> dict[str, TextureData]:
    jobs = _texture_jobs(folder, manifest)
    with ThreadPoolExecutor(4) as pool:  # decoding releases the interpreter's lock
        decoded = list(pool.map(lambda job: _read_texels(job[1], f"texture {job[0]}", job[2], job[3]), jobs))
    levels: dict[str, list[NDArray[Any]]] = {}
    for job, texels in zip(jobs, decoded):
        levels.setdefault(job[0], []).append(texels)
    least = {"position": 3, "normal": 3, "weights": 4, "base_color": 3, "orm": 3, "emissive": 3}
    for name, arrays in levels.items():
        for texels in arrays:
            if texels.shape[2] < least[name] or texels.shape[2] > 4:
                raise AssetError(f"texture {name} has {texels.shape[2]} channels, not {least[name]} to 4: {REBUILD}")
            if texels.dtype.kind == "f" and not np.isfinite(texels).all():
                raise AssetError(f"texture {name} holds values that are not finite: {REBUILD}")
    return {name: TextureData(name, tuple(arrays)) for name, arrays in levels.items()}


def _read_weight_details(folder: Path, manifest: Manifest) -> WeightDetails:
    """Where joint weights are finer than their map."""
    weights = manifest.json["textures"]["weights"]
    entry = weights.get("details")
    if entry is None:
        return no_details()
    where = f"{folder / 'manifest.json'}: textures.weights.details"
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise AssetError(f"{where} names no file: {REBUILD}")
    num_leaves, slots = (_whole_number(entry.get(key), f"{where}.{key}") for key in ("leaves", "slots"))
    path = folder / entry["file"]
    image = _read_texels(path, "weight details", weights["format"], details_size(num_leaves, slots))
    if image.shape[2] != 4:
        raise AssetError(f"{path} has {image.shape[2]} channels, not 4: {REBUILD}")
    details = unpack_details(image, num_leaves, str(path))
    tree = build_quadtree(details, str(path))
    outside = (tree.cells >= np.maximum(np.array(weights["size"]) - 1, 1)).any()
    if outside or details.joints.max(initial=0) >= len(manifest.joints):
        raise AssetError(f"{path} is not of this character: {REBUILD}")
    return details


def _read_material(spec: dict[str, Any]) -> MaterialData:
    pbr = spec.get("pbrMetallicRoughness", {})
    base = tuple(map(float, pbr.get("baseColorFactor", (1, 1, 1, 1))))
    emissive = np.array(spec.get("emissiveFactor", (0, 0, 0)), float)
    extensions = spec.get("extensions", {})
    emissive = emissive * extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    return MaterialData(
        name=str(spec.get("name", "")),
        base_color_factor=(base[0], base[1], base[2], base[3]),
        metallic_factor=float(pbr.get("metallicFactor", 1.0)),
        roughness_factor=float(pbr.get("roughnessFactor", 1.0)),
        emissive_factor=(float(emissive[0]), float(emissive[1]), float(emissive[2])),
        occlusion_strength=float(spec.get("occlusionTexture", {}).get("strength", 1.0)),
        alpha_mode=str(spec.get("alphaMode", "OPAQUE")),
        alpha_cutoff=float(spec.get("alphaCutoff", 0.5)),
        double_sided=bool(spec.get("doubleSided", False)),
        unlit="KHR_materials_unlit" in extensions,
    )


def _read_skeleton(document: Document, manifest: Manifest) -> Skeleton:
    from runtime.animation.skeleton import read_skeleton

    skin = document.item("skins", 0)
    joints = skin.get("joints", [])
    if len(joints) != len(manifest.joints):
        raise AssetError(
            f"{document.path} has {len(joints)} joints and manifest.json {len(manifest.joints)}: they are of different "
            f"builds; {REBUILD}"
        )
    if "inverseBindMatrices" in skin:
        inverse_bind = document.accessor(skin["inverseBindMatrices"]).astype(np.float64)
    else:
        inverse_bind = np.tile(np.eye(4), (len(joints), 1, 1))
    return read_skeleton(document, joints, inverse_bind)


def load(path: str | Path) -> Asset:
    """Read a built character.

    Parameters
    ----------
    path : str or Path
        The folder that `python -m preprocess` wrote.

    Returns
    -------
    Asset

    Raises
    ------
    AssetError
        If anything in the folder is missing, damaged, or newer than this program; the message names it.
    """
    from runtime.animation.clip import read_clips

    if not isinstance(path, str | PathLike):
        raise AssetError(f"a character is loaded from the path of its folder, not from {shown(path)}")
    folder = Path(path)
    manifest = read_manifest(folder)
    model = manifest.json.get("model", "model.glb")
    document = read_document(folder / str(model))
    textures = _read_textures(folder, manifest)
    skeleton = _read_skeleton(document, manifest)
    weight_entry = manifest.json["textures"]["weights"]
    materials = tuple(_read_material(spec) for spec in document.items("materials")) or (MaterialData(),)
    return Asset(
        path=folder,
        manifest=manifest,
        textures=textures,
        materials=materials,
        lods=read_lods(document, manifest.name, manifest.json["lods"]),
        skeleton=skeleton,
        clips=read_clips(document, skeleton),
        weight_size=(int(weight_entry["size"][0]), int(weight_entry["size"][1])),
        weight_details=_read_weight_details(folder, manifest),
    )
