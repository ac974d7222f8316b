"""Mip chains whose every level is seamless (docs/method.md, section 3).

Box filtering alone mixes charts with their neighbours and with the background, and half the resolution moves every
texel relative to the seam. Here a level is the box filter of the one above over its used texels alone, in linear light
where the values are sRGB, and then erased at its own resolution. Trilinear samples between two seamless levels are
seamless.

Where a texel is as wide as a chart, closing all seams leaves little but one colour: from afar dark hair would turn to
skin. A chain may end before that; its last level then serves for all that is farther away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.eraser import Eraser
from preprocess.erase.options import DEFAULT_OPTIONS, EraseOptions
from preprocess.erase.prepare import plan_erasure
from preprocess.erase.quantise import quantise
from preprocess.erase.seam_samples import SeamMeasure
from preprocess.files.srgb import linear_to_srgb, srgb_to_linear
from preprocess.mesh.face_geometry import face_areas
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface

# The jump that a stored level may have at most; and shares of the limit asked for (or of one that leaves rounding some
# room) that are tried where a level exceeds it.
VISIBLE = 0.5 / 255
JUMP_LIMIT = 0.2 / 255
TIGHTER = (1.0, 0.3, 0.1)

# A chain also ends where charts are narrower, but for levels of so few texels that they cost nothing.
NARROW_PX = 1.2
FEW_TEXELS = 100 * 100


@dataclass(frozen=True)
class Level:
    """One level of a seamless mip chain.

    Attributes
    ----------
    texels : (H, W, C)
        uint8 or uint16 where integers were asked for, else float64.
    before, after, stored : SeamMeasure
        Jump of the box-filtered level, of the solution, and of `texels` (integers as values in [0, 1]).
    is_large : bool
        Whether it has so many unknowns that it was solved once, whatever its largest jump.
    """

    texels: NDArray[Any]
    before: SeamMeasure
    after: SeamMeasure
    stored: SeamMeasure
    is_large: bool = False


def mip_sizes(width: int, height: int, smallest: int = 1) -> list[tuple[int, int]]:
    """Widths and heights of a chain, the full size first: halved, rounded down, until both are `smallest` or less."""
    sizes = [(width, height)]
    while max(sizes[-1]) > smallest and max(sizes[-1]) > 1:
        w, h = sizes[-1]
        sizes.append((max(w // 2, 1), max(h // 2, 1)))
    return sizes


def is_crowded(surface: TexturedSurface, seams: Seams, width: int, height: int) -> bool:
    """Whether charts are narrower than a texel, and so many that every texel is tied to thousands of others."""
    if width * height <= FEW_TEXELS or not len(seams.vertices):
        return False
    corners = surface.uvs[surface.face_uvs] * (width, height)
    area = face_areas(corners).sum()
    sides = surface.uvs[seams.uv_pairs] * (width, height)
    outline = np.linalg.norm(sides[:, :, 1] - sides[:, :, 0], axis=2).sum()
    return bool(4.0 * area < NARROW_PX * outline)  # a square of side s has an area of s² in an outline of 4 s


def _box_weights(size: int, new_size: int) -> sparse.csr_array:
    """Overlap of each new texel with the old ones, rows sum to one: (new_size, size)."""
    scale = size / new_size
    taps = int(np.ceil(scale)) + 1
    start = np.arange(new_size) * scale
    columns = np.floor(start).astype(np.int64)[:, None] + np.arange(taps)
    overlap = np.minimum(columns + 1, (start + scale)[:, None]) - np.maximum(columns, start[:, None])
    kept = (overlap > 1e-9) & (columns < size)
    rows = np.broadcast_to(np.arange(new_size)[:, None], columns.shape)
    return sparse.csr_array((overlap[kept] / scale, (rows[kept], columns[kept])), shape=(new_size, size))


def shrink(texels: NDArray[Any], used: NDArray[np.bool_], width: int, height: int) -> NDArray[Any]:
    """Box-filter an image over its used texels.

    Parameters
    ----------
    texels : (H, W, C) float32 or float64
    used : (H, W) bool
        Texels that count. Where a new texel covers none, all that it covers count.
    width, height : int
        New size.

    Returns
    -------
    (height, width, C), of the type given
    """
    old_height, old_width, channels = texels.shape
    down, across = (_box_weights(*sizes).astype(texels.dtype) for sizes in ((old_height, height), (old_width, width)))

    def average(image: NDArray[Any]) -> NDArray[Any]:
        rows = (down @ image.reshape(old_height, -1)).reshape(height, old_width, -1)
        turned = np.ascontiguousarray(rows.transpose(1, 0, 2)).reshape(old_width, -1)
        result: NDArray[Any] = (across @ turned).reshape(width, height, -1).transpose(1, 0, 2)
        return result

    share = average(used[:, :, None].astype(texels.dtype))
    masked = average(texels * used[:, :, None])
    plain = average(texels) if (share <= 0).any() else masked
    assert channels == texels.shape[2]
    return np.where(share > 0, masked / np.where(share > 0, share, 1.0), plain)


def _change(texels: Floats, before: Floats, inside: NDArray[np.bool_]) -> float:
    """Root mean square change of the texels inside charts, (H, W, C) each; 0 where none is."""
    return float(np.sqrt(np.square(texels[inside] - before[inside]).mean())) if inside.any() else 0.0


def _stored(texels: Floats, plan: Eraser, levels: int) -> tuple[NDArray[Any], SeamMeasure]:
    """A level as it is stored, and its jump."""
    if not levels:
        return texels, plan.measure(texels)
    rounded = quantise(texels, plan.strip, levels)
    return rounded, plan.measure(rounded, float(levels))


def erase_mips(
    texels: Floats,
    surface: TexturedSurface,
    seams: Seams,
    options: EraseOptions = DEFAULT_OPTIONS,
    *,
    levels: int = 0,
    srgb_channels: int = 0,
    smallest: int = 1,
    most_change: float | None = None,
    plans: dict[tuple[int, int], Eraser] | None = None,
    samples: tuple[Floats, Floats] | None = None,
) -> tuple[Level, ...]:
    """Erase a texture and build its mip chain.

    Parameters
    ----------
    texels : (H, W, C) float
        The source texture, in [0, 1] where integers are asked for.
    surface : TexturedSurface
    seams : Seams
    options : EraseOptions
    levels : int
        Largest integer to store, 255 or 65535; 0 for float texels.
    srgb_channels : int
        How many of the first channels hold sRGB values; these are averaged in linear light.
    smallest : int
        The chain ends at the first level that is no larger than this on both axes.
    most_change : float, optional
        It ends before the first level whose inside texels erasure moves by more than this, root mean square.
    plans : dict, optional
        Erasers by (width, height) for the same surface, seams and options but for the jump limit: used where there is
        one, and filled, so that several textures share them. Without, each is gone before the next is made.
    samples : uvs (N, 2) and values (N, C), optional
        Values that the full size should have at points. Coarser levels are averages of it, as ever.

    Returns
    -------
    tuple of Level
        The full size first.
    """
    height, width, _ = texels.shape
    chain: list[Level] = []
    current: NDArray[Any] = np.asarray(texels, np.float32) if levels else np.asarray(texels, np.float64)
    used: NDArray[np.bool_] | None = None
    for w, h in mip_sizes(width, height, smallest):
        if chain and is_crowded(surface, seams, w, h):
            break
        if used is not None:
            light = current.copy()
            for row in light:
                row[:, :srgb_channels] = srgb_to_linear(row[:, :srgb_channels])
            current = shrink(light, used, w, h)
            current[:, :, :srgb_channels] = linear_to_srgb(current[:, :, :srgb_channels])
        known = samples if used is None else None
        plan = None if plans is None else plans.get((w, h))
        if plan is None:
            plan = plan_erasure(surface, seams, w, h, options, sample_uvs=None if known is None else known[0])
        if plans is not None:
            plans[w, h] = plan
        limit = options.jump_limit
        bounds = (0.0, 1.0) if levels else None
        values = None if known is None else known[1]
        erased = plan.erase(current, sample_values=values, bounds=bounds, jump_limit=limit)
        if chain and most_change is not None and _change(erased.texels, current, plan.region.inside) > most_change:
            break
        result, stored = _stored(erased.texels, plan, levels)
        # A finite seam weight says nothing of single points, and rounding may find no room beside the jumps that are
        # allowed: smaller limits then, until what is stored stays within half an 8-bit step.
        again_and_again = levels and options.seam_weight is not None and not plan.is_large
        for tighter in TIGHTER if again_and_again else ():
            if stored.max.max(initial=0.0) <= VISIBLE:
                break
            if limit is not None and tighter == 1.0:
                continue
            limited = tighter * (limit or JUMP_LIMIT)
            again = plan.erase(current, sample_values=values, bounds=bounds, jump_limit=limited)
            rounded, measured = _stored(again.texels, plan, levels)
            if measured.max.max() < stored.max.max():
                erased, result, stored = again, rounded, measured
        chain.append(Level(result, plan.measure(current), plan.measure(erased.texels), stored, plan.is_large))
        current = erased.texels
        used = plan.region.used
        del plan  # before the next is made: its factors are the largest part of the memory
    return tuple(chain)
