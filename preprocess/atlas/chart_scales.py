"""How many texels a metre each chart gets, and how large the textures are in which it has them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.atlas.distortion import sums, turned_areas
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.face_geometry import face_frames
from preprocess.mesh.surface import TexturedSurface

MIN_SIZE_PX, MAX_SIZE_PX = 512, 4096  # of an automatic size; borders between flat colours need some texels too

NORMAL_SIZE_PX = 1024  # of a normal texture without normal maps

FINEST_SHARE = 0.95
"""Of a chart's area: its scale is right for all but what is finer than this."""

PLAIN_SHARE = 0.5
"""Of the mean density, that charts without detail get at least: with it no chart has under a quarter of the median's
(half of the area cannot have more than √2.5 times the root mean square of all)."""

SAFE_FILL = 0.5
"""Of the square that charts cover at least, so that what is given away does not make the texture larger."""

SMALLER = 0.1
"""Of a size, that its next power of two may be larger: 7 % fewer texels a metre are not seen, four times
as many cost."""


def chart_densities(needs: Floats, areas_m2: Floats, face_charts: NDArray[np.integer], num_charts: int) -> Floats:
    """Texels a metre for each chart, (C,) float64.

    Every chart gets what its detail needs; what a texture of the next size has left goes to those that have least.

    Parameters
    ----------
    needs : (F,) float64
        Texels a metre that each face needs.
    areas_m2 : (F,) float64
    face_charts : (F,) int
    num_charts : int
    """
    order = np.lexsort((needs, face_charts))
    charts = face_charts[order]
    total = sums(face_charts, areas_m2, num_charts)
    so_far = np.cumsum(areas_m2[order])
    so_far -= (np.cumsum(total) - total)[charts]
    enough = np.flatnonzero(so_far >= FINEST_SHARE * total[charts] * (1.0 - 1e-9))
    first = np.unique(charts[enough], return_index=True)
    density = np.zeros(num_charts)
    density[first[0]] = needs[order][enough[first[1]]]
    mean = math.sqrt(float((total * density**2).sum()) / max(float(total.sum()), 1e-300))
    density = np.maximum(density, PLAIN_SHARE * mean)
    texels = SAFE_FILL * texture_side(math.sqrt(float((total * density**2).sum()) / SAFE_FILL)) ** 2
    return np.maximum(density, _level(density, total, texels))


def _level(density: Floats, areas_m2: Floats, texels: float) -> float:
    """The least density that all charts can have with so many texels together."""
    order = np.argsort(density)
    areas, squares = areas_m2[order], density[order] ** 2
    below = np.cumsum(areas)
    above = (areas * squares).sum() - np.cumsum(areas * squares)
    levels = (texels - above) / np.maximum(below, 1e-300)  # squared, where the first k charts are raised
    higher = np.append(squares[1:], np.inf)
    fits = np.flatnonzero((levels >= squares) & (levels <= higher))
    return math.sqrt(levels[fits[0]]) if len(fits) else 0.0


def wanted_side(surface: TexturedSurface, needs: Floats) -> float:
    """Side in texels of the square texture in which every chart has the texels that it needs; 0 where none needs any.

    Parameters
    ----------
    surface : TexturedSurface
        With the atlas as its uvs.
    needs : (F,) float64
        Texels a metre.
    """
    if not needs.any():
        return 0.0
    edges = find_edges(surface.faces)
    num_charts, charts = label_faces(edges, cut_edges(edges, surface.face_uvs))
    areas_m2 = face_frames(surface.positions, surface.faces)[0]
    uv_areas = np.bincount(charts, np.abs(turned_areas(surface.uvs[surface.face_uvs])), num_charts)
    texels = np.bincount(charts, needs**2 * areas_m2, num_charts)
    return float(np.sqrt((texels / np.maximum(uv_areas, 1e-12)).max()))


def texture_side(wanted: float) -> int:
    """The power of two that is taken for a wanted side, within the limits of automatic sizes."""
    side = 2 ** math.ceil(math.log2(max(wanted, 1.0)) - SMALLER)
    return int(min(max(side, MIN_SIZE_PX), MAX_SIZE_PX))
