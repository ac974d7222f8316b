"""The drawn side: a built folder, read by the runtime and sampled as its shaders sample.

Nothing here comes from the stages that made the folder, only from its files.
Letters in shapes: V surface vertices, F faces, J joints, P poses, N points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices
from preprocess.files.srgb import srgb_to_linear
from preprocess.fit.weight_quadtree import sample_weights
from preprocess.mesh.texels import bilinear_stencil
from runtime.asset.asset import Asset
from runtime.asset.packed_positions import read_words
from runtime.asset.weight_stack import unpack_weights

POSITION_STEPS = 65535  # positions without words lie in GPU memory as 16-bit numbers over their box


def distinct_rows(rows: NDArray[np.float32]) -> tuple[Indices, Indices]:
    """First of each distinct row of (N, 2) float32, and the number of each row's value."""
    words = np.ascontiguousarray(rows, np.float32).view(np.uint64).ravel()
    _, first, number = np.unique(words, return_index=True, return_inverse=True)
    return first, number


def _sampled(level: NDArray[Any], uvs: Floats, held: Callable[[Floats], Floats] = lambda texels: texels) -> Floats:
    """Bilinear samples of a texture as GPU memory holds it, (N, C); texels that nobody asks for are not touched."""
    height, width, channels = level.shape
    texels, shares = bilinear_stencil(uvs, width, height)
    values = held(level.reshape(-1, channels)[texels].astype(np.float64))
    result: Floats = np.einsum("nk,nkc->nc", shares, values)
    return result


def positions_at(asset: Asset, uvs: Floats) -> Floats:
    """Positions at rest at places of the atlas, metres, (N, 3): words, or 16-bit numbers over their box."""
    level = asset.textures["position"].levels[0][:, :, :3]
    words = read_words(asset.manifest.json["textures"]["position"].get("words"), "textures.position.words")
    if words is not None:
        return _sampled(level, uvs, lambda texels: words.metres(words.numbers(texels)))
    low = level.min(axis=(0, 1)).astype(np.float64)
    step = np.maximum(np.ptp(level, axis=(0, 1)).astype(np.float64), 1e-30) / POSITION_STEPS
    return _sampled(level, uvs, lambda texels: low + np.rint((texels - low) / step) * step)


@dataclass(frozen=True)
class Drawn:
    """A level of a built character as it is drawn.

    Attributes
    ----------
    asset : Asset
    positions : (V, 3) float64
        At rest, metres.
    weights : (V, J) float64
    faces : (F, 3) int64
        Into `positions`.
    uvs, normal_uvs : (F, 3, 2) float64
        Of the corners: where materials are sampled, and normals.
    materials : (F,) int64
        Into the asset's materials.
    """

    asset: Asset
    positions: Floats
    weights: Floats
    faces: Indices
    uvs: Floats
    normal_uvs: Floats
    materials: Indices

    @cached_property
    def diagonal_m(self) -> float:
        """Of the box around the vertices at rest."""
        return float(np.linalg.norm(np.ptp(self.positions, axis=0)))

    def at(self, corners: Floats, faces: Indices, shares: Floats) -> Floats:
        """A value of corners, (F, 3, C), at points of faces, (N, C)."""
        result: Floats = np.einsum("nk,nkc->nc", shares, corners[faces])
        return result

    def normals(self, faces: Indices, shares: Floats) -> Floats:
        """Unit shading normals at points, object space, (N, 3)."""
        texels = self._texels("normal", self.normal_uvs, faces, shares)[:, :3]
        if self.asset.textures["normal"].levels[0].dtype.kind == "u":
            texels = 2.0 * texels - 1.0
        result: Floats = texels / np.maximum(np.linalg.norm(texels, axis=1, keepdims=True), 1e-30)
        return result

    def base_colors(self, faces: Indices, shares: Floats) -> Floats:
        """Linear base colour and alpha at points, (N, 4)."""
        texels = self._channels("base_color", faces, shares)
        texels[:, :3] = srgb_to_linear(texels[:, :3])
        return texels * self._factors(lambda material: material.base_color_factor, faces)

    def emission(self, faces: Indices, shares: Floats) -> Floats:
        """Linear emission at points, (N, 3)."""
        texels = srgb_to_linear(self._channels("emissive", faces, shares)[:, :3])
        return texels * self._factors(lambda material: material.emissive_factor, faces)

    def surface_factors(self, faces: Indices, shares: Floats) -> Floats:
        """Occlusion, roughness and metallic at points, (N, 3)."""
        texels = self._channels("orm", faces, shares)[:, :3]
        strength = self._factors(lambda material: (material.occlusion_strength,), faces)[:, 0]
        texels[:, 0] = 1.0 + strength * (texels[:, 0] - 1.0)
        texels[:, 1:] *= self._factors(lambda material: (material.roughness_factor, material.metallic_factor), faces)
        return texels

    def _factors(self, of: object, faces: Indices) -> Floats:
        table = np.array([of(material) for material in self.asset.materials], np.float64)  # type: ignore[operator]
        return table[self.materials[faces]]

    def _channels(self, name: str, faces: Indices, shares: Floats) -> Floats:
        """RGBA as stored, ones where there is no such texture or channel, (N, 4)."""
        values = np.ones((len(faces), 4))
        if name in self.asset.textures:
            entry = self.asset.manifest.entry.textures.colors()[name]
            texels = self._texels(name, self.uvs if entry.uvs is UNSET else self.normal_uvs, faces, shares)
            values[:, : texels.shape[1]] = texels
        return values

    def _texels(self, name: str, corners: Floats, faces: Indices, shares: Floats) -> Floats:
        """Bilinear samples of a texture's finest level, integers scaled to [0, 1]."""
        level = self.asset.textures[name].levels[0]
        sampled = _sampled(level, self.at(corners, faces, shares))
        return sampled / float(np.iinfo(level.dtype).max) if level.dtype.kind == "u" else sampled


def read_drawn(asset: Asset, level: int = 0) -> Drawn:
    """Sample a level's vertices."""
    lod = asset.lods[level]
    first, vertex_of = distinct_rows(lod.canonical_uvs)
    owners = lod.canonical_uvs[first].astype(np.float64)
    triangles = lod.triangles.astype(np.int64)
    materials = np.zeros(len(triangles), np.int64)
    for draw in lod.draws:
        materials[draw.first : draw.first + draw.count] = draw.material
    uvs = lod.uvs.astype(np.float64)[triangles]
    normal_uvs = uvs if lod.normal_uvs is None else lod.normal_uvs.astype(np.float64)[triangles]
    return Drawn(
        asset=asset,
        positions=positions_at(asset, owners),
        weights=weights_at(asset, owners),
        faces=vertex_of[triangles],
        uvs=uvs,
        normal_uvs=normal_uvs,
        materials=materials % len(asset.materials),
    )


def weights_at(asset: Asset, uvs: Floats) -> Floats:
    """Joint weights at places of the atlas, (N, J)."""
    stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
    return sample_weights(stored, asset.weight_details, uvs)
