"""Charts packed into the unit square: each at its best turn, the largest first, the lowest free place on a bitmap.

Free places of a chart are the zeros of the correlation of its mask with what is taken (fast Fourier transform). The
common scale is the largest of a bisection at which everything fits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from demos.creature.raster import cover_texels
from demos.creature.surface import Floats, Ints

_GRID = 256  # cells a side; one cell is four texels of the 1024² textures
_BISECTIONS = 7


def _turn_to_box(uvs: Floats) -> Floats:
    """Rotate one chart so that its bounding box is smallest, wider than high."""
    best, best_area = uvs, np.inf
    for angle in np.linspace(0.0, np.pi / 2, 46)[:-1]:
        c, s = np.cos(angle), np.sin(angle)
        turned = uvs @ np.array([[c, s], [-s, c]])
        area = float(np.prod(np.ptp(turned, axis=0)))
        if area < best_area - 1e-12:
            best, best_area = turned, area
    if np.ptp(best[:, 0]) < np.ptp(best[:, 1]):
        best = best @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    result: Floats = best - best.min(axis=0)
    return result


def _quarter(uvs: Floats, turns: int) -> Floats:
    for _ in range(turns):
        uvs = uvs @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    result: Floats = uvs - uvs.min(axis=0)
    return result


def _mask(uvs: Floats, faces: Ints) -> NDArray[np.bool_] | None:
    """Cells that a chart touches, with the gutter around it; None if it is larger than the square."""
    extent = np.ceil(uvs.max(axis=0) * _GRID).astype(int) + 5
    if (extent > _GRID).any():
        return None
    fine = 2
    _, x, y, _ = cover_texels((uvs * _GRID + 2.0) / _GRID, faces, fine * _GRID)
    image = np.zeros((fine * _GRID, fine * _GRID), bool)
    image[y, x] = True
    coarse = np.asarray(image.reshape(_GRID, fine, _GRID, fine).any(axis=(1, 3)))
    grown = ndimage.binary_dilation(coarse, np.ones((3, 3), bool))
    return grown[: extent[1], : extent[0]]


def _place(charts: list[tuple[Floats, Ints]], scale: float) -> list[Floats] | None:
    """Placed uvs of every chart at one scale, or None when they do not fit."""
    taken = np.zeros((_GRID, _GRID), np.float32)
    placed = []
    for uvs, faces in charts:
        spectrum = fft.rfft2(taken, (2 * _GRID, 2 * _GRID))
        best: tuple[int, Floats, NDArray[np.bool_], int, int] | None = None
        for turns in range(4):
            candidate = _quarter(uvs * scale, turns)
            mask = _mask(candidate, faces)
            if mask is None:
                continue
            height, width = mask.shape
            kernel = fft.rfft2(mask[::-1, ::-1].astype(np.float32), (2 * _GRID, 2 * _GRID))
            overlap = fft.irfft2(spectrum * kernel, (2 * _GRID, 2 * _GRID))
            free = overlap[height - 1 : _GRID, width - 1 : _GRID] < 0.5
            spots = np.argwhere(free)
            if not len(spots):
                continue
            reach = np.maximum((spots[:, 0] + height) * 1000, (spots[:, 1] + width) * 1000) + spots.sum(axis=1)
            pick = int(reach.argmin())
            if best is None or reach[pick] < best[0]:
                best = (int(reach[pick]), candidate, mask, int(spots[pick, 0]), int(spots[pick, 1]))
        if best is None:
            return None
        _, candidate, mask, y, x = best
        taken[y : y + mask.shape[0], x : x + mask.shape[1]] += mask
        placed.append(candidate + (np.array([x, y]) + 2.0) / _GRID)
    return placed


def pack_charts(uvs: Floats, face_uvs: Ints, charts: Ints, densities: Floats) -> Floats:
    """Turn, scale and move charts so that they lie apart inside the unit square.

    Parameters
    ----------
    uvs : (T, 2) float64
        Flat charts in metres; T texture vertices, none shared by two charts.
    face_uvs : (F, 3) int64
    charts : (F,) int64
    densities : (K,) float64
        Relative texel density wanted for each chart.

    Returns
    -------
    uvs : (T, 2) float64, in [0, 1]
    """
    rows, flat = [], []
    for chart, density in enumerate(densities):
        used, local = np.unique(face_uvs[charts == chart], return_inverse=True)
        rows.append(used)
        flat.append((_turn_to_box(uvs[used] * density), local.reshape(-1, 3)))
    order = np.argsort([-float(np.prod(np.ptp(chart, axis=0))) for chart, _ in flat], kind="stable")
    ordered = [flat[k] for k in order]
    area = sum(float(np.prod(np.ptp(chart, axis=0))) for chart, _ in flat)
    low, high = 0.5 / np.sqrt(area), 1.35 / np.sqrt(area)
    best = None
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        placed = _place(ordered, middle)
        if placed is None:
            high = middle
        else:
            best, low = placed, middle
    if best is None:
        raise ValueError("the charts do not fit into the square at any scale tried")
    packed = np.zeros_like(uvs)
    for index, placed_uvs in zip(order, best, strict=True):
        packed[rows[index]] = placed_uvs
    return packed
