"""What decimation tests measure in the plane of the texture."""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface


def uv_areas(surface: TexturedSurface) -> Floats:
    corners = surface.uvs[surface.face_uvs]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def outline(surface: TexturedSurface) -> Floats:
    """uv segments of the silhouette, (S, 2 ends, 2)."""
    seams = find_seams(surface)
    return surface.uvs[np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs])]


def distance_to_segments(points: Floats, segments: Floats) -> Floats:
    start, line = segments[None, :, 0], (segments[:, 1] - segments[:, 0])[None]
    t = ((points[:, None] - start) * line).sum(2) / np.maximum((line**2).sum(2), 1e-300)
    nearest = start + np.clip(t, 0.0, 1.0)[..., None] * line
    return np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)
