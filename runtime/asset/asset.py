"""A built character's folder, read into arrays: manifest, textures, LOD meshes, skeleton and clips (no GL here).

The folder is described in docs/format.md.
Everything is checked as it is read, so that a damaged folder is refused here, by name, and not found out in a picture.
Letters in shapes: L mip levels, C channels, N vertices, F faces.
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from msgspec import UnsetType
from numpy.typing import NDArray

from runtime.asset.lod_mesh import LodMesh, read_lods
from runtime.asset.manifest import FURTHEST_M, MANIFEST, Manifest, read_manifest
from runtime.asset.morphs import Morphs, morphs_size, unpack_morphs
from runtime.asset.packed_positions import read_words
from runtime.asset.weight_quadtree import WeightDetails, build_quadtree, details_size, no_details, unpack_details
from runtime.errors import REBUILD, AssetError
from runtime.gltf.document import Document, read_document
from runtime.gltf.local_files import find_local_file
from runtime.gltf.png_check import find_png_fault, first_line
from runtime.validation import describe

if TYPE_CHECKING:
    from runtime.animation.clip import Clip
    from runtime.animation.skeleton import Skeleton

ALPHA_MODES = ("OPAQUE", "MASK", "BLEND")
# Channels that each texture must have at least; none has more than four.
LEAST_CHANNELS = {"position": 3, "normal": 3, "weights": 4, "base_color": 3, "orm": 3, "emissive": 3}
MOST_CHANNELS = 4
WEIGHT_STEPS = 255
LARGEST_FACTOR = 1e9  # of materials, either sign
WORD_SLACK = 0.01  # of a step, besides the rounding of 32-bit floats
DURATION_SLACK_S = 1e-3  # keys are stored in 32 bits

_DTYPES = {"uint8": np.uint8, "uint16": np.uint16, "half": np.float16, "float": np.float32}


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
    morphs: Morphs | None = None

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

    @property
    def morph_names(self) -> tuple[str, ...]:
        """What its morph targets (blend shapes) are called, in their order."""
        return self.skeleton.morphs

    @property
    def morph_reaches(self) -> NDArray[np.float64]:
        """How far each morph of weight one moves what each joint carries, (M, J, 2, 3): least and greatest shift."""
        reaches = np.zeros((len(self.morph_names), self.num_joints, 2, 3))
        entry = self.manifest.entry.morphs
        for number, target in enumerate([] if isinstance(entry, UnsetType) else entry.targets):
            for joint, low, high in target.reach:
                reaches[number, joint] = low, high
        return reaches

    def __repr__(self) -> str:
        faces = len(self.lods[0].triangles)
        counts = f"{faces:,} faces, {len(self.lods)} levels, {self.num_joints} joints, {len(self.clips)} clips"
        return f"<Asset {self.name!r}: {counts}>"

    @property
    def colors_moved(self) -> bool:
        """Whether colour textures are sampled at normal uvs, where there are any."""
        entry = self.manifest.entry.textures.base_color
        return not isinstance(entry, UnsetType) and entry.uvs == "normal"

    @property
    def num_joints(self) -> int:
        """Number of joints, J."""
        return len(self.manifest.joints)

    @property
    def joint_bounds(self) -> tuple[NDArray[np.float64] | None, ...]:
        """Box (2, 3) at rest of what each joint moves, None for a joint that moves nothing."""
        return self.manifest.joint_bounds


def _read_texels(path: Path, what: str, dtype: str, size: tuple[int, int]) -> NDArray[Any]:
    """Decode one image file in its stored type, (H, W, C)."""
    import OpenImageIO as oiio

    fault = find_png_fault(path.read_bytes())
    if fault:
        raise AssetError(f"{what}: {path} does not decode: {fault}: {REBUILD}")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), config)
    if reader is None:
        reason = first_line(oiio.geterror, "unknown format")
        raise AssetError(f"{what}: {path} does not decode ({reason}): {REBUILD}")
    try:
        spec = reader.spec()
        if (spec.width, spec.height) != size or spec.depth != 1:
            raise AssetError(f"{what}: {path} is {spec.width} x {spec.height}, not {size[0]} x {size[1]}: {REBUILD}")
        if str(spec.format) != dtype:
            raise AssetError(f"{what}: {path} holds {spec.format}, not {dtype} as the manifest says: {REBUILD}")
        if spec.nchannels > MOST_CHANNELS:
            raise AssetError(f"{what}: {path} has {spec.nchannels} channels: {REBUILD}")
        texels = reader.read_image(0, 0, 0, spec.nchannels, dtype)
        reason = first_line(reader.geterror, "" if texels is not None else "no texels")
    finally:
        reader.close()
    if reason:
        raise AssetError(f"{what}: {path} is cut short or damaged ({reason}): {REBUILD}")
    return np.ascontiguousarray(texels, _DTYPES[dtype]).reshape(size[1], size[0], -1)


@dataclass(frozen=True)
class _ImageJob:
    """One image file to decode: whose it is, and what it must be."""

    texture: str
    path: Path
    format: str
    size: tuple[int, int]


def _image_jobs(folder: Path, manifest: Manifest) -> list[_ImageJob]:
    """Every level of every texture that the runtime knows, level 0 first."""
    entries = manifest.entry.textures

    def find(name: str, file: str) -> Path:
        return find_local_file(folder, file, f"texture {name}", REBUILD)

    position, weights = entries.position, entries.weights
    width, height = weights.size
    jobs = [
        _ImageJob("position", find("position", position.file), position.format, position.size),
        _ImageJob(
            "weights", find("weights", weights.file), weights.format, (width, 2 * -(-weights.slots // 4) * height)
        ),
    ]
    for name, entry in entries.colors().items():
        for level, file in enumerate([entry.file, *entry.mip_files]):
            size = (max(1, entry.size[0] >> level), max(1, entry.size[1] >> level))
            jobs.append(_ImageJob(name, find(name, file), entry.format, size))
    return jobs


def _read_textures(folder: Path, manifest: Manifest) -> dict[str, TextureData]:
    jobs = _image_jobs(folder, manifest)
    with ThreadPoolExecutor(4) as pool:  # decoding releases the interpreter's lock
        decoded = list(
            pool.map(lambda job: _read_texels(job.path, f"texture {job.texture}", job.format, job.size), jobs)
        )
    levels: dict[str, list[NDArray[Any]]] = {}
    for job, texels in zip(jobs, decoded):
        alike = all(texels.shape[2] == finer.shape[2] for finer in levels.get(job.texture, []))
        if texels.shape[2] < LEAST_CHANNELS[job.texture] or not alike:
            raise AssetError(f"texture {job.texture}: {job.path} has {texels.shape[2]} channels: {REBUILD}")
        if texels.dtype.kind == "f" and not (np.abs(texels) <= FURTHEST_M).all():
            raise AssetError(f"texture {job.texture} holds values that are not finite or far too large: {REBUILD}")
        levels.setdefault(job.texture, []).append(texels)
    return {name: TextureData(name, tuple(arrays)) for name, arrays in levels.items()}


def _check_words(folder: Path, manifest: Manifest, texels: NDArray[Any]) -> None:
    """Positions that are drawn as words are whole steps of these."""
    entry = manifest.json["textures"]["position"].get("words")
    where = f"{folder / MANIFEST}: textures.position.words"
    words = read_words(entry, where)
    if words is None:
        return
    steps = (texels[..., :3] - words.low) / np.maximum(words.steps_m, 1e-30)
    rounding = 1e-6 * np.abs(texels[..., :3]).max() / np.maximum(words.steps_m, 1e-30) + WORD_SLACK
    if not (np.abs(steps - np.clip(np.rint(steps), 0, words.masks)) <= rounding).all():
        raise AssetError(f"{where} are not those of its texels: {REBUILD}")


def _check_weights(stack: NDArray[Any], height: int, num_joints: int, path: str) -> None:
    """Joints of the weight map exist, and the weights of each texel count to one."""
    images = stack.reshape(-1, 2, height, stack.shape[1], 4).astype(np.int64)
    unit = WEIGHT_STEPS * (257 if stack.dtype == np.uint16 else 1)
    if images[:, 0].max() >= num_joints:
        raise AssetError(f"{path} names joint {images[:, 0].max()} of {num_joints}: {REBUILD}")
    if (images[:, 1].sum(axis=(0, -1)) != unit).any() or (images[:, 1] % (unit // WEIGHT_STEPS)).any():
        raise AssetError(f"{path} has texels whose weights are not one together: {REBUILD}")


def _read_weight_details(folder: Path, manifest: Manifest) -> WeightDetails:
    """Where joint weights are finer than their map."""
    weights = manifest.entry.textures.weights
    entry = weights.details
    if isinstance(entry, UnsetType):
        return no_details()
    path = find_local_file(folder, entry.file, "weight details", REBUILD)
    image = _read_texels(path, "weight details", weights.format, details_size(entry.leaves, entry.slots))
    if image.shape[2] != 4:
        raise AssetError(f"{path} has {image.shape[2]} channels, not 4: {REBUILD}")
    details = unpack_details(image, entry.leaves, str(path))
    tree = build_quadtree(details, str(path))
    outside = (tree.cells >= np.maximum(np.array(weights.size) - 1, 1)).any()
    if outside or details.joints.max(initial=0) >= len(manifest.joints):
        raise AssetError(f"{path} is not of this character: {REBUILD}")
    return details


def _read_morphs(folder: Path, manifest: Manifest) -> Morphs | None:
    """Displacement maps of the morph targets."""
    entry = manifest.entry.morphs
    if isinstance(entry, UnsetType):
        return None
    path = find_local_file(folder, entry.file, "morphs", REBUILD)
    size = manifest.entry.textures.position.size
    image = _read_texels(path, "morphs", "uint16", morphs_size(sum(target.texels for target in entry.targets)))
    if image.shape[2] != 4:
        raise AssetError(f"{path} has {image.shape[2]} channels, not 4: {REBUILD}")
    targets = [msgspec.to_builtins(target) for target in entry.targets]
    return Morphs(unpack_morphs(image, targets, size[0] * size[1], str(path)), size)


def _factors(spec: dict[str, Any], key: str, default: tuple[float, ...], where: str) -> tuple[float, ...]:
    """As many finite numbers as the default has."""
    values = spec.get(key, list(default) if len(default) > 1 else default[0])
    values = tuple(map(float, values)) if isinstance(values, list) else (float(values),)
    if len(values) != len(default) or not all(abs(value) <= LARGEST_FACTOR for value in values):
        raise AssetError(f"{where}: {key} is not {len(default)} numbers up to {LARGEST_FACTOR:g}: {REBUILD}")
    return values


def _read_material(spec: dict[str, Any], where: str) -> MaterialData:
    pbr, extensions = spec.get("pbrMetallicRoughness", {}), spec.get("extensions", {})
    base = _factors(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0), where)
    emissive = _factors(spec, "emissiveFactor", (0.0, 0.0, 0.0), where)
    strength = _factors(extensions.get("KHR_materials_emissive_strength", {}), "emissiveStrength", (1.0,), where)[0]
    mode = spec.get("alphaMode", "OPAQUE")
    if mode not in ALPHA_MODES:
        raise AssetError(f"{where}: alphaMode is {describe(mode)}, not one of {', '.join(ALPHA_MODES)}: {REBUILD}")
    return MaterialData(
        name=str(spec.get("name", "")),
        base_color_factor=(base[0], base[1], base[2], base[3]),
        metallic_factor=_factors(pbr, "metallicFactor", (1.0,), where)[0],
        roughness_factor=_factors(pbr, "roughnessFactor", (1.0,), where)[0],
        emissive_factor=(emissive[0] * strength, emissive[1] * strength, emissive[2] * strength),
        occlusion_strength=_factors(spec.get("occlusionTexture", {}), "strength", (1.0,), where)[0],
        alpha_mode=mode,
        alpha_cutoff=_factors(spec, "alphaCutoff", (0.5,), where)[0],
        double_sided=bool(spec.get("doubleSided", False)),
        unlit="KHR_materials_unlit" in extensions,
    )


def _read_skeleton(document: Document, manifest: Manifest) -> Skeleton:
    from runtime.animation.skeleton import read_skeleton

    joints = document.item("skins", 0).get("joints", [])
    if len(joints) != len(manifest.joints):
        raise AssetError(
            f"{document.path} has {len(joints)} joints and manifest.json {len(manifest.joints)}: they are of different "
            f"builds; {REBUILD}"
        )
    inverse_bind: NDArray[Any] = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in document.item("skins", 0):
        inverse_bind = document.accessor(document.item("skins", 0)["inverseBindMatrices"])
    if inverse_bind.shape != (len(joints), 4, 4):
        raise AssetError(f"{document.path} has no inverse bind matrix for each of its joints: {REBUILD}")
    skeleton = read_skeleton(document, joints, inverse_bind)
    if skeleton.joint_names != manifest.joints:
        raise AssetError(f"{document.path} and manifest.json name other joints, of different builds: {REBUILD}")
    return skeleton


def _read_clips(document: Document, skeleton: Skeleton, manifest: Manifest) -> tuple[Clip, ...]:
    """The clips of the model, which are those of the manifest and of its boxes."""
    from runtime.animation.clip import read_clips

    clips = read_clips(document, skeleton)
    listed = manifest.entry.clips
    agree = [clip.name for clip in clips] == [entry.name for entry in listed] and all(
        abs(clip.duration_s - entry.duration_s) <= DURATION_SLACK_S for clip, entry in zip(clips, listed)
    )
    for what, holds in (("clips", agree), ("bounds.clips", manifest.clip_bounds.keys() == {c.name for c in clips})):
        if not holds:
            raise AssetError(f"{document.path} and the {what} of {MANIFEST} are not the same: {REBUILD}")
    return clips


def _read_materials(document: Document, lods: tuple[LodMesh, ...]) -> tuple[MaterialData, ...]:
    """The materials of the model, among them every one that a level is drawn with."""
    materials = tuple(
        _read_material(spec, f"{document.path}: material {number}")
        for number, spec in enumerate(document.items("materials"))
    ) or (MaterialData(),)
    numbers = {draw.material for lod in lods for draw in lod.draws}
    if max(numbers) >= len(materials):
        raise AssetError(f"{document.path} draws with material {max(numbers)} of {len(materials)}: {REBUILD}")
    return materials


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
    if not isinstance(path, str | PathLike):
        raise AssetError(f"a character is loaded from the path of its folder, not from {describe(path)}")
    folder = Path(path)
    manifest = read_manifest(folder)
    document = read_document(find_local_file(folder, manifest.entry.model, "model", REBUILD))
    textures = _read_textures(folder, manifest)
    weights = manifest.entry.textures.weights
    _check_words(folder, manifest, textures["position"].levels[0])
    _check_weights(textures["weights"].levels[0], weights.size[1], len(manifest.joints), str(folder / weights.file))
    skeleton = _read_skeleton(document, manifest)
    morphs = _read_morphs(folder, manifest)
    if morphs is not None:
        names, weights_at_rest = zip(*((target.name, target.default) for target in morphs.targets))
        skeleton = dataclasses.replace(skeleton, morphs=names, morph_weights=weights_at_rest)
    lods = read_lods(document, manifest.entry.lods)
    return Asset(
        path=folder,
        manifest=manifest,
        textures=textures,
        materials=_read_materials(document, lods),
        lods=lods,
        skeleton=skeleton,
        clips=_read_clips(document, skeleton, manifest),
        weight_size=weights.size,
        weight_details=_read_weight_details(folder, manifest),
        morphs=morphs,
    )
