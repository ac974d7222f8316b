"""Patterns in space: value noise, its octaves, and cells. Made of integer hashes, so they are the same everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from demos.creature.surface import Floats

_U32 = np.uint32


def _hash(x: NDArray[np.int64], y: NDArray[np.int64], z: NDArray[np.int64], seed: int) -> NDArray[np.uint32]:
    """Scramble integer coordinates to 32 bits (multiply and shift rounds)."""
    value = x.astype(_U32) * _U32(0x8DA6B343) ^ y.astype(_U32) * _U32(0xD8163841)
    value = value ^ z.astype(_U32) * _U32(0xCB1AB31F) ^ _U32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    value = (value ^ (value >> _U32(15))) * _U32(0x2C1B3C6D)
    value = (value ^ (value >> _U32(12))) * _U32(0x297A2D39)
    result: NDArray[np.uint32] = value ^ (value >> _U32(15))
    return result


def value_noise(points: Floats, seed: int = 0) -> Floats:
    """Smooth noise in [0, 1] with features one unit apart, at (N, 3) points."""
    base = np.floor(points)
    t = points - base
    t = t * t * (3.0 - 2.0 * t)
    x, y, z = base.astype(np.int64).T
    result = np.zeros(len(points))
    for corner in range(8):
        dx, dy, dz = corner & 1, corner >> 1 & 1, corner >> 2 & 1
        weight = (t[:, 0] if dx else 1 - t[:, 0]) * (t[:, 1] if dy else 1 - t[:, 1]) * (t[:, 2] if dz else 1 - t[:, 2])
        result += weight * (_hash(x + dx, y + dy, z + dz, seed) / 4294967295.0)
    return result


def fractal_noise(points: Floats, octaves: int = 3, seed: int = 0) -> Floats:
    """Octaves of value noise, each half as strong and twice as fine; in [0, 1]."""
    total, strength, norm = np.zeros(len(points)), 1.0, 0.0
    for octave in range(octaves):
        total += strength * value_noise(points * 2.0**octave + 17.3 * octave, seed + octave)
        norm += strength
        strength *= 0.5
    return total / norm


def cells(points: Floats, seed: int = 0, jitter: float = 0.8) -> tuple[Floats, Floats, Floats]:
    """Distances to the nearest and second nearest of scattered sites one unit apart, and a number of the nearest.

    Worley 1996, "A cellular texture basis function". Sites are looked for in the 27 cubes around a point.

    Returns
    -------
    first, second : (N,) float64
    identity : (N,) float64
        In [0, 1], the same for all points that share their nearest site.
    """
    base = np.floor(points)
    local = (points - base).astype(np.float32)
    x, y, z = base.astype(np.int64).T
    first = np.full(len(points), 9.0, np.float32)
    second = first.copy()
    identity = np.zeros(len(points), np.uint32)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            for dz in (-1, 0, 1):
                h = _hash(x + dx, y + dy, z + dz, seed)
                distance = np.zeros(len(points), np.float32)
                for axis, (offset, shift) in enumerate(((dx, 0), (dy, 10), (dz, 20))):
                    site = ((h >> _U32(shift)) & _U32(1023)).astype(np.float32) * np.float32(jitter / 1023.0)
                    gap = site + np.float32(offset + 0.5 - 0.5 * jitter) - local[:, axis]
                    distance += gap * gap
                closer = distance < first
                second = np.where(closer, first, np.minimum(second, distance))
                identity = np.where(closer, h, identity)
                first = np.where(closer, distance, first)
    return np.sqrt(first).astype(float), np.sqrt(second).astype(float), identity / 4294967295.0
