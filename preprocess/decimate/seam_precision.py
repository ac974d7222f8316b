"""Seams that are straight and matched as far as the file can say are made so exactly, before any edge collapses.

An exact collapse needs a seam whose two sides run along one line in joint uv space (paper, section 5.1). Uvs that were
written with six decimals, or kept as 32-bit floats, are off such a line by what was rounded away. So each chain between
two corners is simplified in that space with the rounding as its tolerance (as seam straightening does with a larger
one, section 6) and its points are moved onto the segments, by less than what the file leaves open. After that the
rules need no tolerance but float64's, and nothing adds up over many collapses.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.decimate.topology import HalfEdges
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten.chains import find_chains
from preprocess.straighten.simplify import joint_points, simplify_chains, straight_points

# A point and both ends of its segment are off by half a step in each of four coordinates at most, so the point is off
# the segment by two of those half diagonals: 2 · √4 / 2 steps.
ROUNDED_STEPS = 2.0
# What no texture can show: a sixty-fourth of a texel at 4096 x 4096. Coarser uvs need a tolerance from a person.
MOST_UV = 1.0 / (64 * 4096)
MOST_DECIMALS = 9
# A decimal number below 100 read as float64 is this near to its decimals, as a share of the last of nine.
DECIMAL_ERROR = 1e-4
MOST_ROUNDS = 8  # in which points around faces that would fold are given back


def uv_step(uvs: Floats) -> float:
    """The spacing that uvs (T, 2) were rounded to: that of decimals or of 32-bit floats; 0 for neither.

    It is what most of them were rounded to. Numbers of six significant digits, which many programs write, have the
    more decimals the smaller they are: only those of the decade in which most uvs lie are asked.
    """
    values = np.abs(uvs[uvs != 0.0])
    if not len(values):
        return 0.0
    decades = np.floor(np.log10(values)).astype(np.int64)
    found, counts = np.unique(decades, return_counts=True)
    common = values[decades == found[counts.argmax()]]
    for decimals in range(1, MOST_DECIMALS + 1):
        scaled = common * 10.0**decimals
        if (np.abs(scaled - np.rint(scaled)) <= DECIMAL_ERROR).mean() > 0.5:
            return float(10.0**-decimals)
    if (uvs.astype(np.float32) == uvs).all():
        return float(np.spacing(np.float32(values.max())))
    return 0.0


def written_tolerance_uv(uvs: Floats) -> float:
    """How far a point of a straight, matched seam may lie off its line only because uvs (T, 2) were rounded."""
    return min(ROUNDED_STEPS * uv_step(uvs), MOST_UV)


def _uv_areas(surface: TexturedSurface, uvs: Floats) -> Floats:
    """Twice the signed area of every uv triangle, (F,)."""
    first, second = np.diff(uvs[surface.face_uvs], axis=1).transpose(1, 0, 2)
    result: Floats = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return result


def straighten_within(half_edges: HalfEdges, positions: Floats, uvs: Floats, tolerance_uv: float) -> Floats:
    """The uvs (W, 2) of a surface's wedges with every seam and boundary straight where it is so within a tolerance.

    Parameters
    ----------
    half_edges : HalfEdges
    positions : (V, 3) float64
    uvs : (W, 2) float64
    tolerance_uv : float
        Farthest that a point may move in the joint uv space of its copies.

    Returns
    -------
    (W, 2) float64
        No face is folded or flat that was not before.
    """
    if not tolerance_uv > 0.0:
        return uvs
    corners = slice(3 * half_edges.num_faces)
    faces, face_uvs = (a[corners].reshape(-1, 3).astype(np.int32) for a in (half_edges.tail, half_edges.wedge))
    surface = TexturedSurface(positions, faces, uvs, face_uvs)
    chains = find_chains(surface)
    joint = joint_points(chains, uvs)
    limits = np.full(len(joint), tolerance_uv)
    must_keep = np.zeros(len(joint), bool)
    must_keep[chains.offsets[:-1]] = must_keep[chains.offsets[1:] - 1] = True
    kept, fractions = np.ones(len(joint), bool), np.zeros(len(joint))
    pending = np.ones(chains.num_chains, bool)
    before = _uv_areas(surface, uvs)
    for _ in range(MOST_ROUNDS):
        kept, fractions = simplify_chains(chains, joint, limits, must_keep, kept, fractions, pending)
        moved, result = straight_points(joint, kept, fractions), uvs.copy()
        for side in range(2):
            has = chains.uv_ids[:, side] >= 0
            result[chains.uv_ids[has, side]] = moved[has, 2 * side : 2 * side + 2]
        folded = (before != 0.0) & (np.sign(_uv_areas(surface, result)) != np.sign(before))
        if not folded.any():
            return result
        near = np.zeros(len(uvs) + 1, bool)  # the last stands for the missing side of boundaries
        near[surface.face_uvs[folded]] = True
        spoiled = near[chains.uv_ids].any(axis=1)
        must_keep |= spoiled
        pending = np.zeros(chains.num_chains, bool)
        pending[chains.point_chains[spoiled]] = True
    return uvs
