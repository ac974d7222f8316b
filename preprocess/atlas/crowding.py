"""How many texels two charts of an atlas would have to share at a given size."""

from __future__ import annotations

import numpy as np

from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import uv_to_px
from preprocess.numerics.jit import entry


def measure_crowding(surface: TexturedSurface, size_px: int) -> float:
    """Share of the texels that bilinear samples of two or more charts read, among those that any reads.

    Parameters
    ----------
    surface : TexturedSurface
        uvs in the unit square.
    size_px : int
        Side of the texture.

    Returns
    -------
    float
    """
    edges = find_edges(surface.faces)
    _, charts = label_faces(edges, cut_edges(edges, surface.face_uvs))
    triangles = uv_to_px(surface.uvs, size_px, size_px)[surface.face_uvs]
    owner = np.full((size_px, size_px), -1, np.int32)
    shared = np.zeros((size_px, size_px), bool)
    _claim(np.ascontiguousarray(triangles), charts, owner, shared)
    return float(shared.sum() / max((owner >= 0).sum(), 1))


@entry
def _claim(triangles, charts, owner, shared):  # type: ignore[no-untyped-def]
    """Mark texels whose bilinear support (a square of side 2) meets a triangle, and those of two charts."""
    size = len(owner)
    for f in range(len(triangles)):
        t = triangles[f]
        x0 = max(int(np.ceil(min(t[0, 0], t[1, 0], t[2, 0]) - 1.0)), 0)
        x1 = min(int(np.floor(max(t[0, 0], t[1, 0], t[2, 0]) + 1.0)), size - 1)
        y0 = max(int(np.ceil(min(t[0, 1], t[1, 1], t[2, 1]) - 1.0)), 0)
        y1 = min(int(np.floor(max(t[0, 1], t[1, 1], t[2, 1]) + 1.0)), size - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                meets = True
                for k in range(3):  # the triangle's edges as separating axes of the square around (x, y)
                    m = (k + 1) % 3
                    o = (k + 2) % 3
                    nx, ny = t[k, 1] - t[m, 1], t[m, 0] - t[k, 0]
                    inner = nx * (t[o, 0] - t[k, 0]) + ny * (t[o, 1] - t[k, 1])
                    if inner < 0.0:
                        nx, ny = -nx, -ny
                    if nx * (x - t[k, 0]) + ny * (y - t[k, 1]) + abs(nx) + abs(ny) <= 0.0:
                        meets = False
                        break
                if meets:
                    if owner[y, x] >= 0 and owner[y, x] != charts[f]:
                        shared[y, x] = True
                    owner[y, x] = charts[f]
