"""What a crowd needs ready-made: clips as rows of joint matrices, and the strongest joints of each vertex.

Rows lie on a clip's own keys where these are evenly spaced, and as many in between as it takes: between two rows the
shader blends matrices, so a skinned point moves on a chord, and how far that may be from its place is measured.
Letters in shapes: C clips, R rows of all clips, J joints, V vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.animation.bounds import pose_bounds
from runtime.animation.clip import Clip
from runtime.animation.pose import rest_pose, sample, skinning_rows
from runtime.animation.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]

LEAST_RATE_HZ, MOST_RATE_HZ = 30.0, 240.0
# How far a point may be from its place between two rows, of the character's diagonal: half a millisecond of a stride.
TIME_TOLERANCE_REL = 2.5e-4
MAX_ROWS = 8192
_KEY_TOLERANCE = 0.004  # of a step: keys nearer to a row than this lie on it
_PARTS = 4  # places between two rows where the chord is compared with the clip
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
        Middle of the box that holds all poses of a clip, object space, metres.
    radii_m : (C,) float64
        Of the sphere around that box.
    row_boxes : (R, 2, 3) float32
        Box that holds each row's pose, object space, metres. What lies between two rows lies between their boxes.
    shift_m : float
        How far a point may be from its place, since what lies between two rows is blended.
    """

    names: tuple[str, ...]
    matrices: NDArray[np.float32]
    first_row: NDArray[np.int64]
    num_rows: NDArray[np.int64]
    durations_s: NDArray[np.float64]
    rates_hz: NDArray[np.float64]
    centres: NDArray[np.float64]
    radii_m: NDArray[np.float64]
    row_boxes: NDArray[np.float32]
    shift_m: float


def steps_between_keys(clip: Clip) -> int:
    """The fewest equal steps over a clip that all its keys lie on; 0 where they are not evenly spaced."""
    if clip.duration_s <= 0:
        return 0
    places = np.unique(np.append(clip.key_times, [0.0, clip.duration_s])) / clip.duration_s
    gaps = np.diff(places)
    least = gaps[gaps > _KEY_TOLERANCE / (MOST_RATE_HZ * clip.duration_s)].min(initial=1.0)
    for wanted in np.arange(1, 5) / least:
        steps = round(float(wanted))
        if steps <= MOST_RATE_HZ * clip.duration_s and np.abs(places * steps - np.rint(places * steps)).max() <= (
            _KEY_TOLERANCE
        ):
            return steps
    return 0


def _bake(skeleton: Skeleton, clip: Clip, steps: int, corners: Floats) -> tuple[NDArray[np.float32], float]:
    """A clip in equal steps, (steps + 1, J, 3, 4), and how far the chords between them stray, metres.

    corners : (J, 8, 3), NaN where a joint moves nothing
    """
    times = np.linspace(0.0, clip.duration_s, _PARTS * steps + 1)
    exact = skinning_rows(skeleton, sample(clip, skeleton, times, dtype=np.float64))
    rows, shift = exact[::_PARTS], 0.0
    used = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    for part in range(1, _PARTS if steps else 0):
        share = part / _PARTS
        strays = (rows[:-1, used] * (1 - share) + rows[1:, used] * share) - exact[part::_PARTS, used]
        ways = np.einsum("sjrc,jkc->sjkr", strays[..., :3], corners[used]) + strays[:, :, None, :, 3]
        shift = max(shift, float(np.sqrt(np.einsum("sjkr,sjkr->sjk", ways, ways).max(initial=0.0))))
    return rows.astype(np.float32), shift


def _bake_well(
    skeleton: Skeleton, clip: Clip, corners: Floats, tolerance_m: float, most_hz: float
) -> tuple[NDArray[np.float32], float]:
    """A clip in as few steps as keep its chords within a tolerance, or in as many as are allowed."""
    most = max(int(np.ceil(clip.duration_s * most_hz)), 1)
    own = steps_between_keys(clip)
    unit = own if 0 < own <= most else 1
    steps = min(unit * int(np.ceil(clip.duration_s * min(LEAST_RATE_HZ, most_hz) / unit)), most // unit * unit)
    while True:
        rows, shift = _bake(skeleton, clip, steps, corners)
        if shift <= tolerance_m or steps + max(steps // 2, unit) > most:
            return rows, shift
        # Halving the steps divides a smooth stray by four; a kink at a key between two rows only by two.
        steps = min(
            unit * int(np.ceil(steps * min(max((shift / tolerance_m) ** 0.5, 1.5), 4.0) / unit)), most // unit * unit
        )


def bake_clips(
    skeleton: Skeleton, clips: Sequence[Clip], boxes: NDArray[np.float64], max_rows: int = MAX_ROWS
) -> BakedClips:
    """Sample clips into rows of skinning matrices.

    Parameters
    ----------
    skeleton : Skeleton
    clips : sequence of Clip
    boxes : (J, 2, 3) float64
        From `runtime.animation.bounds.joint_boxes`.
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
    most_hz = min(MOST_RATE_HZ, room / total_s) if total_s > 0 else MOST_RATE_HZ
    picks = np.array([[corner >> axis & 1 for axis in range(3)] for corner in range(8)])
    corners = boxes[:, picks, np.arange(3)]
    finite = boxes[np.isfinite(boxes).all(axis=(1, 2))]
    diagonal = float(np.linalg.norm(finite[:, 1].max(axis=0) - finite[:, 0].min(axis=0))) if len(finite) else 1.0
    blocks: list[NDArray[np.float32]] = []
    shift = 0.0
    for clip in clips:
        block, strayed = _bake_well(skeleton, clip, corners, TIME_TOLERANCE_REL * diagonal, most_hz)
        blocks.append(block)
        shift = max(shift, strayed)
    blocks.append(skinning_rows(skeleton, rest_pose(skeleton)).astype(np.float32))
    counts = np.array([len(block) for block in blocks], dtype=np.int64)
    durations = np.array([*(clip.duration_s for clip in clips), 0.0])
    unbounded = np.zeros((len(blocks), 3))
    baked = BakedClips(
        names=(*(clip.name for clip in clips), "rest"),
        matrices=np.concatenate(blocks),
        first_row=np.cumsum(counts) - counts,
        num_rows=counts,
        durations_s=durations,
        rates_hz=(counts - 1) / np.where(durations > 0, durations, 1.0),
        centres=unbounded,
        row_boxes=np.zeros((int(counts.sum()), 2, 3), np.float32),
        radii_m=unbounded[:, 0],
        shift_m=shift,
    )
    return bounds_of_rows(baked, boxes)


def bounds_of_rows(baked: BakedClips, boxes: NDArray[np.float64]) -> BakedClips:
    """The same clips with the bounds that follow from these boxes of joints, (J, 2, 3)."""
    row_boxes = pose_bounds(baked.matrices, boxes)
    low = np.minimum.reduceat(row_boxes[:, 0], baked.first_row).astype(np.float64)
    high = np.maximum.reduceat(row_boxes[:, 1], baked.first_row).astype(np.float64)
    halves = (high - low) / 2 + baked.shift_m + 1e-4
    return replace(
        baked, centres=(low + high) / 2, row_boxes=row_boxes.astype(np.float32), radii_m=np.linalg.norm(halves, axis=1)
    )


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
