"""Tangents a corner, as glTF wants them where a file has none: MikkTSpace.

Corners with the same vertex, normal and uv are one; they are grouped where their triangles share an edge at them and
wind the same way in uv. A group's tangent is the mean of its triangles' directions of rising u, each projected into
the plane of the normal and weighted by the triangle's (projected) angle there. Handedness is the uv winding: +1
where, seen from outside, the picture is not mirrored. A triangle whose uvs have no area has no direction of its own
and takes that of a group it touches.

uvs run with v down as in glTF; green in a normal map points up, so the bitangent n x t * w points against v.

Mikkelsen 2008, "Simulation of Wrinkled Surfaces Revisited", section 3 and appendix; glTF 2.0, section 3.7.2.1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices
from preprocess.mesh.grouping import connected_groups, group_rows
from preprocess.mesh.surface import SkinnedMesh


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("...c,...c->...", a, b)
    return product


def _unit(vectors: Floats) -> Floats:
    """Unit vectors; zero stays zero."""
    lengths = np.sqrt(_dot(vectors, vectors))[..., None]
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def _in_plane(vectors: Floats, normals: Floats) -> Floats:
    """Unit vectors along the projections into the planes of the normals."""
    return _unit(vectors - _dot(vectors, normals)[..., None] * normals)


def _directions_of_u(corners: Floats, uvs: Floats) -> tuple[Floats, Floats]:
    """Direction of rising u in each triangle, (F, 3) not normalised, and twice its signed area in uv, (F,)."""
    d1, d2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # v up: the picture as it is looked at
    u1, v1 = (uvs[:, 1] - uvs[:, 0]).T * [[1], [-1]]
    u2, v2 = (uvs[:, 2] - uvs[:, 0]).T * [[1], [-1]]
    area = u1 * v2 - v1 * u2
    direction = np.sign(area)[:, None] * (v2[:, None] * d1 - v1[:, None] * d2)
    return direction, area


def _linked_corners(corner_ids: Indices) -> tuple[Indices, Indices]:
    """Pairs of flat corners at both ends of every edge that two triangles run along against each other."""
    start = corner_ids.reshape(-1)
    end = np.roll(corner_ids, -1, axis=1).reshape(-1)
    half = np.arange(start.size)
    forward = start < end
    edge, _ = group_rows(np.minimum(start, end), np.maximum(start, end))
    # The n-th forward half-edge of an edge meets its n-th backward one.
    order = np.lexsort((half, forward, edge))
    run = np.r_[True, (edge[order][1:] != edge[order][:-1]) | (forward[order][1:] != forward[order][:-1])]
    rank = np.empty(start.size, np.int64)
    rank[order] = np.arange(start.size) - np.maximum.accumulate(np.where(run, np.arange(start.size), 0))
    pair, firsts = group_rows(edge, rank)
    partner = np.full((len(firsts), 2), -1, np.int64)
    partner[pair, forward.astype(int)] = half
    left, right = partner[(partner >= 0).all(axis=1)].T
    left_end, right_end = (h // 3 * 3 + (h + 1) % 3 for h in (left, right))
    return np.r_[left, left_end], np.r_[right_end, right]


def _borrow(tangents: Floats, have: NDArray[np.bool_], keys: Indices) -> NDArray[np.bool_]:
    """Give corners without a tangent that of the first corner with one under the same key; what is known after."""
    source = np.full(keys.max(initial=-1) + 1, -1, np.int64)
    known = np.flatnonzero(have)[::-1]
    source[keys[known]] = known
    found = ~have & (source[keys] >= 0)
    tangents[found] = tangents[source[keys[found]]]
    return have | found


def _any_tangent(normals: Floats) -> Floats:
    """Some unit vector across each normal, (N, 4), for what has no uv direction at all."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across: Floats = np.cross(axis, normals).astype(np.float64)
    return np.concatenate([_unit(across), np.ones((len(normals), 1))], axis=1)


def compute_tangents(positions: Floats, faces: NDArray[np.integer], normals: Floats, uvs: Floats) -> Floats:
    """MikkTSpace tangents.

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int
    normals : (F, 3, 3) float64
        Unit normals a corner.
    uvs : (F, 3, 2) float64
        Texture coordinates a corner, v down.

    Returns
    -------
    (F, 3, 4) float64
        Unit tangents across the normals, and handedness +1 or -1.

    References
    ----------
    Mikkelsen 2008. Where a triangle without uv area parts two groups, the original may join them, in an order that
    depends on the triangles' numbers; here they stay apart.
    """
    if not len(faces):
        return np.zeros((0, 3, 4))
    corners = positions[faces]
    direction, area = _directions_of_u(corners, uvs)
    usable = (area != 0) & (_dot(direction, direction) > 0)

    flat_normals = normals.reshape(-1, 3)
    ids, _ = group_rows(faces.reshape(-1), *(flat_normals.T + 0.0), *(uvs.reshape(-1, 2).T + 0.0))
    left, right = _linked_corners(ids.reshape(-1, 3))
    same = usable[left // 3] & usable[right // 3] & ((area > 0)[left // 3] == (area > 0)[right // 3])
    num_groups, groups = connected_groups(3 * len(faces), left[same], right[same])

    along = _in_plane(np.repeat(direction, 3, axis=0), flat_normals)
    ahead = _in_plane((np.roll(corners, -1, axis=1) - corners).reshape(-1, 3), flat_normals)
    back = _in_plane((np.roll(corners, 1, axis=1) - corners).reshape(-1, 3), flat_normals)
    angle = np.arccos(np.clip(_dot(ahead, back), -1.0, 1.0)) * np.repeat(usable, 3)
    sums = np.stack([np.bincount(groups, angle * along[:, c], minlength=num_groups) for c in range(3)], axis=1)

    tangents = np.empty((3 * len(faces), 4))
    tangents[:, :3] = _unit(sums.astype(np.float64, copy=False))[groups]
    tangents[:, 3] = np.repeat(np.where(area < 0, -1.0, 1.0), 3)
    have = (_dot(tangents[:, :3], tangents[:, :3]) > 0) & np.repeat(usable, 3)
    for keys in (ids, group_rows(faces.reshape(-1), *(flat_normals.T + 0.0))[0]):
        if have.all():
            break
        have = _borrow(tangents, have, keys)
    tangents[~have] = _any_tangent(flat_normals[~have])
    return tangents.reshape(-1, 3, 4)


def corner_tangents(mesh: SkinnedMesh, faces: NDArray[np.integer], uvs: Floats) -> Floats:
    """The file's own tangents of some faces, MikkTSpace ones where it has none.

    Parameters
    ----------
    mesh : SkinnedMesh
    faces : (G,) int
        All that are drawn with one normal texture: tangents are averaged over them, and over no others.
    uvs : (G, 3, 2) float64
        Where their corners sample it.

    Returns
    -------
    (G, 3, 4) float64
    """
    own: Floats | None = None if mesh.corner_tangents is None else mesh.corner_tangents[faces]
    if own is not None and np.isfinite(own).all():
        return own
    made = compute_tangents(mesh.surface.positions, mesh.surface.faces[faces], mesh.corner_normals[faces], uvs)
    return made if own is None else np.where(np.isfinite(own).all(axis=2, keepdims=True), own, made)
