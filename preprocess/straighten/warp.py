"""Warps images from old uvs to new ones: new texel → surface point → old uv (paper, section 6, "warp of the signals").

Each new texel's centre is found on the surface through the new uvs, and read from the old image there: with a bicubic
filter (Catmull and Rom 1974), held within the range of the texels that it reads so that hard edges do not ring, or,
where the old image is denser than the new one, averaged over the texel's footprint. Texels beside a chart continue its
nearest face; the rest take the nearest value that is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.files.resample import sample_footprints
from preprocess.mesh.raster import Coverage, clamp_extrapolation, fill_outside, rasterise
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import uv_to_px
from preprocess.numerics.jit import entry

REACH_PX = 3.0  # how far beside a chart its faces are continued: bilinear samples, and one mip level more
DENSER = 1.25  # old texels a new one beyond which it averages its footprint


@dataclass(frozen=True)
class Warp:
    """Where every texel of an H x W image comes from. N texels have a source.

    Attributes
    ----------
    coverage : Coverage
        Of the new uvs.
    rows, columns : (N,) int64
        The texels with a source.
    old_uvs : (N, 2) float64
        Their source.
    old_dx, old_dy : (N, 2) float64
        Change of the source over one texel to the right and down.
    """

    coverage: Coverage
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    old_uvs: Floats
    old_dx: Floats
    old_dy: Floats

    def apply(self, texels: NDArray[np.floating]) -> Floats:
        """Warp one image.

        Parameters
        ----------
        texels : (h, w, C) float
            Of any size. uvs beyond its edges repeat it, as glTF's default sampler does.

        Returns
        -------
        (H, W, C) float64
            Every texel is defined; values never leave the range of the source's.
        """
        height, width = texels.shape[:2]
        size = np.array([width, height])
        span = np.maximum(np.abs(self.old_dx * size).max(axis=1), np.abs(self.old_dy * size).max(axis=1))
        dense = span > DENSER
        values = np.empty((len(self.rows), texels.shape[2]))
        source = np.ascontiguousarray(texels, np.float64)
        values[~dense] = _sample_cubic(source, uv_to_px(self.old_uvs[~dense], width, height))
        values[dense] = sample_footprints(
            source, self.old_uvs[dense], self.old_dx[dense], self.old_dy[dense], "REPEAT", "REPEAT", False
        )
        result = np.zeros((*self.coverage.shape, texels.shape[2]))
        result[self.rows, self.columns] = values
        return fill_outside(result, self.coverage.faces >= 0)


@entry
def _sample_cubic(texels, points_px):  # type: ignore[no-untyped-def]
    """Catmull-Rom samples (N, C) at texel coordinates (N, 2), within the range of their 4 x 4 texels; repeats."""
    height, width, channels = texels.shape
    result = np.empty((len(points_px), channels))
    weight = np.empty((2, 4))
    first = np.empty(2, np.int64)
    for n in range(len(points_px)):
        for axis in range(2):
            low = np.floor(points_px[n, axis])
            first[axis] = int(low) - 1
            t = points_px[n, axis] - low
            weight[axis, 0] = t * (t * (1.0 - 0.5 * t) - 0.5)
            weight[axis, 1] = 1.0 + t * t * (1.5 * t - 2.5)
            weight[axis, 2] = t * (0.5 + t * (2.0 - 1.5 * t))
            weight[axis, 3] = 0.5 * t * t * (t - 1.0)
        for c in range(channels):
            total, least, most = 0.0, np.inf, -np.inf
            for j in range(4):
                for i in range(4):
                    value = texels[(first[1] + j) % height, (first[0] + i) % width, c]
                    total += weight[0, i] * weight[1, j] * value
                    if weight[0, i] != 0.0 and weight[1, j] != 0.0:
                        least, most = min(least, value), max(most, value)
            result[n, c] = min(max(total, least), most)
    return result


def find_warp(old: TexturedSurface, new: TexturedSurface, width: int, height: int) -> Warp:
    """Prepare the warp of W x H images from a surface's old uvs to its new ones.

    Parameters
    ----------
    old, new : TexturedSurface
        The same faces, corner by corner; only `uvs` and `face_uvs` count.
    width, height : int
        Size of the images to make.

    Raises
    ------
    ValueError
        If the numbers of faces differ.
    """
    if len(old.faces) != len(new.faces):
        raise ValueError(f"the surfaces have {len(old.faces)} and {len(new.faces)} faces: they must be the same")
    coverage = rasterise(new.uvs, new.face_uvs, width, height, REACH_PX)
    rows, columns = np.nonzero(coverage.faces >= 0)
    faces = coverage.faces[rows, columns]
    old_corners, new_corners = old.uvs[old.face_uvs], new.uvs[new.face_uvs] * (width, height)
    weights = clamp_extrapolation(coverage.barycentrics[rows, columns])
    old_edges = np.stack([old_corners[:, 1] - old_corners[:, 0], old_corners[:, 2] - old_corners[:, 0]], axis=2)
    new_edges = np.stack([new_corners[:, 1] - new_corners[:, 0], new_corners[:, 2] - new_corners[:, 0]], axis=2)
    (a, b), (c, d) = new_edges.transpose(1, 2, 0)
    area = np.where(a * d - b * c == 0.0, 1.0, a * d - b * c)
    inverse = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1) / area[:, None, None]
    jacobian = (old_edges @ inverse)[faces]
    return Warp(
        coverage=coverage,
        rows=rows,
        columns=columns,
        old_uvs=np.einsum("nk,nkc->nc", weights, old_corners[faces]),
        old_dx=jacobian[:, :, 0],
        old_dy=jacobian[:, :, 1],
    )
