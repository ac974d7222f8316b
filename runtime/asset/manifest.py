"""manifest.json of a built character: its shape as types, and the one place where it is read and checked.

What the types below say is checked by msgspec as it converts: every value that the runtime looks at has its type,
length and range before anything else sees it. Keys that they do not name are left alone (docs/format.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray

from runtime.errors import REBUILD, AssetError

SCHEMA = 2  # 2: weights may have details
MANIFEST = "manifest.json"
MAX_BYTES = 64 * 2**20  # of manifest.json; those of large characters have a fiftieth of it
# The numbers that the types allow. Metres: beyond, 32-bit floats are no finer than a character.
FURTHEST_M = 1e9
MAX_SIDE = 16384  # texels: no OpenGL 4.1 driver that is told of takes more
MAX_MIPS = 15
MAX_SLOTS = 64
MAX_LEAVES = 2**22
MAX_COUNT = 2**31 - 1
MAX_MORPHS, MAX_MORPH_TEXELS = 4096, 2**24

Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
Slots = Annotated[int, Meta(ge=1, le=MAX_SLOTS)]
Coordinate = Annotated[float, Meta(ge=-FURTHEST_M, le=FURTHEST_M)]
Point = tuple[Coordinate, Coordinate, Coordinate]
BoxPoints = tuple[Point, Point]
Weight = Annotated[float, Meta(ge=-FURTHEST_M, le=FURTHEST_M)]
Bits = Annotated[int, Meta(ge=1, le=30)]
Name = Annotated[str, Meta(min_length=1)]


class WordsEntry(Struct, kw_only=True):
    """What packed positions mean (runtime/asset/packed_positions.py)."""

    bits: tuple[Bits, Bits, Bits]
    low: Point
    high: Point


class PositionEntry(Struct, kw_only=True):
    """The position texture, without mip levels."""

    file: Name
    size: tuple[Side, Side]
    format: Literal["half", "float"]
    mips: Annotated[int, Meta(ge=1, le=1)] = 1
    mip_files: Annotated[list[Name], Meta(max_length=0)] = []
    words: WordsEntry | UnsetType = UNSET


class ColorEntry(Struct, kw_only=True):
    """The normal texture, or one of colours."""

    file: Name
    size: tuple[Side, Side]
    format: Literal["uint8", "uint16", "half", "float"]
    mips: Annotated[int, Meta(ge=1, le=MAX_MIPS)]
    mip_files: list[Name]
    uvs: Literal["normal"] | UnsetType = UNSET


class DetailsEntry(Struct, kw_only=True):
    """Where joint weights are finer than their map (runtime/asset/weight_quadtree.py)."""

    file: Name
    leaves: Annotated[int, Meta(ge=1, le=MAX_LEAVES)]
    slots: Slots


class WeightsEntry(Struct, kw_only=True):
    """The joint weights; `size` is that of the map."""

    file: Name
    size: tuple[Side, Side]
    format: Literal["uint8", "uint16"]
    slots: Slots
    mips: Annotated[int, Meta(ge=1, le=1)] = 1
    mip_files: Annotated[list[Name], Meta(max_length=0)] = []
    layout: Literal["texel-joints"] = "texel-joints"
    details: DetailsEntry | UnsetType = UNSET


class TextureEntries(Struct, kw_only=True):
    """All textures that the runtime knows."""

    position: PositionEntry
    normal: ColorEntry
    weights: WeightsEntry
    base_color: ColorEntry | UnsetType = UNSET
    orm: ColorEntry | UnsetType = UNSET
    emissive: ColorEntry | UnsetType = UNSET

    def colors(self) -> dict[str, ColorEntry]:
        """Normal and colour textures that are there, by name."""
        found = {"normal": self.normal, "base_color": self.base_color, "orm": self.orm, "emissive": self.emissive}
        return {name: entry for name, entry in found.items() if entry is not UNSET}


class LodEntry(Struct, kw_only=True):
    """One level of detail."""

    node: Name
    error_m: Annotated[float, Meta(ge=0, le=FURTHEST_M)]
    faces: Count
    vertices: Count


class ClipEntry(Struct, kw_only=True):
    """One clip."""

    name: str
    duration_s: Annotated[float, Meta(ge=0, le=1e9)]


class BoundsEntry(Struct, kw_only=True):
    """Boxes."""

    bind: BoxPoints
    joints: list[BoxPoints | None] | None = None
    clips: dict[str, BoxPoints] = {}


class MorphEntry(Struct, kw_only=True):
    """One morph target (runtime/asset/morphs.py); how far it moves what joints carry, least and greatest shift."""

    name: Name
    default: Weight
    texels: Count
    shift_m: Annotated[float, Meta(ge=0, le=FURTHEST_M)]
    turn: Annotated[float, Meta(ge=0, le=FURTHEST_M)]
    reach: list[tuple[Count, Point, Point]] = []


class MorphsEntry(Struct, kw_only=True):
    """The displacement maps of all morph targets."""

    file: Name
    targets: Annotated[list[MorphEntry], Meta(min_length=1, max_length=MAX_MORPHS)]


class ManifestEntry(Struct, kw_only=True):
    """All of manifest.json that the runtime looks at."""

    schema: Annotated[int, Meta(ge=1, le=SCHEMA)]
    joints: Annotated[list[str], Meta(min_length=1, max_length=65536)]
    bounds: BoundsEntry
    textures: TextureEntries
    lods: Annotated[list[LodEntry], Meta(min_length=1)]
    clips: list[ClipEntry]
    name: Name | UnsetType = UNSET
    model: Name = "model.glb"
    morphs: MorphsEntry | UnsetType = UNSET
    files: dict[str, str] = {}


@dataclass(frozen=True)
class Manifest:
    """manifest.json, checked.

    Attributes
    ----------
    name : str
    schema : int
    joints : tuple of J str
    bind_bounds : (2, 3) float64
    joint_bounds : tuple of J boxes (2, 3), None for a joint that moves nothing
    clip_bounds : dict of str to (2, 3) float64
    entry : ManifestEntry
        What the runtime looks at, typed.
    json : dict
        Everything, as in the file.
    """

    name: str
    schema: int
    joints: tuple[str, ...]
    bind_bounds: NDArray[np.float64]
    joint_bounds: tuple[NDArray[np.float64] | None, ...]
    clip_bounds: dict[str, NDArray[np.float64]]
    entry: ManifestEntry = field(repr=False)
    json: dict[str, Any] = field(repr=False)


def _read_json(path: Path) -> dict[str, Any]:
    """The JSON object in the file, with a schema that this program reads."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise AssetError(f"cannot read {path} ({error.strerror}): {REBUILD}") from None
    if len(data) > MAX_BYTES:
        raise AssetError(f"{path} has more than {MAX_BYTES >> 20} MB: it is no manifest; {REBUILD}")
    try:
        found = msgspec.json.decode(data)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise AssetError(f"{path} is not JSON ({str(error)[:80]}): {REBUILD}") from None
    schema = found.get("schema") if isinstance(found, dict) else None
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise AssetError(f"{path} names no schema: {REBUILD}")
    if schema > SCHEMA:
        raise AssetError(f"{path} has schema {str(schema)[:20]}, this seamskin reads up to {SCHEMA}: upgrade seamskin")
    return dict(found)


def _convert(found: dict[str, Any], path: Path) -> ManifestEntry:
    try:
        return msgspec.convert(found, ManifestEntry)
    except (msgspec.ValidationError, OverflowError) as error:
        fault, _, place = " ".join(str(error).split()).partition(" - at ")
        place = place.strip("`").removeprefix("$").lstrip(".")[:80]
        raise AssetError(f"{path}: {place + ': ' if place else ''}{fault[:120]}: {REBUILD}") from None


def _box(points: BoxPoints, where: str) -> NDArray[np.float64]:
    box = np.array(points, np.float64)
    if (box[0] > box[1]).any():
        raise AssetError(f"{where} is not a box of a low and a high point: {REBUILD}")
    return box


def read_manifest(folder: Path) -> Manifest:
    """Read and check manifest.json.

    Raises
    ------
    AssetError
        If the folder or the file is missing or malformed, or of a newer schema.
    """
    path = folder / MANIFEST
    if folder.is_file():
        raise AssetError(f"{folder} is a file, not a built character: load the folder that python -m preprocess made")
    if not folder.is_dir():
        raise AssetError(f"no such folder: {folder}: {REBUILD}, or check the path")
    if not path.is_file():
        raise AssetError(f"{folder} has no manifest.json: it is not a built character; {REBUILD}")
    found = _read_json(path)
    entry = _convert(found, path)
    boxes = entry.bounds.joints or [None] * len(entry.joints)
    if len(boxes) != len(entry.joints):
        raise AssetError(f"{path}: bounds.joints has {len(boxes)} entries for {len(entry.joints)} joints: {REBUILD}")
    if not isinstance(entry.morphs, UnsetType):
        _check_morphs(entry.morphs, len(entry.joints), f"{path}: morphs")
    for name, texture in entry.textures.colors().items():
        _check_mips(texture, f"{path}: textures.{name}")
    return Manifest(
        name=folder.stem if isinstance(entry.name, UnsetType) else entry.name,
        schema=entry.schema,
        joints=tuple(entry.joints),
        bind_bounds=_box(entry.bounds.bind, f"{path}: bounds.bind"),
        joint_bounds=tuple(
            None if box is None else _box(box, f"{path}: bounds.joints[{i}]") for i, box in enumerate(boxes)
        ),
        clip_bounds={name: _box(box, f"{path}: bounds.clips[{name[:40]}]") for name, box in entry.bounds.clips.items()},
        entry=entry,
        json=found,
    )


def _check_mips(texture: ColorEntry, where: str) -> None:
    if len(texture.mip_files) != texture.mips - 1:
        raise AssetError(f"{where} has {len(texture.mip_files)} mip_files for {texture.mips} levels: {REBUILD}")
    if texture.mips > max(texture.size).bit_length():
        raise AssetError(f"{where} has {texture.mips} levels of {max(texture.size)} texels: {REBUILD}")


def _check_morphs(morphs: MorphsEntry, num_joints: int, where: str) -> None:
    names = [target.name for target in morphs.targets]
    if len(set(names)) != len(names):
        raise AssetError(f"{where} have a name twice: {REBUILD}")
    if sum(target.texels for target in morphs.targets) > MAX_MORPH_TEXELS:
        raise AssetError(f"{where} have more than {MAX_MORPH_TEXELS} texels: {REBUILD}")
    if any(joint >= num_joints for target in morphs.targets for joint, _, _ in target.reach):
        raise AssetError(f"{where} reach a joint beyond the {num_joints}: {REBUILD}")
