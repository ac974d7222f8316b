"""The energies along edges (paper, section 4; docs/method.md, section 3), one function each.

Every one is an integral of a squared polynomial along edges, so Gauss-Legendre points of sufficient degree turn it,
exactly, into a sum of squares |R p - t|². Each function returns the sparse rows R, over all texels, and where there
is one the target t, both scaled by the roots of the quadrature weights. Sums of squares evaluate without
cancellation: a seam energy of 1e-20 means what it says.

| function | energy | degree of the square | points |
|---|---|---|---|
| `jump_elements` | B(e1) - B(e2) | 4 | 3 |
| `value_rows` | B(e) - known values (lerp, outside) | 4 | 3 |
| `slope_elements` | sum of the inward derivatives of both sides (C1) | 2 | 2 |
| `sample_rows` | B(point) - known value | | |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.intervals import Intervals
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import bilinear_stencil, uv_to_px


def _blend_weights(fractions: Floats) -> Floats:
    """Bilinear weights of the four texels, (..., 4), at positions (..., 2) in the cell."""
    fx, fy = fractions[..., 0], fractions[..., 1]
    return np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=-1)


def _shares(intervals: Intervals, lengths_m: Floats, weights: Floats) -> Floats:
    """Roots of the quadrature weights times each edge's share of the whole length, (I, Q)."""
    total = lengths_m.sum()
    share = lengths_m / total if total > 0 else lengths_m
    return np.sqrt(weights * share[intervals.edges][:, None])


def to_rows(texels: NDArray[np.integer], values: Floats, num_texels: int) -> sparse.csr_array:
    """Sparse matrix with rows `values` (I, Q, K) at the texels (I, K) of each interval: (I Q, num_texels)."""
    num_intervals, num_points, width = values.shape
    columns = np.broadcast_to(texels[:, None], values.shape).reshape(-1)
    starts = np.arange(num_intervals * num_points + 1, dtype=np.int64) * width
    shape = (num_intervals * num_points, num_texels)
    return sparse.csr_array((values.reshape(-1), columns, starts), shape=shape)


def jump_weights(intervals: Intervals, gamma: Floats) -> Floats:
    """Weights of the eight texels in the jump, side 0 less side 1, at parameters (I, Q): (I, Q, 8)."""
    blend = _blend_weights(intervals.fractions(gamma))
    return np.concatenate([blend[:, :, 0], -blend[:, :, 1]], axis=2)


def jump_elements(intervals: Intervals, lengths_m: Floats) -> Floats:
    """Weights (I, 3, 8) of each interval's eight texels in rows J with |J p|² = D_total(p), the mean squared jump.

    Parameters
    ----------
    intervals : Intervals
        Of the seams, both sides.
    lengths_m : (E,) float64
        3D lengths of the seams.

    References
    ----------
    Liu, Ferguson, Jacobson, Gingold 2017, equation 2.
    """
    gamma, weights = intervals.gauss(3)
    return jump_weights(intervals, gamma) * _shares(intervals, lengths_m, weights)[:, :, None]


def jump_rows(intervals: Intervals, lengths_m: Floats) -> sparse.csr_array:
    """`jump_elements` as sparse rows over all texels, (3 I, H W)."""
    width, height = intervals.size_px
    return to_rows(intervals.texels.reshape(-1, 8), jump_elements(intervals, lengths_m), width * height)


def value_rows(intervals: Intervals, lengths_m: Floats) -> tuple[sparse.csr_array, Floats]:
    """Rows R with |R p|² = (1/L) Σ ℓ ∫ |B(e)|² over lone edges, for targets along the silhouette.

    Returns
    -------
    rows : (3 I, H W) sparse
    scale : (I, 3) float64
        What a target at the points of `intervals.gauss(3)` is multiplied by.
    """
    gamma, weights = intervals.gauss(3)
    scale = _shares(intervals, lengths_m, weights)
    blend = _blend_weights(intervals.fractions(gamma)[:, :, 0]) * scale[:, :, None]
    width, height = intervals.size_px
    return to_rows(intervals.texels[:, 0], blend, width * height), scale


def lerp_targets(intervals: Intervals, scale: Floats, end_values: Floats) -> Floats:
    """Targets of `value_rows` for values that run linearly along each edge.

    Parameters
    ----------
    intervals : Intervals
    scale : (I, 3) float64
        From `value_rows`.
    end_values : (E, 2, C) float64
        Values at the two ends of each edge.

    Returns
    -------
    (3 I, C) float64
    """
    gamma = intervals.gauss(3)[0][:, :, None]
    ends = end_values[intervals.edges][:, None]
    values = (1 - gamma) * ends[:, :, 0] + gamma * ends[:, :, 1]
    return (values * scale[:, :, None]).reshape(-1, end_values.shape[2])


def inward_normals(surface: TexturedSurface, seams: Seams, width: int, height: int) -> Floats:
    """Unit vectors in texel space, perpendicular to each side of each seam and into its face, (S, 2, 2) float64.

    Zero where the side has no length or its face no area.
    """
    corners = surface.face_uvs[seams.faces]  # (S, 2, 3)
    opposite = corners.sum(axis=2) - seams.uv_pairs.sum(axis=2)
    points = uv_to_px(surface.uvs, width, height)
    origin = points[seams.uv_pairs[:, :, 0]]
    along = points[seams.uv_pairs[:, :, 1]] - origin
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    side = np.sign(np.einsum("skd,skd->sk", normal, points[opposite] - origin))
    length = np.linalg.norm(normal, axis=2)
    result: Floats = normal * (side / np.where(length > 0, length, 1.0))[:, :, None]
    return result


def slope_elements(intervals: Intervals, lengths_m: Floats, normals: Floats) -> Floats:
    """Weights (I, 2, 8) in rows R with |R p|² the integrated C1 discontinuity across seams.

    The derivatives of both sides along their inward normals (a texel is the unit of length) cancel where the signal
    runs on smoothly across the seam.

    Parameters
    ----------
    intervals : Intervals
        Of the seams, both sides.
    lengths_m : (E,) float64
    normals : (E, 2, 2) float64
        From `inward_normals`.
    """
    gamma, weights = intervals.gauss(2)
    fractions = intervals.fractions(gamma)
    fx, fy = fractions[..., 0], fractions[..., 1]  # (I, Q, 2)
    directions = np.where(intervals.is_clamped, 0.0, normals[intervals.edges])[:, None]
    nx, ny = directions[..., 0], directions[..., 1]
    slope = np.stack(
        [
            -nx * (1 - fy) - ny * (1 - fx),
            nx * (1 - fy) - ny * fx,
            -nx * fy + ny * (1 - fx),
            nx * fy + ny * fx,
        ],
        axis=-1,
    )  # (I, Q, 2, 4)
    return slope.reshape(*gamma.shape, 8) * _shares(intervals, lengths_m, weights)[:, :, None]


def slope_rows(intervals: Intervals, lengths_m: Floats, normals: Floats) -> sparse.csr_array:
    """`slope_elements` as sparse rows over all texels, (2 I, H W)."""
    width, height = intervals.size_px
    return to_rows(intervals.texels.reshape(-1, 8), slope_elements(intervals, lengths_m, normals), width * height)


def sample_rows(uvs: Floats, width: int, height: int) -> sparse.csr_array:
    """Rows R with R p the bilinear samples at uv points (N, 2), scaled so that |R p - t|² is a mean."""
    texels, weights = bilinear_stencil(uvs, width, height)
    return to_rows(texels, (weights / np.sqrt(max(len(uvs), 1)))[:, None], width * height)
