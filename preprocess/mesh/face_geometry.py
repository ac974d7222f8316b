"""Areas, normals, centroids and angles of triangles, in space and in uv: the one place where they are computed.

Triangles are given by their corners, (F, 3, 3) in space or (F, 3, 2) in uv: `positions[faces]`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats


def doubled_area_vectors(triangles: Floats) -> Floats:
    """Normals of triangles in space, as long as twice their areas, (F, 3)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    return np.cross(b - a, c - a)


def doubled_signed_areas(triangles: Floats) -> Floats:
    """Twice the areas of plane triangles, (F,): positive where the second axis lies to the left of the first edge."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: Floats = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return areas


def face_areas(triangles: Floats) -> Floats:
    """Areas of triangles in space or in the plane, (F,), not negative."""
    if triangles.shape[-1] == 2:
        return 0.5 * np.abs(doubled_signed_areas(triangles))
    result: Floats = 0.5 * np.linalg.norm(doubled_area_vectors(triangles), axis=1)
    return result


def unit_vectors(vectors: Floats) -> Floats:
    """Vectors of length one, (..., 3); zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    result: Floats = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
    return result


def face_normals(triangles: Floats) -> Floats:
    """Unit normals of triangles in space, (F, 3); zero for one without area."""
    return unit_vectors(doubled_area_vectors(triangles))


def face_frames(positions: Floats, faces: NDArray[np.integer]) -> tuple[Floats, Floats, Floats]:
    """Area, unit normal and centroid of every face: (F,), (F, 3), (F, 3)."""
    triangles = positions[faces]
    centroids = (triangles[:, 0] + triangles[:, 1] + triangles[:, 2]) / 3
    return face_areas(triangles), face_normals(triangles), centroids


def corner_angles(triangles: Floats) -> Floats:
    """Inner angles of triangles in space, (F, 3), radians; zero beside an edge of no length."""
    ahead = np.roll(triangles, -1, axis=1) - triangles
    back = np.roll(triangles, 1, axis=1) - triangles
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    result: Floats = np.arctan2(sine, np.einsum("fkc,fkc->fk", ahead, back)) * (sine > 0)
    return result
