"""What an atlas is worth: stretch, coverage, the share of its seams that can collapse."""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.mesh.edges import face_frames
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface

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
    return straight.all(axis=1) & matched & joined
