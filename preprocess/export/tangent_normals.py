"""A tangent-space normal map of the atlas, for engines: glTF knows no object-space normals.

The object-space normal texture, closed at its seams, is turned texel by texel into the frame that an engine has there:
the finest level's vertex normals and tangents, interpolated over its triangles, and the bitangent n × t · w. So relief
shows wherever the character is opened, and the two sides of a seam show the same direction, each in its own frame.

glTF 2.0, section 3.9.3 (normal textures) and 3.7.2.1 (tangents).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from preprocess.arrays import Floats
from preprocess.export.lod_vertices import LodMesh
from preprocess.load.character import Material
from preprocess.load.tangents import compute_tangents
from preprocess.mesh.raster import fill_outside, interpolate_corners, rasterise
from preprocess.mesh.surface import SkinnedMesh
from runtime.asset.lod_mesh import UV_STEPS

LEAST_UP = 0.05  # of a stored normal along the vertex normal: an engine lights nothing from below the surface


def has_relief(materials: Sequence[Material]) -> bool:
    """Whether any material has a normal map: without one, vertex normals say everything."""
    return any(material.normal is not None for material in materials)


def atlas_tangents(mesh: SkinnedMesh) -> Floats:
    """MikkTSpace tangents of the atlas, (F, 3, 4)."""
    surface = mesh.surface
    return compute_tangents(surface.positions, surface.faces, mesh.corner_normals, surface.uvs[surface.face_uvs])


def _unit(vectors: Floats) -> Floats:
    result: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
    return result


def to_frame(directions: Floats, normals: Floats, tangents: Floats) -> Floats:
    """Directions in the frames that an engine makes of interpolated normals and tangents.

    Parameters
    ----------
    directions : (N, 3) float64
        Unit vectors, object space.
    normals : (N, 3) float64
        Not zero; need not be unit vectors.
    tangents : (N, 4) float64
        With handedness; need not be across the normals.

    Returns
    -------
    (N, 3) float64
        Unit vectors: along the tangent, the bitangent and the normal. `t * x + b * y + n * z` is the direction again.
    """
    n, t = _unit(normals), _unit(tangents[:, :3])
    b = np.cross(n, t) * np.where(tangents[:, 3:] < 0, -1.0, 1.0)
    frames = np.stack([t, b, n], axis=2)
    singular = np.abs(np.linalg.det(frames)) < 1e-6
    frames[singular] = np.eye(3)
    local = np.asarray(np.linalg.solve(frames, directions[:, :, None])[:, :, 0], np.float64)
    local[singular] = (0.0, 0.0, 1.0)
    return _unit(local)


def bake_tangent_normals(level: LodMesh, normals: Floats) -> Floats:
    """The tangent-space normal map.

    Parameters
    ----------
    level : LodMesh
        The finest, with tangents.
    normals : (H, W, 3) float64
        The stored object-space normal texture, in [0, 1].

    Returns
    -------
    (H, W, 3) float64
        In [0, 1], as glTF stores it: green points up.
    """
    assert level.tangents is not None
    height, width = normals.shape[:2]
    uvs = level.uvs.astype(np.float64) if level.normal_uvs is None else level.normal_uvs / float(UV_STEPS)
    coverage = rasterise(uvs, level.faces.astype(np.int32), width, height)
    near = coverage.faces >= 0
    frames = interpolate_corners(
        coverage, np.concatenate([level.normals, level.tangents], axis=1).astype(np.float64)[level.faces]
    )[near]
    local = to_frame(_unit(2.0 * normals[near] - 1.0), frames[:, :3], frames[:, 3:])
    local[:, 2] = np.maximum(local[:, 2], LEAST_UP)
    result = np.zeros((height, width, 3))
    result[..., 2] = 1.0
    result[near] = _unit(local)
    return np.asarray(0.5 * fill_outside(result, near) + 0.5, np.float64)
