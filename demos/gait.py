"""How fast a clip walks: the pace at which the feet that stand do not slide.

Whatever is lowest touches the ground, if it comes near it at all: a heel, a sole, a toe. What touches the ground goes
back at the body's pace while it stands, and at any speed while it is set down or lifted. So the pace is not a mean or
a median of these speeds but the one around which most of the time gathers (their mode, found by mean shift).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.animation.clip import Clip
from runtime.animation.pose import global_transforms, sample, skinning_rows
from runtime.animation.skeleton import Skeleton
from runtime.crowd.lod_buffers import expand_levels
from runtime.gpu.model import Model

Floats = NDArray[np.floating[Any]]

NUM_MOMENTS = 121
SWING_REL = 0.1  # a body none of whose lowest points moves by this part of its height goes nowhere
TOUCH_REL = 0.01  # points within this part of the height from the lowest touch the ground with it
GROUND_REL = 0.05  # lowest points so far above the ground count e times less: nobody stands in the air
SPREAD = 0.3  # speeds that belong together, of the typical one
MOST_VERTICES = 4000


@dataclass(frozen=True)
class Skin:
    """Points of a body and the joints that carry them.

    Attributes
    ----------
    positions : (V, 3) float, at rest, metres
    joints : (V, K) int
    weights : (V, K) float
    """

    positions: Floats
    joints: NDArray[np.integer[Any]]
    weights: Floats


def model_skin(ctx: moderngl.Context, model: Model) -> Skin:
    """The vertices of the finest level of a model that is not larger than needed."""
    levels = expand_levels(ctx, model)
    return Skin(*next((level for level in levels if len(level[0]) <= MOST_VERTICES), levels[-1]))


def _places(skeleton: Skeleton, clip: Clip, times: Floats, skin: Skin | None) -> Floats:
    """Where the points of a body are at some moments, (A, V, 3): of its skin, or of its joints."""
    pose = sample(clip, skeleton, times)
    if skin is None:
        places: Floats = global_transforms(skeleton, pose)[:, np.unique(skeleton.joint_nodes)][:, :, :3, 3]
        return places
    rows = np.asarray(skinning_rows(skeleton, pose), dtype=np.float64)
    points = np.concatenate([skin.positions, np.ones((len(skin.positions), 1))], axis=1)
    return np.stack([np.einsum("vk,vkij,vj->vi", skin.weights, row[skin.joints], points) for row in rows])


def _mode(values: Floats, weights: Floats, spread: float) -> float:
    """Where weighted values lie densest: the peak of their sum of bells, climbed by mean shift."""

    def bells(at: Any) -> Floats:
        found: Floats = weights * np.exp(-0.5 * ((at - values) / spread) ** 2)
        return found

    candidates = np.linspace(values.min(), values.max(), 200)
    peak = candidates[int(np.argmax([bells(at).sum() for at in candidates]))]
    for _ in range(30):
        near = bells(peak)
        peak = (near * values).sum() / near.sum()
    return float(peak)


def pace(skeleton: Skeleton, clip: Clip, height_m: float, skin: Skin | None = None) -> float:
    """Metres a second along +Z that a body must move for its standing foot to stay where it is.

    Parameters
    ----------
    skeleton : Skeleton
    clip : Clip
    height_m : float
        Of the body.
    skin : Skin, optional
        What touches the ground. The joints do without, which lie above it: they roll with a foot that stands.
    """
    if clip.duration_s <= 0:
        return 0.0
    times = np.linspace(0.0, clip.duration_s, NUM_MOMENTS)
    places = _places(skeleton, clip, times, skin)
    swings = np.ptp(places[:, :, [0, 2]], axis=0).max(axis=1) > SWING_REL * height_m
    if skin is None:
        places = places[:, swings]
    if not swings.any():
        return 0.0
    heights = (places[1:, :, 1] + places[:-1, :, 1]) / 2
    lowest = heights.min(axis=1, keepdims=True)
    touching = heights <= lowest + TOUCH_REL * height_m
    on_ground = np.exp(-(((lowest - lowest.min()) / (GROUND_REL * height_m)) ** 2))
    weights = (on_ground * touching / touching.sum(axis=1, keepdims=True))[touching]
    speeds = (np.diff(places[:, :, 2], axis=0) / np.diff(times)[:, None])[touching]
    order = np.argsort(np.abs(speeds))
    middle = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
    typical = float(np.abs(speeds[order[min(int(middle), len(order) - 1)]]))
    if typical <= 1e-6 * height_m:
        return 0.0
    return -_mode(speeds, weights, SPREAD * typical)
