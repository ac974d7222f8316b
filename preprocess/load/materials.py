"""Materials of a glTF file: factors, textures, samplers and the extensions that change them.

Sources: glTF 2.0 specification, sections 3.8 and 3.9; KHR_texture_transform; KHR_materials_unlit;
KHR_materials_emissive_strength; KHR_materials_pbrSpecularGlossiness (approximated: its diffuse part is kept).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.errors import InputError
from preprocess.files.images import Image, read_image
from preprocess.load.character import Material, TextureRef
from preprocess.mesh.surface import SkinnedMesh
from runtime.gltf.document import Document

WRAPS = {10497: "REPEAT", 33071: "CLAMP_TO_EDGE", 33648: "MIRRORED_REPEAT"}
NEAREST = 9728
ALPHA_MODES = ("OPAQUE", "MASK", "BLEND")
READ_EXTENSIONS = ("KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_materials_pbrSpecularGlossiness")
# Where textures hide their image: extension name -> whether OpenImageIO decodes what it holds.
IMAGE_EXTENSIONS = {"EXT_texture_webp": True, "EXT_texture_avif": False, "KHR_texture_basisu": False}


def texture_transform(spec: dict[str, Any], where: str) -> NDArray[np.float64]:
    """Matrix of a KHR_texture_transform object: scale, then rotation, then offset.

    The rotation runs counter-clockwise as seen in the image (v down), as the Khronos viewer has it.

    Returns
    -------
    (3, 3) float64, acts on (u, v, 1)

    Raises
    ------
    InputError
        If a number is missing or not finite.
    """
    offset = _numbers(spec.get("offset", (0.0, 0.0)), 2, where)
    scale = _numbers(spec.get("scale", (1.0, 1.0)), 2, where)
    (angle,) = _numbers((spec.get("rotation", 0.0),), 1, where)
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(3)
    matrix[:2, :2] = np.array([[c, s], [-s, c]]) * scale
    matrix[:2, 2] = offset
    return matrix


def _numbers(values: Any, count: int, where: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"{where} needs {count} finite numbers where it has {str(values)[:60]}: export it again")
    return numbers


class _Reader:
    """Reads the materials of one document; decodes every image at most once."""

    def __init__(self, document: Document, num_texcoords: int) -> None:
        self.document = document
        self.num_texcoords = num_texcoords
        self.images: dict[int, Image] = {}
        self.warnings: list[str] = []

    def image(self, index: int) -> Image:
        if index not in self.images:
            what = f"{self.document.path.name}: image {index}"
            left = self.document.limits.image_texels - sum(
                image.texels.shape[0] * image.texels.shape[1] for image in self.images.values()
            )
            self.images[index] = read_image(
                self.document.image_bytes(index), what, limits=self.document.limits, most_texels=left
            )
        return self.images[index]

    def texture(self, info: Any, where: str) -> TextureRef | None:
        """A TextureRef of a textureInfo object, None where there is none."""
        if info is None:
            return None
        if not isinstance(info, dict):
            raise InputError(f"{where} is not an object: export the file again")
        texture = self.document.item("textures", info.get("index"))
        source = self._image_of(texture, where)
        sampler = self.document.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        texcoord = moved.get("texCoord", info.get("texCoord", 0))
        if not isinstance(texcoord, int) or texcoord < 0:
            raise InputError(f"{where} asks for texture coordinate set {texcoord}: export the file again")
        if texcoord >= max(self.num_texcoords, 1):
            self.warnings.append(f"{where} uses TEXCOORD_{texcoord}, which no mesh has: TEXCOORD_0 taken")
            texcoord = 0
        return TextureRef(
            image=self.image(source),
            name=str(self.document.item("images", source).get("name") or f"image {source}"),
            texcoord=texcoord,
            wrap_s=WRAPS.get(sampler.get("wrapS", 10497), "REPEAT"),
            wrap_t=WRAPS.get(sampler.get("wrapT", 10497), "REPEAT"),
            nearest=sampler.get("magFilter") == NEAREST,
            transform=texture_transform(moved, where),
        )

    def _image_of(self, texture: dict[str, Any], where: str) -> int:
        if "source" in texture:
            return int(texture["source"])
        for name, readable in IMAGE_EXTENSIONS.items():
            if name in texture.get("extensions", {}):
                if readable:
                    return int(texture["extensions"][name]["source"])
                raise InputError(f"{where} is stored with {name} alone: store the file's textures as PNG or JPEG")
        raise InputError(f"{where} has no image: give the texture an image or remove it")

    def material(self, index: int) -> Material:
        """One material with its defaults."""
        spec = self.document.item("materials", index)
        name = str(spec.get("name") or f"material {index}")
        where = f"{self.document.path.name}: material {index} ({name})"
        extensions = spec.get("extensions", {})
        dropped = sorted(
            key
            for key in extensions
            if key.startswith(("KHR_materials", "EXT_materials")) and key not in READ_EXTENSIONS
        )
        if dropped:
            self.warnings.append(f"material {name}: {', '.join(dropped)} dropped")
        base = spec.get("pbrMetallicRoughness", {})
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if glossy is not None:
            base = self._from_specular_glossiness(glossy, name)
        alpha_mode = spec.get("alphaMode", "OPAQUE")
        if alpha_mode not in ALPHA_MODES:
            raise InputError(f"{where} has alphaMode {alpha_mode}: use OPAQUE, MASK or BLEND")
        strength = _number(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0), where)
        emissive = _numbers(spec.get("emissiveFactor", (0, 0, 0)), 3, where)
        normal, occlusion = spec.get("normalTexture"), spec.get("occlusionTexture")
        r, g, b, a = _numbers(base.get("baseColorFactor", (1, 1, 1, 1)), 4, where)
        return Material(
            name=name,
            base_color_factor=(r, g, b, a),
            metallic_factor=_number(base.get("metallicFactor", 1.0), where),
            roughness_factor=_number(base.get("roughnessFactor", 1.0), where),
            emissive_factor=(emissive[0] * strength, emissive[1] * strength, emissive[2] * strength),
            normal_scale=_number((normal or {}).get("scale", 1.0), where),
            occlusion_strength=_number((occlusion or {}).get("strength", 1.0), where),
            alpha_mode=alpha_mode,
            alpha_cutoff=_number(spec.get("alphaCutoff", 0.5), where),
            double_sided=bool(spec.get("doubleSided", False)),
            unlit="KHR_materials_unlit" in extensions,
            base_color=self.texture(base.get("baseColorTexture"), f"{where}: base colour texture"),
            metallic_roughness=self.texture(
                base.get("metallicRoughnessTexture"), f"{where}: metallic-roughness texture"
            ),
            normal=self.texture(normal, f"{where}: normal texture"),
            occlusion=self.texture(occlusion, f"{where}: occlusion texture"),
            emissive=self.texture(spec.get("emissiveTexture"), f"{where}: emissive texture"),
        )

    def _from_specular_glossiness(self, spec: dict[str, Any], name: str) -> dict[str, Any]:
        """The nearest metallic-roughness description: diffuse as base colour, no metal, rough where not glossy."""
        self.warnings.append(f"material {name}: specular-glossiness approximated (specular colour dropped)")
        base: dict[str, Any] = {
            "baseColorFactor": spec.get("diffuseFactor", (1, 1, 1, 1)),
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0 - float(spec.get("glossinessFactor", 1.0)),
        }
        if "diffuseTexture" in spec:
            base["baseColorTexture"] = spec["diffuseTexture"]
        if "specularGlossinessTexture" in spec:
            base["roughnessFactor"] = max(base["roughnessFactor"], 0.5)
        return base


def _number(value: Any, where: str) -> float:
    return _numbers((value,), 1, where)[0]


def read_materials(
    document: Document, used: list[int | None], num_texcoords: int
) -> tuple[tuple[Material, ...], list[str]]:
    """Read the materials that faces use.

    Parameters
    ----------
    document : Document
    used : list of int or None
        Material indices of the file in the order wanted; None stands for glTF's default material.
    num_texcoords : int
        Number of TEXCOORD sets the mesh has.

    Returns
    -------
    materials : tuple of Material, in the order of `used`
    warnings : list of str

    Raises
    ------
    InputError, AssetError
        If one is malformed or an image does not decode.
    """
    reader = _Reader(document, num_texcoords)
    materials = [Material("default") if index is None else reader.material(index) for index in used]
    return tuple(materials), reader.warnings


TEXTURES = ("base_color", "metallic_roughness", "normal", "occlusion", "emissive")


def note_missing_texcoords(materials: tuple[Material, ...], mesh: SkinnedMesh) -> list[str]:
    """A line for each texture that some faces of its material have no texture coordinates for: they show none of it."""
    notes = []
    for index in np.unique(mesh.face_materials).tolist():
        material, faces = materials[index], mesh.face_materials == index
        for name in TEXTURES:
            ref: TextureRef | None = getattr(material, name)
            lacking = 0 if ref is None else int((faces & ~mesh.has_texcoords(ref.texcoord)).sum())
            if ref is not None and lacking:
                notes.append(
                    f"material {material.name}: {lacking} triangles have no TEXCOORD_{ref.texcoord} for its "
                    f"{name.replace('_', ' ')} texture: drawn without it"
                )
    return notes
