"""Hard edges inside charts: where each corner samples the normal texture (docs/method.md, section 3).

On both sides of a hard edge the surface has normals of its own. At a seam they lie apart in the atlas; inside a chart
they are next to each other, and a bilinear sample less than a texel from the edge reads both sides. So the normal
texture is sampled at uvs of its own: those of the atlas, but at the ends of a hard edge a corner moves to its own side,
just so far that no texel of the other is read. Between the two sides a gap opens, as between two charts. The texture
is baked over the moved triangles, so what a point reads is its own normal, not that of the place it moved from.

Words: a half-edge `3 f + k` runs from corner k of face f to the next. A fan is what corners around one texture vertex
make up together where no hard edge parts them: it moves as one, so smooth neighbours stay together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats, Indices, Ints
from preprocess.mesh.edges import next_corners, pair_inside_charts
from preprocess.mesh.face_geometry import doubled_signed_areas
from preprocess.mesh.grouping import connected_groups
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import px_to_uv, uv_to_px
from runtime.asset.lod_mesh import UV_STEPS

CREASE_RAD = np.radians(5.0)  # neighbours' normals at a shared corner that differ by more are meant to
# A bilinear sample reaches |x| + |y| texels across an edge whose unit normal is (x, y). A little more covers the
# rounding of stored uvs.
INSET = 1.02
MAX_MOVE_PX = 6.0  # where two hard edges meet in a sharp angle, their insets cross far away
# A moved triangle keeps this share of its area: strips thinner than three texels move less.
LEAST_AREA_REL = 0.2
SHORTEN, SHORTEST = 0.8, 0.02  # steps of moving less, and when to give up moving
STIFFNESS = 1e-3  # against squared sines: opposite hard edges, as at the end of one, leave their fan where it is


@dataclass(frozen=True)
class NormalUvs:
    """Where the corners of a mesh sample the normal texture. N normal uvs, F faces.

    Attributes
    ----------
    uvs : (N, 2) float64
        Whole steps of the atlas, as they are stored (`UV_STEPS`): the texture is made for these.
    face_uvs : (F, 3) int32, into uvs
    hard : (F, 3) bool
        Half-edges inside charts that are hard at their start.
    """

    uvs: Floats
    face_uvs: Ints
    hard: Bools

    @property
    def corners(self) -> Floats:
        """The uv of every corner, (F, 3, 2)."""
        return self.uvs[self.face_uvs]


def find_hard_starts(corner_normals: Floats, twins: Indices, crease_rad: float = CREASE_RAD) -> Bools:
    """Half-edges at whose start the two faces have different normals, (3 F,) bool; none on outlines.

    Parameters
    ----------
    corner_normals : (F, 3, 3) float64
        Unit normals.
    twins : (3 F,) int64
    crease_rad : float
        Angle above which normals differ.
    """
    normals = corner_normals.reshape(-1, 3)
    across = next_corners(twins)  # the corner of the other face at the same vertex
    gap = np.linalg.norm(normals - normals[across], axis=1)
    result: Bools = (twins >= 0) & (gap > 2 * np.sin(crease_rad / 2))
    return result


def _wanted_moves(fans: Indices, num_fans: int, hard: Bools, twins: Indices, corners_px: Floats) -> Floats:
    """How far each fan should move, texels, (G, 2): to the inset lines of its hard edges, in least squares."""
    following = next_corners(np.arange(len(corners_px)))
    along = corners_px[following] - corners_px
    length = np.linalg.norm(along, axis=1)
    triangles = corners_px.reshape(-1, 3, 2)
    sides = np.repeat(np.sign(doubled_signed_areas(triangles)), 3)
    inwards = np.stack([-along[:, 1], along[:, 0]], axis=1) * (sides / np.maximum(length, 1e-12))[:, None]
    starts = np.flatnonzero(hard & (length > 0))
    ends = np.flatnonzero((twins >= 0) & hard[twins] & (length > 0))
    edges = np.r_[starts, ends]
    fan = fans[np.r_[starts, following[ends]]]
    normal = inwards[edges]
    distance = INSET * np.abs(normal).sum(axis=1)

    def add_up(values: Floats) -> Floats:
        return np.bincount(fan, values, num_fans).astype(np.float64)

    xx, yy = (add_up(normal[:, axis] ** 2) + STIFFNESS for axis in range(2))
    xy = add_up(normal[:, 0] * normal[:, 1])
    x, y = (add_up(normal[:, axis] * distance) for axis in range(2))
    moves = np.stack([yy * x - xy * y, xx * y - xy * x], axis=1) / (xx * yy - xy * xy)[:, None]
    size = np.linalg.norm(moves, axis=1, keepdims=True)
    result: Floats = moves * np.minimum(1.0, MAX_MOVE_PX / np.maximum(size, MAX_MOVE_PX))
    return result


def _shorten(moves: Floats, face_fans: Indices, triangles_px: Floats) -> Floats:
    """Moves of which no triangle turns over or loses most of its area."""
    before = doubled_signed_areas(triangles_px)
    shares = np.ones(len(moves))
    while True:
        after = doubled_signed_areas(triangles_px + (moves * shares[:, None])[face_fans])
        crushed = after * np.sign(before) < LEAST_AREA_REL * np.abs(before)
        if not crushed.any():
            return moves * shares[:, None]
        fans = np.unique(face_fans[crushed])
        shares[fans] = np.where(shares[fans] > SHORTEST, shares[fans] * SHORTEN, 0.0)


def move_from_creases(surface: TexturedSurface, twins: Indices, hard: Bools, size_px: tuple[int, int]) -> NormalUvs:
    """Normal uvs of a mesh whose hard half-edges are known.

    Parameters
    ----------
    surface : TexturedSurface
    twins : (3 F,) int64
        `pair_inside_charts(surface)`.
    hard : (3 F,) bool
        Half-edges inside charts that are hard at their start.
    size_px : (width, height)
        Of the normal texture.

    Returns
    -------
    NormalUvs
    """
    linked = np.flatnonzero((twins >= 0) & ~hard)
    num_fans, fans = connected_groups(surface.faces.size, linked, next_corners(twins[linked]))
    corners_px = uv_to_px(surface.uvs, *size_px)[surface.face_uvs.reshape(-1)]
    moves = _wanted_moves(fans, num_fans, hard, twins, corners_px)
    moves = _shorten(moves, fans.reshape(-1, 3), corners_px.reshape(-1, 3, 2))
    places_px = np.zeros((num_fans, 2))
    places_px[fans] = corners_px
    uvs = np.clip(px_to_uv(places_px + moves, *size_px), 0.0, 1.0)
    return NormalUvs(np.rint(uvs * UV_STEPS) / UV_STEPS, fans.reshape(-1, 3).astype(np.int32), hard.reshape(-1, 3))


def bake_surface(surface: TexturedSurface, normal: NormalUvs) -> TexturedSurface:
    """The surface in the atlas of its normal uvs."""
    return replace(surface, uvs=normal.uvs, face_uvs=normal.face_uvs)


def erase_surface(surface: TexturedSurface, normal: NormalUvs) -> TexturedSurface:
    """The same for seam erasure, whose texels inside charts hold their values: the gaps must count as inside too.

    The faces come twice, first at their normal uvs, then where they lie in the atlas, which covers the gaps.
    """
    return TexturedSurface(
        surface.positions,
        np.concatenate([surface.faces, surface.faces]),
        np.concatenate([normal.uvs, surface.uvs]),
        np.concatenate([normal.face_uvs, surface.face_uvs + np.int32(len(normal.uvs))]),
    )


def move_seams(seams: Seams, surface: TexturedSurface, normal: NormalUvs) -> Seams:
    """The atlas's seams and outlines, seen at normal uvs.

    Parameters
    ----------
    seams : Seams
        Of `surface`.
    surface : TexturedSurface
    normal : NormalUvs
    """

    def at(faces: NDArray[np.integer], texture_vertices: NDArray[np.integer]) -> NDArray[np.int32]:
        corner = (surface.face_uvs[faces] == texture_vertices[..., None]).argmax(axis=-1)
        result: NDArray[np.int32] = normal.face_uvs[faces, corner]
        return result

    some_corner = np.zeros(len(surface.uvs), np.int32)
    some_corner[surface.face_uvs.reshape(-1)] = normal.face_uvs.reshape(-1)
    return replace(
        seams,
        uv_pairs=at(seams.faces[:, :, None], seams.uv_pairs),
        boundary_uvs=at(seams.boundary_faces[:, None], seams.boundary_uvs),
        foldover_uvs=some_corner[seams.foldover_uvs],
    )


def find_normal_uvs(
    mesh: SkinnedMesh, size_px: tuple[int, int], borders: Bools | None = None, crease_rad: float = CREASE_RAD
) -> NormalUvs | None:
    """Where a character's corners sample its normal texture.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    size_px : (width, height)
        Of the normal texture.
    borders : (3 F,) bool, optional
        Half-edges that count as hard at their start as well: colours differ across them.
    crease_rad : float

    Returns
    -------
    NormalUvs or None
        None where no chart has a hard edge inside: the atlas's own uvs serve.
    """
    twins = pair_inside_charts(mesh.surface)
    hard = find_hard_starts(mesh.corner_normals, twins, crease_rad)
    if borders is not None:
        hard |= borders & (twins >= 0)
    return move_from_creases(mesh.surface, twins, hard, size_px) if hard.any() else None
