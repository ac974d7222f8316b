"""Textures of a character on the GPU: which units they take, how texels are prepared, and how they get there.

Preparing needs no context and may run in any thread; uploading goes a slice at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.asset.asset import Asset
from runtime.asset.packed_positions import read_words
from runtime.asset.texel_footprint import fetch_bilinear, touched_cells
from runtime.errors import RenderError
from runtime.gpu.gl_state import allocate_mips, write_rows
from runtime.gpu.material_packing import MaterialChannels, arrange_channels
from runtime.gpu.weight_records import WeightCells, build_weight_cells

# Texture units, the same for every program.
TEXTURE_UNITS = {
    "position_texture": 0,
    "weight_cells": 1,
    "weight_records": 2,
    "joint_records": 3,
    "joint_texture": 4,
    "normal_texture": 5,
    "base_color_texture": 6,
    "orm_texture": 7,
    "emissive_texture": 8,
    "reflection_texture": 9,
    "morph_numbers": 10,
    "morph_sums": 11,
}
NUM_TEXTURE_UNITS = len(TEXTURE_UNITS)
MATERIAL_TEXTURES = ("normal_texture", "base_color_texture", "orm_texture", "emissive_texture")
ANISOTROPY = 8.0  # more shows nowhere in charts that are stretched four times at most
MUCH_SQUEEZED = 0.1  # of the surface
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "SwiftShader")
_DTYPES = {"uint8": "f1", "uint16": "nu2", "float16": "f2", "float32": "f4"}
_EXACT_DTYPES = {"uint16": "u2", "uint32": "u4"}
_BYTES = {"uint8": 1, "f1": 1, "nu2": 2, "f2": 2, "f4": 4, "u2": 2, "u4": 4}
SLICE_BYTES = 1 << 20  # uploaded at a time by a model made in slices: well under a millisecond on any bus
POSITION_FORMATS = ("auto", "words", "unorm16", "float32")


def make_texture(
    ctx: moderngl.Context, texels: NDArray[Any], mips: tuple[NDArray[Any], ...] = (), linear: bool = True
) -> moderngl.Texture:
    """A 2D texture for an array (H, W, C), clamped, with its mip levels, not yet filled."""
    kind = texels.dtype.name
    dtype = _DTYPES[kind] if linear else _EXACT_DTYPES[kind]
    height, width, channels = texels.shape
    texture = ctx.texture((width, height), channels, alignment=1, dtype=dtype)
    if mips:
        texture.use(ctx.default_texture_unit)
        allocate_mips((width, height), len(mips))
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    else:
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR) if linear else (moderngl.NEAREST, moderngl.NEAREST)
    texture.repeat_x = texture.repeat_y = False
    return texture


def is_software(ctx: moderngl.Context) -> bool:
    """Whether the context's renderer runs on the processor."""
    return any(name in ctx.info["GL_RENDERER"] for name in SOFTWARE_RENDERERS)


def squeezed_share(asset: Asset) -> float:
    """Part of the surface whose texels are over twice as long as wide: isotropic filtering loses a mip level there."""
    mesh, texels = asset.lods[0], asset.textures["position"].levels[0][:, :, :3]
    triangles = mesh.triangles.astype(np.int64)
    points = fetch_bilinear(np.asarray(texels, np.float32), mesh.canonical_uvs).astype(np.float64)
    uvs = mesh.uvs.astype(np.float64) * asset.textures.get("base_color", asset.textures["position"]).size
    along, across = (np.stack([a[triangles[:, k]] - a[triangles[:, 0]] for k in (1, 2)], -1) for a in (points, uvs))
    determinant = np.linalg.det(across)
    sound = np.abs(determinant) > 1e-12
    metres = along[sound] @ np.linalg.inv(across[sound])  # (F, 3, 2), that a texel covers along u and v
    gram = metres.transpose(0, 2, 1) @ metres
    half, product = np.trace(gram, axis1=1, axis2=2) / 2, np.linalg.det(gram)
    root = np.sqrt(np.maximum(half * half - product, 0.0))
    areas = np.sqrt(np.maximum(product, 0.0)) * np.abs(determinant[sound])
    return float(areas[half + root > 4.0 * (half - root)].sum() / max(areas.sum(), 1e-300))


def filter_anisotropically(
    ctx: moderngl.Context, textures: Mapping[str, moderngl.Texture], most: float | None, squeezed: float
) -> None:
    """Let surfaces that are seen aslant, or squeezed in the atlas, be sampled along the way they are shortened.

    Parameters
    ----------
    ctx : moderngl.Context
    textures : mapping of names to textures
    most : float or None
        Most samples; None: `ANISOTROPY`. Where the processor filters, every texture so filtered makes a picture half
        as dear again: there it is base colours alone, of characters with much that is squeezed.
    squeezed : float
        From `squeezed_share`.
    """
    names: tuple[str, ...] = MATERIAL_TEXTURES
    if most is None and is_software(ctx):
        names = ("base_color_texture",) if squeezed > MUCH_SQUEEZED else ()
    wanted = min(ANISOTROPY if most is None else most, ctx.max_anisotropy)
    for name in names:
        if wanted > 1:  # the extension is there
            textures[name].anisotropy = wanted


def fill_texture(ctx: moderngl.Context, texture: moderngl.Texture, levels: tuple[NDArray[Any], ...]) -> Iterator[None]:
    """Write a texture's levels, some rows at a time: `SLICE_BYTES` at most, at least one row."""
    for level, texels in enumerate(levels):
        height, width = texels.shape[:2]
        rows = max(1, SLICE_BYTES // max(texels[0].nbytes, 1))
        for first in range(0, height, rows):
            part = np.ascontiguousarray(texels[first : first + rows])
            if level:  # moderngl knows no levels that it has not made itself
                texture.use(ctx.default_texture_unit)
                write_rows(part, level, first)
            else:
                texture.write(part, viewport=(0, first, width, len(part)), alignment=1)
            yield


def texture_bytes(texture: moderngl.Texture) -> int:
    """Bytes of a texture's first level."""
    return int(texture.width * texture.height * texture.components * _BYTES[texture.dtype])


@dataclass(frozen=True)
class PreparedPositions:
    """The position texture as the GPU has it.

    Attributes
    ----------
    texels : (H, W, 1) uint32, or (H, W, 4) uint16 or float32
        Words (`runtime.asset.packed_positions`), or x, y, z; 16 bits count as 0 to 1.
    scale, offset : (3,) float64
        Metres are what a texel holds times scale plus offset.
    shifts, masks : (3,) int64 or None
        Where in its word a texel holds x, y and z.
    """

    texels: NDArray[Any]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    shifts: NDArray[np.int64] | None = None
    masks: NDArray[np.int64] | None = None

    @property
    def metres(self) -> NDArray[np.float64]:
        """What the shaders read, (H, W, 3)."""
        if self.shifts is not None and self.masks is not None:
            held: NDArray[Any] = (self.texels >> self.shifts) & self.masks
        else:
            held = self.texels[:, :, :3] / (65535.0 if self.texels.dtype == np.uint16 else 1.0)
        return np.asarray(held * self.scale + self.offset, np.float64)


@dataclass(frozen=True)
class Prepared:
    """A character turned into what the GPU takes, without a context: the slow part of making a model.

    Attributes
    ----------
    asset : Asset
    positions : PreparedPositions
    weight_cells : WeightCells
    channels : MaterialChannels
    squeezed : float
        From `squeezed_share`.
    """

    asset: Asset
    positions: PreparedPositions
    weight_cells: WeightCells
    channels: MaterialChannels
    squeezed: float


def _prepare_positions(asset: Asset, form: str) -> PreparedPositions:
    """Texels for the GPU, and what turns them back into metres."""
    texels = asset.textures["position"].levels[0]
    positions = texels[:, :, :3].astype(np.float64)
    if form in ("auto", "words"):
        where = f"{asset.path / 'manifest.json'}: textures.position.words"
        words = read_words(asset.manifest.json["textures"]["position"].get("words"), where)
        if words is not None:
            return PreparedPositions(words.pack(positions), words.steps_m, words.low, words.shifts, words.masks)
        if form == "words":
            raise RenderError(f"{asset.name} was built before positions could be words: build it again")
    if form == "float32":
        full = np.zeros((*positions.shape[:2], 4), np.float32)
        full[:, :, :3] = positions
        return PreparedPositions(full, np.ones(3), np.zeros(3))
    low, high = positions.min(axis=(0, 1)), positions.max(axis=(0, 1))
    size = np.maximum(high - low, 1e-30)
    full16 = np.zeros((*positions.shape[:2], 4), np.uint16)
    full16[:, :, :3] = np.rint((positions - low) / size * 65535.0)
    return PreparedPositions(full16, size, low)


def prepare(asset: Asset, position_format: str = "auto") -> Prepared:
    """Turn a character into what the GPU takes. Needs no context: may run in any thread.

    Raises
    ------
    RenderError
        If there is no such position format, or the character has no words.
    """
    if position_format not in POSITION_FORMATS:
        raise RenderError(f"no position format {position_format!r}: one of {', '.join(POSITION_FORMATS)}")
    positions = _prepare_positions(asset, position_format)
    cells = build_weight_cells(
        asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints, asset.weight_details, _touched(asset)
    )
    return Prepared(asset, positions, cells, arrange_channels(asset), squeezed_share(asset))


def _touched(asset: Asset) -> NDArray[np.bool_]:
    """Cells of the weight map that any level reads: under its triangles, and at its canonical uvs."""
    touched = np.zeros(np.maximum(np.array(asset.weight_size[::-1]) - 1, 1), bool)
    for mesh in asset.lods:
        touched |= touched_cells(mesh.uvs, mesh.triangles, asset.weight_size)
        alone = np.repeat(np.arange(len(mesh.canonical_uvs))[:, None], 3, axis=1)
        touched |= touched_cells(mesh.canonical_uvs, alone, asset.weight_size)
    return touched
