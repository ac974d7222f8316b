"""The source's charts, and which of them are sound: one-to-one within themselves, neither flat nor crushed.

A sound chart is kept whatever the others are like; where it lies, and whether it lies on others, is for packing. A few
faces that overlap within a chart are taken out of it. A connected part that is mostly unsound is unwrapped as a whole:
what is left of the artist's layout there would be shreds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from preprocess.arrays import Bools, Floats, Indices, Ints
from preprocess.atlas.distortion import overlapping_faces, singular_values, turned_areas
from preprocess.atlas.flatten import flatten_free
from preprocess.mesh.edges import find_edges, label_faces
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.surface import TexturedSurface

MOST_STRETCH, LEAST_DENSITY = 4.0, 0.25
"""A face stretched more than this, or with a smaller share of its chart's texels a metre, is crushed."""

CRUSHED_SHARE = 0.01
"""Of a chart's area that may be crushed: artists squeeze what is seldom seen, like the inside of a mouth."""

OVERLAPPING_SHARE = 0.02
"""Of a chart's area up to which overlapping faces are taken out of it."""

RELAX_STEPS = 10

SOUND_SHARE = 0.5
"""Of a connected part's area that has to be sound for any of its charts to be kept."""


def find_charts(surface: TexturedSurface, groups: NDArray[np.integer] | None = None) -> Indices:
    """Charts: faces that meet at uv edges without folding over, (F,) int64, numbered in the order of their first face.

    Faces that share a texture vertex alone, or lie on the same side of a shared uv edge (a mirrored half), belong to
    different charts, and so do those of different groups (F,). A face without area is a chart of its own.
    """
    corners, uv_corners = surface.faces.astype(np.int64), surface.face_uvs.astype(np.int64)
    sign = face_orientation(surface.uvs, surface.face_uvs).astype(np.int64)
    tips = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    ends = np.sort(np.stack([uv_corners, np.roll(uv_corners, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    keys = np.concatenate([ends, tips], axis=1)
    order = np.lexsort(keys.T[::-1])
    same = np.flatnonzero((keys[order][1:] == keys[order][:-1]).all(axis=1))
    left, right = order[same] // 3, order[same + 1] // 3
    joined = sign[left] * sign[right] > 0
    if groups is not None:
        joined &= groups[left] == groups[right]
    left, right = left[joined], right[joined]
    links = coo_array((np.ones(len(left), np.int8), (left, right)), (len(corners),) * 2)
    return _number_anew(connected_components(links, directed=False)[1])


def find_sound_charts(surface: TexturedSurface, flat: Floats, texels: Floats) -> Indices:
    """Charts that can be kept, (F,) int64; -1 for faces that have to be unwrapped.

    Parameters
    ----------
    surface : TexturedSurface
        With the source's uvs.
    flat : (F, 3, 2) float64
        `local_triangles` of it.
    texels : (F, 2) float64
        Width and height of the image that a face's uvs point into.
    """
    charts = np.full(len(surface.faces), -1, np.int64)
    if not len(surface.uvs):
        return charts
    usable: Bools = np.asarray(np.isfinite(surface.uvs[surface.face_uvs]).all(axis=(1, 2)))
    usable &= face_orientation(np.nan_to_num(surface.uvs, posinf=0.0, neginf=0.0), surface.face_uvs) != 0
    corners = surface.uvs[surface.face_uvs] * texels[:, None]
    groups = np.unique(texels, axis=0, return_inverse=True)[1].reshape(-1)
    areas = turned_areas(flat)
    found = rows = np.zeros(0, np.int64)
    for _ in range(3):  # again without the faces that overlap others: what is left may have come apart
        usable &= ~in_parts_with_little(surface.faces, areas, usable)
        rows = np.flatnonzero(usable)
        if not len(rows):
            return charts
        part = TexturedSurface(surface.positions, surface.faces[rows], surface.uvs, surface.face_uvs[rows])
        found = find_charts(part, groups[rows])
        bad = _find_unsound(corners[rows], flat[rows], areas[rows], found)
        if not bad.any():
            break
        usable[rows[bad]] = False
    charts[usable] = _number_anew(found[usable[rows]]) if usable.any() else -1
    return charts


def _find_unsound(corners: Floats, flat: Floats, areas: Floats, charts: Indices) -> Bools:
    """Faces that cannot stay, (F,) bool: those of unsound charts and those that overlap others within sound ones."""
    num_charts = int(charts.max()) + 1
    chart_areas = np.bincount(charts, areas, num_charts)
    scale = np.sqrt(np.bincount(charts, np.abs(turned_areas(corners)), num_charts) / chart_areas)[charts]
    crushed = _are_crushed(corners, flat, scale)
    unsound = np.bincount(charts, areas * crushed, num_charts) > CRUSHED_SHARE * chart_areas
    overlapping = overlapping_faces(corners, charts, num_charts)
    unsound |= np.bincount(charts, areas * overlapping, num_charts) > OVERLAPPING_SHARE * chart_areas
    return unsound[charts] | overlapping


def relax_crushed_charts(
    uvs: Floats, face_uvs: Ints, flat: Floats, charts: Indices, areas: Floats, seen_area: float
) -> Floats:
    """Let charts with crushed faces that can be seen find the shape that suits them all, where it is one-to-one.

    Parameters
    ----------
    uvs : (T, 2) float64
        At the surface's scale.
    face_uvs : (F, 3) int32
    flat : (F, 3, 2) float64
    charts : (F,) int64
        From 0 on; each with texture vertices of its own.
    areas : (F,) float64
    seen_area : float
        Of the smallest faces that can be seen.

    Returns
    -------
    (T, 2) float64
    """
    num_charts = int(charts.max()) + 1
    crushed = _are_crushed(uvs[face_uvs], flat, np.ones(len(flat))) & (areas > seen_area)
    rows = np.flatnonzero(np.bincount(charts[crushed], minlength=num_charts)[charts])
    if not len(rows):
        return uvs
    ids, local = np.unique(face_uvs[rows], return_inverse=True)
    local = local.reshape(-1, 3).astype(np.int32)
    start = uvs[ids].copy()
    clockwise = np.bincount(charts[rows], turned_areas(start[local]), num_charts) < 0
    start[np.unique(local[clockwise[charts[rows]]]), 0] *= -1.0
    number = np.unique(charts[rows], return_inverse=True)[1].reshape(-1)
    relaxed = flatten_free(start, flat[rows], local, number, RELAX_STEPS)
    corners = relaxed[local]
    wrong = _are_crushed(corners, flat[rows], np.ones(len(rows))) & (areas[rows] > seen_area)
    wrong |= turned_areas(corners) <= 0
    wrong |= overlapping_faces(corners, number, int(number.max()) + 1)
    good = (np.bincount(number[wrong], minlength=int(number.max()) + 1) == 0)[number]
    result = uvs.copy()
    result[ids[local[good]]] = relaxed[local[good]]
    return result


def _are_crushed(corners: Floats, flat: Floats, scale: Floats) -> Bools:
    """Faces that are stretched too far or have few texels at a chart's scale (F,), (F,) bool."""
    largest, smallest = singular_values(flat, corners)
    return (largest > MOST_STRETCH * smallest) | (largest * smallest < (LEAST_DENSITY * scale) ** 2)


def in_parts_with_little(faces: Ints, areas: Floats, good: Bools) -> Bools:
    """Faces of connected parts of which less than `SOUND_SHARE` is good, (F,) bool."""
    edges = find_edges(faces)
    num_parts, parts = label_faces(edges, ~edges.glued)
    sound = np.bincount(parts, areas * good, num_parts)
    return np.asarray(sound < SOUND_SHARE * np.bincount(parts, areas, num_parts))[parts]


def _number_anew(labels: NDArray[np.integer]) -> Indices:
    """The same classes numbered in the order of their first members."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    result: Indices = rank[inverse.reshape(-1)]
    return result
