"""Signals of the surface into textures of the atlas (paper, sections 7 and 8): position, normal, weights.

Each texel takes the surface's value under its centre. A bilinear sample at a vertex then misses that vertex by the
curvature inside one cell; `fit_vertices` moves the texels, as little as possible, until the samples at all vertices
are exact, so that the finest level of detail is the source mesh.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.mesh.raster import cover_atlas, fill_outside, interpolate_corners
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import bilinear_stencil
from preprocess.numerics.cholesky import factor_symmetric

log = logging.getLogger(__name__)

PROJECTIONS = 4  # alternations that keep weights non-negative; each halves what clipping costs at the vertices
FIT_DAMPING = 1e-4  # relative to a stencil's own weight; vertices denser than texels then share the error


def bake_surface_positions(mesh: SkinnedMesh, size: tuple[int, int]) -> Floats:
    """Object-space positions of the surface under each texel, metres, (H, W, 3) float64; size is (width, height)."""
    coverage = cover_atlas(mesh, *size)
    texels = interpolate_corners(coverage, mesh.surface.positions[mesh.surface.faces])
    return fill_outside(texels, coverage.faces >= 0)


def bake_positions(mesh: SkinnedMesh, size: tuple[int, int]) -> Floats:
    """Object-space positions, metres, right at the vertices.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    size : (width, height)

    Returns
    -------
    (H, W, 3) float64
    """
    surface = mesh.surface
    texels = bake_surface_positions(mesh, size)
    return fit_vertices(texels, surface.uvs, vertex_values(mesh, surface.positions))


def bake_weights(mesh: SkinnedMesh, num_joints: int, size: tuple[int, int], projections: int = PROJECTIONS) -> Floats:
    """Joint weights, non-negative and summing to one in every texel.

    Parameters
    ----------
    mesh : SkinnedMesh
    num_joints : int
    size : (width, height)
    projections : int
        Alternations between the vertices' own weights and partitions of unity.

    Returns
    -------
    (H, W, J) float64
    """
    surface = mesh.surface
    dense = mesh.dense_weights(num_joints)
    used = np.flatnonzero(dense.max(axis=0) > 0)
    dense = dense[:, used]
    coverage = cover_atlas(mesh, *size)
    near = coverage.faces >= 0
    height, width = coverage.shape
    texels = np.zeros((height, width, len(used)))
    barycentrics = np.clip(coverage.barycentrics[near].astype(np.float64), 0.0, None)
    barycentrics /= barycentrics.sum(axis=1, keepdims=True)
    corners = surface.faces[coverage.faces[near]]
    texels[near] = sum(barycentrics[:, k, None] * dense[corners[:, k]] for k in range(3))
    texels = fill_outside(texels, near)
    values = vertex_values(mesh, dense)
    texels = _project(texels, plan_fit(surface.uvs, width, height), values, projections)
    result = np.zeros((height, width, num_joints))
    result[..., used] = texels
    return result


def _project(texels: Floats, fit: Callable[[Floats, Floats], Floats], values: Floats, times: int) -> Floats:
    """Alternate between the vertices' values and partitions of unity."""
    for _ in range(times):
        texels = np.clip(fit(texels, values), 0.0, None)
        texels /= texels.sum(axis=2, keepdims=True)
    return texels


def vertex_values(mesh: SkinnedMesh, values: NDArray[np.floating]) -> Floats:
    """Values a surface vertex, (V, C), as values a texture vertex, (T, C)."""
    surface = mesh.surface
    result = np.zeros((len(surface.uvs), values.shape[1]))
    result[surface.face_uvs.ravel()] = values[surface.faces.ravel()]
    return result


def fit_vertices(texels: Floats, uvs: Floats, values: Floats) -> Floats:
    """Change the texels as little as possible so that bilinear samples at given points take given values.

    Parameters
    ----------
    texels : (H, W, C) float64
    uvs : (N, 2) float64
    values : (N, C) float64

    Returns
    -------
    (H, W, C) float64
    """
    height, width = texels.shape[:2]
    return plan_fit(uvs, width, height)(texels, values)


def plan_fit(
    uvs: Floats, width: int, height: int, damping: Floats | float = FIT_DAMPING
) -> Callable[[Floats, Floats], Floats]:
    """`fit_vertices` for any number of textures of one size, factored once.

    Minimises |δ|² + |W (p + δ) - v|² / damping, where W holds the bilinear stencils and the damping may differ from
    point to point; solved in the space of the points, (W Wᵀ + damping) λ = v - W p, δ = Wᵀ λ.
    """
    stencil = stencil_matrix(uvs, width, height)
    gram = (stencil @ stencil.T + sp.diags(np.broadcast_to(damping, len(uvs)))).tocsc()
    factor = factor_symmetric(gram)

    def fit(texels: Floats, values: Floats) -> Floats:
        flat = texels.reshape(-1, texels.shape[2])
        multipliers = factor.solve(np.asarray(values - stencil @ flat))
        result: Floats = (flat + stencil.T @ multipliers).reshape(texels.shape)
        return result

    return fit


def stencil_matrix(uvs: Floats, width: int, height: int) -> sp.csr_matrix:
    """Bilinear samples as a sparse matrix, (N, H * W)."""
    texels, weights = bilinear_stencil(uvs, width, height)
    rows = np.repeat(np.arange(len(uvs)), 4)
    return sp.csr_matrix((weights.ravel(), (rows, texels.ravel())), shape=(len(uvs), width * height))
