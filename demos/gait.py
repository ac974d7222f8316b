"""How fast a clip walks: the pace at which the feet that stand do not slide."""

from __future__ import annotations

import numpy as np

from runtime.clip import Clip
from runtime.pose import global_transforms, sample
from runtime.skeleton import Skeleton

NUM_MOMENTS = 121
SWING_REL = 0.1  # a joint that moves less than this part of the body's height is no foot


def pace(skeleton: Skeleton, clip: Clip, height_m: float) -> float:
    """Metres a second along +Z that a body must move for its standing foot to stay where it is.

    The lowest of the joints that swing is taken to stand; the median of its speed is what the body must undo.

    Parameters
    ----------
    skeleton : Skeleton
    clip : Clip
    height_m : float
        Of the body.
    """
    times = np.linspace(0.0, clip.duration_s, NUM_MOMENTS)
    if clip.duration_s <= 0:
        return 0.0
    joints = np.unique(skeleton.joint_nodes)
    places = global_transforms(skeleton, sample(clip, skeleton, times))[:, joints][:, :, :3, 3]
    swings = np.ptp(places[:, :, [0, 2]], axis=0).max(axis=1) > SWING_REL * height_m
    if not swings.any():
        return 0.0
    places = places[:, swings]
    step = np.arange(NUM_MOMENTS - 1)
    lowest = places[:-1, :, 1].argmin(axis=1)
    speeds = (places[step + 1, lowest, 2] - places[step, lowest, 2]) / np.diff(times)
    return -float(np.median(speeds))
