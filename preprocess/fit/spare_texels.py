"""Canonical uvs for vertices that the position texture misses: places outside all charts, with a texel of their own.

Where more vertices meet in a 2 x 2 cell than it can tell apart, no texture of that size holds them all. But a vertex
need not fetch its geometry inside its chart: every copy of it fetches at its canonical uv (docs/method.md, section 6),
and any place that no triangle reads will do. So the few vertices that stay off are given free texels.

Letters in shapes: V vertices of a level, N parked points.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.decimate import Lod
from preprocess.mesh.texels import px_to_uv, sample_bilinear, snap_canonical_uvs, uv_to_px
from preprocess.settings import PARK_REL
from runtime.asset.texel_footprint import touched_cells

log = logging.getLogger(__name__)

CURVE_BITS = 8  # places in a cell of the weight map that can be told apart, an axis
LEVEL_SHARE = 0.1  # of a coarser level's error that its vertices may be off
UNLIKE = 0.03  # weights of vertices so far apart are not one
STORED_STEPS = 4  # each leaves a few thousandths of the error: 16-bit uvs miss the texel's centre by so much


def free_texels(lods: Sequence[Lod], size: tuple[int, int], weight_size: tuple[int, int]) -> NDArray[np.int64]:
    """Column and row of the texels that no triangle of any level reads, (N, 2), in the order they should be taken.

    Cell by cell of the weight map, the emptiest first, and quarter by quarter in each: what is parked in one square
    may share its weights. The map clamps beyond its outermost cells, so what lies there is left.
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
    places = uv_to_px(px_to_uv(np.stack([column, row], axis=1).astype(np.float64), width, height), *weight_size)
    inside = ((places >= 0.5) & (places <= np.array(weight_size) - 1.5)).all(axis=1)
    row, column, places = row[inside], column[inside], places[inside]
    cell = places.astype(np.int64)
    _, cell_of, in_cell = np.unique(cell[:, 1] * weight_size[0] + cell[:, 0], return_inverse=True, return_counts=True)
    order = np.lexsort((_along_curve(places - cell), cell_of.ravel(), -in_cell[cell_of.ravel()]))
    return np.stack([column[order], row[order]], axis=1)


def _along_curve(fractions: Floats) -> NDArray[np.int64]:
    """Number of each place in a square, (N, 2) in [0, 1), along a Z-curve: quarter by quarter, to `CURVE_BITS`."""
    steps = (fractions * 2**CURVE_BITS).astype(np.int64)
    code = np.zeros(len(steps), np.int64)
    for bit in range(CURVE_BITS):
        code |= ((steps[:, 0] >> bit & 1) << 2 * bit) | ((steps[:, 1] >> bit & 1) << 2 * bit + 1)
    return code


def _alike_together(weights: Floats) -> NDArray[np.intp]:
    """An order of points, (N,), by their joint weights (N, J): those that follow each other move nearly alike."""
    rows = np.arange(len(weights))
    first = weights.argmax(axis=1) if weights.size else np.zeros(len(weights), np.intp)
    others = weights.copy()
    others[rows, first] = 0.0
    second = others.argmax(axis=1) if weights.size else first
    return np.lexsort((-weights[rows, first], second, first))


def lie_beyond(uvs: Floats, weights: Floats, weight_size: tuple[int, int]) -> NDArray[np.bool_]:
    """Points that the weight map cannot hold, (N,) bool: beyond its outermost texels, in a cell of unlike weights.

    Parameters
    ----------
    uvs : (N, 2) float64
    weights : (N, J) float64
    weight_size : (width, height)
    """
    last = np.array(weight_size) - 1
    px = uv_to_px(uvs, *weight_size)
    beyond = np.asarray(((px < 0.0) | (px > last)).any(axis=1), np.bool_)
    if not beyond.any():
        return beyond
    cell = np.clip(px.astype(np.int64), 0, np.maximum(last - 1, 0)) @ (1, weight_size[0])
    order = np.argsort(cell, kind="stable")
    firsts = np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0])
    spread = np.maximum.reduceat(weights[order], firsts) - np.minimum.reduceat(weights[order], firsts)
    unlike = np.empty(len(uvs), np.bool_)
    unlike[order] = np.repeat(spread.max(axis=1) > UNLIKE, np.diff(np.r_[firsts, len(uvs)]))
    return np.logical_and(beyond, unlike)


def park_vertices(
    texels: NDArray[np.float32],
    lods: Sequence[Lod],
    full_positions: Floats,
    diagonal_m: float,
    weights: Sequence[Floats],
    weight_size: tuple[int, int],
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
    weights : sequence of (V, J) float64
        Joint weights of every level's vertices: those that are alike are parked together.
    weight_size : (width, height)
        Texels of the weight map.

    Returns
    -------
    texels : (H, W, 3) float32
    lods : tuple of Lod
        With `fetch_uvs`, and the positions that are drawn; a level's error grows by what it is off now, a bound.
    """
    height, width = texels.shape[:2]
    wanted = [full_positions, *(lod.positions for lod in lods[1:])]
    allowed = [PARK_REL, *(max(PARK_REL, LEVEL_SHARE * lod.error_m / diagonal_m) for lod in lods[1:])]
    places = [_distinct(snap_canonical_uvs(own), own) for own in (lod.uvs[lod.canonical_uvs] for lod in lods)]
    rows = [np.c_[uvs, positions] for uvs, positions in zip(places, wanted)]
    points, first, point_of = np.unique(np.concatenate(rows), axis=0, return_index=True, return_inverse=True)
    uvs, positions = points[:, :2], points[:, 2:]
    allowed_rel = np.full(len(points), np.inf)
    np.minimum.at(allowed_rel, point_of.ravel(), np.repeat(allowed, [len(part) for part in wanted]))
    of_points = np.concatenate(weights)[first]
    off_rel = np.linalg.norm(sample_bilinear(texels, uvs) - positions, axis=1) / max(diagonal_m, 1e-30)
    beyond = lie_beyond(uvs, of_points, weight_size)
    off_rel += np.where(beyond, 1.01 * allowed_rel, 0.0)
    off = np.flatnonzero(off_rel > allowed_rel)
    of_finest = np.isin(np.arange(len(points)), point_of.ravel()[: len(wanted[0])])
    # Room may be short. No details help what lies beyond the map, and in poses wrong weights move it furthest.
    off = off[np.lexsort((-off_rel[off] / allowed_rel[off], ~beyond[off], ~of_finest[off]))]
    free = free_texels(lods, (width, height), weight_size)[: len(off)]
    parked = off[: len(free)]
    parked = parked[_alike_together(of_points[parked])]
    log.info("%d of %d points miss, %d of these have a texel of their own", len(off), len(points), len(parked))
    uvs[parked] = snap_canonical_uvs(px_to_uv(free.astype(np.float64), width, height))
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
