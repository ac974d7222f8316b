"""The source's side: what the file says at points of its own surface, from the parsed arrays alone.

Written again here and not shared with the stages that bake: a mistake there must not be made twice. glTF 2.0,
sections 3.7.3 (skins), 3.9 (materials) and the appendix on tangent frames; KHR_texture_transform.
Letters in shapes: F faces, V vertices, J joints, P poses, N points.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Indices
from preprocess.files.srgb import srgb_to_linear
from preprocess.load.character import Character, Material, TextureRef

# A stored texel stands for a patch of the source's image, and a bilinear sample of it for a tent twice as wide: the
# source is averaged over as many points of that. Two interleaved squares of 3 x 3 points of a tent.
_STEPS = np.array([-0.6, 0.0, 0.6])
TENT = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)
TENT_WEIGHTS = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25]).ravel()


def _wrapped(index: Indices, size: int, mode: str) -> Indices:
    """Texel numbers inside an image, as a sampler wraps them."""
    if mode == "CLAMP_TO_EDGE":
        return np.clip(index, 0, size - 1)
    if mode == "MIRRORED_REPEAT":
        turned = np.mod(index, 2 * size)
        return np.where(turned < size, turned, 2 * size - 1 - turned)
    return np.mod(index, size)


def _sample_image(ref: TextureRef, uvs: Floats, is_color: bool) -> Floats:
    """Samples of an image through its sampler, colours in linear light, (N, 4): missing channels as glTF fills them."""
    height, width, channels = ref.image.texels.shape
    px = uvs * (width, height)
    if not ref.nearest:
        px = px - 0.5
    low = np.floor(px).astype(np.int64)
    fraction = np.zeros_like(px) if ref.nearest else px - low
    total = np.zeros((len(uvs), channels))
    for right in (0, 1):
        for down in (0, 1):
            share = np.abs(1 - right - fraction[:, 0]) * np.abs(1 - down - fraction[:, 1])
            column = _wrapped(low[:, 0] + right, width, ref.wrap_s)
            row = _wrapped(low[:, 1] + down, height, ref.wrap_t)
            texels = np.asarray(ref.image.texels[row, column], np.float64)
            if is_color:
                tones = channels - int(channels in (2, 4))
                texels[:, :tones] = srgb_to_linear(texels[:, :tones])
            total += share[:, None] * texels
    values = np.ones((len(uvs), 4))
    tones = channels - int(channels in (2, 4))
    values[:, :3] = total[:, :3] if tones >= 3 else total[:, :1]
    if channels in (2, 4):
        values[:, 3] = total[:, -1]
    return values


class Source:
    """The source's surface, asked at points (faces, barycentric coordinates)."""

    def __init__(self, character: Character) -> None:
        self.character = character
        self.mesh = character.mesh
        self.corners = self.mesh.surface.positions[self.mesh.surface.faces]

    def positions(self, faces: Indices, shares: Floats) -> Floats:
        """Places at rest, (N, 3)."""
        result: Floats = np.einsum("nk,nkc->nc", shares, self.corners[faces])
        return result

    def weights(self, vertices: Indices) -> Floats:
        """Joint weights of vertices, (N, J)."""
        mesh = self.mesh
        dense = np.zeros((len(vertices), self.character.skeleton.num_joints))
        rows = np.repeat(np.arange(len(vertices)), mesh.joint_indices.shape[1])
        np.add.at(dense, (rows, mesh.joint_indices[vertices].ravel()), mesh.joint_weights[vertices].ravel())
        return dense

    def _texcoords(self, ref: TextureRef, faces: Indices) -> Floats:
        """What a texture is looked up with at the corners of faces, (N, 3, 2)."""
        uvs = self.mesh.corner_texcoords[faces, :, ref.texcoord]
        ones = np.ones((*uvs.shape[:2], 1))
        result: Floats = np.einsum("ij,nkj->nki", ref.transform[:2], np.concatenate([uvs, ones], axis=2))
        return result

    def texture(self, ref: TextureRef | None, faces: Indices, shares: Floats, steps: Floats, is_color: bool) -> Floats:
        """A texture at points, averaged over what a stored texel there stands for, (N, 4); ones without one.

        `steps` (N, 2, 3): change of the barycentric coordinates over one stored texel right and down.
        """
        values = np.ones((len(faces), 4))
        if ref is None:
            return values
        seen = np.flatnonzero(self.mesh.has_texcoords(ref.texcoord)[faces])
        if len(seen):
            values[seen] = self._averaged(ref, faces[seen], shares[seen], steps[seen], is_color)
        return values

    def _averaged(self, ref: TextureRef, faces: Indices, shares: Floats, steps: Floats, is_color: bool) -> Floats:
        corners = self._texcoords(ref, faces)
        middle = np.einsum("nk,nkc->nc", shares, corners)
        along = np.einsum("ndk,nkc->ndc", steps, corners)
        uvs = middle[:, None] + np.einsum("td,ndc->ntc", TENT, along)
        sampled = _sample_image(ref, uvs.reshape(-1, 2), is_color).reshape(len(faces), len(TENT), 4)
        return np.asarray(np.einsum("t,ntc->nc", TENT_WEIGHTS, sampled), np.float64)

    def _of_materials(self, faces: Indices, width: int, shader: object) -> Floats:
        """Values of points, each by the shader of its face's material, (N, width)."""
        values = np.ones((len(faces), width))
        of_point = self.mesh.face_materials[faces]
        for index in np.unique(of_point):
            rows = np.flatnonzero(of_point == index)
            values[rows] = shader(self.character.materials[index], rows)  # type: ignore[operator]
        return values

    def base_colors(self, faces: Indices, shares: Floats, steps: Floats) -> Floats:
        """Linear base colour and alpha, vertex colours multiplied in, (N, 4)."""

        def shader(material: Material, rows: Indices) -> Floats:
            texels = self.texture(material.base_color, faces[rows], shares[rows], steps[rows], True)
            result: Floats = texels * np.array(material.base_color_factor)
            return result

        values = self._of_materials(faces, 4, shader)
        if self.mesh.corner_colors is not None:
            values *= np.einsum("nk,nkc->nc", shares, self.mesh.corner_colors[faces])
        return values

    def emission(self, faces: Indices, shares: Floats, steps: Floats) -> Floats:
        """Linear emission, (N, 3)."""

        def shader(material: Material, rows: Indices) -> Floats:
            texels = self.texture(material.emissive, faces[rows], shares[rows], steps[rows], True)
            result: Floats = texels[:, :3] * np.array(material.emissive_factor)
            return result

        return self._of_materials(faces, 3, shader)

    def surface_factors(self, faces: Indices, shares: Floats, steps: Floats) -> Floats:
        """Occlusion, roughness and metallic, (N, 3)."""

        def shader(material: Material, rows: Indices) -> Floats:
            at = (faces[rows], shares[rows], steps[rows], False)
            packed = self.texture(material.metallic_roughness, *at)
            occlusion = self.texture(material.occlusion, *at)[:, 0] if material.occlusion is not None else 1.0
            return np.stack(
                [
                    1.0 + material.occlusion_strength * (occlusion - np.ones(len(rows))),
                    packed[:, 1] * material.roughness_factor,
                    packed[:, 2] * material.metallic_factor,
                ],
                axis=1,
            )

        return self._of_materials(faces, 3, shader)

    def normals(self, faces: Indices, shares: Floats, steps: Floats) -> Floats:
        """Unit shading normals, (N, 3): corner normals interpolated, the normal map in the frame that its uvs give."""
        smooth = np.einsum("nk,nkc->nc", shares, self.mesh.corner_normals[faces])
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)

        def shader(material: Material, rows: Indices) -> Floats:
            n: Floats = smooth[rows]
            if material.normal is None:
                return n
            seen = self.mesh.has_texcoords(material.normal.texcoord)[faces[rows]]
            if not seen.all():
                n = n.copy()
                n[seen] = shader(material, rows[seen]) if seen.any() else n[seen]
                return n
            corners = self._texcoords(material.normal, faces[rows])
            local = self.texture(material.normal, faces[rows], shares[rows], steps[rows], False)[:, :3] * 2.0 - 1.0
            local[:, :2] *= material.normal_scale
            t, b = self._frame(faces[rows], shares[rows], corners, n)
            turned = local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * n
            result: Floats = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
            return result

        return self._of_materials(faces, 3, shader)

    def _frame(self, faces: Indices, shares: Floats, uvs: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Tangent and bitangent at points, (N, 3) each: the file's own, or where u grows on the face; v grows down."""
        edges = self.corners[faces][:, 1:] - self.corners[faces][:, :1]
        across = uvs[:, 1:] - uvs[:, :1]
        area = across[:, 0, 0] * across[:, 1, 1] - across[:, 0, 1] * across[:, 1, 0]
        # Seen from outside, u runs right and v down in a face that is not mirrored: its bitangent, up, is n x t.
        handedness = np.where(area < 0, 1.0, -1.0)[:, None]
        along = (edges[:, 0] * across[:, 1, 1:] - edges[:, 1] * across[:, 0, 1:]) * -handedness
        if self.mesh.corner_tangents is not None:
            own = self.mesh.corner_tangents[faces]
            given = np.logical_and.reduce(np.isfinite(own), axis=(1, 2))[:, None]
            own = np.where(given[..., None], own, 0.0)
            along = np.where(given, np.einsum("nk,nkc->nc", shares, own[..., :3]), along)
            handedness = np.where(given, np.sign(own[:, :1, 3]), handedness)
        tangent = along - np.einsum("nc,nc->n", along, normals)[:, None] * normals
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-30)
        return tangent, handedness * np.cross(normals, tangent)
