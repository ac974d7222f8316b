"""Pictures of textured meshes and how much they differ by FLIP (Andersson et al. 2020), for decimated meshes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from demos.headless import Canvas, create_context
from preprocess.mesh.face_geometry import doubled_area_vectors
from preprocess.mesh.surface import TexturedSurface
from runtime.gpu.programs import build_program, set_uniforms
from runtime.scene.camera import Camera

Pixels = NDArray[np.uint8]

FOVY_DEG = 25.0
AZIMUTHS_DEG = (20.0, 110.0, 200.0, 290.0)
ELEVATION_DEG = 12.0
FILL = 0.9  # of the picture, by the longest extent of the box


def _corner_attributes(surface: TexturedSurface) -> NDArray[np.float32]:
    """Position, smooth normal of the welded vertex, and uv of every corner, (3 F, 8) float32."""
    corners = surface.positions[surface.faces]
    normals = doubled_area_vectors(corners)
    sums = [np.bincount(surface.faces.ravel(), np.repeat(n, 3), len(surface.positions)) for n in normals.T]
    smooth = np.stack(sums, axis=1)
    smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
    parts = corners, smooth[surface.faces], surface.uvs[surface.face_uvs]
    return np.concatenate(parts, axis=2).reshape(-1, 8).astype(np.float32)


class MeshStudio:
    """Draws meshes that share one texture, seen from all around.

    Parameters
    ----------
    texels : (H, W, 3) float, encoded colours in [0, 1]
    full : TexturedSurface
        What the cameras frame.
    """

    def __init__(self, texels: NDArray[np.floating], full: TexturedSurface) -> None:
        self._ctx = create_context()
        self._program = build_program(self._ctx, ("textured_mesh.vert", "textured_mesh.frag"))
        height, width = texels.shape[:2]
        data = np.rint(np.clip(texels[..., :3], 0.0, 1.0) * 255).astype(np.uint8)
        self._texture = self._ctx.texture((width, height), 3, data.tobytes(), alignment=1)
        self._texture.build_mipmaps()
        self._texture.filter = (self._ctx.LINEAR_MIPMAP_LINEAR, self._ctx.LINEAR)
        low, high = full.positions.min(axis=0), full.positions.max(axis=0)
        self._middle, self.extent_m = 0.5 * (low + high), float((high - low).max())

    def pictures(self, surface: TexturedSurface, size_px: int, px_per_metre: float | None = None) -> list[Pixels]:
        """One square picture (S, S, 3) a camera; `px_per_metre` at the mesh's middle, by default to fill it."""
        if px_per_metre is None:
            px_per_metre = FILL * size_px / self.extent_m
        canvas = Canvas(self._ctx, (size_px, size_px))
        buffer = self._ctx.buffer(_corner_attributes(surface).tobytes())
        array = self._ctx.vertex_array(self._program, [(buffer, "3f 3f 2f", "in_position", "in_normal", "in_uv")])
        distance = size_px / px_per_metre / (2.0 * math.tan(math.radians(FOVY_DEG) / 2.0))
        result = []
        for azimuth in AZIMUTHS_DEG:
            turn, rise = math.radians(azimuth), math.radians(ELEVATION_DEG)
            to_eye = np.array(
                [math.sin(turn) * math.cos(rise), math.sin(rise), math.cos(turn) * math.cos(rise)], np.float64
            )
            eye = self._middle + distance * to_eye
            matrices = Camera(tuple(eye), tuple(self._middle), fovy_deg=FOVY_DEG).matrices(size_px, size_px)
            with canvas.drawing((0.95, 0.95, 0.96, 1.0)):
                self._ctx.enable_only(self._ctx.DEPTH_TEST)
                self._texture.use(0)
                values = {
                    "clip_from_world": tuple(matrices.clip_from_world.T.ravel()),
                    "eye": tuple(eye),
                    "to_light": tuple(to_eye),
                    "color_texture": 0,
                }
                set_uniforms(self._program, values)
                array.render()
            result.append(canvas.pixels()[..., :3].copy())
        for thing in (array, buffer, canvas):
            thing.release()
        return result


def mean_flip(reference: list[Pixels], pictures: list[Pixels]) -> float:
    """FLIP of pictures against others, averaged over the pixels that either mesh covers."""
    import flip_evaluator

    total, count = 0.0, 0
    for pair in zip(reference, pictures, strict=True):
        images = [np.ascontiguousarray(image.astype(np.float32) / 255.0) for image in pair]
        errors, _, _ = flip_evaluator.evaluate(*images, "LDR", inputsRGB=True, applyMagma=False)
        covered = np.any([(image != image[0, 0]).any(axis=2) for image in pair], axis=0)
        total += float(np.asarray(errors).reshape(covered.shape)[covered].sum())
        count += int(covered.sum())
    return total / max(count, 1)
