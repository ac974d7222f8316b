"""Triangles of the parameter mesh to texels: which face covers a texel, and where on that face its centre lies.

Texels outside every triangle but near one get the nearest triangle, with barycentric coordinates that extrapolate
it, so that a bilinear sample just inside a chart's outline reads the surface's own continuation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import uv_to_px
from preprocess.numerics.jit import entry, helper

REACH_PX = 2.0  # how far outside a triangle texels are still its own; a bilinear cell reaches at most sqrt(2)
EXTRAPOLATION = 1.0  # barycentric coordinates stay in [-1, 2]: slivers would shoot far beyond


@dataclass(frozen=True)
class Coverage:
    """What each texel of an H x W image shows.

    Attributes
    ----------
    faces : (H, W) int32
        Face whose triangle holds the texel's centre, or the nearest within reach, or -1.
    barycentrics : (H, W, 3) float32
        Coordinates of the texel's centre on that face; beyond [0, 1] where the centre is outside.
    inside : (H, W) bool
        Whether the centre lies inside its triangle.
    """

    faces: Ints
    barycentrics: NDArray[np.float32]
    inside: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.faces.shape[0], self.faces.shape[1]


def rasterise(uvs: Floats, face_uvs: Ints, width: int, height: int, reach_px: float = REACH_PX) -> Coverage:
    """Find the face and the barycentric coordinates of every texel.

    Parameters
    ----------
    uvs : (T, 2) float64
    face_uvs : (F, 3) int32
    width, height : int
    reach_px : float
        How far outside a triangle a texel may lie and still belong to it.

    Returns
    -------
    Coverage
    """
    corners_px = uv_to_px(uvs, width, height)[face_uvs]
    faces = np.full((height, width), -1, np.int32)
    barycentrics = np.zeros((height, width, 3), np.float32)
    distances = np.full((height, width), np.inf, np.float32)
    _rasterise(np.ascontiguousarray(corners_px), reach_px, faces, barycentrics, distances)
    return Coverage(faces, barycentrics, distances == 0.0)


@helper
def _segment_distance_sq(px, py, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    dx, dy = bx - ax, by - ay
    length_sq = dx * dx + dy * dy
    t = 0.0
    if length_sq > 0.0:
        t = min(1.0, max(0.0, ((px - ax) * dx + (py - ay) * dy) / length_sq))
    ex, ey = px - ax - t * dx, py - ay - t * dy
    return ex * ex + ey * ey


@entry
def _rasterise(corners_px, reach_px, faces, barycentrics, distances):  # type: ignore[no-untyped-def]
    height, width = faces.shape
    for f in range(len(corners_px)):
        ax, ay = corners_px[f, 0, 0], corners_px[f, 0, 1]
        bx, by = corners_px[f, 1, 0], corners_px[f, 1, 1]
        cx, cy = corners_px[f, 2, 0], corners_px[f, 2, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        x0 = max(0, int(np.ceil(min(ax, bx, cx) - reach_px)))
        x1 = min(width - 1, int(np.floor(max(ax, bx, cx) + reach_px)))
        y0 = max(0, int(np.ceil(min(ay, by, cy) - reach_px)))
        y1 = min(height - 1, int(np.floor(max(ay, by, cy) + reach_px)))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                distance = 0.0
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    distance = np.sqrt(
                        min(
                            _segment_distance_sq(x, y, ax, ay, bx, by),
                            _segment_distance_sq(x, y, bx, by, cx, cy),
                            _segment_distance_sq(x, y, cx, cy, ax, ay),
                        )
                    )
                    if distance == 0.0:
                        distance = 1e-6
                if distance <= reach_px and distance < distances[y, x]:
                    faces[y, x] = f
                    distances[y, x] = distance
                    barycentrics[y, x, 0] = wa
                    barycentrics[y, x, 1] = wb
                    barycentrics[y, x, 2] = wc


def interpolate_corners(coverage: Coverage, corner_values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Values given at face corners, at every texel; zero where no face is near.

    Parameters
    ----------
    coverage : Coverage of an H x W image
    corner_values : (F, 3, C) float

    Returns
    -------
    (H, W, C) float64
    """
    height, width = coverage.shape
    near = coverage.faces >= 0
    weights = clamp_extrapolation(coverage.barycentrics[near])
    result = np.zeros((height, width, corner_values.shape[2]))
    result[near] = np.einsum("nk,nkc->nc", weights, corner_values[coverage.faces[near]])
    return result


def clamp_extrapolation(barycentrics: NDArray[np.float32]) -> NDArray[np.float64]:
    """Barycentric coordinates pulled back towards the triangle where they leave [-1, 2], still summing to one."""
    weights = barycentrics.astype(np.float64)
    excess = np.maximum(weights.max(axis=1, initial=0.0) - 1.0, -weights.min(axis=1, initial=0.0))
    scale = np.where(excess > EXTRAPOLATION, EXTRAPOLATION / np.maximum(excess, 1e-30), 1.0)[:, None]
    return 1.0 / 3.0 + (weights - 1.0 / 3.0) * scale


def cover_atlas(mesh: SkinnedMesh, width: int, height: int) -> Coverage:
    """Texels of an image of the given size against the atlas of a character."""
    return rasterise(mesh.surface.uvs, mesh.surface.face_uvs, width, height)


def fill_outside(values: Floats, known: NDArray[np.bool_]) -> Floats:
    """Copy to every unknown texel the value of the nearest known one, so that no sample ever reads nothing.

    Parameters
    ----------
    values : (H, W, C) float
    known : (H, W) bool

    Returns
    -------
    (H, W, C) float
    """
    if known.all() or not known.any():
        return values
    from scipy import ndimage

    rows, columns = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    result: Floats = values[rows, columns]
    return result
