"""Seams as dense samples: the texels that seams read, and the jump at points along them, as sparse rows.

The jump is one quadratic on each interval (see `intervals`), so a few points on each see all of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.energies import jump_weights, to_rows
from preprocess.erase.intervals import Intervals, cut_into_intervals
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface

# Points on each interval at which the largest jump is looked for; a quadratic cannot exceed them by much.
DENSE_POINTS = 9


@dataclass(frozen=True)
class SeamStrip:
    """Samples of the jump along seams. N texels, P points.

    Attributes
    ----------
    texels : (N,) int64
        Flat indices of the texels that any seam reads, sorted.
    rows : (P, N) sparse
        Jump at each point from the texels: side 0 less side 1.
    weights : (P,) float64
        Length that each point stands for, in units of the mean.
    groups : (N,) int64
        Of eight, by the parity of column and row and by the side of the seam: texels of one group seldom share a point.
    """

    texels: NDArray[np.int64]
    rows: sparse.csr_array
    weights: Floats
    groups: NDArray[np.int64]

    @cached_property
    def texels_of_point(self) -> NDArray[np.int32]:
        """The texels that each point reads, N where there are no more: (P, 8 or less)."""
        count = np.diff(self.rows.indptr)
        holds = np.arange(count.max(initial=1)) < count[:, None]
        texels = np.full(holds.shape, len(self.texels), np.int32)
        texels[holds] = self.rows.indices
        return texels


@dataclass(frozen=True)
class SeamMeasure:
    """How much a texture jumps across seams, in the texture's own unit. C channels, S seams.

    Attributes
    ----------
    rms : (C,) float64
        Root of the mean squared jump over the seams' 3D length (exact).
    max : (C,) float64
        Largest jump over dense samples.
    total : (C,) float64
        D_total, the square of `rms`.
    seam_rms : (S, C) float64
        The same for each seam alone.
    """

    rms: Floats
    max: Floats
    total: Floats
    seam_rms: Floats


def build_strip(intervals: Intervals, lengths_m: Floats) -> SeamStrip:
    """Sample the start and the middle of every interval, and the end of every seam.

    Parameters
    ----------
    intervals : Intervals
        Of the seams, both sides.
    lengths_m : (E,) float64
    """
    span = intervals.end - intervals.start
    inner = intervals.start[:, None] + span[:, None] * np.array([0.0, 0.5])
    is_last = np.append(intervals.edges[1:] != intervals.edges[:-1], True)[: len(intervals)]
    sides = intervals.texels.reshape(-1, 8)
    texels = np.unique(sides)
    local = np.searchsorted(texels, sides)
    at_end = jump_weights(intervals, intervals.end[:, None])[is_last]
    rows = sparse.vstack(
        [
            to_rows(local, jump_weights(intervals, inner), len(texels)),
            to_rows(local[is_last], at_end, len(texels)),
        ],
        format="csr",
    )
    rows.sum_duplicates()
    share = span * lengths_m[intervals.edges]
    weights = np.concatenate([np.repeat(share / 2, 2), np.zeros(np.count_nonzero(is_last))])
    mean = weights.mean() if len(weights) else 0.0
    row, column = np.divmod(texels, intervals.size_px[0])
    on_second_side = np.zeros(len(texels), np.bool_)
    on_second_side[local[:, 4:]] = True
    groups = column % 2 + 2 * (row % 2) + 4 * on_second_side
    return SeamStrip(texels, rows, weights / (mean if mean > 0 else 1.0), groups)


def _between(steps: Floats) -> Floats:
    """Weights of the three Gauss points' values in a quadratic's value at each step of [0, 1], (P, 3)."""
    nodes = 0.5 + 0.5 * np.polynomial.legendre.leggauss(3)[0]
    return np.asarray(np.linalg.solve(np.vander(nodes, 3).T, np.vander(steps, 3).T).T, np.float64)


def measure_intervals(texels: Floats, intervals: Intervals, lengths_m: Floats) -> SeamMeasure:
    """`measure_seams` for seams that are cut already."""
    channels = texels.shape[2]
    num_seams = len(lengths_m)
    if not len(intervals):
        zero = np.zeros(channels)
        return SeamMeasure(zero, zero, zero, np.zeros((num_seams, channels)))
    read = np.unique(intervals.texels)
    values = np.asarray(texels.reshape(-1, channels)[read], np.float64)
    local = np.searchsorted(read, intervals.texels.reshape(-1, 8))
    gamma, weights = intervals.gauss(3)
    jump = (to_rows(local, jump_weights(intervals, gamma), len(read)) @ values).reshape(len(intervals), -1, channels)
    energy = np.einsum("iq,iqc->ic", weights, jump**2)
    per_seam = np.stack([np.bincount(intervals.edges, energy[:, c], num_seams) for c in range(channels)], axis=1)
    length = lengths_m.sum()
    total = lengths_m @ per_seam / (length if length > 0 else 1.0)
    # One quadratic on each interval: the values at three points give those at all others.
    largest = np.zeros(channels)
    for blend in _between(np.linspace(0, 1, DENSE_POINTS)):
        largest = np.maximum(largest, np.abs(np.einsum("q,iqc->ic", blend, jump)).max(axis=0))
    return SeamMeasure(np.sqrt(total), largest, total, np.sqrt(per_seam))


def measure_seams(
    texels: Floats,
    surface: TexturedSurface,
    seams: Seams,
    *,
    joined: NDArray[np.bool_] | None = None,
    repeat: bool = False,
) -> SeamMeasure:
    """Measure the jump of a texture across seams.

    Parameters
    ----------
    texels : (H, W, C) float
    surface : TexturedSurface
    seams : Seams
    joined : (S,) bool, optional
        Which seams count; all by default.
    repeat : bool
        Whether the sampler repeats.

    Returns
    -------
    SeamMeasure
        Seams that do not count have no entry in `seam_rms`.
    """
    height, width = texels.shape[:2]
    kept = slice(None) if joined is None else joined
    intervals = cut_into_intervals(surface.uvs[seams.uv_pairs[kept]], width, height, repeat=repeat)
    return measure_intervals(texels, intervals, seams.lengths_m[kept])
