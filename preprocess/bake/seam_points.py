"""Points beside seams, where a texture is held to what the source shows there (docs/method.md, section 3).

Closing a seam moves the texels that it reads, and what lies on narrow faces beside a straightened seam falls between
texel centres. Points that are even over the surface, not over the atlas, weigh both as they are seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import uv_to_px

NEAR_PX = 4.0  # beside joined seams: as far as erasure moves normals
POINTS_A_TEXEL = 2.3  # over all texels that charts cover; a quarter as many leave texels beside seams to chance
LINE_STEP_PX = 0.5
# Two irrational steps whose multiples fill a square evenly (Roberts 2018, from the plastic number).
STEPS = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class SurfacePoints:
    """N points of a surface.

    Attributes
    ----------
    faces : (N,) int64
    barycentrics : (N, 3) float64
    """

    faces: NDArray[np.int64]
    barycentrics: Floats

    def interpolate(self, corner_values: Floats) -> Floats:
        """Values given at the corners of all faces, (F, 3, C), at the points, (N, C)."""
        result: Floats = np.einsum("nk,nkc->nc", self.barycentrics, corner_values[self.faces])
        return result


def spread_points(corners: Floats, count: int) -> SurfacePoints:
    """Points that are even over triangles (F, 3, 3): as many an area everywhere, and evenly within each."""
    reached = np.cumsum(face_areas(corners))
    number = np.arange(count)
    faces = np.searchsorted(reached, (number + 0.5) / max(count, 1) * reached[-1])
    first, second = (np.modf(0.5 + number * step)[0] for step in STEPS)
    over = first + second > 1.0  # the other half of the square
    first, second = np.where(over, 1.0 - first, first), np.where(over, 1.0 - second, second)
    return SurfacePoints(np.minimum(faces, len(corners) - 1), np.stack([1.0 - first - second, first, second], axis=1))


def near_lines(lines_px: Floats, width: int, height: int) -> NDArray[np.bool_]:
    """Texels within reach of lines (E, 2, 2), in texel coordinates, (H, W) bool."""
    from scipy import ndimage

    far = np.ones((height, width), bool)
    along = lines_px[:, 1] - lines_px[:, 0]
    pieces = np.ceil(np.linalg.norm(along, axis=1) / LINE_STEP_PX).astype(np.int64) + 1
    line = np.repeat(np.arange(len(lines_px)), pieces)
    share = (np.arange(len(line)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / np.maximum(pieces[line] - 1, 1)
    column, row = np.rint(lines_px[line, 0] + share[:, None] * along[line]).astype(np.int64).T
    far[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] = False
    if far.all():
        return ~far
    return np.asarray(ndimage.distance_transform_edt(far) <= NEAR_PX)


def points_near_seams(
    surface: TexturedSurface, corner_uvs: Floats, seam_uvs: Floats, size_px: tuple[int, int]
) -> SurfacePoints:
    """Points beside seams, even over the surface.

    Parameters
    ----------
    surface : TexturedSurface
    corner_uvs : (F, 3, 2) float64
        Where the corners of its faces sample the texture.
    seam_uvs : (S, 2, 2, 2) float64
        Both sides of the seams, from end to end, in the same texture.
    size_px : (width, height)

    Returns
    -------
    SurfacePoints
    """
    flat = uv_to_px(corner_uvs, *size_px)
    covered = face_areas(flat).sum()
    points = spread_points(surface.positions[surface.faces], int(np.ceil(POINTS_A_TEXEL * covered)))
    near = near_lines(uv_to_px(seam_uvs, *size_px).reshape(-1, 2, 2), *size_px)
    column, row = np.rint(points.interpolate(flat)).astype(np.int64).T
    kept = near[np.clip(row, 0, size_px[1] - 1), np.clip(column, 0, size_px[0] - 1)]
    return SurfacePoints(points.faces[kept], points.barycentrics[kept])
