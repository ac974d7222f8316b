"""Mip chains of a build, whose every level is seamless as stored (rules: `erase.mips`; method: `closing`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.erase.local.band import Band, plan_band
from preprocess.erase.local.closing import JUMP_LIMIT, MAX_STORED, UNIT, close_seams
from preprocess.erase.mips import Level, is_crowded, mip_sizes, shrink
from preprocess.erase.options import DEFAULT_OPTIONS, EraseOptions
from preprocess.files.srgb import linear_to_srgb, srgb_to_linear
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface

SLACK = 0.005  # of a step: sums in another order

Bands = dict[tuple[int, int], Band]


def close_mips(
    texels: NDArray[np.floating],
    surface: TexturedSurface,
    seams: Seams,
    options: EraseOptions = DEFAULT_OPTIONS,
    *,
    levels: int = 0,
    srgb_channels: int = 0,
    most_change: float = np.inf,
    jump_limit: float = JUMP_LIMIT,
    bands: Bands | None = None,
    even_reach: bool = False,
) -> tuple[Level, ...]:
    """Close the seams of a texture and of its mip chain.

    Parameters
    ----------
    texels : (H, W, C) float
        In [0, 1] where integers are asked for.
    surface : TexturedSurface
    seams : Seams
    options : EraseOptions
        Which seams are joined, and the weights of change and gradient.
    levels : int
        Largest integer to store, 255 or 65535; 0 for float texels.
    srgb_channels : int
        How many of the first channels hold sRGB values; these are averaged in linear light.
    most_change : float
        The chain ends before the first level whose inside texels move by more than this, root mean square, or that
        still jumps too far as stored.
    jump_limit : float
        Of the solutions, in 255ths.
    bands : dict, optional
        Bands by (width, height) for the same surface, seams and options: used where there is one, and filled.
    even_reach : bool
        Whether a change reaches as many texels at every level. The weight of change is shared by the inside texels, so
        the reach halves from level to level otherwise, which is a fixed distance on the surface.

    Returns
    -------
    tuple of Level
        The full size first, which always is.
    """
    height, width, _ = texels.shape
    bands = {} if bands is None else bands
    chain: list[Level] = []
    finer: tuple[NDArray[Any], NDArray[np.bool_]] | None = None
    for size in mip_sizes(width, height):
        if chain and is_crowded(surface, seams, *size):
            break
        if size not in bands:
            share = 0.25 ** len(chain) if even_reach else 1.0
            weights = replace(options.weights, change=share * options.weights.change)
            bands[size] = plan_band(surface, seams, *size, replace(options, weights=weights))
        band = bands[size]
        current = texels if finer is None else _average(*finer, size, levels, srgb_channels)
        allowed = most_change if chain else np.inf
        closed = close_seams(current, band, levels=levels, jump_limit=jump_limit, most_change=allowed)
        if closed is None or (chain and closed.stored.max.max(initial=0.0) > (MAX_STORED + SLACK) / UNIT):
            break
        chain.append(Level(closed.texels, closed.before, closed.after, closed.stored))
        finer = closed.texels, band.region.used
    return tuple(chain)


def _average(
    stored: NDArray[Any], used: NDArray[np.bool_], size: tuple[int, int], levels: int, srgb_channels: int
) -> NDArray[np.float32]:
    """The box filter of a stored level over its used texels, in linear light where values are sRGB."""
    scale = np.float32(levels or 1)
    light: NDArray[Any] = np.empty(stored.shape, np.float32)
    if srgb_channels and levels == 255:
        table = srgb_to_linear(np.arange(256, dtype=np.float32) / scale).astype(np.float32)
        light[..., :srgb_channels] = table[stored[..., :srgb_channels]]
    elif srgb_channels:
        light[..., :srgb_channels] = srgb_to_linear(stored[..., :srgb_channels] / scale)
    light[..., srgb_channels:] = stored[..., srgb_channels:] / scale
    small: NDArray[Any] = shrink(light, used, *size)
    small[..., :srgb_channels] = linear_to_srgb(small[..., :srgb_channels])
    return small
