"""Sides of colour textures that no source image sets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from preprocess.arrays import Floats
from preprocess.mesh.surface import SkinnedMesh

if TYPE_CHECKING:
    from preprocess.load import TextureRef

PLAIN_SIZE_PX = 512  # of flat colours: borders between them need some texels too
PAINTED_SIZE_PX = 1024  # of colours that vertices give


def color_side(mesh: SkinnedMesh, kind: str, sides: Mapping[str, int]) -> int:
    """Side of a square texture: what its images need (`Atlas.sides`), or a plain one's."""
    return sides.get(kind) or (PLAIN_SIZE_PX if mesh.corner_colors is None else PAINTED_SIZE_PX)


def transformed(uvs: Floats, ref: TextureRef) -> Floats:
    """Source uvs as a texture's transform places them."""
    transform = np.asarray(ref.transform)
    return uvs @ transform[:2, :2].T + transform[:2, 2]
