"""The pace of walks that are known: a walker whose standing foot is nailed to the ground, rolling from heel to toe."""

from __future__ import annotations

import numpy as np
import pytest
from builders_animation import random_skeleton

from demos.gait import Skin, pace
from runtime.animation.clip import Clip, Track
from runtime.animation.skeleton import Skeleton

HEIGHT_M = 1.8
HEEL_M, TOE_M, ANKLE_M = -0.07, 0.18, 0.09  # along the foot from below the ankle; the ankle above the sole


def walker(pace_m_s: float, period_s: float, stance: float, turn: float = 0.0) -> tuple[Skeleton, Clip, Skin]:
    """Hips and two feet. A foot stands for a part of the period: rolls over its heel, lies flat, rolls over its toe.

    It is nailed down in the world, so relative to the hips its point of rest goes back at the pace exactly.
    """
    skeleton = random_skeleton(5, 0)
    feet = skeleton.joint_nodes[1:]
    skeleton.parents[:] = [-1, 0, 0, 0, 0]
    skeleton.rotation[:], skeleton.scale[:], skeleton.translation[:] = [0, 0, 0, 1], 1, 0
    skeleton.inverse_bind[:] = np.eye(4)
    skeleton.__dict__.pop("levels", None)
    times = np.linspace(0.0, period_s, 241)
    tracks = []
    for number, node in enumerate(feet):
        part = (times / period_s + 0.5 * number) % 1.0
        stands = part < stance
        gone = np.where(stands, part, 0.0) * period_s * pace_m_s  # way of the body since the foot was set down
        pitch = np.interp(part / stance, [0.0, 0.25, 0.6, 1.0], [-0.45, 0.0, 0.0, 0.7])  # toes up, flat, heel up
        pivot = np.where(pitch < 0, HEEL_M, np.where(pitch > 0, TOE_M, 0.0))
        # The ankle turns around the pivot, which stays where it was set down.
        above, along = ANKLE_M, -pivot
        forward = pivot + along * np.cos(pitch) + above * np.sin(pitch) - gone
        height = -along * np.sin(pitch) + above * np.cos(pitch)
        swing = np.clip((part - stance) / (1.0 - stance), 0.0, 1.0)
        first, last = 0.0, -stance * period_s * pace_m_s
        smooth = swing * swing * (3 - 2 * swing)
        forward = np.where(stands, forward, last + (first - last) * smooth)
        height = np.where(stands, height, ANKLE_M + 0.12 + 0.15 * np.sin(np.pi * swing))
        pitch = np.where(stands, pitch, 0.7 + (-0.45 - 0.7) * swing)
        places = np.stack([np.full_like(times, 0.1 - 0.2 * number), height, forward], axis=1)
        turns = np.stack([np.sin(pitch / 2), 0 * pitch, 0 * pitch, np.cos(pitch / 2)], axis=1)
        tracks += [
            Track(int(node), "translation", "LINEAR", times, places),
            Track(int(node), "rotation", "LINEAR", times, turns),
        ]
    sole = np.array([[x, -ANKLE_M, z] for x in (-0.04, 0.04) for z in np.linspace(HEEL_M, TOE_M, 6)])
    instep = sole * [0.8, 0.0, 0.6]
    points = np.concatenate([sole, instep, sole, instep])
    joints = np.repeat([1, 2], 2 * len(sole))[:, None]
    return skeleton, Clip("walk", period_s, tuple(tracks)), Skin(points, joints, np.ones((len(points), 1)))


@pytest.mark.parametrize("pace_m_s", [0.4, 1.4, -1.1, 3.0])
@pytest.mark.parametrize("stance", [0.35, 0.6, 0.72])
def test_a_nailed_foot_tells_its_pace(pace_m_s: float, stance: float) -> None:
    """A limp, a stroll, a run with time in the air (stance 0.35), backwards: within 3 per cent."""
    period = 0.7 / abs(pace_m_s) + 0.4
    skeleton, clip, skin = walker(pace_m_s, period, stance)
    assert pace(skeleton, clip, HEIGHT_M, skin) == pytest.approx(pace_m_s, rel=0.03)


def test_the_builder_nails_the_foot_down() -> None:
    """While the foot is flat its sole goes back at the pace, to rounding; while it rolls its pivot does."""
    from demos.gait import _places

    skeleton, clip, skin = walker(1.4, 1.0, 0.6)
    times = np.linspace(0.01, 0.59, 40)
    places = _places(skeleton, clip, times, skin)[:, : len(skin.positions) // 2]
    np.testing.assert_allclose(places[:, :, 1].min(axis=1), 0.0, atol=2e-4)
    lowest = places[:, :, 1].argmin(axis=1)
    world = places[np.arange(40), lowest, 2] + 1.4 * times
    points = {round(float(skin.positions[i, 2]), 6) for i in lowest}
    assert {HEEL_M, TOE_M} <= points
    np.testing.assert_allclose(world, skin.positions[lowest, 2], atol=2e-3)


def test_who_stands_goes_nowhere() -> None:
    skeleton, clip, skin = walker(1.4, 1.0, 0.6)
    still = Clip("idle", 1.0, ())
    assert pace(skeleton, still, HEIGHT_M, skin) == 0.0 and pace(skeleton, still, HEIGHT_M) == 0.0
    assert pace(skeleton, Clip("pose", 0.0, clip.tracks), HEIGHT_M, skin) == 0.0
    hop = Track(int(skeleton.joint_nodes[0]), "translation", "LINEAR", np.array([0, 0.5, 1]), np.eye(3))
    waves = Clip("wave", 1.0, (hop,))  # hips sway while both feet stand
    assert abs(pace(skeleton, waves, HEIGHT_M, skin)) < 1e-9
