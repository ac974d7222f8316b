"""Owner uvs for vertices that the position texture misses: places outside all charts, with a texel of their own.

Where more vertices meet in a 2 x 2 cell than it can tell apart, no texture of that size holds them all. But a vertex
need not fetch its geometry inside its chart: every copy of it fetches at its owner's uv (method, section 6), and any
place that no triangle reads will do. So the few vertices that stay off are given free texels.
Letters in shapes: V vertices of a level, N parked points.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from preprocess.decimate import Lod
from preprocess.mesh import Floats
from preprocess.settings import PARK_REL
from preprocess.texels import px_to_uv, sample_bilinear, snap_owner_uvs
from runtime.touched_cells import touched_cells

log = logging.getLogger(__name__)

BLOCK = 4  # free texels are taken from whole free squares first, so that parked points lie together
LEVEL_SHARE = 0.1  # of a coarser level's error that its vertices may be off
STORED_STEPS = 4  # each leaves a few thousandths of the error: 16-bit uvs miss the texel's centre by so much


def free_texels(lods: Sequence[Lod], size: tuple[int, int], margin_uv: float = 0.0) -> NDArray[np.int64]:
    """Column and row of the texels that no triangle of any level reads, (N, 2), in the order they should be taken.

    Those nearer to the edge than `margin_uv` are left: a coarser texture clamps there and cannot tell them apart.
    """
    width, height = size
    used = np.zeros((height, width), bool)
    for lod in lods:
        cells = touched_cells(lod.uvs, lod.face_uvs, size)
        rows, columns = cells.shape
        for y in range(min(2, height)):
            for x in range(min(2, width)):
                used[y : y + rows, x : x + columns] |= cells
    row, column = np.nonzero(~used)
    place = px_to_uv(np.stack([column, row], axis=1).astype(np.float64), width, height)
    inside = (np.minimum(place, 1.0 - place) >= margin_uv).all(axis=1)
    row, column = row[inside], column[inside]
    block = (row // BLOCK) * width + column // BLOCK
    _, block_of, in_block = np.unique(block, return_inverse=True, return_counts=True)
    order = np.lexsort((column, row, block, -in_block[block_of.ravel()]))
    return np.stack([column[order], row[order]], axis=1)


def park_vertices(
    texels: NDArray[np.float32], lods: Sequence[Lod], full_positions: Floats, diagonal_m: float, margin_uv: float
) -> tuple[NDArray[np.float32], tuple[Lod, ...]]:
    """Give every level the places where its vertices fetch their geometry, and those that are off a texel.

    Parameters
    ----------
    texels : (H, W, 3) float32
        Position texture, metres.
    lods : sequence of Lod
        The finest first, with the positions that their vertices should have.
    full_positions : (V, 3) float64
        Of the finest level's vertices, instead of what it says.
    diagonal_m : float
    margin_uv : float
        Width of the border where nothing is parked.

    Returns
    -------
    texels : (H, W, 3) float32
    lods : tuple of Lod
        With `fetch_uvs`, and the positions that are drawn; a level's error grows by what it is off now, a bound.
    """
    height, width = texels.shape[:2]
    wanted = [full_positions, *(lod.positions for lod in lods[1:])]
    allowed = [PARK_REL, *(max(PARK_REL, LEVEL_SHARE * lod.error_m / diagonal_m) for lod in lods[1:])]
    places = [_distinct(snap_owner_uvs(own), own) for own in (lod.uvs[lod.owner_uvs] for lod in lods)]
    rows = [np.c_[uvs, positions] for uvs, positions in zip(places, wanted)]
    points, point_of = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    uvs, positions = points[:, :2], points[:, 2:]
    allowed_rel = np.full(len(points), np.inf)
    np.minimum.at(allowed_rel, point_of.ravel(), np.repeat(allowed, [len(part) for part in wanted]))
    off_rel = np.linalg.norm(sample_bilinear(texels, uvs) - positions, axis=1) / max(diagonal_m, 1e-30)
    off = np.flatnonzero(off_rel > allowed_rel)
    off = off[np.argsort(-off_rel[off], kind="stable")]
    free = free_texels(lods, (width, height), margin_uv)[: len(off)]
    parked = off[: len(free)]
    log.info("%d of %d points parked, %d texels were free", len(parked), len(points), len(free))
    uvs[parked] = snap_owner_uvs(px_to_uv(free.astype(np.float64), width, height))
    exact = texels.astype(np.float64)
    for _ in range(STORED_STEPS):
        exact[free[:, 1], free[:, 0]] += positions[parked] - sample_bilinear(exact, uvs[parked])
    stored = exact.astype(np.float32)

    finished: list[Lod] = []
    ends = np.cumsum([len(part) for part in wanted])
    for lod, part, own_wanted in zip(lods, np.split(point_of.ravel(), ends[:-1]), wanted):
        drawn = sample_bilinear(stored, uvs[part])
        left_m = float(np.linalg.norm(drawn - own_wanted, axis=1).max(initial=0.0))
        error_m = max(lod.error_m + left_m, finished[-1].error_m) if finished else left_m
        finished.append(dataclasses.replace(lod, fetch_uvs=uvs[part], positions=drawn, error_m=error_m))
    return stored, tuple(finished)


def _distinct(snapped: Floats, uvs: Floats) -> Floats:
    """The snapped uvs, or the given ones where two vertices would come to lie in one place."""
    same = len(np.unique(snapped, axis=0)) < len(snapped)
    return uvs if same else snapped
