"""Morph targets as displacement maps: texels such that every vertex of every level moves as the file says.

A target is baked as positions are: the surface's value under each texel, then texels changed as little as possible so
that bilinear samples at the vertices' fetch uvs are exact. All copies of a vertex fetch at one place, so a morphed
surface is as watertight as it is at rest; seams between vertices need no erasing for that. What a target does not
touch is not stored (runtime/asset/morphs.py).
Letters in shapes: V vertices of the full mesh, N points.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from preprocess.arrays import Floats
from preprocess.bake.geometry import plan_fit
from preprocess.decimate import Lod
from preprocess.mesh.raster import clamp_extrapolation, cover_atlas
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import snap_canonical_uvs
from runtime.asset.morphs import Morphs, MorphTarget, pack_morphs, unpack_morphs
from runtime.asset.texel_footprint import touched_cells

log = logging.getLogger(__name__)

# What exact samples at touched vertices stir up further away, falling off with every texel, is left out below this.
LEAST_SHIFT_REL = 1e-5  # of the diagonal: a twentieth of the accuracy goal
LEAST_TURN = 2e-3  # an eighth of a degree


def _texels_read(lods: Sequence[Lod], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Texels that any level's vertex or triangle reads, (H, W) bool."""
    cells = np.zeros((max(size[1] - 1, 1), max(size[0] - 1, 1)), bool)
    for lod in lods:
        cells |= touched_cells(lod.uvs, lod.face_uvs, size)
        fetched = lod.uvs[lod.canonical_uvs] if lod.fetch_uvs is None else lod.fetch_uvs
        cells |= touched_cells(fetched, np.repeat(np.arange(len(fetched))[:, None], 3, axis=1), size)
    read = np.zeros((size[1], size[0]), bool)
    for row in range(min(2, size[1])):
        for column in range(min(2, size[0])):
            read[row : row + cells.shape[0], column : column + cells.shape[1]] |= cells
    return read


def _surface_under(mesh: SkinnedMesh, size: tuple[int, int]) -> tuple[NDArray[np.int64], Floats]:
    """Corners (H, W, 3) and barycentrics (H, W, 3) of the face under each texel, or of the nearest that has one."""
    coverage = cover_atlas(mesh, *size)
    near = coverage.faces >= 0
    rows, columns = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
    shares = np.zeros((*near.shape, 3))
    shares[near] = clamp_extrapolation(coverage.barycentrics[near])
    return mesh.surface.faces[coverage.faces[rows, columns]].astype(np.int64), shares[rows, columns]


def store_morphs(
    mesh: SkinnedMesh,
    lods: Sequence[Lod],
    vertices: Sequence[tuple[NDArray[np.int64], Floats]],
    size: tuple[int, int],
) -> Morphs | None:
    """The mesh's morphs as maps over the position texture, as they are stored; None where it has none.

    Parameters
    ----------
    mesh : SkinnedMesh
        The full mesh with the atlas as its uvs.
    lods : sequence of Lod
        With `fetch_uvs`.
    vertices : sequence of ((N, 3) int64, (N, 3) float64)
        Where on the full mesh each level's vertices lie: corners of a face, and barycentrics.
    size : (width, height)
        Of the position texture.
    """
    if not mesh.morphs:
        return None
    surface, (width, height) = mesh.surface, size
    own = np.zeros(len(surface.uvs), np.int64)
    own[surface.face_uvs.ravel()] = surface.faces.ravel()
    points = [lod.uvs[lod.canonical_uvs] if lod.fetch_uvs is None else lod.fetch_uvs for lod in lods]
    uvs, first = np.unique(np.concatenate([*points, snap_canonical_uvs(surface.uvs)]), axis=0, return_index=True)
    alone = np.tile((1.0, 0.0, 0.0), (len(own), 1))
    corners = np.concatenate([*(at for at, _ in vertices), own[:, None].repeat(3, axis=1)])[first]
    shares = np.concatenate([*(share for _, share in vertices), alone])[first]
    fit = plan_fit(uvs, width, height)
    under, under_shares = _surface_under(mesh, size)
    read = _texels_read(lods, size).ravel()
    targets, missed = [], 0.0
    for morph in mesh.morphs:
        dense = morph.dense_rows(mesh.num_vertices)
        wanted = sum(shares[:, k, None] * dense[corners[:, k]] for k in range(3))
        texels = sum(under_shares[..., k, None] * dense[under[..., k]] for k in range(3))
        rows = fit(np.asarray(texels), np.asarray(wanted)).reshape(-1, 3, 4)
        moves = np.abs(rows[..., 3]).max(axis=1) > LEAST_SHIFT_REL * surface.diagonal_m
        kept = np.flatnonzero(read & (moves | (np.abs(rows[..., :3]).max(axis=(1, 2)) > LEAST_TURN)))
        targets.append(MorphTarget(morph.name, morph.default, kept, rows[kept].astype(np.float32)))
    image, entries = pack_morphs(targets)
    stored = Morphs(unpack_morphs(image, entries, width * height, "morphs"), size)
    for number, morph in enumerate(mesh.morphs):
        shifts = morph.dense_shifts(mesh.num_vertices)
        drawn = stored.rows_at(number, points[0])[..., 3]
        at, share = vertices[0]
        missed = max(missed, float(np.linalg.norm(drawn - np.einsum("nk,nkc->nc", share, shifts[at]), axis=1).max()))
    log.info(
        "morphs: %d, %d of %d texels touched, %d in all; off by %.2g m at most",
        len(targets),
        len(stored.texels),
        width * height,
        sum(len(target.texels) for target in stored.targets),
        missed,
    )
    return stored
