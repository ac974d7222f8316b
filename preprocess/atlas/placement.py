"""Charts into the unit square, each with the texels that its detail needs, as far apart as the square can spare."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.atlas.chart_scales import chart_densities, texture_side
from preprocess.atlas.distortion import turned_areas
from preprocess.atlas.pack import pack_charts
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.face_geometry import face_frames
from preprocess.mesh.surface import TexturedSurface

GUTTER_SIZE_PX, GUTTER_PX = 1024, 8.0
"""Charts stay this many texels of a texture of that size apart: two, where geometry and weights have 256 …"""

GUTTER_SHARE, LEAST_GUTTER_PX = 0.15, 2.0
"""… or fewer, where gutters would take more of the square than this; two texels of the largest texture at least."""

LEAST_CHART_PX = 2.0
"""Side of the square, in texels at `GUTTER_SIZE_PX`, that a chart covers at least."""


FILL = 0.65  # of the square, by charts: what packing usually comes to


def _choose_gutter(segments: Floats, area: float) -> float:
    """Least distance of charts in texels at `GUTTER_SIZE_PX`, from all outlines and the area in texels."""
    side = np.sqrt(area / FILL)  # of the square, texels
    outline = float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()) / side
    widest = 2.0 * GUTTER_SHARE / max(outline, 1e-300) * GUTTER_SIZE_PX
    least = LEAST_GUTTER_PX * min(GUTTER_SIZE_PX / texture_side(side), 1.0)
    return float(np.clip(widest, least, GUTTER_PX))


def _separate(surface: TexturedSurface, charts: Ints) -> tuple[TexturedSurface, NDArray[np.int64]]:
    """Give every chart texture vertices of its own: the surface, and the chart of every texture vertex (T,)."""
    stride = max(len(surface.uvs), 1)
    keys = np.repeat(charts.astype(np.int64), 3) * stride + surface.face_uvs.ravel()
    unique, index = np.unique(keys, return_inverse=True)
    face_uvs = index.reshape(-1, 3).astype(np.int32)
    return TexturedSurface(surface.positions, surface.faces, surface.uvs[unique % stride], face_uvs), unique // stride


def place_charts(surface: TexturedSurface, needs: Floats) -> TexturedSurface:
    """Place all charts in the unit square, turned and scaled, else unchanged in shape.

    Parameters
    ----------
    surface : TexturedSurface
        Its charts may overlap one another and lie anywhere, each being one-to-one in itself.
    needs : (F,) float64
        Texels a metre; zeros where nothing is painted.

    Raises
    ------
    InputError
        If there are more charts than fit.
    """
    edges = find_edges(surface.faces)
    cut = cut_edges(edges, surface.face_uvs)
    num_charts, charts = label_faces(edges, cut)
    surface, uv_charts = _separate(surface, charts)
    areas_m2 = face_frames(surface.positions, surface.faces)[0]
    corners = surface.uvs[surface.face_uvs]
    uv_areas = np.bincount(charts, np.abs(turned_areas(corners)), num_charts)
    density = chart_densities(needs, areas_m2, charts, num_charts)
    true_m = np.sqrt(np.bincount(charts, areas_m2, num_charts) / np.maximum(uv_areas, 1e-300))
    true_m = np.where(true_m > 0, true_m, np.median(true_m))
    factor = density * true_m  # texels for one uv of a chart as it comes
    halves = edges.halves[cut]
    halves = halves[halves >= 0]
    ends = halves - halves % 3 + (halves + 1) % 3
    points = corners.reshape(-1, 2)
    segments = np.stack([points[halves], points[ends]], axis=1) * factor[charts[halves // 3]][:, None, None]
    areas = uv_areas * factor**2
    gutter = _choose_gutter(segments, float(areas.sum()))
    packing = pack_charts(segments, charts[halves // 3], num_charts, areas, GUTTER_SIZE_PX, gutter, LEAST_CHART_PX)
    uvs = packing.apply(surface.uvs * factor[uv_charts][:, None], uv_charts)
    return TexturedSurface(surface.positions, surface.faces, uvs, surface.face_uvs)
