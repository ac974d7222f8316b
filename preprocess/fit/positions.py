"""The position texture: fitted to the vertices of the full mesh and along its seams, as small as is good enough.

Geometry is fetched at canonical uvs (docs/method.md, section 6), so nothing cracks whatever the texture does at
seams, and it need not be closed exactly. Points along both sides of every seam take part in the fit with a smaller
weight, so that subdivided surfaces run on smoothly there. One fit is a direct solution with as many unknowns as
points, hundredths of a second, so sizes are simply tried, each judged as it will be stored: within the surface's box,
at the vertices, between them and along the seams. A few vertices may miss, where more of them meet in a cell than it
has texels: those are given spare texels (spare_texels.py).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from preprocess.arrays import Floats
from preprocess.bake.geometry import FIT_DAMPING, bake_surface_positions, plan_fit, vertex_values
from preprocess.erase import measure_seams
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import sample_bilinear, snap_canonical_uvs
from preprocess.settings import GEOMETRY_RMS_REL, PARK_REL

log = logging.getLogger(__name__)

SIZES_PX = (*range(48, 128, 4), *range(128, 320, 8), *range(320, 640, 32), *range(640, 2049, 128))
STRIDE = 4  # sizes are tried in such steps, and then those skipped last
TEXELS_PER_VERTEX = 3.0, 48.0  # the smallest and largest sizes tried; few characters need more than thirty
SEAM_DAMPING = 1e-2  # of points along seams: a hundred times that of vertices
RANGE_REL = 0.05  # of the diagonal: how far beyond the surface's box texels may go, which sets what 16 bits can tell
RMS_SHARE = 0.8  # of the accuracy goal at the vertices that stay: weights and rounding add their own part
SPARE_SHARE = 0.1  # of the vertices, that may need spare texels
BETWEEN_RMS_REL = 2e-3  # of the surface between vertices, of the diagonal: what divided triangles show
JUMP_RMS_REL = 6e-4  # across seams, of the diagonal


@dataclass(frozen=True)
class Positions:
    """A position texture of one size.

    Attributes
    ----------
    baked, fitted : (H, W, 3) float64
        Metres, before and after the fit.
    """

    baked: Floats
    fitted: Floats


def fit_positions(mesh: SkinnedMesh, seams: Seams, side: int | None = None) -> Positions:
    """Object-space positions as a square texture.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    seams : Seams
        Its seams.
    side : int, optional
        Texels; by default as few as are good enough.
    """
    surface = mesh.surface
    expected = vertex_values(mesh, surface.positions)
    uvs = snap_canonical_uvs(surface.uvs)
    room = RANGE_REL * surface.diagonal_m
    low, high = surface.positions.min(axis=0) - room, surface.positions.max(axis=0) + room

    def fit(side: int) -> Positions:
        baked = bake_surface_positions(mesh, (side, side))
        seam_uvs, seam_positions = points_along_seams(surface, seams, side)
        damping = np.repeat([FIT_DAMPING, SEAM_DAMPING], [len(uvs), len(seam_uvs)])
        solve = plan_fit(np.concatenate([uvs, seam_uvs]), side, side, damping)
        return Positions(baked, np.clip(solve(baked, np.concatenate([expected, seam_positions])), low, high))

    if side:
        return fit(side)
    return smallest_positions(len(uvs), fit, lambda found: _is_good(found.fitted, surface, seams, uvs, expected))


def points_along_seams(surface: TexturedSurface, seams: Seams, side: int) -> tuple[Floats, Floats]:
    """A point for every texel that a seam crosses, on both sides of it: uvs (N, 2) and positions (N, 3)."""
    ends = surface.uvs[seams.uv_pairs]  # seam, side, end
    counts = np.ceil(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2).max(axis=1, initial=0.0) * side)
    counts = np.maximum(counts, 1).astype(np.int64)
    seam = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(seam)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = ((number + 0.5) / counts[seam])[:, None]
    first, last = surface.positions[seams.vertices[seam]].transpose(1, 0, 2)
    uvs = [(1.0 - share) * ends[seam, k, 0] + share * ends[seam, k, 1] for k in (0, 1)]
    return np.concatenate(uvs), np.tile((1.0 - share) * first + share * last, (2, 1))


def smallest_positions(
    num_vertices: int, fit: Callable[[int], Positions], is_good: Callable[[Positions], bool]
) -> Positions:
    """Positions at the smallest square size that is good enough, or nearly: larger is not always better.

    Parameters
    ----------
    num_vertices : int
        Texture vertices: the sizes tried have a few texels for each, and no more than a few dozen.
    fit : callable
        From a side in texels to the positions at that size.
    is_good : callable
    """
    least, most = (share * max(num_vertices, 1) for share in TEXELS_PER_VERTEX)
    sides = [side for side in SIZES_PX if least <= side * side <= most]
    if not sides:
        sides = [SIZES_PX[0] if most < SIZES_PX[0] ** 2 else SIZES_PX[-1]]
    number = 0
    while not (good := is_good(best := fit(sides[number]))) and number < len(sides) - 1:
        number = min(number + STRIDE, len(sides) - 1)
    below, step = number, STRIDE // 2
    while good and step and below >= step:
        smaller = fit(sides[below - step])
        if is_good(smaller):
            best, below = smaller, below - step
        step //= 2
    return best


def _is_good(fitted: Floats, surface: TexturedSurface, seams: Seams, uvs: Floats, expected: Floats) -> bool:
    """Whether positions keep the limits above."""
    diagonal_m = max(surface.diagonal_m, 1e-30)
    error_rel = np.linalg.norm(sample_bilinear(fitted, uvs) - expected, axis=1) / diagonal_m
    stays = error_rel <= PARK_REL
    rms_rel, between_rel = _rms(error_rel[stays]), deviation_rms(fitted, surface) / diagonal_m
    good = rms_rel <= RMS_SHARE * GEOMETRY_RMS_REL and between_rel <= BETWEEN_RMS_REL
    good = good and float((~stays).mean()) <= SPARE_SHARE
    jump_rel = float(np.linalg.norm(measure_seams(fitted, surface, seams).rms)) / diagonal_m if good else np.nan
    log.info(
        "positions %d²: of the diagonal %.2g at vertices, %.2g between, %.2g across seams, %d of %d vertices missed",
        len(fitted), rms_rel, between_rel, jump_rel, (~stays).sum(), len(stays),
    )  # fmt: skip
    return good and jump_rel <= JUMP_RMS_REL


def deviation_rms(texels: Floats, surface: TexturedSurface) -> float:
    """How far the texture is from the flat faces between their corners, metres, rms over the area.

    Parameters
    ----------
    texels : (H, W, 3) float64
    surface : TexturedSurface
    """
    corners = surface.positions[surface.faces]
    area = face_areas(corners)
    shares = np.array([(2, 2, 2), (4, 1, 1), (1, 4, 1), (1, 1, 4)]) / 6.0  # middles of the four quarters
    flat = np.einsum("sk,fkc->fsc", shares, corners)
    uvs = np.einsum("sk,fkc->fsc", shares, surface.uvs[surface.face_uvs])
    wrong_sq = ((sample_bilinear(texels, uvs.reshape(-1, 2)).reshape(flat.shape) - flat) ** 2).sum(axis=2).mean(axis=1)
    return float(np.sqrt((wrong_sq * area).sum() / max(area.sum(), 1e-30)))


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
