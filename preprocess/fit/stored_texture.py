"""A texture as the folder of a built character holds it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.erase import SeamMeasure, measure_seams
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from runtime.asset.morphs import Morphs
from runtime.asset.weight_quadtree import WeightDetails


@dataclass(frozen=True)
class StoredTexture:
    """A texture as the folder holds it.

    Attributes
    ----------
    name : str
        File stem.
    levels : tuple of (H, W, C) float
        Mip levels, finest first; integer formats hold multiples of their step in [0, 1].
    format : str
        "uint8", "uint16", "half" or "float".
    size : (width, height)
        Of the finest level (of the grid, where the file is a stack of several).
    seam : dict
        `before`, `after` (the solution) and `stored` (a list, one a level), each with `rms` and `max`.
    extra : dict
        More keys for the manifest.
    details : WeightDetails or None
        Of joint weights: where they are finer than their map.
    morphs : Morphs or None
        Of positions: how morph targets displace them.
    """

    name: str
    levels: tuple[NDArray[Any], ...]
    format: str
    size: tuple[int, int]
    seam: dict[str, Any]
    extra: dict[str, Any] = field(default_factory=dict)
    details: WeightDetails | None = None
    morphs: Morphs | None = None


def jump(measure: SeamMeasure) -> dict[str, float]:
    """Root mean square over the seams' length of the jump's norm, and the largest jump of any channel."""
    return {"rms": float(np.sqrt(measure.total.sum())), "max": float(measure.max.max(initial=0.0))}


def seam_report(
    surface: TexturedSurface, seams: Seams, baked: Floats, erased: Floats, stored: NDArray[Any]
) -> dict[str, Any]:
    """Jump across all seams before, after and as stored."""
    before, after, kept = (jump(measure_seams(texels, surface, seams)) for texels in (baked, erased, stored))
    return {"before": before, "after": after, "stored": [kept]}
