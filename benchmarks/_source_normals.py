"""The source's own shading normals at points of its surface, as glTF defines them, at rest and posed; 64 bits.

Nothing of the pipeline is used but the loaded file: tangents are computed here anew where the file has none, images are
sampled here. For the slow and plain twin that a measurement wants, not for speed.

glTF 2.0, sections 3.7.2.1 (normals, tangents) and 3.9.3 (normal textures); Mikkelsen 2008 (MikkTSpace).
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.load import Character
from preprocess.load.character import TextureRef
from preprocess.mesh.surface import SkinnedMesh

Ints = NDArray[np.integer]


def unit(vectors: Floats) -> Floats:
    """Vectors of length one; what has none stays zero."""
    result: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
    return result


def cofactors(matrices: Floats) -> Floats:
    """What turns normals where the matrices (..., 3, 3) turn points, the right way round where they mirror."""
    x, y, z = matrices[..., 0, :], matrices[..., 1, :], matrices[..., 2, :]
    rows = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=-2)
    mirrored = np.where(np.einsum("...i,...i->...", x, rows[..., 0, :]) < 0, -1.0, 1.0)
    return rows * mirrored[..., None, None]


def wrap(index: Ints, size: int, mode: str) -> Ints:
    """Texel numbers brought into an image by a glTF wrap mode."""
    if mode == "CLAMP_TO_EDGE":
        return np.clip(index, 0, size - 1)
    if mode == "MIRRORED_REPEAT":
        folded = np.mod(index, 2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return np.mod(index, size)


def sample_texture(ref: TextureRef, texcoords: Floats) -> Floats:
    """Values as stored of the finest level at texture coordinates (N, 2) of the file, (N, C)."""
    texels = np.asarray(ref.image.texels, np.float64)
    height, width = texels.shape[:2]
    homogeneous = np.concatenate([texcoords, np.ones((len(texcoords), 1))], axis=1)
    place = (homogeneous @ np.asarray(ref.transform).T)[:, :2] * (width, height)
    if ref.nearest:
        column, row = np.floor(place).astype(np.int64).T
        return np.asarray(texels[wrap(row, height, ref.wrap_t), wrap(column, width, ref.wrap_s)])
    corner = np.floor(place - 0.5).astype(np.int64)
    fraction = place - 0.5 - corner
    result = np.zeros((len(place), texels.shape[2]))
    for right in (0, 1):
        for down in (0, 1):
            share_x = fraction[:, 0] if right else 1.0 - fraction[:, 0]
            share_y = fraction[:, 1] if down else 1.0 - fraction[:, 1]
            column, row = wrap(corner[:, 0] + right, width, ref.wrap_s), wrap(corner[:, 1] + down, height, ref.wrap_t)
            result += (share_x * share_y)[:, None] * texels[row, column]
    return result


def mikk_tangents(positions: Floats, faces: Ints, normals: Floats, uvs: Floats) -> Floats:
    """MikkTSpace tangents per corner, (F, 3, 4), of normals (F, 3, 3) and uvs (F, 3, 2) with v down.

    Corners with equal position, normal and uv form one tangent where their triangles hang together by edges with equal
    ends and are not mirrored against each other: the mean of the triangles' directions of rising u in the plane of the
    normal, weighted by the angle there. Triangles without area in uv get a tangent of their neighbours', or any.
    """
    corners = positions[faces]
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (u1, v1), (u2, v2) = (uvs[:, 1] - uvs[:, 0]).T, (uvs[:, 2] - uvs[:, 0]).T
    area = u2 * v1 - u1 * v2  # v down: positive where the picture is not mirrored
    direction = (v1[:, None] * across - v2[:, None] * along) * np.sign(area)[:, None]
    flat_normals = normals.reshape(-1, 3)
    keys = [
        (int(vertex), *normal, *uv)
        for vertex, normal, uv in zip(faces.ravel(), flat_normals.tolist(), uvs.reshape(-1, 2).tolist(), strict=True)
    ]
    group = list(range(3 * len(faces)))

    def root(corner: int) -> int:
        while group[corner] != corner:
            corner = group[corner]
        return corner

    ends: dict[tuple[object, object], int] = {}
    for half in range(3 * len(faces)):
        face, after = half // 3, half // 3 * 3 + (half + 1) % 3
        other = ends.get((keys[after], keys[half]))
        if other is not None and area[face] * area[other // 3] > 0:
            other_after = other // 3 * 3 + (other + 1) % 3
            for ours, theirs in ((half, other_after), (after, other)):
                group[root(ours)] = root(theirs)
        ends[keys[half], keys[after]] = half

    def in_plane(vectors: Floats) -> Floats:
        return unit(vectors - (vectors * flat_normals).sum(axis=1, keepdims=True) * flat_normals)

    ahead = in_plane((np.roll(corners, -1, axis=1) - corners).reshape(-1, 3))
    back = in_plane((np.roll(corners, 1, axis=1) - corners).reshape(-1, 3))
    angle = np.arccos(np.clip((ahead * back).sum(axis=1), -1.0, 1.0))
    shares = in_plane(np.repeat(direction, 3, axis=0)) * angle[:, None]
    sums: dict[int, Floats] = defaultdict(lambda: np.zeros(3))
    roots = [root(corner) for corner in range(3 * len(faces))]
    for corner, of in enumerate(roots):
        sums[of] += shares[corner]
    tangents = np.array([sums[of] for of in roots])
    missing = np.linalg.norm(tangents, axis=1) < 1e-12
    known = {keys[corner]: tangents[corner] for corner in np.flatnonzero(~missing).tolist()}
    for corner in np.flatnonzero(missing).tolist():
        aside = np.eye(3)[np.abs(flat_normals[corner]).argmin()]
        tangents[corner] = known.get(keys[corner], np.cross(aside, flat_normals[corner]))
    handedness = np.where(np.repeat(area, 3) < 0, -1.0, 1.0)
    return np.concatenate([unit(tangents), handedness[:, None]], axis=1).reshape(-1, 3, 4)


def file_tangents(character: Character) -> Floats | None:
    """Tangents of all corners, the file's own or MikkTSpace's; None where no material has a normal map."""
    mesh = character.mesh
    sets = {int(i): character.materials[i].normal for i in np.unique(mesh.face_materials)}
    if all(ref is None for ref in sets.values()):
        return None
    if mesh.corner_tangents is not None:
        return mesh.corner_tangents
    tangents = np.tile([1.0, 0.0, 0.0, 1.0], (mesh.num_faces, 3, 1))
    for texcoord in sorted({ref.texcoord for ref in sets.values() if ref is not None}):
        users = [i for i, ref in sets.items() if ref is not None and ref.texcoord == texcoord]
        faces = np.flatnonzero(np.isin(mesh.face_materials, users))
        uvs = mesh.corner_texcoords[faces][:, :, texcoord]
        tangents[faces] = mikk_tangents(
            mesh.surface.positions, mesh.surface.faces[faces], mesh.corner_normals[faces], uvs
        )
    return tangents


class SourceNormals:
    """Shading normals of a loaded character at N points of its surface.

    Parameters
    ----------
    character : Character
    faces : (N,) int
    shares : (N, 3) float64
        Barycentric coordinates.
    """

    def __init__(self, character: Character, faces: Ints, shares: Floats) -> None:
        self._mesh: SkinnedMesh = character.mesh
        self._faces, self._shares = faces, shares
        self._tangents = file_tangents(character)
        self._local = np.tile([0.0, 0.0, 1.0], (len(faces), 1))
        for index, material in enumerate(character.materials):
            points = np.flatnonzero(self._mesh.face_materials[faces] == index)
            if material.normal is None or not len(points):
                continue
            texcoords = self._mesh.corner_texcoords[faces[points]][:, :, material.normal.texcoord]
            stored = sample_texture(material.normal, np.einsum("nk,nkc->nc", shares[points], texcoords))
            scale = (material.normal_scale, material.normal_scale, 1.0)
            self._local[points] = (stored[:, :3] * 2.0 - 1.0) * scale

    def at_rest(self) -> Floats:
        """Unit normals, (N, 3)."""
        mesh = self._mesh
        tangents = None if self._tangents is None else self._tangents[self._faces]
        return self._shade(mesh.corner_normals[self._faces], tangents)

    def skinned_points(self, skin: Floats) -> Floats:
        """Unit normals (N, 3) under the vertices' blended matrices (V, 3, 4): each point moves by the blend at it."""
        corners = self._mesh.surface.faces[self._faces]
        blended = np.einsum("nk,nkij->nij", self._shares, skin[:, :, :3][corners])
        return unit(np.einsum("nij,nj->ni", cofactors(blended), self.at_rest()))

    def skinned_vertices(self, skin: Floats) -> Floats:
        """The same as viewers approximate it: normals and tangents are moved at the vertices and interpolated."""
        corners = self._mesh.surface.faces[self._faces]
        turns = cofactors(skin[:, :, :3])[corners]
        normals = unit(np.einsum("nkij,nkj->nki", turns, self._mesh.corner_normals[self._faces]))
        if self._tangents is None:
            return self._shade(normals, None)
        tangents = self._tangents[self._faces].copy()
        tangents[..., :3] = unit(np.einsum("nkij,nkj->nki", skin[:, :, :3][corners], tangents[..., :3]))
        return self._shade(normals, tangents)

    def _shade(self, normals: Floats, tangents: Floats | None) -> Floats:
        """Frames at the corners (N, 3, 3 and 4) to normals: interpolated, used as they are, made unit at the end."""
        normal = np.einsum("nk,nki->ni", self._shares, normals)
        if tangents is None:
            return unit(normal)
        tangent = np.einsum("nk,nki->ni", self._shares, tangents[..., :3])
        bitangent = tangents[:, :1, 3] * np.cross(normal, tangent)
        x, y, z = (self._local[:, k : k + 1] for k in range(3))
        return unit(x * tangent + y * bitangent + z * normal)
