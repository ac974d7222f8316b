"""What loading gives: one mesh, one skeleton, clips and materials."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from preprocess.files.images import Image
from preprocess.mesh.surface import SkinnedMesh
from runtime.animation.clip import Clip
from runtime.animation.skeleton import Skeleton


@dataclass(frozen=True)
class TextureRef:
    """An image as a material looks at it.

    Attributes
    ----------
    image : Image
        Decoded texels, values as stored (colours are not linearised). Shared between the references to one image.
    name : str
        The image's name in the file, or "image N".
    texcoord : int
        Which TEXCOORD set.
    wrap_s, wrap_t : "REPEAT", "CLAMP_TO_EDGE" or "MIRRORED_REPEAT"
    nearest : bool
        Magnified without interpolation.
    transform : (3, 3) float64
        From the set's (u, v, 1) to the sampled (u, v, 1) (KHR_texture_transform).
    """

    image: Image
    name: str
    texcoord: int
    wrap_s: str
    wrap_t: str
    nearest: bool
    transform: NDArray[np.float64]


@dataclass(frozen=True)
class Material:
    """A glTF metallic-roughness material with the file's defaults filled in. Factors are linear.

    Attributes
    ----------
    name : str
    base_color_factor : four floats
    metallic_factor, roughness_factor : float
    emissive_factor : three floats, KHR_materials_emissive_strength multiplied in
    normal_scale, occlusion_strength : float
    alpha_mode : "OPAQUE", "MASK" or "BLEND"
    alpha_cutoff : float
    double_sided, unlit : bool
    base_color, metallic_roughness, normal, occlusion, emissive : TextureRef or None
    """

    name: str
    base_color_factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    metallic_factor: float = 1.0
    roughness_factor: float = 1.0
    emissive_factor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal_scale: float = 1.0
    occlusion_strength: float = 1.0
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False
    base_color: TextureRef | None = field(default=None, repr=False)
    metallic_roughness: TextureRef | None = field(default=None, repr=False)
    normal: TextureRef | None = field(default=None, repr=False)
    occlusion: TextureRef | None = field(default=None, repr=False)
    emissive: TextureRef | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Character:
    """Everything of a file's default scene that has a mesh, as one welded, skinned surface.

    Attributes
    ----------
    name : str
        The file's stem.
    source : Path
    source_hash : str
        SHA-256 of the file, hexadecimal. Of the .gltf alone, where buffers lie beside it.
    mesh : SkinnedMesh
    skeleton : Skeleton
        `skinning_matrices` of any pose move the mesh exactly as the file's own skins and nodes move its parts.
    clips : tuple of Clip
    materials : tuple of Material
        `mesh.face_materials` points into it.
    warnings : tuple of str
        Everything changed, dropped or approximated, one line each.
    """

    name: str
    source: Path
    source_hash: str
    mesh: SkinnedMesh
    skeleton: Skeleton
    clips: tuple[Clip, ...]
    materials: tuple[Material, ...]
    warnings: tuple[str, ...]
