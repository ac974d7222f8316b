"""Boxes that hold a skinned character: for any pose, and for a whole clip between its samples too.

A skinned point is a convex combination of the places its joints would carry it to. So the box around every joint's
own vertices, carried by that joint's matrix, holds the character in that pose (`pose_bounds`), and any blend of poses
by matrices as well.

Over a clip (`clip_bounds`) the pose is sampled, and between two samples a point strays from its chord by at most
h²/8 times its largest acceleration. That is bounded through the hierarchy: with G the linear part above a node, L its
own R·S, and o its origin,

    |G·L|″ ≤ |G″||L| + 2|G′||L′| + |G||L″|,     o″ ≤ o₀″ + |G″||T| + 2|G′||T′| + |G||T″|,

where key frame tracks give |R′| = ω, |R″| ≤ ω² exactly (great arcs) and polynomials bound the rest. Nothing is
assumed about the clip, so the box is proven, not guessed from samples.
Letters in shapes: A actors, J joints, P joints that move something, N nodes, V vertices, K influences, I intervals of
time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.clip import WEIGHTS, Clip
from runtime.animation.keyframes import Bank, locate
from runtime.animation.pose import sample, skinning_rows
from runtime.animation.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]

# Sampling is doubled until the margin it needs is this small a part of the box, or this many times.
_MARGIN_REL = 0.004
_MAX_DOUBLINGS = 6
# A cubic rotation whose quaternion may come nearer to zero than this has no useful bound on its speed.
_SHORTEST_QUATERNION = 0.05
_UNBOUNDED = 1e30


def joint_boxes(
    positions: ArrayLike,
    joint_indices: ArrayLike,
    joint_weights: ArrayLike,
    num_joints: int,
    faces: ArrayLike | None = None,
    margin_m: float = 0.0,
) -> NDArray[np.float64]:
    """Box around the vertices that each joint moves, in the mesh's space at rest.

    Parameters
    ----------
    positions : (V, 3) float, metres
    joint_indices : (V, K) int
    joint_weights : (V, K) float
        Slots with weight 0 do not count.
    num_joints : int
    faces : (F, 3) int, optional
        With them a box holds every face that has a vertex of the joint. That is needed where points between the
        vertices are skinned too: other levels of detail, and tessellation.
    margin_m : float
        Grows every box on all sides.

    Returns
    -------
    (J, 2, 3) float64: lower and upper corner; +inf, -inf for a joint that moves nothing
    """
    points = np.asarray(positions, dtype=np.float64)
    indices, weights = np.asarray(joint_indices), np.asarray(joint_weights)
    vertex, slot = np.nonzero(weights > 0)
    joint = indices[vertex, slot]
    if faces is not None and len(np.asarray(faces)):
        corners = np.asarray(faces)
        moved = np.zeros((len(points), num_joints), dtype=bool)
        moved[vertex, joint] = True
        face, joint = np.nonzero(moved[corners].any(axis=1))
        vertex, joint = corners[face].ravel(), np.repeat(joint, 3)
    boxes = np.empty((num_joints, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    np.minimum.at(boxes[:, 0], joint, points[vertex] - margin_m)
    np.maximum.at(boxes[:, 1], joint, points[vertex] + margin_m)
    return boxes


def reaches_of(weights: Floats, reaches: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far morphs of these weights (A, M) move what each joint carries: least and greatest shift, (A, J, 2, 3).

    reaches : (M, J, 2, 3), of weight one
    """
    swapped = reaches[:, :, ::-1]  # a negative weight turns the greatest shift into the least
    up, down = np.maximum(weights, 0.0), np.minimum(weights, 0.0)
    return np.asarray(np.tensordot(up, reaches, 1) + np.tensordot(down, swapped, 1))


def weight_ranges(clip: Clip, skeleton: Skeleton) -> NDArray[np.float64]:
    """Least and greatest weight of each morph in a clip, (2, M). Cubic keys stay within their Bezier points."""
    ranges = np.repeat(np.array([skeleton.morph_weights], np.float64), 2, axis=0)
    for track in clip.tracks:
        if track.path == WEIGHTS:
            values = track.values
            if track.interpolation == "CUBICSPLINE":
                thirds = np.diff(track.times)[:, None] / 3
                leaving = values[:-1, 1] + thirds * values[:-1, 2]
                arriving = values[1:, 1] - thirds * values[1:, 0]
                values = np.concatenate([values[:, 1], leaving, arriving])
            ranges[:, track.node] = values.min(), values.max()
    return ranges


def grown_boxes(
    boxes: NDArray[np.float64], reaches: NDArray[np.float64], ranges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Boxes of joints (J, 2, 3) that hold what they carry while morph weights stay within ranges (2, M)."""
    shifts = ranges[:, :, None, None, None] * reaches  # least and greatest weight, morph, joint, both ends, xyz
    least, greatest = shifts.min(axis=(0, 3)).sum(axis=0), shifts.max(axis=(0, 3)).sum(axis=0)
    return np.stack([boxes[:, 0] + least, boxes[:, 1] + greatest], axis=1)


def stored_joint_boxes(stored: Sequence[NDArray[np.float64] | None], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint boxes (J, 2, 3) as a built character has them: +inf, -inf for None, a joint that moves nothing.

    A character that stores none gets its whole box for every joint: safe, and looser.
    """
    nothing = np.array([[np.inf] * 3, [-np.inf] * 3]) if any(box is not None for box in stored) else whole
    return np.array([nothing if box is None else box for box in stored], np.float64).reshape(-1, 2, 3)


class JointBoxes:
    """Boxes of the joints that move something, ready to be carried by any number of poses.

    Parameters
    ----------
    boxes : (J, 2, 3) float64
        From `joint_boxes`.
    reaches : (M, J, 2, 3) float64, optional
        How far each morph of weight one moves what each joint carries: least and greatest shift.
    """

    def __init__(self, boxes: NDArray[np.float64], reaches: NDArray[np.float64] | None = None) -> None:
        self.boxes = boxes
        self.used = np.flatnonzero(np.isfinite(boxes).all(axis=(1, 2)))
        # Where a joint's 3 x 4 words lie in a pose. Joints come last in all that follows: inner loops are long then.
        self._words = np.arange(12).reshape(3, 4, 1) + 12 * self.used
        factors = np.zeros((2, 4, len(self.used)))  # of half edges and the translation, and of what moves the middle
        factors[0, :3] = np.ptp(boxes[self.used], axis=1).T / 2
        factors[0, 3] = 1.0
        factors[1, :3] = boxes[self.used].mean(axis=1).T
        self._exact, self._single = factors, factors.astype(np.float32)
        self._reaches = None if reaches is None or not len(reaches) else reaches[:, self.used]

    def _grown(self, weights: Floats) -> tuple[Floats, Floats]:
        """The factors of each of A actors whose morphs have weights (A, M): (A, 1, 4, P) each."""
        assert self._reaches is not None
        shifts = reaches_of(weights, self._reaches)  # (A, P, 2, 3)
        edges, middles = (np.repeat(one[None], len(weights), axis=0) for one in self._exact)
        edges[:, :3] += (shifts[:, :, 1] - shifts[:, :, 0]).transpose(0, 2, 1) / 2
        middles[:, :3] += shifts.mean(axis=2).transpose(0, 2, 1)
        return edges[:, None].astype(np.float32), middles[:, None].astype(np.float32)

    def carried(self, matrices: Floats, morph_weights: Floats | None = None) -> Floats:
        """Boxes of the joints that move something, carried by (A, J, 3, 4) matrices, turned as these turn them.

        Boxes grow by what morphs of weights (A, M) move.

        Returns
        -------
        (A, 3, 4, P)
            Three half edges and the middle of each, as columns.
        """
        words = matrices.reshape(len(matrices), int(np.prod(matrices.shape[1:]))).take(self._words, axis=1)
        edges, middles = self._single if words.dtype == np.float32 else self._exact
        if morph_weights is not None and self._reaches is not None:
            edges, middles = self._grown(morph_weights)
        parts: Floats = words * edges
        words *= middles
        parts[:, :, 3] += np.add.reduce(words, axis=2)
        return parts

    def around(self, matrices: Floats, morph_weights: Floats | None = None) -> Floats:
        """Box of the skinned mesh of each pose, (A, 2, 3); zeros where no joint moves anything."""
        return box_around(self.carried(matrices, morph_weights))


def upright_boxes(parts: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest corner of what holds each of boxes that are turned, (A, 3, 4, P): (A, 3, P) each."""
    middles, reaches = parts[:, :, 3], np.abs(parts[:, :, :3]).sum(axis=2)
    return middles - reaches, middles + reaches


def box_around(parts: Floats) -> Floats:
    """What holds all boxes of each body, (A, 3, 4, P): (A, 2, 3), zeros where P is 0."""
    if not parts.shape[3]:
        return np.zeros((len(parts), 2, 3), parts.dtype)
    low, high = upright_boxes(parts)
    return np.stack([low.min(axis=2), high.max(axis=2)], axis=1)


def pose_bounds(matrices: Floats, boxes: NDArray[np.float64]) -> Floats:
    """Box of the skinned mesh of each of A poses.

    Parameters
    ----------
    matrices : (A, J, 3, 4) or (A, J, 4, 4) float
        Skinning matrices.
    boxes : (J, 2, 3) float64
        From `joint_boxes`.

    Returns
    -------
    (A, 2, 3) float, object space; zeros where no joint moves anything
    """
    return JointBoxes(boxes).around(matrices[:, :, :3])


@dataclass(frozen=True)
class _Motion:
    """Bounds of one property over intervals: of its size, and of its first and second derivative, (N, I)."""

    size: NDArray[np.float64]
    speed: NDArray[np.float64]
    acceleration: NDArray[np.float64]


def _polynomial_motion(bank: Bank, width: int) -> tuple[NDArray[np.float64], ...]:
    """Bounds of size, speed and acceleration over u ∈ [0, 1] of every segment, each (S,)."""
    degree = 1 if bank.form == "linear" else 3
    parts = [bank.coefficients[power * width : (power + 1) * width] for power in range(degree + 1)]
    sizes = [np.linalg.norm(part, axis=0) for part in parts]
    size = np.add.reduce(sizes)
    if bank.form == "linear":
        # A straight way is longest at one of its ends.
        size = np.maximum(sizes[0], np.linalg.norm(parts[0] + parts[1], axis=0))
        return size, sizes[1], np.zeros_like(size)
    speed = sizes[1] + 2 * sizes[2] + 3 * sizes[3]
    acceleration = np.maximum(2 * sizes[2], np.linalg.norm(2 * parts[2] + 6 * parts[3], axis=0))
    return size, speed, acceleration


def _rotation_motion(bank: Bank) -> tuple[NDArray[np.float64], ...]:
    """Bounds of |R|, |R′| and |R″| over u ∈ [0, 1] of every segment, each (S,)."""
    if bank.form == "arc":
        turn = 2 * np.abs(bank.coefficients[8])  # a quaternion turns half as far as what it rotates
        return np.ones_like(turn), turn, turn * turn
    _, speed, acceleration = _polynomial_motion(bank, 4)
    u = np.linspace(0, 1, 17)[:, None, None]
    a, b, c, d = (bank.coefficients[power * 4 : power * 4 + 4] for power in range(4))
    shortest = np.linalg.norm(((d * u + c) * u + b) * u + a, axis=1).min(axis=0) - speed / 32
    bounded = shortest > _SHORTEST_QUATERNION
    safe = np.where(bounded, shortest, 1.0)
    turning = np.where(bounded, speed / safe, _UNBOUNDED)
    bending = np.where(bounded, acceleration / safe + 3 * (speed / safe) ** 2, _UNBOUNDED)
    return np.ones_like(turning), 2 * turning, 2 * bending + 2 * turning**2


def _motions(skeleton: Skeleton, clip: Clip, middles: NDArray[np.float64]) -> dict[str, _Motion]:
    """Bounds of translation, rotation and scale of every node over intervals given by their middles."""
    shape = (skeleton.num_nodes, len(middles))
    rest = {
        "translation": np.linalg.norm(skeleton.translation, axis=1),
        "rotation": np.ones(skeleton.num_nodes),
        "scale": np.abs(skeleton.scale).max(axis=1),
    }
    motions = {
        path: _Motion(np.broadcast_to(size[:, None], shape).copy(), np.zeros(shape), np.zeros(shape))
        for path, size in rest.items()
    }
    if not clip.keys.banks:
        return motions
    segments, _ = locate(clip.keys, middles)
    key_rates = clip.keys.rates[clip.keys.first_key[:, None] + segments]
    # Before a track's first key nothing moves, although the segment found there has a rate.
    key_rates = np.where(middles < clip.keys.start_times[clip.keys.first_key][:, None], 0.0, key_rates)
    for bank in clip.keys.banks:
        if bank.path not in motions:  # morph weights move no node
            continue
        bounds = _rotation_motion(bank) if bank.path == "rotation" else _polynomial_motion(bank, 3)
        index = bank.first_segment[:, None] + segments[bank.time_lists]
        rates = key_rates[bank.time_lists]
        motion = motions[bank.path]
        motion.size[bank.nodes] = bounds[0][index]
        motion.speed[bank.nodes] = bounds[1][index] * rates
        motion.acceleration[bank.nodes] = bounds[2][index] * rates**2
    return motions


def _accelerations(
    skeleton: Skeleton, clip: Clip, middles: NDArray[np.float64], reaches: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bound of the acceleration of a joint's vertices, and of their distance from the origin, each (J, I).

    reaches : (J,) largest distance of a joint's vertices from the joint.
    """
    motions = _motions(skeleton, clip, middles)
    move, turn, grow = motions["translation"], motions["rotation"], motions["scale"]
    own = grow.size
    own_1 = turn.speed * grow.size + grow.speed
    own_2 = turn.acceleration * grow.size + 2 * turn.speed * grow.speed + grow.acceleration
    for index, matrix in zip(skeleton.matrix_nodes, skeleton.matrices):
        own[index], own_1[index], own_2[index] = np.linalg.norm(matrix[:3, :3], 2), 0.0, 0.0
        move.size[index] = np.linalg.norm(matrix[:3, 3])

    shape = (skeleton.num_nodes, len(middles))
    linear, linear_1, linear_2 = np.empty(shape), np.empty(shape), np.empty(shape)
    origin, origin_2 = np.empty(shape), np.empty(shape)
    root = float(np.linalg.norm(skeleton.root_transform[:3, :3], 2))
    root_shift = float(np.linalg.norm(skeleton.root_transform[:3, 3]))
    for node, parent in enumerate(skeleton.parents):
        if parent < 0:
            g, g_1, g_2, o, o_2 = root, 0.0, 0.0, root_shift, 0.0
        else:
            g, g_1, g_2 = linear[parent], linear_1[parent], linear_2[parent]
            o, o_2 = origin[parent], origin_2[parent]
        linear[node] = g * own[node]
        linear_1[node] = g_1 * own[node] + g * own_1[node]
        linear_2[node] = g_2 * own[node] + 2 * g_1 * own_1[node] + g * own_2[node]
        origin[node] = o + g * move.size[node]
        origin_2[node] = o_2 + g_2 * move.size[node] + 2 * g_1 * move.speed[node] + g * move.acceleration[node]
    joints = skeleton.joint_nodes
    accelerations = origin_2[joints] + linear_2[joints] * reaches[:, None]
    return accelerations, origin[joints] + linear[joints] * reaches[:, None]


def _sample_times(clip: Clip, parts: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Starts and ends of intervals that no key lies inside of, (I,) each.

    An interval ends just before the key that closes it: a STEP track jumps there.
    """
    keys = np.unique(np.concatenate([[0.0], clip.key_times, [clip.duration_s]]))
    if len(keys) < 2:
        return keys, keys
    fractions = np.arange(parts) / parts
    spans = np.diff(keys)[:, None]
    starts = (keys[:-1, None] + spans * fractions).ravel()
    ends = (keys[:-1, None] + spans * (fractions + 1 / parts)).reshape(-1, parts)
    ends[:, -1] = np.maximum(np.nextafter(keys[1:], 0.0), starts.reshape(-1, parts)[:, -1])
    # The last key itself is a pose of its own where a STEP track jumps on it.
    return np.append(starts, keys[-1]), np.append(ends.ravel(), keys[-1])


def clip_bounds(skeleton: Skeleton, clip: Clip, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Box that holds the skinned mesh at every moment of a clip.

    Parameters
    ----------
    skeleton : Skeleton
    clip : Clip
    boxes : (J, 2, 3) float64
        From `joint_boxes`.

    Returns
    -------
    (2, 3) float64, object space, metres
        Proven conservative; grown by less than half a percent unless the clip turns very fast.
    """
    used = np.flatnonzero(np.isfinite(boxes).all(axis=(1, 2)))
    if not len(used):
        return np.zeros((2, 3))
    corners = np.array([[boxes[joint, k >> 2 & 1, 0], boxes[joint, k >> 1 & 1, 1], boxes[joint, k & 1, 2]]
                        for joint in used for k in range(8)]).reshape(len(used), 8, 3)  # fmt: skip
    inverse = skeleton.inverse_bind[used]
    local = np.einsum("jrc,jkc->jkr", inverse[:, :3, :3], corners) + inverse[:, None, :3, 3]
    reaches = np.zeros(skeleton.num_joints)
    reaches[used] = np.linalg.norm(local, axis=2).max(axis=1)

    box, carrier = np.zeros((2, 3)), JointBoxes(boxes)
    for doubling in range(_MAX_DOUBLINGS + 1):
        starts, ends = _sample_times(clip, 2**doubling)
        first, last = (
            np.stack(upright_boxes(carrier.carried(skinning_rows(skeleton, sample(clip, skeleton, times)))), axis=1)
            for times in (starts, ends)
        )
        accelerations, radii = _accelerations(skeleton, clip, (starts + ends) / 2, reaches)
        stray = np.minimum((ends - starts) ** 2 / 8 * accelerations, 2 * radii)[used].T[:, None]
        # Left limits are taken one rounding step early, and sums round: a hair covers both.
        hair = 1e-9 * (1 + float(radii.max()))
        box = np.stack(
            [
                (np.minimum(first[:, 0], last[:, 0]) - stray).min(axis=(0, 2)) - hair,
                (np.maximum(first[:, 1], last[:, 1]) + stray).max(axis=(0, 2)) + hair,
            ]
        )
        sampled = np.stack([first[:, 0].min(axis=(0, 2)), first[:, 1].max(axis=(0, 2))])
        if np.abs(box - sampled).max() <= _MARGIN_REL * np.linalg.norm(np.ptp(sampled, axis=0)):
            break
    return box
