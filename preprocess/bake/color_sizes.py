"""Automatic sizes of colour textures: the source's texel density, within bounds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from preprocess.arrays import Floats
from preprocess.mesh.surface import SkinnedMesh

if TYPE_CHECKING:
    from preprocess.load import TextureRef

MIN_SIZE_PX, MAX_SIZE_PX = 512, 4096  # of an automatic size; borders between flat colours need some texels too
MOST_GROWTH = 4.0  # texels of a resampled texture, for each that the surface has in the source


def resampled_size(mesh: SkinnedMesh, refs: list[TextureRef | None], resampled: bool) -> tuple[int, int]:
    """Side of a square texture, and that in which most of the surface keeps the source's texel density.

    Both are powers of two. They differ where the atlas is mostly empty, as with thousands of charts, or beyond the
    largest automatic size.
    """
    surface = mesh.surface
    atlas_area = _areas(surface.uvs[surface.face_uvs])
    wanted = np.zeros(mesh.num_faces)
    for index, ref in enumerate(refs):
        if ref is None:
            continue
        faces = (mesh.face_materials == index) & mesh.has_texcoords(ref.texcoord)
        if not faces.any():
            continue
        height, width = ref.image.texels.shape[:2]
        wanted[faces] = _areas(transformed(mesh.corner_texcoords[faces][:, :, ref.texcoord], ref)) * width * height
    used = atlas_area > 0
    if not used.any() or not wanted.any():
        least = MIN_SIZE_PX * 2 if resampled else MIN_SIZE_PX
        return least, least
    density = np.sqrt(wanted[used] / atlas_area[used])
    order = np.argsort(density)
    share = np.cumsum(atlas_area[used][order])
    side = float(density[order][np.searchsorted(share, 0.75 * share[-1])])
    most = min(_power_of_two(math.sqrt(MOST_GROWTH * wanted.sum())), MAX_SIZE_PX)
    full = _power_of_two(side)
    return max(min(full, most), MIN_SIZE_PX), max(full, MIN_SIZE_PX)


def _power_of_two(side: float) -> int:
    return int(2 ** math.ceil(math.log2(max(side, 1.0)) - 0.25))


def _areas(corners: Floats) -> Floats:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def transformed(uvs: Floats, ref: TextureRef) -> Floats:
    """Source uvs as a texture's transform places them."""
    transform = np.asarray(ref.transform)
    return uvs @ transform[:2, :2].T + transform[:2, 2]
