"""Automatic texture sizes of geometry and weights.

Positions are judged as they will be stored, after the erasure that also fits the vertices: there, between them and
along the seams. A few vertices may miss, where more of them meet in a cell than it has texels: those are parked
elsewhere (spare_texels.py). Weights have quadtrees where their map is too coarse (weight_quadtree.py), so any size is
right; the one that takes the least memory has about a texel for every five vertices.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from preprocess.arrays import Floats
from preprocess.erase import Eraser
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from preprocess.settings import GEOMETRY_RMS_REL, PARK_REL

log = logging.getLogger(__name__)

GEOMETRY_SIZES_PX = (*range(48, 128, 4), *range(128, 320, 8), *range(320, 640, 32), *range(640, 2049, 128))
STRIDE = 4  # sizes are tried in such steps, and then those skipped last
TEXELS_A_VERTEX = 3.0  # half of what the characters here need that need least
RMS_SHARE = 0.8  # of the accuracy goal at the vertices that stay: weights and rounding add their own part
PARKED_SHARE = 0.1  # of the vertices at most
STRAY_RMS_REL = 2e-3  # of the surface between vertices, of the diagonal: what divided triangles show
JUMP_RMS_REL = 7.5e-5  # across seams, of the diagonal: 1e-4 when rounded (words.py)
WEIGHT_SIZES_PX = (32, 48, 64, 96, 128, 192, 256, 384, 512)
WEIGHT_TEXELS_A_VERTEX = 0.22


@dataclass(frozen=True)
class Positions:
    """A position texture of one size.

    Attributes
    ----------
    baked, erased : (H, W, 3) float64
        Metres, before and after erasure.
    jump_m : float
        Left across the seams, rms.
    eraser : Eraser or None
        For these texels, to erase them again.
    """

    baked: Floats
    erased: Floats
    jump_m: float
    eraser: Eraser | None = None


def smallest_positions(surface: TexturedSurface, expected: Floats, bake: Callable[[int], Positions]) -> Positions:
    """Positions at the smallest square size that is good enough, or nearly: larger is not always better.

    Parameters
    ----------
    surface : TexturedSurface
    expected : (T, 3) float64
        Positions at the texture vertices.
    bake : callable
        From a side in texels to the positions at that size.

    Returns
    -------
    Positions
    """
    enough = [side for side in GEOMETRY_SIZES_PX if side * side >= TEXELS_A_VERTEX * len(surface.uvs)]
    sides = enough or list(GEOMETRY_SIZES_PX[-1:])
    number = 0
    while not (good := _are_good(best := bake(sides[number]), surface, expected)) and number < len(sides) - 1:
        number = min(number + STRIDE, len(sides) - 1)
    below, step = number, STRIDE // 2
    while good and step and below >= step:
        smaller = bake(sides[below - step])
        if _are_good(smaller, surface, expected):
            best, below = smaller, below - step
        step //= 2
    return best


def _are_good(positions: Positions, surface: TexturedSurface, expected: Floats) -> bool:
    """Whether positions keep the limits above."""
    erased, jump_rel = positions.erased, positions.jump_m / surface.diagonal_m
    error_rel = np.linalg.norm(sample_bilinear(erased, surface.uvs) - expected, axis=1) / surface.diagonal_m
    stays = error_rel <= PARK_REL
    rms_rel, stray_rel = _rms(error_rel[stays]), stray_rms(erased, surface) / surface.diagonal_m
    log.info(
        "positions %d²: of the diagonal %.2g at vertices, %.2g between, %.2g across seams, %d of %d vertices missed",
        len(erased), rms_rel, stray_rel, jump_rel, (~stays).sum(), len(stays),
    )  # fmt: skip
    good = rms_rel <= RMS_SHARE * GEOMETRY_RMS_REL and stray_rel <= STRAY_RMS_REL and jump_rel <= JUMP_RMS_REL
    return bool(good and (~stays).mean() <= PARKED_SHARE)


def stray_rms(texels: Floats, surface: TexturedSurface) -> float:
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


def weight_side(num_vertices: int) -> int:
    """Side of the weight map, texels."""
    wanted = np.sqrt(WEIGHT_TEXELS_A_VERTEX * num_vertices)
    return min(WEIGHT_SIZES_PX, key=lambda side: abs(np.log(side / max(wanted, 1.0))))


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
