"""Layers of a mixer: which nodes they move, and whether they replace or add."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.skeleton import Skeleton

MODES = ("override", "additive")


@dataclass(frozen=True)
class Layer:
    """One layer of a mixer.

    Attributes
    ----------
    name : str
    mode : "override" or "additive"
        An additive layer adds what its clip does relative to the clip's first frame.
    mask : (N,) float32 or None
        How far each node follows the layer, 0 to 1. None is all of them.
    """

    name: str
    mode: str = "override"
    mask: NDArray[np.float32] | None = None


def make_layer(skeleton: Skeleton, name: str, mode: str = "override", nodes: ArrayLike | None = None) -> Layer:
    """A layer from what a caller may give.

    Parameters
    ----------
    skeleton : Skeleton
    name : str
    mode : "override" or "additive"
    nodes : (N,) float or bool mask, or a list of node names whose subtrees take part; all by default

    Raises
    ------
    ValueError
        For an unknown mode or node, or a mask of the wrong length.
    """
    if mode not in MODES:
        raise ValueError(f"layer mode {mode!r} is unknown; use 'override' or 'additive'")
    if nodes is None:
        return Layer(name, mode)
    given = np.asarray(nodes)
    if given.dtype.kind in "US":
        mask = np.zeros(skeleton.num_nodes, dtype=bool)
        for node in np.atleast_1d(given):
            mask |= skeleton.descendants(str(node))
        return Layer(name, mode, mask.astype(np.float32))
    if given.shape != (skeleton.num_nodes,):
        raise ValueError(f"a mask needs one number a node ({skeleton.num_nodes}), not shape {given.shape}")
    return Layer(name, mode, np.clip(given.astype(np.float32), 0, 1))
