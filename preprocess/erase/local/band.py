"""The texels beside seams and what says how they should be: the system that erasure solves (paper, section 4).

Only texels near joined seams are unknown: those that seam samples read, and so many rings around them that the change
has faded (it falls by e over the fading length). One matrix-free system serves all channels and all textures of a size
whose joined seams are the same. For texels p with given values p0:

    Σ mass (p - p0)²  +  Σ stiffness (difference of neighbours - its target)²  +  Σ penalty · max(|jump| - limit, 0)²

with the target of a difference that of the given texels inside charts, and zero where one of the two lies outside (the
texture's author may never have painted it). The jump is sampled at the start and the middle of every interval and at
the end of every seam: one quadratic on each (see `intervals`), so it is small everywhere if it is small there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from preprocess.arrays import Floats
from preprocess.erase.energies import jump_weights
from preprocess.erase.intervals import Intervals, cut_into_intervals
from preprocess.erase.matrix import GRADIENT_MASS
from preprocess.erase.options import EraseOptions
from preprocess.erase.region import Region, find_region
from preprocess.erase.seam_samples import SeamMeasure
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface

MOST_FADING_PX = 4.0  # a change that reaches further is not seen as more gradual, and costs more
FADING_LENGTHS = 3.0  # the band's rings, in fading lengths
LEAST_WEIGHT = 0.05  # of a sample that stands for a tiny piece of seam, in texels
# ∫ q² of a quadratic from its values at start, middle and end, on an interval of length one.
QUADRATIC_MASS = np.array([(4.0, 2.0, -1.0), (2.0, 16.0, 2.0), (-1.0, 2.0, 4.0)]) / 30.0
TIE = 1e-6  # of an outside texel that nothing else holds


@dataclass(frozen=True)
class Band:
    """N texels, P samples of the jump.

    Attributes
    ----------
    region : Region
    intervals : Intervals
        Of the joined seams, both sides.
    lengths_m : (E,) float64
        3D lengths of the joined seams.
    texels : (N,) int64
        Flat indices, sorted.
    seam_texels : (M,) int32
        Those that samples read, as numbers in `texels`.
    mass : (N,) float32
        Of each texel's squared change.
    neighbours : (N, 4) int32
        In the band, left, right, above and below; the texel itself where there is none.
    stiffness : (N, 4) float32
        Of the squared difference from each neighbour; zero where there is none.
    keeps_difference : (N, 4) bool
        Whether the target of that difference is the given one.
    sample_texels : (P, 8) int32
        What each sample reads, each texel once.
    sample_weights : (P, 8) float32
        Of these in the jump, side 0 less side 1; zero where there are fewer.
    sample_lengths : (P,) float32
        Length of seam that each stands for, texels.
    starts, samples, shares : (N + 1,) int32, (K,) int32, (K,) float32
        The same by texel: texel t has weight shares[k] in samples[k] for k from starts[t] to starts[t + 1].
    interval_samples : (I, 3) int32
        The samples at start, middle and end of each interval.
    """

    region: Region
    intervals: Intervals
    lengths_m: Floats
    texels: NDArray[np.int64]
    seam_texels: NDArray[np.int32]
    mass: NDArray[np.float32]
    neighbours: NDArray[np.int32]
    stiffness: NDArray[np.float32]
    keeps_difference: NDArray[np.bool_]
    sample_texels: NDArray[np.int32]
    sample_weights: NDArray[np.float32]
    sample_lengths: NDArray[np.float32]
    starts: NDArray[np.int32]
    samples: NDArray[np.int32]
    shares: NDArray[np.float32]
    interval_samples: NDArray[np.int32]

    def jumps(self, values: Floats) -> Floats:
        """The jump of texels (N, C) at every sample, (P, C)."""
        result = np.zeros((len(self.sample_texels), values.shape[1]))
        for texels, weights in zip(self.sample_texels.T, self.sample_weights.T):
            result += weights[:, None] * values[texels]
        return result

    def measure(self, jumps: Floats) -> SeamMeasure:
        """How much a texture jumps across the joined seams, from its jumps at the samples (P, C)."""
        channels, num_seams = jumps.shape[1], len(self.lengths_m)
        if not len(self.intervals):
            zero = np.zeros(channels)
            return SeamMeasure(zero, zero, zero, np.zeros((num_seams, channels)))
        at = jumps[self.interval_samples]  # (I, 3, C)
        energy = np.einsum("ijc,jk,ikc->ic", at, QUADRATIC_MASS, at)
        energy *= (self.intervals.end - self.intervals.start)[:, None]
        edges = self.intervals.edges
        per_seam = np.stack([np.bincount(edges, energy[:, c], num_seams) for c in range(channels)], axis=1)
        length = self.lengths_m.sum()
        total = self.lengths_m @ per_seam / (length if length > 0 else 1.0)
        return SeamMeasure(np.sqrt(total), self.peaks(jumps).max(axis=0), total, np.sqrt(per_seam))

    def peaks(self, jumps: Floats) -> Floats:
        """The largest jump on each interval, (I, C), from the jumps at the samples (P, C)."""
        start, middle, end = (jumps[self.interval_samples[:, k]] for k in range(3))
        curve, slope = 2.0 * (start + end - 2.0 * middle), 4.0 * middle - 3.0 * start - end
        turn = -slope / np.where(curve == 0.0, 1.0, 2.0 * curve)
        inner = np.where((turn > 0.0) & (turn < 1.0), start + turn * (slope + turn * curve), 0.0)
        return np.maximum(np.maximum(np.abs(start), np.abs(end)), np.maximum(np.abs(middle), np.abs(inner)))

    def samples_near(self, chosen: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
        """Some samples, (P,) bool, and those that share a texel with them, ring by ring."""
        reads = self.sample_weights != 0.0
        for _ in range(rings):
            moved = np.zeros(len(self.texels), np.bool_)
            moved[self.sample_texels[chosen][reads[chosen]]] = True
            chosen = (moved[self.sample_texels] & reads).any(axis=1)
        return chosen


def _sample_seams(intervals: Intervals) -> tuple[NDArray[np.int64], Floats, Floats, NDArray[np.int32]]:
    """Texels (P, 8), weights (P, 8) and lengths (P,) of the samples, and those of every interval (I, 3)."""
    count = len(intervals)
    span = intervals.end - intervals.start
    at = intervals.start[:, None] + span[:, None] * np.array([0.0, 0.5])
    is_last = np.append(intervals.edges[1:] != intervals.edges[:-1], True)[:count]
    texels = intervals.texels.reshape(-1, 8)
    weights = np.concatenate(
        [
            jump_weights(intervals, at).reshape(-1, 8),
            jump_weights(intervals, intervals.end[:, None])[is_last].reshape(-1, 8),
        ]
    )
    lines = intervals.lines_px
    lengths = span * np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=2).max(axis=1)[intervals.edges]
    ends = np.zeros(np.count_nonzero(is_last))
    numbers = np.stack([2 * np.arange(count), 2 * np.arange(count) + 1, 2 * np.arange(1, count + 1)], axis=1)
    numbers[is_last, 2] = 2 * count + np.arange(len(ends))
    return (
        np.concatenate([np.repeat(texels, 2, axis=0), texels[is_last]]),
        weights,
        np.maximum(np.concatenate([np.repeat(lengths / 2, 2), ends]), LEAST_WEIGHT),
        numbers.astype(np.int32),
    )


def _merge(texels: NDArray[np.int64], weights: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Each row's texels once: a repeated one's weights are added to its first place, and it keeps none at the other."""
    order = np.argsort(texels, axis=1, kind="stable")
    texels, weights = np.take_along_axis(texels, order, 1), np.take_along_axis(weights, order, 1)
    for k in range(texels.shape[1] - 1, 0, -1):
        same = texels[:, k] == texels[:, k - 1]
        weights[same, k - 1] += weights[same, k]
        weights[same, k] = 0.0
    return texels, weights


def fading_px(options: EraseOptions, num_inside: int) -> float:
    """Distance over which a change falls by e, texels."""
    weights = options.weights
    length = np.sqrt(weights.inside_gradient * GRADIENT_MASS * max(num_inside, 1) / max(weights.change, 1e-12))
    return float(min(length, MOST_FADING_PX))


def plan_band(surface: TexturedSurface, seams: Seams, width: int, height: int, options: EraseOptions) -> Band:
    """Find the texels near the joined seams and what holds them.

    Parameters
    ----------
    surface : TexturedSurface
    seams : Seams
        Of the surface.
    width, height : int
        Of the image.
    options : EraseOptions
        Which seams are joined, and the weights of change and gradient.
    """
    joined = slice(None) if options.joined is None else options.joined
    intervals = cut_into_intervals(surface.uvs[seams.uv_pairs[joined]], width, height, repeat=options.repeat)
    region = find_region(surface, seams, width, height, repeat=options.repeat, seam_cells=intervals.texels[:, :, 0])
    fading = fading_px(options, region.num_inside)
    texels, weights, lengths, interval_samples = _sample_seams(intervals)
    near = np.zeros((height, width), np.bool_)
    near.ravel()[texels] = True
    if near.any():
        near = ndimage.binary_dilation(near, iterations=int(np.ceil(FADING_LENGTHS * fading)))
    band = np.flatnonzero(near & region.used)
    number = np.full(height * width, -1, np.int32)
    number[band] = np.arange(len(band))
    texels, weights = _merge(number[texels].astype(np.int64), weights)
    neighbours, stiffness, keeps, mass = _hold(region, band, number, fading)

    shape = (len(texels), len(band))
    rows = sparse.csr_array((weights.flatten(), texels.flatten(), np.arange(len(texels) + 1) * 8), shape=shape)
    rows.eliminate_zeros()
    columns = sparse.csr_array(rows.T)
    return Band(
        region,
        intervals,
        seams.lengths_m[joined],
        band,
        np.flatnonzero(np.diff(columns.indptr)).astype(np.int32),
        mass,
        neighbours,
        stiffness,
        keeps,
        texels.astype(np.int32),
        weights.astype(np.float32),
        lengths.astype(np.float32),
        columns.indptr.astype(np.int32),
        columns.indices.astype(np.int32),
        columns.data.astype(np.float32),
        interval_samples,
    )


def _hold(
    region: Region, band: NDArray[np.int64], number: NDArray[np.int32], fading: float
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """Neighbours (N, 4), their stiffness and whether differences stay; mass (N,). See `Band`."""
    height, width = region.inside.shape
    inside, used = region.inside.ravel(), region.used.ravel()
    row, column = np.divmod(band, width)
    mass = np.where(inside[band], GRADIENT_MASS / max(fading, 1e-3) ** 2, TIE).astype(np.float32)
    neighbours = np.repeat(np.arange(len(band), dtype=np.int32)[:, None], 4, axis=1)
    stiffness = np.zeros((len(band), 4), np.float32)
    keeps = np.zeros((len(band), 4), np.bool_)
    for k, (right, down) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
        x, y = column + right, row + down
        exists = (x >= 0) & (x < width) & (y >= 0) & (y < height) | region.repeat
        there = np.where(exists, y % height * width + x % width, band)
        exists &= used[there]
        both = inside[band] & inside[there]
        held = exists & (number[there] >= 0)
        neighbours[held, k] = number[there[held]]
        stiffness[held, k] = GRADIENT_MASS
        keeps[:, k] = both
        mass[exists & ~held & both] += np.float32(GRADIENT_MASS)  # texels beyond the band do not change
    return neighbours, stiffness, keeps, mass
