"""Automatic texture sizes: the smallest that reach the accuracy asked for at the vertices of the full mesh."""

from __future__ import annotations

import logging

import numpy as np

from preprocess.bake import bake_positions, bake_weights, vertex_values
from preprocess.mesh import Floats, SkinnedMesh
from preprocess.settings import GEOMETRY_MAX_REL, GEOMETRY_RMS_REL
from preprocess.texels import sample_bilinear

log = logging.getLogger(__name__)

GEOMETRY_SIZES_PX = (128, 192, 256, 384, 512, 768, 1024, 1536, 2048)
WEIGHT_SIZES_PX = (64, 96, 128, 192, 256, 384, 512, 768)
RMS_MARGIN, MAX_MARGIN = 0.5, 0.8  # of the accuracy goals: seam erasure and rounding add their own part
HOPELESS = 4.0  # times the goal after one projection: more of them will not help
TEXELS_A_VERTEX = 1.5  # fewer cannot hold a value of its own for every vertex


def bake_positions_auto(mesh: SkinnedMesh) -> Floats:
    """Positions at the smallest size that holds the full mesh's vertices, (H, W, 3) float64, square."""
    expected = vertex_values(mesh, mesh.surface.positions)
    for side in _sides(GEOMETRY_SIZES_PX, mesh):
        texels = bake_positions(mesh, (side, side))
        error_m = np.linalg.norm(sample_bilinear(texels, mesh.surface.uvs) - expected, axis=1)
        if _good(error_m, mesh.surface.diagonal_m):
            break
    log.info("position texture: %d² texels, error rms %.2g max %.2g m", side, _rms(error_m), error_m.max())
    return texels


def bake_weights_auto(mesh: SkinnedMesh, poses: Floats) -> Floats:
    """Weights at the smallest size that poses the full mesh's vertices rightly, (H, W, J) float64, square.

    Parameters
    ----------
    poses : (P, J, 4, 4) float64
        Skinning matrices of a few poses of the clips: weights matter by how far they move a vertex.
    """
    num_joints = poses.shape[1]
    positions = np.c_[mesh.surface.positions, np.ones(mesh.num_vertices)]
    dense = mesh.dense_weights(num_joints)
    owner = np.zeros(mesh.num_vertices, np.int64)  # one texture vertex of every surface vertex
    owner[mesh.surface.faces.ravel()] = mesh.surface.face_uvs.ravel()
    moved = np.einsum("pjik,vk->vjpi", poses[:, :, :3], positions).reshape(mesh.num_vertices, num_joints, -1)

    def measure(texels: Floats) -> Floats:
        wrong = sample_bilinear(texels, mesh.surface.uvs[owner]) - dense
        return np.linalg.norm(np.einsum("vj,vjc->vc", wrong, moved).reshape(mesh.num_vertices, -1, 3), axis=2)

    sides = list(_sides(WEIGHT_SIZES_PX, mesh))
    for side in sides:
        first = bake_weights(mesh, num_joints, (side, side), projections=1)
        if side != sides[-1] and _rms(measure(first)) > HOPELESS * GEOMETRY_RMS_REL * mesh.surface.diagonal_m:
            continue
        texels = bake_weights(mesh, num_joints, (side, side))
        error_m = measure(texels)
        if _good(error_m, mesh.surface.diagonal_m):
            break
    log.info("weight texture: %d² texels, error rms %.2g max %.2g m", side, _rms(error_m), error_m.max())
    return texels


def _sides(candidates: tuple[int, ...], mesh: SkinnedMesh) -> list[int]:
    """Candidates with enough texels for the vertices; the largest in any case."""
    enough = [side for side in candidates if side * side >= TEXELS_A_VERTEX * mesh.num_vertices]
    return enough or [candidates[-1]]


def _rms(error_m: Floats) -> float:
    return float(np.sqrt((error_m**2).mean()))


def _good(error_m: Floats, diagonal_m: float) -> bool:
    return bool(
        _rms(error_m) <= RMS_MARGIN * GEOMETRY_RMS_REL * diagonal_m
        and error_m.max() <= MAX_MARGIN * GEOMETRY_MAX_REL * diagonal_m
    )
