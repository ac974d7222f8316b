"""Seam edges, boundary edges and foldover edges of a textured surface (paper, section 3; docs/method.md, section 1).

- Seam edge: a 3D edge whose two half-edges have different uvs.
- Boundary edge: a 3D edge with one incident face.
- Foldover edge: a uv edge whose two faces lie on the same side of it.
- Silhouette: seams and boundaries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.errors import InputError
from preprocess.mesh.edges import group_half_edges, next_corners
from preprocess.mesh.surface import TexturedSurface


@dataclass(frozen=True)
class Seams:
    """Silhouette edges of a surface. S seam edges, B boundary edges, D foldover edges.

    Attributes
    ----------
    vertices : (S, 2) int32
        Surface vertices at γ = 0 and γ = 1 of each seam edge.
    uv_pairs : (S, 2, 2) int32
        Texture vertices, [seam, side, end]; both sides run from the same surface vertex to the same surface vertex.
    faces : (S, 2) int32
        The face on each side.
    lengths_m : (S,) float64
        3D lengths.
    boundary_vertices, boundary_uvs : (B, 2) int32
        Surface and texture vertices of the boundary edges, in their face's direction.
    boundary_faces : (B,) int32
    boundary_lengths_m : (B,) float64
    foldover_uvs : (D, 2) int32
        Texture vertices of the foldover edges.
    """

    vertices: Ints
    uv_pairs: NDArray[np.int32]
    faces: Ints
    lengths_m: Floats
    boundary_vertices: Ints
    boundary_uvs: Ints
    boundary_faces: Ints
    boundary_lengths_m: Floats
    foldover_uvs: Ints


def count_crowded_edges(surface: TexturedSurface) -> int:
    """Number of 3D edges with three or more faces."""
    groups = group_half_edges(surface.faces)
    return int((groups.real & (groups.count > 2)).sum())


def find_seams(surface: TexturedSurface, *, join_crowded: bool = False) -> Seams:
    """Pair the half-edges of every 3D edge and sort them into seams, boundaries and foldovers.

    Zero-length uv edges are kept (they carry no discontinuity). Edges that join a vertex to itself are ignored.

    Parameters
    ----------
    surface : TexturedSurface
    join_crowded : bool
        Where three or more faces meet at a 3D edge, pair its different uv edges one after the other: signals that
        agree across each pair agree across all.

    Raises
    ------
    InputError
        If a 3D edge has three or more faces, unless they are to be joined: such a mesh is split before it comes here.
    """
    groups = group_half_edges(surface.faces)
    start, end, count, real = groups.start, groups.end, groups.count, groups.real
    uv_start = surface.face_uvs.reshape(-1).astype(np.int64)
    uv_end = uv_start[next_corners(np.arange(len(uv_start)))]
    face = np.arange(len(start)) // 3
    crowded = real & (count > 2)
    if crowded.any() and not join_crowded:
        a = groups.order[groups.first[crowded][0]]
        raise InputError(
            f"{int(crowded.sum())} mesh edges have three or more faces (the first joins vertices "
            f"{min(start[a], end[a])} and {max(start[a], end[a])}): split them before finding seams"
        )

    one = groups.order[groups.first[real & (count == 1)]]
    left, right = groups.pairs(real & (count == 2))
    crowd = groups.order[np.repeat(crowded, count)]
    if len(crowd):
        runs_up = start[crowd] < end[crowd]
        at_low = np.where(runs_up, uv_start[crowd], uv_end[crowd])
        at_high = np.where(runs_up, uv_end[crowd], uv_start[crowd])
        crowd_order = np.lexsort((face[crowd], at_high, at_low, groups.edge[crowd]))
        crowd = crowd[crowd_order]
        one_edge = groups.edge[crowd[1:]] == groups.edge[crowd[:-1]]
        ends = np.stack([at_low[crowd_order], at_high[crowd_order]])
        differ = np.flatnonzero(one_edge & (ends[:, 1:] != ends[:, :-1]).any(axis=0))
        left, right = np.concatenate([left, crowd[differ]]), np.concatenate([right, crowd[differ + 1]])
    # Bring the right half-edge's uvs into the left one's direction.
    opposed = start[left] == end[right]
    right_uv_start = np.where(opposed, uv_end[right], uv_start[right])
    right_uv_end = np.where(opposed, uv_start[right], uv_end[right])
    is_seam = (uv_start[left] != right_uv_start) | (uv_end[left] != right_uv_end)

    s_left, s_right = left[is_seam], right[is_seam]
    vertices = np.stack([start[s_left], end[s_left]], axis=1)
    uv_pairs = np.stack(
        [
            np.stack([uv_start[s_left], uv_end[s_left]], axis=1),
            np.stack([right_uv_start[is_seam], right_uv_end[is_seam]], axis=1),
        ],
        axis=1,
    )
    positions = surface.positions
    return Seams(
        vertices=vertices.astype(np.int32),
        uv_pairs=uv_pairs.astype(np.int32),
        faces=np.stack([face[s_left], face[s_right]], axis=1).astype(np.int32),
        lengths_m=np.linalg.norm(positions[vertices[:, 1]] - positions[vertices[:, 0]], axis=1),
        boundary_vertices=np.stack([start[one], end[one]], axis=1).astype(np.int32),
        boundary_uvs=np.stack([uv_start[one], uv_end[one]], axis=1).astype(np.int32),
        boundary_faces=face[one].astype(np.int32),
        boundary_lengths_m=np.linalg.norm(positions[end[one]] - positions[start[one]], axis=1),
        foldover_uvs=_find_foldovers(surface, left[~is_seam], right[~is_seam], uv_start, uv_end, face),
    )


def pick_seams(seams: Seams, chosen: NDArray[np.bool_]) -> Seams:
    """Some of the seams, (S,) bool, as if there were no others and no outlines: what lies beyond these stays."""
    return Seams(
        seams.vertices[chosen],
        seams.uv_pairs[chosen],
        seams.faces[chosen],
        seams.lengths_m[chosen],
        seams.boundary_vertices[:0],
        seams.boundary_uvs[:0],
        seams.boundary_faces[:0],
        seams.boundary_lengths_m[:0],
        seams.foldover_uvs[:0],
    )


def _find_foldovers(
    surface: TexturedSurface,
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    uv_start: NDArray[np.int64],
    uv_end: NDArray[np.int64],
    face: NDArray[np.int64],
) -> Ints:
    """Interior edges whose two uv triangles lie on the same side, (D, 2) texture vertices."""

    def side(half: NDArray[np.int64], origin: NDArray[np.int64], tip: NDArray[np.int64]) -> Floats:
        corners = surface.face_uvs[face[half]]
        opposite = corners.sum(axis=1) - uv_start[half] - uv_end[half]
        d = surface.uvs[tip] - surface.uvs[origin]
        e = surface.uvs[opposite] - surface.uvs[origin]
        result: Floats = d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0]
        return result

    origin, tip = uv_start[left], uv_end[left]
    folded = side(left, origin, tip) * side(right, origin, tip) > 0
    return np.stack([origin[folded], tip[folded]], axis=1).astype(np.int32)


STEPS_OF_UV = 4 * 65535  # to which uvs are rounded when seams are put in order: finer than they are stored


def seam_order(surface: TexturedSurface, seams: Seams) -> NDArray[np.int64]:
    """The seams in an order that depends on where they lie in the atlas alone, (S,).

    Whoever finds the same seams anew, from a file whose faces and vertices have other numbers, puts them in the same
    order.
    """
    steps = np.rint(surface.uvs[seams.uv_pairs] * STEPS_OF_UV).astype(np.int64)
    keys = (steps[..., 0] << 32) + steps[..., 1]  # seam, side, end
    keys = np.sort(keys, axis=2)
    swapped = (keys[:, 0, 0] > keys[:, 1, 0]) | ((keys[:, 0, 0] == keys[:, 1, 0]) & (keys[:, 0, 1] > keys[:, 1, 1]))
    keys = np.where(swapped[:, None, None], keys[:, ::-1], keys).reshape(-1, 4)
    return np.lexsort(keys.T[::-1])


def pack_seams(surface: TexturedSurface, seams: Seams, mask: NDArray[np.bool_]) -> str:
    """Some of the seams, (S,) bool, as text: bits in the order of `seam_order`, hexadecimal."""
    return np.packbits(mask[seam_order(surface, seams)]).tobytes().hex()


def unpack_seams(surface: TexturedSurface, seams: Seams, text: str) -> NDArray[np.bool_]:
    """The inverse of `pack_seams`.

    Raises
    ------
    ValueError
        If the text is not of as many seams.
    """
    data = bytes.fromhex(text)
    count = len(seams.uv_pairs)
    if len(data) != -(-count // 8):
        raise ValueError(f"{8 * len(data)} bits are not {count} seams")
    mask = np.zeros(count, bool)
    mask[seam_order(surface, seams)] = np.unpackbits(np.frombuffer(data, np.uint8))[:count].astype(bool)
    return mask
