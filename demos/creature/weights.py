"""Skin weights: every vertex starts with the bone of the body part that made it, then the weights diffuse like heat.

One implicit step of heat flow over the skin, (M + t L) w = M w0, with lumped areas M and a Laplacian L of clipped
cotangents: smooth along the surface, never across a gap between two limbs, never negative, rows sum to one (after
Baran and Popović 2007, "Automatic rigging and animation of 3D characters"). The four largest influences stay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from demos.creature.field import Field
from demos.creature.skeleton import Joints
from demos.creature.surface import Floats, Ints, corner_cotangents, vertex_areas, weighted_laplacian

_SPREAD_M = 0.042  # how far the weights of a joint spread over the skin
_INFLUENCES = 4

# The joints that each region of the body may follow; the nearest bone of them is taken.
_REGION_JOINTS: dict[str, tuple[str, ...]] = {
    "trunk": ("hips", "spine", "chest", "belly"),
    "neck": ("chest", "neck"),
    "head": ("head",),
    "muzzle": ("head",),
    "nostril": ("head",),
    "eye": ("head",),
    "lid": ("head",),
    "horn": ("head",),
    "jaw": ("jaw",),
    "mouth": ("head", "jaw"),
    "ear": ("ear", "ear_tip"),
    "tail": ("tail_1", "tail_2", "tail_3", "tail_4", "tail_5"),
    "fin": ("tail_5",),
    "arm": ("upper_arm", "forearm", "hand"),
    "leg": ("thigh", "shin", "foot"),
    "claw": ("hand", "foot"),
    "wing": ("wing", "wing_tip"),
    "crest": ("head", "neck", "chest", "spine", "hips", "tail_1", "tail_2", "tail_3", "tail_4", "tail_5"),
}


def _segment_distance(points: Floats, start: Floats, end: Floats) -> Floats:
    axis = end - start
    t = np.clip((points - start) @ axis / max(float(axis @ axis), 1e-12), 0.0, 1.0)
    result: Floats = np.linalg.norm(points - start - t[:, None] * axis, axis=1)
    return result


def _first_guess(field: Field, joints: Joints, points: Floats) -> Floats:
    """One bone a region and point, mixed as the regions are: (V, J), rows summing to one."""
    mix = field.regions_at(points)
    side = np.where(points[:, 0] >= 0, ".L", ".R")
    guess = np.zeros((len(points), len(joints.names)))
    rows = np.arange(len(points))
    distance = np.stack(
        [_segment_distance(points, a, b) for a, b in zip(joints.positions, joints.tips, strict=True)], axis=1
    )
    for region, share in zip(field.regions, mix.T, strict=True):
        allowed = np.zeros(guess.shape, bool)
        for joint, name in enumerate(joints.names):
            base, dot, suffix = name.partition(".")
            if base in _REGION_JOINTS[region]:
                allowed[:, joint] = side == dot + suffix if dot else True
        nearest = np.where(allowed, distance, np.inf).argmin(axis=1)
        guess[rows, nearest] += share
    return guess


def compute_weights(
    field: Field, joints: Joints, points: Floats, faces: Ints
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Smooth weights of at most four joints a vertex.

    Parameters
    ----------
    field : Field
        The body, which knows the region of each point.
    joints : Joints
    points : (V, 3) float64
        Symmetric in x = 0 or not.
    faces : (F, 3) int64

    Returns
    -------
    indices : (V, 4) uint16
        Joints, strongest first; unused slots are 0.
    weights : (V, 4) float32
        Non-negative, rows summing to one.
    """
    cotangents = np.maximum(corner_cotangents(points, faces), 0.02)
    laplacian = weighted_laplacian(faces, 0.5 * cotangents, len(points))
    mass = sparse.diags(vertex_areas(points, faces))
    solver = splu((mass + _SPREAD_M**2 * laplacian).tocsc())
    weights = solver.solve(np.asarray(mass @ _first_guess(field, joints, points)))
    weights = np.maximum(solver.solve(np.asarray(mass @ weights)), 0.0) ** 1.35
    strongest = np.argsort(-weights, axis=1, kind="stable")[:, :_INFLUENCES]
    kept = np.take_along_axis(weights, strongest, axis=1)
    kept = np.maximum(kept / kept.sum(axis=1, keepdims=True) - 0.012, 0.0)
    kept /= kept.sum(axis=1, keepdims=True)
    strongest[kept == 0] = 0
    return strongest.astype(np.uint16), kept.astype(np.float32)
