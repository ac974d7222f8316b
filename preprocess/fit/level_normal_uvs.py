"""Hard edges of coarser levels: which of a level's edges run along those of the full mesh (see bake/hard_edges.py).

A level whose faces are all the full mesh's own takes its normal uvs. Of another, an edge is hard where it lies on hard
edges of the full mesh from end to end. Only levels that may be drawn with the normal texture's texels a pixel or more
in size need it: on others a texel beside the edge cannot be seen.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from preprocess.arrays import Bools, Floats, Indices
from preprocess.bake.hard_edges import NormalUvs, move_from_creases
from preprocess.decimate.levels import Lod
from preprocess.mesh.edges import next_corners, pair_inside_charts
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.grouping import expand_ranges
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import uv_to_px

MAX_ERROR_TEXELS = 1.0  # levels with a larger error are drawn where a texel is less than a pixel
NEAR_PX = 0.3  # an edge this close to a hard one lies on it
STEP_PX = 0.25  # between the points that stand for a hard edge
PROBES = 8  # points of an edge that must all lie on hard edges
PARALLEL = 0.9  # cosine of the angle between the two


def find_level_normal_uvs(
    surface: TexturedSurface, normal: NormalUvs, lod: Lod, size_px: tuple[int, int]
) -> Floats | None:
    """Where the corners of a level sample the normal texture.

    Parameters
    ----------
    surface : TexturedSurface
        The full mesh.
    normal : NormalUvs
        Of the full mesh.
    lod : Lod
        Over the same atlas.
    size_px : (width, height)
        Of the normal texture.

    Returns
    -------
    (F, 3, 2) float64 or None
        None where the atlas's own uvs serve.
    """
    intact = _corners_of_intact(surface, normal, lod)
    if intact is not None:
        return intact
    if lod.error_m > MAX_ERROR_TEXELS * _texel_length_m(surface, size_px):
        return None
    level = lod.surface
    twins = pair_inside_charts(level)
    hard = find_hard_edges(level, twins, crease_lines_px(surface, normal, size_px), size_px)
    return move_from_creases(level, twins, hard, size_px).corners if hard.any() else None


def _corners_of_intact(surface: TexturedSurface, normal: NormalUvs, lod: Lod) -> Floats | None:
    """Normal uvs of a level that has only faces of the full mesh, whichever corner they start from."""
    corners = lod.uvs[lod.face_uvs]
    sources = surface.face_uvs[lod.face_source]
    for start in range(3):
        order = np.roll(np.arange(3), -start)
        if np.array_equal(corners, surface.uvs[sources[:, order]]):
            return normal.corners[lod.face_source][:, order]
    return None


def _texel_length_m(surface: TexturedSurface, size_px: tuple[int, int]) -> float:
    """Mean side of the surface under a texel, metres."""
    area_m2 = face_areas(surface.positions[surface.faces]).sum()
    texels = face_areas(uv_to_px(surface.uvs, *size_px)[surface.face_uvs]).sum()
    return float(np.sqrt(area_m2 / max(texels, 1e-30)))


def crease_lines_px(surface: TexturedSurface, normal: NormalUvs, size_px: tuple[int, int]) -> Floats:
    """The full mesh's hard half-edges as lines in texels, (E, 2, 2)."""
    corners = uv_to_px(surface.uvs, *size_px)[surface.face_uvs.reshape(-1)]
    starts = np.flatnonzero(normal.hard)
    return np.stack([corners[starts], corners[next_corners(starts)]], axis=1)


def find_hard_edges(level: TexturedSurface, twins: Indices, lines_px: Floats, size_px: tuple[int, int]) -> Bools:
    """Half-edges of a level that lie on hard lines from end to end, (3 F,) bool.

    Parameters
    ----------
    level : TexturedSurface
    twins : (3 F,) int64
        `pair_inside_charts(level)`.
    lines_px : (E, 2, 2) float64
        Hard lines, texels.
    size_px : (width, height)
    """
    along = lines_px[:, 1] - lines_px[:, 0]
    length = np.linalg.norm(along, axis=1)
    pieces = np.ceil(length / STEP_PX).astype(np.int64) + 1
    line, place = expand_ranges(np.zeros(len(pieces), np.int64), pieces)
    share = place / (pieces[line] - 1).clip(1)
    tree = cKDTree(lines_px[line, 0] + along[line] * share[:, None])

    hard = np.zeros(level.faces.size, bool)
    first = np.flatnonzero(twins > np.arange(len(twins)))  # one half of each edge
    corners = uv_to_px(level.uvs, *size_px)[level.face_uvs.reshape(-1)]
    origin, direction = corners[first], corners[next_corners(first)] - corners[first]
    shares = np.linspace(0.0, 1.0, PROBES)
    probes = origin[:, None] + direction[:, None] * shares[:, None]
    distance, nearest = tree.query(probes, distance_upper_bound=NEAR_PX)
    found = np.isfinite(distance)
    other = along[line[np.where(found, nearest, 0)]]
    scale = np.linalg.norm(direction, axis=1)[:, None] * np.linalg.norm(other, axis=2)
    cosine = np.abs(np.einsum("ec,epc->ep", direction, other)) / np.maximum(scale, 1e-12)
    # At the ends several lines meet, and any of them may be the nearest.
    parallel = cosine > PARALLEL
    parallel[:, [0, -1]] = True
    is_hard = (found & parallel).all(axis=1)
    hard[first[is_hard]] = hard[twins[first[is_hard]]] = True
    return hard
