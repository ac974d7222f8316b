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
TEXELS_A_VERTEX = 1.5  # fewer cannot hold a value of its own for every vertex


def choose_geometry_size(mesh: SkinnedMesh) -> int:
    """Side of the square position texture, texels."""
    expected = vertex_values(mesh, mesh.surface.positions)
    diagonal_m = mesh.surface.diagonal_m
    for side in GEOMETRY_SIZES_PX:
        if side * side < TEXELS_A_VERTEX * mesh.num_vertices:
            continue
        error_m = np.linalg.norm(
            sample_bilinear(bake_positions(mesh, (side, side)), mesh.surface.uvs) - expected, axis=1
        )
        if _good(error_m, diagonal_m):
            break
    log.info("position texture: %d² texels, error rms %.2g max %.2g m", side, _rms(error_m), error_m.max())
    return side


def choose_weight_size(mesh: SkinnedMesh, poses: Floats) -> int:
    """Side of the square weight texture, texels.

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
    moved = np.einsum("pjik,vk->pvji", poses[:, :, :3], positions)
    exact = np.einsum("vj,pvji->pvi", dense, moved)
    for side in WEIGHT_SIZES_PX:
        if side * side < TEXELS_A_VERTEX * mesh.num_vertices:
            continue
        weights = sample_bilinear(bake_weights(mesh, num_joints, (side, side)), mesh.surface.uvs[owner])
        error_m = np.linalg.norm(np.einsum("vj,pvji->pvi", weights, moved) - exact, axis=2)
        if _good(error_m, mesh.surface.diagonal_m):
            break
    log.info("weight texture: %d² texels, error rms %.2g max %.2g m", side, _rms(error_m), error_m.max())
    return side


def _rms(error_m: Floats) -> float:
    return float(np.sqrt((error_m**2).mean()))


def _good(error_m: Floats, diagonal_m: float) -> bool:
    return bool(
        _rms(error_m) <= RMS_MARGIN * GEOMETRY_RMS_REL * diagonal_m
        and error_m.max() <= MAX_MARGIN * GEOMETRY_MAX_REL * diagonal_m
    )
