"""Which texels the uv mesh uses: inside it, or outside but read by samples along its silhouette (paper, section 4).

A texel is *inside* where its centre lies in a uv triangle. A cell of four texels is a *silhouette cell* where the uv
silhouette passes through it; its texels that are not inside are *outside* texels: samples read them, but the
texture's author may never have painted them. All other texels are never read and never touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.erase.intervals import Intervals, cut_into_intervals
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import bilinear_stencil, uv_to_px

# Texel centres this close to a triangle count as inside, so that no centre on a shared edge falls between two.
RASTER_SLACK_PX = 1e-7

BAND_ROWS = 256


@dataclass(frozen=True)
class Region:
    """Use of the texels of one image size.

    Attributes
    ----------
    inside : (H, W) bool
        Whether a texel's centre lies in the uv mesh.
    num_inside : int
    cells : (N,) int64
        Silhouette cells as `row * W + column` of their top left texel, sorted.
    repeat : bool
        Whether the sampler repeats: texel 0 then follows texel W - 1.
    """

    inside: NDArray[np.bool_]
    num_inside: int
    cells: NDArray[np.int64]
    repeat: bool

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Inside texels and those of silhouette cells, (H, W) bool."""
        used = self.inside.copy()
        y, x = np.divmod(self.cells, self.width)
        for dy in (0, 1):
            for dx in (0, 1):
                used[(y + dy) % self.height, (x + dx) % self.width] = True
        return used

    @property
    def width(self) -> int:
        """Columns of the image."""
        result: int = self.inside.shape[1]
        return result

    @property
    def height(self) -> int:
        """Rows of the image."""
        result: int = self.inside.shape[0]
        return result


def _find_spans(triangles_px: Floats, slack: float) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Runs of texel centres inside triangles, row by row: row, first and last column; each (S,) int64."""
    y = triangles_px[:, :, 1]
    low, high = y.min(axis=1), y.max(axis=1)
    first = np.ceil(low - slack).astype(np.int64)
    count = np.maximum(np.floor(high + slack).astype(np.int64) - first + 1, 0)
    triangle = np.repeat(np.arange(len(triangles_px)), count)
    row = first[triangle] + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    at = np.clip(row, low[triangle], high[triangle])
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    start, end = triangles_px, np.roll(triangles_px, -1, axis=1)
    rise = end[:, :, 1] - start[:, :, 1]
    slope = (end[:, :, 0] - start[:, :, 0]) / np.where(rise == 0, 1.0, rise)
    for k in range(3):
        meets = (np.minimum(start[:, k, 1], end[:, k, 1])[triangle] <= at) & (
            at <= np.maximum(start[:, k, 1], end[:, k, 1])[triangle]
        )
        hit = np.flatnonzero(meets)
        which = triangle[hit]
        # A level edge counts from end to end.
        x = start[which, k, 0] + (at[hit] - start[which, k, 1]) * slope[which, k]
        other = np.where(rise[which, k] == 0, end[which, k, 0], x)
        left[hit] = np.minimum(left[hit], np.minimum(x, other))
        right[hit] = np.maximum(right[hit], np.maximum(x, other))
    begin, stop = np.ceil(left - slack).astype(np.int64), np.floor(right + slack).astype(np.int64)
    holds = begin <= stop
    return row[holds], begin[holds], stop[holds]


def _wrap_spans(
    row: NDArray[np.int64], begin: NDArray[np.int64], stop: NDArray[np.int64], width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Spans brought into the image by whole images; those that leave it on the right go on at the left."""
    stop = np.minimum(stop, begin + width - 1)
    stop -= begin // width * width
    begin = begin % width
    over = stop >= width
    row = np.concatenate([row, row[over]]) % height
    begin = np.concatenate([begin, np.zeros(np.count_nonzero(over), np.int64)])
    return row, begin, np.concatenate([np.minimum(stop, width - 1), stop[over] - width])


def find_inside(surface: TexturedSurface, width: int, height: int, *, repeat: bool = False) -> NDArray[np.bool_]:
    """Mark the texels whose centres lie in the uv mesh.

    Returns
    -------
    (H, W) bool
    """
    row, begin, stop = _find_spans(uv_to_px(surface.uvs, width, height)[surface.face_uvs], RASTER_SLACK_PX)
    if repeat:
        row, begin, stop = _wrap_spans(row, begin, stop, width, height)
    else:
        kept = (row >= 0) & (row < height) & (begin < width) & (stop >= 0)
        row, begin, stop = row[kept], np.maximum(begin[kept], 0), np.minimum(stop[kept], width - 1)
    inside = np.zeros((height, width), np.bool_)
    # Running sums over a band of rows: plus one where a span begins, minus one behind its end.
    for top in range(0, height, BAND_ROWS):
        band = inside[top : top + BAND_ROWS]
        mine = np.flatnonzero((row >= top) & (row < top + len(band)))
        line = (row[mine] - top) * (width + 1)
        steps = np.zeros(len(band) * (width + 1), np.int32)
        np.add.at(steps, line + begin[mine], np.int32(1))
        np.add.at(steps, line + stop[mine] + 1, np.int32(-1))
        band[:] = np.cumsum(steps, dtype=np.int32).reshape(len(band), -1)[:, :-1] > 0
    return inside


def silhouette_ends(seams: Seams) -> NDArray[np.int32]:
    """Texture vertices at the ends of all silhouette and foldover edges, (E, 2): seam sides, boundaries, foldovers."""
    return np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs, seams.foldover_uvs])


def silhouette_lines(surface: TexturedSurface, seams: Seams) -> Floats:
    """All silhouette and foldover edges as lone uv lines, (E, 1, 2, 2) float64."""
    return surface.uvs[silhouette_ends(seams)][:, None]


def _border_cells(inside: NDArray[np.bool_], repeat: bool) -> NDArray[np.int64]:
    """Cells along the image's border that have an inside texel: where a chart runs over it, squares end there."""
    height, width = inside.shape
    near = np.zeros_like(inside)
    near[[0, -1]] = inside[[0, -1]]
    near[:, [0, -1]] = inside[:, [0, -1]]
    y, x = np.divmod(np.flatnonzero(near), width)
    if not repeat:
        x, y = np.minimum(x, max(width - 2, 0)), np.minimum(y, max(height - 2, 0))
    result: NDArray[np.int64] = y * width + x
    return result


def find_region(
    surface: TexturedSurface,
    seams: Seams,
    width: int,
    height: int,
    *,
    repeat: bool = False,
    silhouette: Intervals | None = None,
    sample_uvs: Floats | None = None,
    seam_cells: NDArray[np.int64] | None = None,
) -> Region:
    """Sort the texels of an image by their use.

    Parameters
    ----------
    surface : TexturedSurface
    seams : Seams
    width, height : int
    repeat : bool
        Whether the sampler repeats.
    silhouette : Intervals, optional
        `cut_into_intervals(silhouette_lines(surface, seams), width, height)` where the caller has it.
    sample_uvs : (N, 2) float64, optional
        Points whose cells count as silhouette cells, so that the texture is free to change there.
    seam_cells : (N,) or more int64, optional
        Cells that the seams read when their two sides are cut together. Where an edge runs along a line of texel
        centres, rounding decides between the cells beside it, and may decide otherwise for a lone edge.

    Returns
    -------
    Region
    """
    if silhouette is None:
        silhouette = cut_into_intervals(silhouette_lines(surface, seams), width, height, repeat=repeat)
    inside = find_inside(surface, width, height, repeat=repeat)
    parts = [silhouette.texels[:, 0, 0]]
    if seam_cells is not None:
        parts.append(seam_cells.reshape(-1))
    if sample_uvs is not None:
        parts.append(bilinear_stencil(sample_uvs, width, height)[0][:, 0])
    if len(surface.uvs) and (surface.uvs.min() < 0 or surface.uvs.max() > 1):
        parts.append(_border_cells(inside, repeat))
    cells = np.unique(np.concatenate(parts))
    return Region(inside, int(np.count_nonzero(inside)), cells, repeat)
