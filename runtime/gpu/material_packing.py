"""What varies of occlusion, roughness and metallic, put where it costs no fetch of its own.

A texture of all three is one more fetch a pixel, and mostly one or two of them do not vary at all: what is constant
becomes a factor, roughness moves into the base colour's alpha where no material needs that, and occlusion or metallic
into the normal's. What finds no such place stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.asset.asset import Asset, MaterialData

Levels = tuple[NDArray[Any], ...]
OCCLUSION, ROUGHNESS, METALLIC = range(3)


@dataclass(frozen=True)
class MaterialChannels:
    """Textures and materials that give the same picture as a character's own, with fewer fetches.

    Attributes
    ----------
    textures : mapping of "normal", "base_color", "orm", "emissive" to levels (H >> k, W >> k, C)
        Those that are sampled.
    materials : tuple of MaterialData
        Factors with what is constant in the textures.
    defines : tuple of str
        Preprocessor definitions that say where things are (shaders/include/surface.glsl).
    """

    textures: Mapping[str, Levels]
    materials: tuple[MaterialData, ...]
    defines: tuple[str, ...]


def _constants(levels: Levels) -> list[float | None]:
    """Each channel's value, 0 to 1, where it is the same in all texels of all levels."""
    lowest = np.min([level.min(axis=(0, 1)) for level in levels], axis=0)
    highest = np.max([level.max(axis=(0, 1)) for level in levels], axis=0)
    return [float(low) / 255 if low == high else None for low, high in zip(lowest[:3], highest[:3])]


def _with_alpha(levels: Levels, alphas: Levels, channel: int) -> Levels:
    """Levels with a channel of others as their alpha."""
    joined = []
    for level, alpha in zip(levels, alphas):
        whole = np.empty((*level.shape[:2], 4), level.dtype)
        whole[:, :, :3] = level[:, :, :3]
        whole[:, :, 3] = alpha[:, :, channel] * level.dtype.type(np.iinfo(level.dtype).max // 255)  # as fine
        joined.append(whole)
    return tuple(joined)


def _takes_alpha(levels: Levels | None, orm: Levels, kinds: Sequence[str]) -> bool:
    """Whether a texture can carry a channel of another in its alpha, texel by texel."""
    return (
        levels is not None
        and levels[0].dtype.name in kinds
        and levels[0].shape[:2] == orm[0].shape[:2]
        and len(levels) <= len(orm)
    )


def arrange_channels(asset: Asset) -> MaterialChannels:
    """Decide where the channels of a character's materials go."""
    names = ("normal", "base_color", "orm", "emissive")
    textures = {name: asset.textures[name].levels for name in names if name in asset.textures}
    materials, orm = asset.materials or (MaterialData(),), textures.get("orm")
    if orm is None or orm[0].dtype != np.uint8 or orm[0].shape[2] < 3:
        return MaterialChannels(textures, materials, ("NO_ORM", "NO_OCCLUSION") if orm is None else ())
    constants = _constants(orm)
    varying = [channel for channel, value in enumerate(constants) if value is None]
    if constants[OCCLUSION] != 1.0:
        varying = sorted({*varying, OCCLUSION})
    others = [channel for channel in varying if channel != ROUGHNESS]
    has_room = all(material.alpha_mode == "OPAQUE" for material in materials) and _takes_alpha(
        textures.get("base_color"), orm, ("uint8",)
    )
    one_place = asset.colors_moved or all(mesh.normal_uvs is None for mesh in asset.lods)
    if (ROUGHNESS in varying and not has_room) or len(others) > 1 or (
        others and not (one_place and _takes_alpha(textures["normal"], orm, ("uint8", "uint16")))
    ):  # fmt: skip
        return MaterialChannels(textures, materials, () if OCCLUSION in varying else ("NO_OCCLUSION",))
    defines = ["NO_ORM"]
    if ROUGHNESS in varying:
        textures["base_color"] = _with_alpha(textures["base_color"], orm, ROUGHNESS)
        defines.append("ROUGHNESS_IN_COLOR")
    for channel in others:
        textures["normal"] = _with_alpha(textures["normal"], orm, channel)
        defines.append("OCCLUSION_IN_NORMAL" if channel == OCCLUSION else "METALLIC_IN_NORMAL")
    if OCCLUSION not in varying:
        defines.append("NO_OCCLUSION")
    del textures["orm"]
    _, roughness, metallic = (1.0 if value is None else value for value in constants)
    folded = tuple(
        replace(
            material,
            roughness_factor=material.roughness_factor * roughness,
            metallic_factor=material.metallic_factor * metallic,
        )
        for material in materials
    )
    return MaterialChannels(textures, folded, tuple(defines))
