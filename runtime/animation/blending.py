"""Blending poses of many actors: weighted mixes, masked overlays, additive layers.

Rotations are mixed as normalised weighted sums with signs aligned to what is there already; additive rotations are
scaled along their own arc. Letters in shapes: A actors, E entries (an actor may have several), N nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from runtime.animation.pose import Pose
from runtime.animation.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]
Rows = NDArray[np.int64]


def _normalised(rotation: Floats) -> Floats:
    """Unit quaternions, components last; zero becomes the identity."""
    lengths = np.sqrt(np.sum(rotation * rotation, axis=-1, keepdims=True))
    identity = np.array([0, 0, 0, 1], dtype=rotation.dtype)
    result: Floats = np.where(lengths > 0, rotation / np.where(lengths > 0, lengths, 1), identity)
    return result


def _product(left: Floats, right: Floats) -> Floats:
    """Hamilton product of quaternions (x, y, z, w), components last."""
    ax, ay, az, aw = np.moveaxis(left, -1, 0)
    bx, by, bz, bw = np.moveaxis(right, -1, 0)
    parts = (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
    return np.stack(parts, axis=-1)


def _power(rotation: Floats, amount: Floats) -> Floats:
    """Part of a rotation, on its shorter arc: amount 0 is none of it, 1 all of it. (..., 4) and (...,)."""
    rotation = np.where(rotation[..., 3:] < 0, -rotation, rotation)
    sine = np.sqrt(np.sum(rotation[..., :3] ** 2, axis=-1))
    half_angle = np.arctan2(sine, rotation[..., 3])
    factor = np.where(sine > 1e-12, np.sin(amount * half_angle) / np.where(sine > 1e-12, sine, 1), amount)
    return np.concatenate([rotation[..., :3] * factor[..., None], np.cos(amount * half_angle)[..., None]], axis=-1)


def mix_poses(
    skeleton: Skeleton,
    num_actors: int,
    parts: Sequence[tuple[Rows, NDArray[np.float64], Pose]],
    dtype: DTypeLike = np.float32,
) -> Pose:
    """Weighted mix of poses.

    Parameters
    ----------
    skeleton : Skeleton
        Its rest pose is what an actor without any entry gets.
    num_actors : int
    parts : sequence of (actors (E,) int, weights (E,) float, Pose of E actors)
        An actor may occur in several parts and more than once in a part. Weights need not sum to one.
    dtype : precision of the result

    Returns
    -------
    Pose of `num_actors` actors
    """
    nodes = skeleton.num_nodes
    totals = np.zeros(num_actors)
    mixed = Pose(
        np.zeros((3, nodes, num_actors), dtype).T,
        np.zeros((4, nodes, num_actors), dtype).T,
        np.zeros((3, nodes, num_actors), dtype).T,
        np.zeros((len(skeleton.morphs), num_actors), dtype).T if skeleton.morphs else None,
    )
    for actors, weights, pose in parts:
        # Entries of one actor are taken one after another, so that each aligns with the sum so far.
        turn = _occurrence(actors)
        for number in range(int(turn.max(initial=-1)) + 1):
            entry = np.flatnonzero(turn == number)
            who, weight = actors[entry], weights[entry].astype(dtype)[:, None, None]
            rotation = pose.rotation[entry]
            along = np.sum(rotation * mixed.rotation[who], axis=-1, keepdims=True)
            mixed.rotation[who] += np.where(along < 0, -weight, weight) * rotation
            mixed.translation[who] += weight * pose.translation[entry]
            mixed.scale[who] += weight * pose.scale[entry]
            if mixed.weights is not None and pose.weights is not None:
                mixed.weights[who] += weight[:, :, 0] * pose.weights[entry]
            totals[who] += weights[entry]
    silent = totals <= 0
    share = (1.0 / np.where(silent, 1.0, totals)).astype(dtype)[:, None, None]
    mixed.translation[:] *= share
    mixed.scale[:] *= share
    mixed.rotation[:] = _normalised(mixed.rotation)
    if mixed.weights is not None:
        mixed.weights[:] *= share[:, :, 0]
        mixed.weights[silent] = np.array(skeleton.morph_weights, dtype)
    if silent.any():
        mixed.translation[silent] = skeleton.translation.astype(dtype)
        mixed.rotation[silent] = skeleton.rotation.astype(dtype)
        mixed.scale[silent] = skeleton.scale.astype(dtype)
    return mixed


def _occurrence(actors: Rows) -> Rows:
    """For each entry how often its actor has occurred before it."""
    order = np.argsort(actors, kind="stable")
    ordered = actors[order]
    first = np.searchsorted(ordered, ordered, side="left")
    result = np.empty(len(actors), dtype=np.int64)
    result[order] = np.arange(len(actors)) - first
    return result


def _amounts(amount: NDArray[np.float64], mask: NDArray[np.float32] | None, pose: Pose) -> Floats:
    """How far every node of every actor follows a layer, (E, N)."""
    amounts = np.repeat(amount.astype(pose.dtype)[:, None], pose.translation.shape[1], axis=1)
    return amounts if mask is None else amounts * mask


def overlay_pose(
    pose: Pose, above: Pose, actors: Rows, amount: NDArray[np.float64], mask: NDArray[np.float32] | None
) -> None:
    """Move a pose towards another, in place.

    Parameters
    ----------
    pose : Pose of A actors, changed
    above : Pose of E actors
    actors : (E,) int, different ones
        Which actors of `pose` those of `above` are.
    amount : (E,) float, 0 to 1
    mask : (N,) float or None
    """
    part = _amounts(amount, mask, pose)[..., None]
    pose.translation[actors] += part * (above.translation - pose.translation[actors])
    pose.scale[actors] += part * (above.scale - pose.scale[actors])
    below = pose.rotation[actors]
    towards = np.where(np.sum(below * above.rotation, axis=-1, keepdims=True) < 0, -above.rotation, above.rotation)
    mixed = _normalised(below + part * (towards - below))
    # A node that the layer does not touch keeps its very bits.
    pose.rotation[actors] = np.where(part > 0, mixed, below)
    if pose.weights is not None and above.weights is not None and mask is None:  # a mask of nodes leaves faces alone
        pose.weights[actors] += amount.astype(pose.dtype)[:, None] * (above.weights - pose.weights[actors])


def add_pose(
    pose: Pose,
    above: Pose,
    reference: Pose,
    actors: Rows,
    amount: NDArray[np.float64],
    mask: NDArray[np.float32] | None,
) -> None:
    """Add to a pose, in place, what another does relative to its reference.

    Translations and morph weights are added, scales multiplied, rotations applied after the pose's own in
    the node's own frame.

    Parameters
    ----------
    pose : Pose of A actors, changed
    above, reference : Poses of E actors
    actors : (E,) int, different ones
    amount : (E,) float, 0 to 1
    mask : (N,) float or None
    """
    part = _amounts(amount, mask, pose)
    pose.translation[actors] += part[..., None] * (above.translation - reference.translation)
    safe = np.where(np.abs(reference.scale) > 1e-12, reference.scale, 1)
    pose.scale[actors] *= 1 + part[..., None] * (above.scale / safe - 1)
    inverse = reference.rotation * np.array([-1, -1, -1, 1], dtype=pose.dtype)
    added = _power(_product(inverse, above.rotation), part)
    pose.rotation[actors] = _normalised(_product(pose.rotation[actors], added))
    if pose.weights is not None and above.weights is not None and reference.weights is not None:
        pose.weights[actors] += amount.astype(pose.dtype)[:, None] * (above.weights - reference.weights)
