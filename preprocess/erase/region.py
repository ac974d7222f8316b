"""Which texels the uv mesh uses: inside it, or outside but read by samples along its silhouette (paper, section 4).

A texel is *inside* where its centre lies in a uv triangle. A cell of four texels is a *silhouette cell* where the uv
silhouette passes through it; its texels that are not inside are *outside* texels: samples read them, but the
texture's author may never have painted them. All other texels are never read and never touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from preprocess.erase.intervals import Intervals, split_edges
from preprocess.mesh import Floats, TexturedSurface
from preprocess.seams import Seams
from preprocess.texels import bilinear_stencil, uv_to_px

# Texel centres this close to a triangle count as inside, so that no centre on a shared edge falls between two.
RASTER_SLACK_PX = 1e-7


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
        return self.inside.shape[1]

    @property
    def height(self) -> int:
        """Rows of the image."""
        return self.inside.shape[0]


@njit(cache=True)
def _fill_triangles(triangles_px, slack, repeat, inside):
    """Mark the texel centres in each triangle, row by row."""
    height, width = inside.shape
    for t in range(triangles_px.shape[0]):
        x0, y0 = triangles_px[t, 0, 0], triangles_px[t, 0, 1]
        x1, y1 = triangles_px[t, 1, 0], triangles_px[t, 1, 1]
        x2, y2 = triangles_px[t, 2, 0], triangles_px[t, 2, 1]
        low, high = min(y0, y1, y2), max(y0, y1, y2)
        first, last = int(np.ceil(low - slack)), int(np.floor(high + slack))
        if not repeat:
            first, last = max(first, 0), min(last, height - 1)
        for row in range(first, last + 1):
            y = min(max(float(row), low), high)
            left, right = np.inf, -np.inf
            for k in range(3):
                if k == 0:
                    ax, ay, bx, by = x0, y0, x1, y1
                elif k == 1:
                    ax, ay, bx, by = x1, y1, x2, y2
                else:
                    ax, ay, bx, by = x2, y2, x0, y0
                if min(ay, by) <= y <= max(ay, by):
                    if ay == by:
                        left, right = min(left, ax, bx), max(right, ax, bx)
                    else:
                        x = ax + (y - ay) / (by - ay) * (bx - ax)
                        left, right = min(left, x), max(right, x)
            begin, stop = int(np.ceil(left - slack)), int(np.floor(right + slack))
            if repeat:
                for column in range(begin, stop + 1):
                    inside[row % height, column % width] = True
            else:
                for column in range(max(begin, 0), min(stop, width - 1) + 1):
                    inside[row, column] = True


def find_inside(surface: TexturedSurface, width: int, height: int, *, repeat: bool = False) -> NDArray[np.bool_]:
    """Mark the texels whose centres lie in the uv mesh.

    Returns
    -------
    (H, W) bool
    """
    inside = np.zeros((height, width), np.bool_)
    triangles = np.ascontiguousarray(uv_to_px(surface.uvs, width, height)[surface.face_uvs])
    _fill_triangles(triangles, RASTER_SLACK_PX, repeat, inside)
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
    return y * width + x


def find_region(
    surface: TexturedSurface,
    seams: Seams,
    width: int,
    height: int,
    *,
    repeat: bool = False,
    silhouette: Intervals | None = None,
    sample_uvs: Floats | None = None,
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
        `split_edges(silhouette_lines(surface, seams), width, height)` where the caller has it.
    sample_uvs : (N, 2) float64, optional
        Points whose cells count as silhouette cells, so that the texture is free to change there.

    Returns
    -------
    Region
    """
    if silhouette is None:
        silhouette = split_edges(silhouette_lines(surface, seams), width, height, repeat=repeat)
    inside = find_inside(surface, width, height, repeat=repeat)
    parts = [silhouette.texels[:, 0, 0]]
    if sample_uvs is not None:
        parts.append(bilinear_stencil(sample_uvs, width, height)[0][:, 0])
    if len(surface.uvs) and (surface.uvs.min() < 0 or surface.uvs.max() > 1):
        parts.append(_border_cells(inside, repeat))
    cells = np.unique(np.concatenate(parts))
    return Region(inside, int(np.count_nonzero(inside)), cells, repeat)
