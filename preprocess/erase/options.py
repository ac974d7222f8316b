"""What a person can choose about seam erasure: the energies' weights, which seams, known values, the sampler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Weights:
    """Weights of the energies (paper, section 4; docs/method.md, section 3). Dimensionless.

    Attributes
    ----------
    change : float
        Squared change of inside texels, divided by their number: 1e4 local, 1e2 global.
    inside_gradient, outside_gradient : float
        Squared change of the gradient between inside texels; squared gradient where a texel is outside.
    slope : float
        C1 discontinuity across seams.
    value : float
        Deviation along the silhouette from known values (lerp) or from the original texture.
    samples : float
        Mean squared deviation at sample points.
    """

    change: float = 1e4
    inside_gradient: float = 1.0
    outside_gradient: float = 1.0
    slope: float = 1e2
    value: float = 1e2
    samples: float = 1e4


LOCAL = Weights()
GLOBAL = Weights(change=1e2)


@dataclass(frozen=True)
class EraseOptions:
    """How to erase.

    Attributes
    ----------
    weights : Weights
        `LOCAL` changes texels near seams only; `GLOBAL` spreads the difference ten times as far.
    seam_value : str
        "none", "texture" (stay near the original texture along the silhouette: texels outside are reliable) or
        "lerp" (stay near values that run linearly between those at the edges' ends).
    joined : (S,) bool or None
        Seams that are erased; the others are left as they are. None: all.
    repeat : bool
        Whether the sampler repeats beyond the image (it clamps otherwise).
    seam_weight : float or None
        None closes seams exactly. Then each seam edge can carry no more than one quadratic wherever its two sides
        cross texel lines at different places; a finite weight (1e8: about a hundredth of an 8-bit step is left) keeps
        finer detail along long straight seams.
    jump_limit : float or None
        With a finite seam weight: the jump, in the texture's unit, that solutions may have, so that detail is given up
        only as far as it must be: below the limit a jump costs nothing. Met to about a third of it. None: no limit,
        jumps cost what `seam_weight` says from zero on.
    """

    weights: Weights = LOCAL
    seam_value: str = "none"
    joined: NDArray[np.bool_] | None = None
    repeat: bool = False
    seam_weight: float | None = None
    jump_limit: float | None = None


DEFAULT_OPTIONS = EraseOptions()
