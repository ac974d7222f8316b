"""What an atlas is worth: texels everywhere, stretch, coverage, the share of its seams that can collapse."""

from __future__ import annotations

from typing import Any

import numpy as np

from preprocess.arrays import Floats
from preprocess.atlas.distortion import singular_values, turned_areas
from preprocess.atlas.flatten import local_triangles
from preprocess.atlas.source_charts import LEAST_DENSITY, MOST_STRETCH
from preprocess.mesh.face_geometry import face_frames
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface

QUANTILES = (0.001, 0.01, 0.5, 0.99, 0.999)
PICTURE_PX = 1024
"""The largest side of the character's box in the picture whose pixels say which faces can be seen."""

STRAIGHT_REL = 1e-7
"""Sine of the turn, and relative difference of length ratios, up to which seam edges count as one straight run."""


def measure_stretch(surface: TexturedSurface) -> tuple[float, float]:
    """L2 and L∞ stretch of the map from uv to the surface, normalised so that 1 is an isometry at one scale.

    Faces without area on the surface are left out.

    Returns
    -------
    l2, linf : float
        Infinite where a face has area on the surface but none in uv.

    References
    ----------
    Sander, Snyder, Gortler and Hoppe 2001, "Texture mapping progressive meshes", section 3.
    """
    positions, uvs = surface.positions[surface.faces], surface.uvs[surface.face_uvs]
    s, t = uvs[..., 0], uvs[..., 1]
    double = (s[:, 1] - s[:, 0]) * (t[:, 2] - t[:, 0]) - (s[:, 2] - s[:, 0]) * (t[:, 1] - t[:, 0])
    area_m2, _, _ = face_frames(surface.positions, surface.faces)
    real = area_m2 > 1e-12 * max(float(area_m2.max(initial=0.0)), 1e-300)
    if not real.any():
        return 1.0, 1.0
    if (double[real] == 0).any():
        return float("inf"), float("inf")
    safe = np.where(double == 0, 1, double)[:, None]
    ds = (
        positions[:, 0] * (t[:, 1] - t[:, 2])[:, None]
        + positions[:, 1] * (t[:, 2] - t[:, 0])[:, None]
        + positions[:, 2] * (t[:, 0] - t[:, 1])[:, None]
    ) / safe
    dt = (
        positions[:, 0] * (s[:, 2] - s[:, 1])[:, None]
        + positions[:, 1] * (s[:, 0] - s[:, 2])[:, None]
        + positions[:, 2] * (s[:, 1] - s[:, 0])[:, None]
    ) / safe
    a, b, c = (ds * ds).sum(axis=1), (ds * dt).sum(axis=1), (dt * dt).sum(axis=1)
    largest_sq = 0.5 * (a + c + np.sqrt((a - c) ** 2 + 4 * b * b))
    total_m2 = area_m2[real].sum()
    uv_per_m = np.sqrt(0.5 * np.abs(double[real]).sum() / total_m2)
    l2 = np.sqrt((0.5 * (a + c) * area_m2)[real].sum() / total_m2) * uv_per_m
    return float(l2), float(np.sqrt(largest_sq[real].max()) * uv_per_m)


def measure_texels(surface: TexturedSurface, size_px: int) -> dict[str, Any]:
    """Whether every part of the surface has its texels, at the size that textures will have.

    Parameters
    ----------
    surface : TexturedSurface
        With the uvs as they are stored.
    size_px : int
        Side of the largest texture.

    Returns
    -------
    dict
        `density`: texels a metre against the median, `stretch`: longer against shorter axis of a face's map, both as
        quantiles by area. `sparse_area`, `stretched_area`: shares of the surface with under a quarter of the median, or
        stretched more than 4 : 1. `sparse_faces`, `stretched_faces`: such faces that cover a pixel or more where the
        whole character is 1024 pixels large. `thin_faces`: faces narrower than a texel.
    """
    flat = local_triangles(surface.positions, surface.faces)
    uvs = surface.uvs[surface.face_uvs]
    areas = turned_areas(flat)
    largest, smallest = singular_values(flat, uvs)
    density, stretch = np.sqrt(largest * smallest), largest / np.maximum(smallest, 1e-30)
    density = density / max(_quantiles(density, areas, (0.5,))[0], 1e-300)
    sparse, stretched = density < LEAST_DENSITY, stretch > MOST_STRETCH
    pixel_m = float(np.ptp(surface.positions[surface.faces.ravel()], axis=0).max()) / PICTURE_PX
    seen = areas > pixel_m**2
    longest = np.linalg.norm(uvs - np.roll(uvs, -1, axis=1), axis=2).max(axis=1)
    width_px = 2.0 * np.abs(turned_areas(uvs)) / np.maximum(longest, 1e-30) * size_px
    total = max(float(areas.sum()), 1e-300)
    return {
        "size_px": size_px,
        "density": _quantiles(density, areas, QUANTILES),
        "stretch": _quantiles(stretch, areas, QUANTILES),
        "sparse_area": float(areas[sparse].sum()) / total,
        "stretched_area": float(areas[stretched].sum()) / total,
        "sparse_faces": int((sparse & seen).sum()),
        "stretched_faces": int((stretched & seen).sum()),
        "thin_faces": int((width_px < 1.0).sum()),
    }


def _quantiles(values: Floats, areas: Floats, shares: tuple[float, ...]) -> list[float]:
    """Values that these shares of the area stay below."""
    order = np.argsort(values)
    total = np.cumsum(areas[order])
    rows = np.searchsorted(total, np.asarray(shares) * total[-1])
    return [float(v) for v in values[order][np.minimum(rows, len(order) - 1)]]


def measure_coverage(surface: TexturedSurface) -> float:
    """Share of the unit square inside the uv triangles (of a one-to-one atlas)."""
    uvs = surface.uvs[surface.face_uvs]
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return float(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())


def straight_share(surface: TexturedSurface) -> float:
    """Share of the seam length in edges of which at least one end can collapse along the seam.

    An end can where exactly two seam edges meet, on one straight line and with equal length ratios on both sides
    (paper, section 5; docs/method.md, section 5).

    Returns
    -------
    float
        1 where there are no seams.
    """
    seams = find_seams(surface)
    if not len(seams.vertices):
        return 1.0
    num_vertices = len(surface.positions)
    ends = seams.vertices.ravel()
    degree = np.bincount(ends, minlength=num_vertices)
    degree += np.bincount(seams.boundary_vertices.ravel(), minlength=num_vertices)
    half = np.argsort(ends, kind="stable")
    half = half[degree[ends[half]] == 2]
    half = half[np.bincount(ends[half], minlength=num_vertices)[ends[half]] == 2]  # both of them seams
    first, second = half[0::2], half[1::2]
    free = np.zeros(num_vertices, bool)
    free[ends[first]] = _run_straight(surface.uvs, seams.uv_pairs, first, second)
    return float(seams.lengths_m[free[seams.vertices].any(axis=1)].sum() / max(seams.lengths_m.sum(), 1e-300))


def _run_straight(uvs: Floats, pairs: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether two seam ends (2 * seam + end) at one vertex continue each other on both sides."""
    tail1, head1 = pairs[first // 2, :, first % 2], pairs[first // 2, :, 1 - first % 2]
    tail2, head2 = pairs[second // 2, :, second % 2], pairs[second // 2, :, 1 - second % 2]
    swapped = (tail1 == tail2[:, ::-1]).all(axis=1) & ~(tail1 == tail2).all(axis=1)
    tail2[swapped], head2[swapped] = tail2[swapped, ::-1], head2[swapped, ::-1]
    one, two = uvs[head1] - uvs[tail1], uvs[head2] - uvs[tail2]
    length1, length2 = np.linalg.norm(one, axis=2), np.linalg.norm(two, axis=2)
    turn = np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    straight = (turn <= STRAIGHT_REL * length1 * length2) & ((one * two).sum(axis=2) < 0)
    left, right = length1[:, 0] * length2[:, 1], length1[:, 1] * length2[:, 0]
    matched = np.abs(left - right) <= STRAIGHT_REL * np.maximum(left, right)
    joined = (tail1 == tail2).all(axis=1)
    result: np.ndarray = straight.all(axis=1) & matched & joined
    return result
