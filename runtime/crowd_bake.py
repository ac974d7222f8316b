"""What a crowd needs ready-made: clips as rows of joint matrices, and each level's vertices with their joints.

Clips are sampled at a fixed rate. Between two rows the shader blends matrices, so a skinned point moves on the chord
of two exact places, and the boxes of the rows hold everything that is drawn.
Letters in shapes: C clips, R rows of all clips, J joints, V vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.bounds import pose_bounds
from runtime.clip import Clip
from runtime.pose import rest_pose, sample, skinning_rows
from runtime.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]

# Rows a second. A hand at 2 m/s moves 8 mm from one to the next, so the nearest row is good enough from about 20 m on;
# a blend of two is exact to micrometres. 1,400 rows of 53 joints are 3.5 MB.
BAKE_RATE_HZ = 240.0
MAX_ROWS = 8192
_SAMPLED_ROWS = 48  # of all baked poses, for measuring what a simplification moves


@dataclass(frozen=True)
class BakedClips:
    """Clips as rows of a texture. The last one is the rest pose, for actors that play nothing.

    Attributes
    ----------
    names : tuple of C str
    matrices : (R, J, 3, 4) float32
    first_row : (C,) int64
    num_rows : (C,) int64
        The last row of a clip is its end: a place beyond it is never read.
    durations_s : (C,) float64
    rates_hz : (C,) float64
        Rows a second, so that duration times rate is `num_rows - 1`.
    centres : (C, 3) float64
        Of the sphere that holds all poses of a clip, object space, metres.
    radii_m : (C,) float64
    shift_m : float
        How far a vertex may be from its place when the nearest row is taken instead of a blend of two.
    """

    names: tuple[str, ...]
    matrices: NDArray[np.float32]
    first_row: NDArray[np.int64]
    num_rows: NDArray[np.int64]
    durations_s: NDArray[np.float64]
    rates_hz: NDArray[np.float64]
    centres: NDArray[np.float64]
    radii_m: NDArray[np.float64]
    shift_m: float


def _largest_step(matrices: NDArray[np.float32], boxes: NDArray[np.float64]) -> float:
    """Longest way of any point of the joints' boxes from one row to the next, metres."""
    used = np.flatnonzero(np.isfinite(boxes).all(axis=(1, 2)))
    if len(matrices) < 2 or not len(used):
        return 0.0
    steps = np.diff(matrices[:, used].astype(np.float64), axis=0)
    picks = np.array([[corner >> axis & 1 for axis in range(3)] for corner in range(8)])
    corners = boxes[used][:, picks, np.arange(3)]
    ways = np.einsum("sjrc,jkc->sjkr", steps[..., :3], corners) + steps[:, :, None, :, 3]
    return float(np.linalg.norm(ways, axis=3).max())


def bake_clips(
    skeleton: Skeleton, clips: Sequence[Clip], boxes: NDArray[np.float64], max_rows: int = MAX_ROWS
) -> BakedClips:
    """Sample clips into rows of skinning matrices.

    Parameters
    ----------
    skeleton : Skeleton
    clips : sequence of Clip
    boxes : (J, 2, 3) float64
        From `runtime.bounds.joint_boxes`.
    max_rows : int
        Texture height that must not be exceeded: all clips are sampled more slowly if need be.

    Raises
    ------
    ValueError
        When even two rows a clip are too many.
    """
    total_s = sum(clip.duration_s for clip in clips)
    room = max_rows - 3 * len(clips) - 1
    if room < 0:
        raise ValueError(f"{len(clips)} clips do not fit into {max_rows} rows; give the crowd fewer clips")
    rate = min(BAKE_RATE_HZ, room / total_s) if total_s > 0 else BAKE_RATE_HZ
    blocks: list[NDArray[np.float32]] = []
    shift = 0.0
    for clip in clips:
        steps = int(np.ceil(clip.duration_s * rate))
        times = np.linspace(0.0, clip.duration_s, steps + 1)
        block = skinning_rows(skeleton, sample(clip, skeleton, times, dtype=np.float64)).astype(np.float32)
        blocks.append(block)
        shift = max(shift, _largest_step(block, boxes) / 2)
    blocks.append(skinning_rows(skeleton, rest_pose(skeleton)).astype(np.float32))
    counts = np.array([len(block) for block in blocks], dtype=np.int64)
    durations = np.array([*(clip.duration_s for clip in clips), 0.0])
    spheres = [_sphere(block, boxes) for block in blocks]
    return BakedClips(
        names=(*(clip.name for clip in clips), "rest"),
        matrices=np.concatenate(blocks),
        first_row=np.cumsum(counts) - counts,
        num_rows=counts,
        durations_s=durations,
        rates_hz=(counts - 1) / np.where(durations > 0, durations, 1.0),
        centres=np.array([centre for centre, _ in spheres]),
        radii_m=np.array([radius for _, radius in spheres]),
        shift_m=shift,
    )


def _sphere(matrices: NDArray[np.float32], boxes: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre and radius of a sphere around the boxes of all rows."""
    each = pose_bounds(matrices, boxes).astype(np.float64)
    low, high = each[:, 0].min(axis=0), each[:, 1].max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + 1e-4


def pick_joints(joints: NDArray[Any], weights: Floats, width: int) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """The strongest joints of each vertex, weights summing to one.

    Parameters
    ----------
    joints : (V, K) int
        A joint may occur more than once only with weight 0.
    weights : (V, K) float
    width : int
        How many to keep.

    Returns
    -------
    joints (V, width) uint16, weights (V, width) float32
    """
    order = np.argsort(-weights, axis=1, kind="stable")
    weights = np.take_along_axis(weights, order, axis=1).astype(np.float64)
    joints = np.take_along_axis(joints, order, axis=1)
    missing = ((0, 0), (0, max(0, width - weights.shape[1])))
    kept, joints = np.pad(weights, missing)[:, :width], np.pad(joints, missing)[:, :width]
    kept = kept / np.maximum(kept.sum(axis=1, keepdims=True), 1e-12)
    return np.where(kept > 0, joints, 0).astype(np.uint16), kept.astype(np.float32)


def dropped_shift(
    matrices: NDArray[np.float32], positions: Floats, joints: NDArray[Any], weights: Floats, width: int
) -> float:
    """How far keeping only `width` joints moves any vertex, metres, over a sample of the baked poses.

    Parameters
    ----------
    matrices : (R, J, 3, 4) float32
    positions : (V, 3) float
    joints, weights : (V, K)
    width : int
    """
    affected = np.flatnonzero((weights > 0).sum(axis=1) > width)
    if not len(affected):
        return 0.0
    rows = matrices[np.unique(np.linspace(0, len(matrices) - 1, _SAMPLED_ROWS).astype(int))]
    points = np.concatenate([positions[affected], np.ones((len(affected), 1))], axis=1)
    places = []
    for few, amounts in (
        (joints[affected], weights[affected]),
        pick_joints(joints[affected], weights[affected], width),
    ):
        moved = np.zeros((len(rows), len(affected), 3))
        for slot in range(few.shape[1]):
            carried = np.einsum("rvij,vj->rvi", rows[:, few[:, slot]], points)
            moved += amounts[:, slot, None] * carried
        places.append(moved)
    return float(np.linalg.norm(places[0] - places[1], axis=2).max())
