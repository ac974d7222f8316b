"""A built character as it would be without its seams erased: every texture as a plain bake leaves it.

The textures are baked again from the source file into the same atlas; levels of detail, skeleton and clips are the
built character's. Drawn with `WITHOUT_CANONICAL_UVS`, each side of a seam fetches its own texels, and what erasure and
canonical uvs are for can be seen.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demos.errors import DemoError
from preprocess.atlas import character_atlas
from preprocess.bake.color_borders import find_color_borders
from preprocess.bake.geometry import bake_positions, bake_weights
from preprocess.bake.hard_edges import bake_surface, find_normal_uvs
from preprocess.bake.materials import bake_materials, bake_normals, normal_tangents
from preprocess.errors import InputError
from preprocess.load import load_character
from preprocess.mesh.raster import cover_atlas
from preprocess.settings import Settings
from runtime.asset.asset import Asset, TextureData
from runtime.asset.weight_stack import pack_weights


def find_source(asset: Asset) -> Path | None:
    """The file that a character was built from, if it still lies beside its folder."""
    name = asset.manifest.json.get("source", {}).get("file")
    path = asset.path.parent / str(name)
    return path if name and path.is_file() else None


def _box_mips(texels: NDArray[np.float64], steps: int, dtype: type[np.unsignedinteger]) -> TextureData:
    """Rounded levels by averaging two by two, down to one texel."""
    levels = [texels]
    while min(levels[-1].shape[:2]) > 1:
        fine = levels[-1]
        levels.append(0.25 * (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]))
    return TextureData("", tuple(np.rint(np.clip(level, 0.0, 1.0) * steps).astype(dtype) for level in levels))


def _settings(asset: Asset) -> Settings:
    """The settings that a character was built with, as its manifest has them."""
    known = {field.name for field in dataclasses.fields(Settings)}
    stored = asset.manifest.json.get("settings", {})
    chosen: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in stored.items()
        if name in known and not isinstance(value, dict)  # limits on what a file may ask for
    }
    return Settings(**chosen)


def without_erasure(asset: Asset, source: Path) -> Asset:
    """The same character with textures as baked.

    Parameters
    ----------
    asset : Asset
        Built from `source`.
    source : Path

    Raises
    ------
    DemoError
        If the source cannot be read or is not the one.
    """
    made_from = asset.manifest.json.get("source", {}).get("sha256")
    if made_from and made_from != hashlib.sha256(source.read_bytes()).hexdigest():
        raise DemoError(f"{asset.path} was not built from {source.name} as it is now: build it again")
    try:
        character = load_character(source)
    except InputError as error:
        raise DemoError(str(error)) from None
    atlas = character_atlas(character, _settings(asset))
    mesh = atlas.mesh
    if len(asset.lods[0].triangles) != mesh.num_faces:
        raise DemoError(f"{asset.path} was built by other tools than these: build it again")
    sizes = {name: texture.size for name, texture in asset.textures.items()}
    baked = {name: asset.textures[name] for name in asset.textures}
    positions = bake_positions(mesh, sizes["position"])
    baked["position"] = TextureData("position", (positions.astype(np.float32),))
    packed = pack_weights(bake_weights(mesh, asset.num_joints, asset.weight_size))
    baked["weights"] = TextureData("weights", (packed.stack,))
    borders = find_color_borders(character, mesh, sizes["normal"]).half_edges() if asset.colors_moved else None
    uvs = find_normal_uvs(mesh, sizes["normal"], borders)
    normal_mesh = mesh if uvs is None else mesh.with_surface(bake_surface(mesh.surface, uvs))
    coverage = cover_atlas(normal_mesh, *sizes["normal"])
    normals = bake_normals(character, normal_mesh, normal_tangents(character, mesh), coverage)
    baked["normal"] = dataclasses.replace(_box_mips(0.5 * normals + 0.5, 65535, np.uint16), name="normal")
    side = sizes["base_color"][0]
    color_mesh = normal_mesh if asset.colors_moved else mesh
    for texture in bake_materials(
        character, color_mesh, atlas.resampled, side, lambda width, height: cover_atlas(color_mesh, width, height)
    ):
        if texture.name in baked:
            plain = _box_mips(texture.texels, 255, np.uint8)
            baked[texture.name] = dataclasses.replace(plain, name=texture.name)
    return dataclasses.replace(asset, textures=baked)
