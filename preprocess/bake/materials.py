"""The source's materials into textures of the atlas: base colour, occlusion-roughness-metallic, emissive, normal.

Where the artist's atlas stays and one material covers the character, its images are passed on texel by texel.
Otherwise every texel of the new atlas looks up its surface point in the source's images, through their samplers
and transforms; factors and vertex colours that differ over the surface are multiplied in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Singles
from preprocess.atlas.chart_scales import MAX_SIZE_PX
from preprocess.bake.color_sizes import color_side, transformed
from preprocess.files.resample import sample_footprints
from preprocess.files.srgb import linear_to_srgb, srgb_to_linear
from preprocess.load.tangents import corner_tangents
from preprocess.mesh.raster import Coverage, clamp_extrapolation, fill_outside, interpolate_corners
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import uv_to_px

if TYPE_CHECKING:
    from preprocess.load import Character, Material, TextureRef

POINTS_AT_A_TIME = 1 << 20


@dataclass(frozen=True)
class BakedTexture:
    """One texture of the atlas.

    Attributes
    ----------
    name : str
        File stem: "base_color", "orm", "emissive", "normal".
    texels : (H, W, C) float64
        As stored: colours sRGB-encoded in [0, 1], normals as vectors in [-1, 1].
    format : str
        "uint8", "uint16", "half" or "float".
    is_color : bool
        Whether the stored values are sRGB-encoded.
    copied : bool
        Whether these are the source's own texels.
    scale : float
        What texels are multiplied by when drawn: emission may be stronger than one, stored texels may not.
    """

    name: str
    texels: Floats
    format: str
    is_color: bool
    copied: bool
    scale: float = 1.0


def bake_materials(
    character: Character,
    mesh: SkinnedMesh,
    resampled: bool,
    size_px: int | None,
    cover: Callable[[int, int], Coverage],
    sides: Mapping[str, int] | None = None,
) -> list[BakedTexture]:
    """Base colour, and occlusion-roughness-metallic and emissive where the character has them.

    Parameters
    ----------
    character : Character
    mesh : SkinnedMesh
        With the atlas as its uvs.
    resampled : bool
        Whether the atlas differs from the source's uvs.
    size_px : int or None
        Side of the square textures; None: `sides`.
    cover : function (width, height) -> Coverage
        Rasterises the atlas.
    sides : dict of str to int, optional
        By kind: `Atlas.sides`.
    """
    used = np.unique(mesh.face_materials)
    materials = character.materials
    textures = []
    kinds: tuple[tuple[str, Callable[[Material], TextureRef | None], bool], ...] = (
        ("base_color", lambda m: m.base_color, True),
        ("orm", lambda m: m.metallic_roughness or m.occlusion, False),
        ("emissive", lambda m: m.emissive, True),
    )
    for name, of, is_color in kinds:
        refs: list[TextureRef | None] = [of(materials[i]) for i in used]
        if name != "base_color" and not _varies(name, [materials[i] for i in used], refs):
            continue
        copied = _copy(character, mesh, used, name, refs, resampled, size_px)
        if copied is not None:
            textures.append(BakedTexture(name, copied, "uint8", is_color, True))
            continue
        side = size_px or color_side(mesh, name, sides or {})
        texels, scale = _bake(mesh, materials, name, cover(side, side))
        textures.append(BakedTexture(name, texels, "uint8", is_color, False, scale))
    return textures


def _varies(name: str, materials: list[Material], refs: list[TextureRef | None]) -> bool:
    """Whether a channel needs a texture, or a factor a material is enough."""
    if any(ref is not None for ref in refs):
        return True
    if name == "orm":
        return len({(m.roughness_factor, m.metallic_factor) for m in materials}) > 1
    return len({tuple(m.emissive_factor) for m in materials}) > 1


def _copy(
    character: Character,
    mesh: SkinnedMesh,
    used: NDArray[np.integer],
    name: str,
    refs: list[TextureRef | None],
    resampled: bool,
    size_px: int | None,
) -> Floats | None:
    """The source's own texels, where nothing about them changes; else None."""
    if resampled or size_px is not None or len(used) != 1 or mesh.corner_colors is not None or refs[0] is None:
        return None
    material, ref = character.materials[int(used[0])], refs[0]
    if ref.texcoord != 0 or not np.allclose(ref.transform, np.eye(3)):
        return None
    if name == "orm" and not _is_packed(material):
        return None
    if max(ref.image.texels.shape[:2]) > MAX_SIZE_PX:
        return None
    texels = ref.image.texels.astype(np.float64)
    if texels.shape[2] < 3:  # grey, with or without alpha
        texels = np.concatenate([texels[..., :1]] * 3 + [texels[..., 1:]], axis=2)
    opaque = material.alpha_mode == "OPAQUE"
    return texels[..., :3] if opaque or name != "base_color" else texels


def _is_packed(material: Material) -> bool:
    """Whether occlusion, roughness and metallic already share one image."""
    both = material.occlusion is not None and material.metallic_roughness is not None
    return both and material.occlusion.image is material.metallic_roughness.image  # type: ignore[union-attr]


def _bake(mesh: SkinnedMesh, materials: tuple[Material, ...], name: str, coverage: Coverage) -> tuple[Floats, float]:
    """One channel group of all materials in the atlas, (H, W, 3 or 4), colours sRGB-encoded; what it is stored over."""
    height, width = coverage.shape
    near = coverage.faces >= 0
    face_of_texel = coverage.faces[near]
    blended = name == "base_color" and any(materials[i].alpha_mode != "OPAQUE" for i in np.unique(mesh.face_materials))
    values = np.ones((len(face_of_texel), 4))
    lookup = _Lookup(mesh, face_of_texel, coverage.barycentrics[near].astype(np.float64), (width, height))
    _shade(values, name, materials, lookup)
    if name == "base_color" and mesh.corner_colors is not None:
        values *= interpolate_corners(coverage, mesh.corner_colors)[near]
    scale = max(1.0, float(values[:, :3].max(initial=0.0))) if name == "emissive" else 1.0
    values = np.clip(values / scale, 0.0, 1.0)
    if name != "orm":
        values[:, :3] = linear_to_srgb(values[:, :3])
    texels = np.zeros((height, width, 4 if blended else 3))
    texels[near] = values[:, : texels.shape[2]]
    return fill_outside(texels, near), scale


def _shade(values: Floats, name: str, materials: tuple[Material, ...], lookup: _Lookup) -> None:
    """Fill in the values of all points, each with the shader of its material."""
    material_of_point = lookup.mesh.face_materials[lookup.faces]
    for index in np.unique(lookup.mesh.face_materials):
        rows = np.flatnonzero(material_of_point == index)
        if len(rows):
            values[rows] = _SHADERS[name](materials[index], lookup, rows)


def base_colors_at(
    materials: tuple[Material, ...],
    mesh: SkinnedMesh,
    faces: NDArray[np.integer],
    barycentrics: Floats,
    size_px: tuple[int, int],
) -> Floats:
    """Base colour at points of the surface as a texture of a given size would show it, sRGB-encoded.

    Parameters
    ----------
    materials : tuple of Material
    mesh : SkinnedMesh
        With the atlas as its uvs.
    faces : (N,) int
    barycentrics : (N, 3) float64
    size_px : (width, height)

    Returns
    -------
    (N, 3) float64
    """
    values = np.ones((len(faces), 4))
    _shade(values, "base_color", materials, _Lookup(mesh, faces, barycentrics, size_px))
    if mesh.corner_colors is not None:
        values *= np.einsum("nk,nkc->nc", barycentrics, mesh.corner_colors[faces])
    return linear_to_srgb(np.clip(values[:, :3], 0.0, 1.0))


def _base_color(material: Material, lookup: _Lookup, rows: NDArray[np.integer]) -> Floats:
    values = lookup.color(material.base_color, rows)
    result: Floats = values * np.asarray(material.base_color_factor)
    return result


def _emissive(material: Material, lookup: _Lookup, rows: NDArray[np.integer]) -> Floats:
    values = lookup.color(material.emissive, rows)
    values[:, :3] *= np.asarray(material.emissive_factor)
    return values


def _orm(material: Material, lookup: _Lookup, rows: NDArray[np.integer]) -> Floats:
    values = np.ones((len(rows), 4))
    if material.occlusion is not None:
        occlusion = lookup.raw(material.occlusion, rows)[:, 0]
        values[:, 0] = 1.0 + material.occlusion_strength * (occlusion - 1.0)
    values[:, 1:3] = lookup.raw(material.metallic_roughness, rows)[:, 1:3]
    values[:, 1:3] *= (material.roughness_factor, material.metallic_factor)
    return values


_SHADERS = {"base_color": _base_color, "emissive": _emissive, "orm": _orm}


class _Lookup:
    """Source images seen from N points of the surface, each as wide as a texel of the atlas at a size."""

    def __init__(
        self, mesh: SkinnedMesh, faces: NDArray[np.integer], barycentrics: Floats, size_px: tuple[int, int]
    ) -> None:
        self.mesh = mesh
        self.faces = faces
        self.barycentrics = barycentrics
        surface = mesh.surface
        self.gradients = _barycentric_gradients(uv_to_px(surface.uvs, *size_px)[surface.face_uvs])

    def raw(self, ref: TextureRef | None, rows: NDArray[np.integer], texels: Singles | None = None) -> Floats:
        """Stored values, (N, 4); ones where there is no texture, or no texture coordinates for it."""
        values = np.ones((len(rows), 4))
        if ref is None:
            return values
        seen = np.flatnonzero(self.mesh.has_texcoords(ref.texcoord)[self.faces[rows]])
        source = np.ascontiguousarray(ref.image.texels if texels is None else texels, np.float32)
        for start in range(0, len(seen), POINTS_AT_A_TIME):
            some = seen[start : start + POINTS_AT_A_TIME]
            sampled = self._sample(ref, rows[some], source)
            values[some, : sampled.shape[1]] = sampled
        return values

    def _sample(self, ref: TextureRef, rows: NDArray[np.integer], source: Singles) -> Floats:
        """Stored values of a few points, (N, 3 or 4)."""
        faces = self.faces[rows]
        corners = transformed(self.mesh.corner_texcoords[faces][:, :, ref.texcoord], ref)
        uvs = np.einsum("nk,nkc->nc", self.barycentrics[rows], corners)
        steps = np.einsum("nkd,nkc->ndc", self.gradients[faces], corners)
        sampled = sample_footprints(source, uvs, steps[:, 0], steps[:, 1], ref.wrap_s, ref.wrap_t, ref.nearest)
        if sampled.shape[1] < 3:
            sampled = np.concatenate([sampled[:, :1]] * 3 + [sampled[:, 1:]], axis=1)
        return sampled

    def color(self, ref: TextureRef | None, rows: NDArray[np.integer]) -> Floats:
        """Colours in linear light, (N, 4)."""
        if ref is None:
            return np.ones((len(rows), 4))
        texels = ref.image.texels.astype(np.float32)
        colors = texels.shape[2] - int(texels.shape[2] in (2, 4))
        for row, stored in zip(texels, ref.image.texels, strict=True):
            row[:, :colors] = srgb_to_linear(stored[:, :colors])
        return self.raw(ref, rows, texels)


def _barycentric_gradients(corners_px: Floats) -> Floats:
    """Change of the three barycentric coordinates over one texel right and down, (F, 3, 2)."""
    a, b, c = corners_px[:, 0], corners_px[:, 1], corners_px[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    inverse = np.where(area != 0, 1.0 / np.where(area == 0, 1.0, area), 0.0)[:, None]
    wa = np.stack([b[:, 1] - c[:, 1], c[:, 0] - b[:, 0]], axis=1) * inverse
    wb = np.stack([c[:, 1] - a[:, 1], a[:, 0] - c[:, 0]], axis=1) * inverse
    return np.stack([wa, wb, -wa - wb], axis=1)


def normal_tangents(character: Character, mesh: SkinnedMesh) -> Floats | None:
    """Tangents of every corner, (F, 3, 4), each face's for the texture coordinates that its own normal map uses.

    They are those that the map is sampled at, its KHR_texture_transform applied. None where no face has a normal map;
    any where one face has none.
    """
    groups: dict[tuple[int, bytes], list[int]] = {}
    refs: dict[tuple[int, bytes], TextureRef] = {}
    for index in np.unique(mesh.face_materials).tolist():
        ref = character.materials[index].normal
        if ref is not None:
            key = (ref.texcoord, np.asarray(ref.transform).tobytes())
            groups.setdefault(key, []).append(index)
            refs[key] = ref
    if not groups:
        return None
    tangents = np.tile([1.0, 0.0, 0.0, 1.0], (mesh.num_faces, 3, 1))
    for key, users in groups.items():
        ref = refs[key]
        faces = np.flatnonzero(np.isin(mesh.face_materials, users) & mesh.has_texcoords(ref.texcoord))
        if len(faces):
            uvs = transformed(mesh.corner_texcoords[faces][:, :, ref.texcoord], ref)
            tangents[faces] = corner_tangents(mesh, faces, uvs)
    return tangents


def bake_normals(
    character: Character,
    mesh: SkinnedMesh,
    tangents: NDArray[np.floating] | None,
    coverage: Coverage,
) -> Floats:
    """Object-space unit normals with the source's tangent-space normal maps in them, (H, W, 3) float64.

    The frame, normal and tangent, is interpolated and not renormalised before use, bitangent = handedness *
    cross(n, t), as the glTF specification and MikkTSpace define it.

    Parameters
    ----------
    character : Character
    mesh : SkinnedMesh
        With the uvs of the atlas.
    tangents : (F, 3, 4) float or None
        `normal_tangents`.
    coverage : Coverage
    """
    near = coverage.faces >= 0
    height, width = coverage.shape
    texels = np.zeros((height, width, 3))
    texels[near] = normals_at(
        character, mesh, tangents, coverage.faces[near], coverage.barycentrics[near], (width, height)
    )
    return fill_outside(texels, near)


def normals_at(
    character: Character,
    mesh: SkinnedMesh,
    tangents: NDArray[np.floating] | None,
    faces: NDArray[np.integer],
    barycentrics: NDArray[np.floating],
    size_px: tuple[int, int],
) -> Floats:
    """Object-space unit normals at points of the surface, as a texture of a given size would show them, (N, 3) float64.

    Parameters
    ----------
    character : Character
    mesh : SkinnedMesh
        With the atlas as its uvs.
    tangents : (F, 3, 4) float or None
        `normal_tangents`.
    faces : (N,) int
    barycentrics : (N, 3) float
        May lie a little outside.
    size_px : (width, height)
    """
    weights = clamp_extrapolation(barycentrics)
    normals = np.einsum("nk,nkc->nc", weights, mesh.corner_normals[faces])
    if tangents is None:
        return _unit(normals)
    frames = np.einsum("nk,nkc->nc", weights, tangents[faces])
    lookup = _Lookup(mesh, faces, np.asarray(barycentrics, np.float64), size_px)
    for index in np.unique(mesh.face_materials):
        material = character.materials[index]
        if material.normal is None:
            continue
        mapped = (mesh.face_materials == index) & mesh.has_texcoords(material.normal.texcoord)
        rows = np.flatnonzero(mapped[faces])
        local = lookup.raw(material.normal, rows)[:, :3] * 2.0 - 1.0
        local[:, :2] *= material.normal_scale
        n, t = normals[rows], frames[rows, :3]
        b = np.sign(frames[rows, 3:]) * np.cross(n, t)
        normals[rows] = local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * n
    return _unit(normals)


def _unit(vectors: Floats) -> Floats:
    result: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
    return result
