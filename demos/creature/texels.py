"""Where on the body each texel lies: position, normal and frame, inside the charts and a few texels beyond.

Texels just outside a chart continue its nearest triangle, so that what is painted there goes on naturally and
bilinear samples at a seam are right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from demos.creature.raster import cover_texels
from demos.creature.surface import Floats, Ints

_MARGIN = 5.0  # texels painted around a chart


@dataclass(frozen=True)
class BodyMesh:
    """The dragon as a mesh. V vertices, T texture vertices, F faces.

    Attributes
    ----------
    points, normals : (V, 3) float64
    faces : (F, 3) int64
    uvs : (T, 2) float64, v down
    face_uvs : (F, 3) int64
    uv_to_vertex : (T,) int64
    tangents : (T, 4) float64
        glTF's: xyz along u, w the sign of the bitangent.
    charts : (F,) int64
        Numbered from 0.
    """

    points: Floats
    normals: Floats
    faces: Ints
    uvs: Floats
    face_uvs: Ints
    uv_to_vertex: Ints
    tangents: Floats
    charts: Ints


@dataclass(frozen=True)
class Texels:
    """The N painted texels of a square texture.

    Attributes
    ----------
    size : int
    x, y : (N,) int64
    face : (N,) int64
    barycentric : (N, 3) float64
        Outside [0, 1] in the margin.
    points, normals : (N, 3) float64
    nearest : (size, size) int64
        The painted texel that each texel of the image copies, so that the rest of the image is padded.
    """

    size: int
    x: Ints
    y: Ints
    face: Ints
    barycentric: Floats
    points: Floats
    normals: Floats
    nearest: Ints

    def spread(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image of (N, C) values, padded: (size, size, C)."""
        return values[self.nearest]


def compute_tangents(points: Floats, normals: Floats, uvs: Floats, face_uvs: Ints, uv_to_vertex: Ints) -> Floats:
    """Tangents of texture vertices, (T, 4): angle-weighted means of the faces' u directions, normal to `normals`."""
    corners = points[uv_to_vertex[face_uvs]]
    flat = uvs[face_uvs]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    du1, dv1 = (flat[:, 1] - flat[:, 0]).T
    du2, dv2 = (flat[:, 2] - flat[:, 0]).T
    determinant = du1 * dv2 - du2 * dv1
    inverse = np.sign(determinant) / np.maximum(np.abs(determinant), 1e-20)
    along_u = (edge1 * dv2[:, None] - edge2 * dv1[:, None]) * inverse[:, None]
    along_v = (edge2 * du1[:, None] - edge1 * du2[:, None]) * inverse[:, None]
    along_u /= np.maximum(np.linalg.norm(along_u, axis=1), 1e-20)[:, None]
    along_v /= np.maximum(np.linalg.norm(along_v, axis=1), 1e-20)[:, None]
    sums = np.zeros((len(uvs), 6))
    for k in range(3):
        first = corners[:, (k + 1) % 3] - corners[:, k]
        second = corners[:, (k + 2) % 3] - corners[:, k]
        cosine = (first * second).sum(axis=1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        np.add.at(sums, face_uvs[:, k], np.concatenate([along_u, along_v], axis=1) * angle[:, None])
    normal = normals[uv_to_vertex]
    tangent = sums[:, :3] - (sums[:, :3] * normal).sum(axis=1)[:, None] * normal
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-20)[:, None]
    upwards = -(np.cross(normal, tangent) * sums[:, 3:]).sum(axis=1)  # v points down, the bitangent up
    return np.concatenate([tangent, np.where(upwards < 0, -1.0, 1.0)[:, None]], axis=1)


def locate_texels(mesh: BodyMesh, size: int) -> Texels:
    """Find every texel's place on the body.

    Parameters
    ----------
    mesh : BodyMesh
    size : int
        Texels a side.
    """
    face, x, y, barycentric = cover_texels(mesh.uvs, mesh.face_uvs, size)
    owner = np.full((size, size), -1)
    owner[y, x] = face
    gap, (near_y, near_x) = ndimage.distance_transform_edt(owner < 0, return_indices=True)
    margin = (gap > 0) & (gap <= _MARGIN)
    my, mx = np.nonzero(margin)
    extra_face = owner[near_y[margin], near_x[margin]]
    face = np.r_[face, extra_face]
    x, y = np.r_[x, mx], np.r_[y, my]
    barycentric = np.concatenate([barycentric, _barycentric_of(mesh, extra_face, mx, my, size)])
    index = np.full((size, size), -1)
    index[y, x] = np.arange(len(x))
    _, (near_y, near_x) = ndimage.distance_transform_edt(index < 0, return_indices=True)
    corner_points, corner_normals = mesh.points[mesh.faces[face]], mesh.normals[mesh.faces[face]]
    points = np.einsum("nk,nkc->nc", barycentric, corner_points)
    normals = np.einsum("nk,nkc->nc", np.clip(barycentric, 0.0, 1.0), corner_normals)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return Texels(size, x, y, face, barycentric, points, normals, index[near_y, near_x])


def _barycentric_of(mesh: BodyMesh, face: Ints, x: Ints, y: Ints, size: int) -> Floats:
    """Barycentric coordinates of texel centres in given faces, extrapolated but never far."""
    a, b, c = (mesh.uvs[mesh.face_uvs[face, k]] for k in range(3))
    p = np.stack([x + 0.5, y + 0.5], axis=1) / size
    double = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    second = ((p - a)[:, 0] * (c - a)[:, 1] - (p - a)[:, 1] * (c - a)[:, 0]) / double
    third = ((b - a)[:, 0] * (p - a)[:, 1] - (b - a)[:, 1] * (p - a)[:, 0]) / double
    result = np.stack([1.0 - second - third, second, third], axis=1)
    result = np.clip(result, -2.0, 3.0)
    found: Floats = result / result.sum(axis=1, keepdims=True)
    return found


def tangent_normals(mesh: BodyMesh, texels: Texels, height: Floats, wanted: Floats) -> Floats:
    """Tangent-space normals, (N, 3), of a wanted smooth normal bent by a height map.

    Parameters
    ----------
    mesh : BodyMesh
    texels : Texels
    height : (N,) float64
        Metres above the skin at each texel.
    wanted : (N, 3) float64
        Unit normals in object space before the height is added.
    """
    image = texels.spread(height[:, None])[..., 0]
    slope_u, slope_v = np.asarray(np.gradient(image, axis=1)), np.asarray(np.gradient(image, axis=0))
    slope = np.stack([slope_u[texels.y, texels.x], slope_v[texels.y, texels.x]], axis=1) * texels.size
    # The height's gradient on the surface, from its slopes in uv and the triangle's first fundamental form.
    face = texels.face
    corners, flat = mesh.points[mesh.faces], mesh.uvs[mesh.face_uvs]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    uv_edges = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=1)
    jacobian = np.linalg.solve(uv_edges, edges)  # (F, 2, 3): rows along u and v
    metric = np.linalg.inv(jacobian @ jacobian.transpose(0, 2, 1))
    pseudo = metric @ jacobian
    gradient = np.einsum("nk,nkc->nc", slope, pseudo[face])
    bent = wanted - gradient + (gradient * wanted).sum(axis=1)[:, None] * wanted
    bent /= np.linalg.norm(bent, axis=1)[:, None]
    tangent4 = np.einsum("nk,nkc->nc", np.clip(texels.barycentric, 0, 1), mesh.tangents[mesh.face_uvs[face]])
    tangent = tangent4[:, :3]  # as a renderer interpolates it
    normal = texels.normals
    tangent = tangent - (tangent * normal).sum(axis=1)[:, None] * normal
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    bitangent = np.cross(normal, tangent) * np.sign(tangent4[:, 3])[:, None]
    local = np.stack([(bent * axis).sum(axis=1) for axis in (tangent, bitangent, normal)], axis=1)
    local[:, 2] = np.maximum(local[:, 2], 0.05)
    result: Floats = local / np.linalg.norm(local, axis=1)[:, None]
    return result
