"""Stage "uv steps": texture vertices at whole 65535ths of the atlas, so that a vertex's uv takes four bytes.

Textures are baked and their seams closed for the uvs that are stored, so nothing is lost by rounding these: a step is a
sixteenth of a texel at 4096 x 4096. Levels of detail are found with the uvs as they were, whose seams are straight to
the last bit, and rounded after: they stay as straight as half a step allows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.decimate import Lod
from preprocess.mesh.face_geometry import doubled_signed_areas
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import snap_canonical_uvs


def snap_mesh(mesh: SkinnedMesh) -> SkinnedMesh:
    """The mesh with its uvs in steps, or the very same where that would turn or flatten a face or join vertices.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    """
    surface = mesh.surface
    snapped = _snapped(surface.uvs, slice(None))
    if snapped is None:
        return mesh
    before, after = (_sides(uvs[surface.face_uvs]) for uvs in (surface.uvs, snapped))
    if not np.array_equal(before, after):
        return mesh
    return dataclasses.replace(mesh, surface=dataclasses.replace(surface, uvs=snapped))


def snap_levels(lods: Sequence[Lod]) -> tuple[Lod, ...]:
    """Levels with their uvs in steps, but for those where two vertices would fetch their geometry in one place.

    Parameters
    ----------
    lods : sequence of Lod
        Without `fetch_uvs` yet.
    """
    snapped = (_snapped(lod.uvs, lod.canonical_uvs) for lod in lods)
    return tuple(lod if uvs is None else dataclasses.replace(lod, uvs=uvs) for lod, uvs in zip(lods, snapped))


def _snapped(uvs: Floats, distinct: NDArray[np.integer] | slice) -> Floats | None:
    """The nearest steps, (T, 2); None where uvs leave the atlas, or different ones of some would be one."""
    if uvs.size == 0 or uvs.min() < 0.0 or uvs.max() > 1.0:
        return None
    snapped = snap_canonical_uvs(uvs)
    before, after = (len(np.unique(part[distinct], axis=0)) for part in (uvs, snapped))
    return snapped if before == after else None


def _sides(corners: Floats) -> NDArray[np.float64]:
    """Which way uv triangles (F, 3, 2) turn: 1, -1 or 0, (F,)."""
    return np.sign(doubled_signed_areas(corners))
