"""Joint weights as a built character stores them: a sparse stack of 8- or 16-bit images, packed and unpacked.

The paper (section 8) stores weight maps as 8-bit images, one channel per joint, and normalises on the fly. A texel of
a real character moves with a few joints only, so what is stored here is a list of (joint, weight) pairs per texel, most
important first, as a stack of RGBA images under one another: joints of slots 0-3, weights of slots 0-3, joints of
slots 4-7 and so on. Weights have 255 steps, joint numbers as many bits as they need. Rounding keeps each texel's
weights summing to exactly one, so nothing has to be normalised: a bilinear blend of partitions of unity is one. The
runtime rearranges the stack into one record per 2 x 2 footprint (runtime/gpu/weight_records.py); docs/format.md tells
why.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_SLOTS = 8  # pairs per texel; real characters have at most 4 per vertex, and a texel blends a few vertices
MAX_JOINTS_8BIT = 256  # joint numbers and weights share one image, so more joints make both 16-bit
WEIGHT_STEPS = 255  # what the shaders unpack; 16-bit stacks hold multiples of 257


def stored_step(dtype: Any) -> int:
    """What one of the `WEIGHT_STEPS` steps is in a stored channel: 1 of 8 bits, 257 of 16."""
    return int(np.iinfo(dtype).max) // WEIGHT_STEPS


@dataclass(frozen=True)
class PackedWeights:
    """Joint weights as stored.

    Attributes
    ----------
    stack : (2 * ceil(slots / 4) * H, W, 4) uint8 or uint16
        Joints and weights of four slots in turn, top to bottom. Unused slots hold joint 0 with weight 0.
    slots : int
        Pairs per texel, at least 1.
    size : (int, int)
        W, H of the weight map.
    dropped_max : float
        Largest sum of weights that a texel lost because it had more than `MAX_SLOTS` joints.
    """

    stack: NDArray[Any]
    slots: int
    size: tuple[int, int]
    dropped_max: float

    @property
    def format(self) -> str:
        """Stored type of a channel: "uint8" or "uint16"."""
        return str(self.stack.dtype)

    @property
    def texels01(self) -> NDArray[np.float64]:
        """The stack scaled to [0, 1], as image files take it."""
        return self.stack / float(np.iinfo(self.stack.dtype).max)


def _strongest(weights: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """Indices of the `count` largest weights of each row, largest first, equal ones by joint number: (N, count)."""
    if count < weights.shape[1]:
        chosen = np.argpartition(-weights, count - 1, axis=1)[:, :count]
        chosen.sort(axis=1)
    else:
        chosen = np.broadcast_to(np.arange(weights.shape[1]), weights.shape)
    order = np.argsort(-np.take_along_axis(weights, chosen, axis=1), axis=1, kind="stable")
    return np.take_along_axis(chosen, order, axis=1)


def _round_to_unity(weights: NDArray[np.float64], levels: int) -> NDArray[np.int64]:
    """Round rows that sum to one to multiples of 1/levels that sum to one, by largest remainder: (N, K)."""
    scaled = weights * levels
    rounded = np.floor(scaled + 1e-6).astype(np.int64)
    missing = levels - rounded.sum(axis=1)
    by_remainder = np.argsort(rounded - scaled, axis=1, kind="stable")
    rank = np.empty_like(by_remainder)
    np.put_along_axis(rank, by_remainder, np.broadcast_to(np.arange(weights.shape[1]), weights.shape), axis=1)
    return np.asarray(rounded + (rank < missing[:, None]), np.int64)


def pack_weights(dense: NDArray[np.floating], max_slots: int = MAX_SLOTS) -> PackedWeights:
    """Keep the strongest joints of every texel and round them to the stored steps.

    Weights that are stored multiples already come back unchanged.

    Parameters
    ----------
    dense : (H, W, J) float
        Weights of every joint; negative ones count as zero, rows need not be normalised. A texel whose weights are
        all zero is given to joint 0.
    max_slots : int
        Pairs kept per texel at most.

    Returns
    -------
    PackedWeights

    Raises
    ------
    ValueError
        If the array is not (H, W, J) with at least one joint, or not finite.
    """
    if dense.ndim != 3 or 0 in dense.shape:
        raise ValueError(f"dense weights must be (H, W, J) with at least one texel and joint, got {dense.shape}")
    height, width, num_joints = dense.shape
    dtype: Any = np.uint8 if num_joints <= MAX_JOINTS_8BIT else np.uint16
    weights = np.maximum(np.asarray(dense, np.float64).reshape(-1, num_joints), 0.0)
    if not np.isfinite(weights).all():
        raise ValueError("dense weights must be finite")
    total = weights.sum(axis=1)
    joints = _strongest(weights, min(max_slots, num_joints))
    kept = np.take_along_axis(weights, joints, axis=1)
    kept_total = kept.sum(axis=1)
    nothing = kept_total <= 0.0
    dropped = np.where(nothing, 0.0, 1.0 - kept_total / np.where(nothing, 1.0, total))
    kept[nothing, 0], joints[nothing, 0] = 1.0, 0
    steps = _round_to_unity(kept / kept.sum(axis=1, keepdims=True), WEIGHT_STEPS)
    joints = np.where(steps > 0, joints, 0)
    stored = steps * stored_step(dtype)
    slots = int((steps > 0).sum(axis=1).max())
    num_images = -(-slots // 4)
    pairs = np.zeros((2, len(weights), num_images * 4), dtype)
    used = min(steps.shape[1], num_images * 4)
    pairs[0, :, :used], pairs[1, :, :used] = joints[:, :used], stored[:, :used]
    images = pairs.reshape(2, height, width, num_images, 4).transpose(3, 0, 1, 2, 4)
    stack = np.ascontiguousarray(images.reshape(2 * num_images * height, width, 4))
    return PackedWeights(stack, slots, (width, height), float(dropped.max()))


def unpack_steps(stored: NDArray[Any]) -> NDArray[np.int64]:
    """Whole steps, 0 to `WEIGHT_STEPS`, of stored weights of any shape."""
    step = stored_step(stored.dtype)
    return (stored.astype(np.int64) + step // 2) // step


def unpack_pairs(stack: NDArray[Any], size: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Joints and weights (in steps) of each texel from a stored stack, each (H, W, K) int64.

    Parameters
    ----------
    stack : (2 * N * H, W, 4) uint8 or uint16
    size : (W, H)

    Raises
    ------
    ValueError
        If the stack's shape does not fit the size.
    """
    width, height = size
    if stack.shape[1:] != (width, 4) or stack.shape[0] % (2 * height):
        raise ValueError(f"a weight stack of {width} x {height} texels cannot have the shape {stack.shape}")
    images = stack.reshape(-1, 2, height, width, 4)
    joints = np.concatenate(list(images[:, 0]), axis=-1).astype(np.int64)
    return joints, unpack_steps(np.concatenate(list(images[:, 1]), axis=-1))


def unpack_weights(stack: NDArray[Any], size: tuple[int, int], num_joints: int) -> NDArray[np.float64]:
    """Dense weights from a stored stack, the inverse of `pack_weights` up to rounding.

    Parameters
    ----------
    stack : (2 * N * H, W, 4) uint8 or uint16
    size : (W, H)
    num_joints : int

    Returns
    -------
    (H, W, J) float64

    Raises
    ------
    ValueError
        If the stack's shape does not fit the size, or a joint number is too large.
    """
    joints, steps = unpack_pairs(stack, size)
    if joints.max() >= num_joints:
        raise ValueError(f"a weight texel names joint {joints.max()} of {num_joints}")
    dense = np.zeros((size[1] * size[0], num_joints))
    texels = np.arange(len(dense))
    for slot in range(joints.shape[-1]):  # a joint may come twice only with weight 0
        np.add.at(dense, (texels, joints[..., slot].ravel()), steps[..., slot].ravel() / WEIGHT_STEPS)
    return dense.reshape(size[1], size[0], num_joints)
