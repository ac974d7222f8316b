"""How finely a surface is painted: texels a metre that its source images really need, face by face.

A coarser mip is enough where it looks the same. Levels are compared one by one, from fine to coarse: a block of 2 × 2
texels may be halved where interpolating the coarser level gives each of its texels back to within a few steps, and
where its parts could be halved before. A palette's flat cells need next to nothing, a face's eyelashes every texel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.atlas.distortion import turned_areas
from preprocess.load import Character, Material, TextureRef
from preprocess.mesh.face_geometry import face_frames
from preprocess.mesh.surface import SkinnedMesh
from preprocess.numerics.jit import entry

SAME = 4.0 / 255.0
"""Largest difference of a channel, as stored, that does not count: about the noise of a JPEG."""

COARSEST = 6
"""Levels that are compared; a flat surface keeps a texel for 64 × 64 of the source's."""

FARTHEST_PX = 1e8
"""Texture coordinates beyond repeat the image more often than floats can tell."""

KINDS = ("base_color", "normal", "orm", "emissive")


@dataclass(frozen=True)
class Detail:
    """What the source's textures ask of an atlas.

    Attributes
    ----------
    needs : dict of str to (F,) float64
        Texels a metre that every face needs of each kind of texture; 0 where it has none.
    image_sizes : (F, 2) float64
        Width and height of the image that a face's first uvs point into; ones where there is none.
    sides : dict of str to int
        Longest side of each kind's images; 0 where there are none.
    """

    needs: dict[str, Floats]
    image_sizes: Floats
    sides: dict[str, int]

    def finest(self) -> Floats:
        """Texels a metre for the most demanding kind, (F,)."""
        result: Floats = np.max([np.zeros(len(self.image_sizes)), *self.needs.values()], axis=0)
        return result

    def of_faces(self, sources: NDArray[np.integer]) -> Detail:
        """The same for faces that are parts of others."""
        needs = {kind: need[sources] for kind, need in self.needs.items()}
        return Detail(needs, self.image_sizes[sources], self.sides)


def refs_of(materials: Sequence[Material], kind: str) -> list[TextureRef | None]:
    """The textures of one kind, a material."""
    if kind == "orm":
        return [m.metallic_roughness or m.occlusion for m in materials]
    return [getattr(m, kind) for m in materials]


def no_detail(num_faces: int) -> Detail:
    """For a surface without textures."""
    return Detail({}, np.ones((num_faces, 2)), {})


def find_detail(character: Character) -> Detail:
    """Look at all of a character's textures."""
    mesh = character.mesh
    area_m2 = face_frames(mesh.surface.positions, mesh.surface.faces)[0]
    real = area_m2 > 1e-9 * area_m2.mean()
    levels: dict[int, NDArray[np.uint8]] = {}
    needs, sides, sizes = {}, {}, np.ones((mesh.num_faces, 2))
    for kind in reversed(KINDS):
        need, sides[kind] = np.zeros(mesh.num_faces), 0
        for index, ref in enumerate(refs_of(character.materials, kind)):
            if ref is None:
                continue
            faces = np.flatnonzero((mesh.face_materials == index) & mesh.has_texcoords(ref.texcoord))
            if not len(faces):
                continue
            if id(ref.image) not in levels:
                levels[id(ref.image)] = find_levels(ref.image.texels)
            need[faces] = _needed_lengths(mesh, faces, ref, levels[id(ref.image)])
            sides[kind] = max(sides[kind], *ref.image.texels.shape[:2])
            if ref.texcoord == 0:
                sizes[faces] = ref.image.texels.shape[1::-1]
        needs[kind] = np.where(real, need / np.sqrt(np.where(real, area_m2, 1.0)), 0.0)
    return Detail(needs, sizes, sides)


def _needed_lengths(
    mesh: SkinnedMesh, faces: NDArray[np.integer], ref: TextureRef, levels: NDArray[np.uint8]
) -> Floats:
    """Square root of the texels that every face needs."""
    transform = np.asarray(ref.transform)
    height, width = levels.shape
    corners = mesh.corner_texcoords[faces][:, :, ref.texcoord] @ transform[:2, :2].T + transform[:2, 2]
    corners = np.ascontiguousarray(np.clip(corners * (width, height), -FARTHEST_PX, FARTHEST_PX))
    result: Floats = np.sqrt(np.abs(turned_areas(corners))) / np.exp2(_face_levels(corners, levels))
    return result


def find_levels(texels: NDArray[np.floating]) -> NDArray[np.uint8]:
    """How often each texel's surroundings may be halved, (H, W) uint8; texels (H, W, C) in [0, 1]."""
    height, width = texels.shape[:2]
    step = 1 << COARSEST
    padded = np.pad(texels, ((0, -height % step), (0, -width % step), (0, 0)), mode="edge").astype(np.float32)
    same: list[NDArray[np.bool_]] = []
    for _ in range(COARSEST):
        rows, columns, channels = padded.shape
        half = padded.reshape(rows // 2, 2, columns // 2, 2, channels).mean(axis=(1, 3))
        wrong = np.abs(_doubled(half) - padded).max(axis=2)
        good = wrong.reshape(rows // 2, 2, columns // 2, 2).max(axis=(1, 3)) <= SAME
        if same:
            before = same[-1]
            good &= before.reshape(rows // 2, 2, columns // 2, 2).all(axis=(1, 3))
        same.append(good)
        padded = half
    levels = np.zeros_like(same[-1], np.uint8)
    for good in reversed(same):
        if levels.shape != good.shape:
            levels = levels.repeat(2, axis=0).repeat(2, axis=1)
        levels = np.where(good, levels + 1, 0).astype(np.uint8)
    return levels.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]


def _doubled(half: NDArray[np.float32]) -> NDArray[np.float32]:
    """Twice the texels a side, interpolated between the centres of the given ones."""
    for axis in (0, 1):
        size = half.shape[axis]
        before = half.take(np.r_[0, np.arange(size - 1)], axis=axis)
        after = half.take(np.r_[np.arange(1, size), size - 1], axis=axis)
        pair = np.stack([0.75 * half + 0.25 * before, 0.75 * half + 0.25 * after], axis=axis + 1)
        half = pair.reshape(*half.shape[:axis], 2 * size, *half.shape[axis + 1 :])
    return half


@entry
def _face_levels(corners, levels):  # type: ignore[no-untyped-def]
    """Least level of the texels under each triangle (F, 3, 2), given in texels of an image that repeats, (F,)."""
    height, width = levels.shape
    result = np.empty(len(corners))
    least = levels.min()
    for f in range(len(corners)):
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        x0, x1 = int(np.floor(min(a[0], b[0], c[0]))), int(np.floor(max(a[0], b[0], c[0])))
        y0, y1 = int(np.floor(min(a[1], b[1], c[1]))), int(np.floor(max(a[1], b[1], c[1])))
        if (x1 - x0 + 1) * (y1 - y0 + 1) > 2 * height * width:
            result[f] = least
            continue
        found = levels[
            int(np.floor((a[1] + b[1] + c[1]) / 3)) % height, int(np.floor((a[0] + b[0] + c[0]) / 3)) % width
        ]
        turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                inside = True
                for k in range(3):
                    p, q = corners[f, k], corners[f, (k + 1) % 3]
                    if ((q[0] - p[0]) * (y + 0.5 - p[1]) - (q[1] - p[1]) * (x + 0.5 - p[0])) * turn < 0.0:
                        inside = False
                        break
                if inside:
                    found = min(found, levels[y % height, x % width])
        result[f] = found
    return result
