"""The dragon's clips: idle (breathing, looking about), walk (four planted feet) and greet (sits up and waves).

Every clip loops. Legs are placed by inverse kinematics, so that feet that stand stay where they stand.
"""

from __future__ import annotations

import numpy as np

from demos.creature.motion import Motion, turn
from demos.creature.skeleton import Floats, Joints

_STRIDE_M = 0.155  # ground a foot covers while it stands
_DUTY = 0.66  # share of the cycle that a foot stands
_LIFT_M = 0.055
# A walk in lateral sequence: left hind, left fore, right hind, right fore, a quarter apart.
_FOOTFALLS = {"foot.L": 0.0, "hand.L": 0.27, "foot.R": 0.5, "hand.R": 0.77}
_LIMBS = {
    "foot": ("thigh", "shin", np.array([0.25, 0.3, 1.0])),
    "hand": ("upper_arm", "forearm", np.array([0.35, 0.0, -1.0])),
}
_TAIL = tuple(f"tail_{k}" for k in range(1, 6))


def _smooth(t: Floats) -> Floats:
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


def _pulse(motion: Motion, start: float, rise: float, fall: float, end: float) -> Floats:
    """0 before `start`, 1 between `rise` and `fall`, 0 after `end`, smooth, in phase."""
    p = motion.phase
    return _smooth((p - start) / (rise - start)) * (1.0 - _smooth((p - fall) / (end - fall)))


def _plant(motion: Motion, end: str, shift: Floats, pitch: Floats) -> None:
    """Put a foot or hand at its rest place plus a shift (N, 3), with the toes turned down by `pitch` degrees."""
    kind, _, side = end.partition(".")
    upper, lower, pole = _LIMBS[kind]
    sign = 1.0 if side == "L" else -1.0
    rest = motion.joints.positions[motion.joints.index(end)]
    motion.reach(
        f"{upper}.{side}", f"{lower}.{side}", end, rest + shift, pole * np.array([sign, 1.0, 1.0]), turn(pitch)
    )


def _plant_all(motion: Motion, kinds: tuple[str, ...] = ("foot", "hand")) -> None:
    still = np.zeros((len(motion.phase), 3))
    for kind in kinds:
        for side in "LR":
            _plant(motion, f"{kind}.{side}", still, np.zeros(len(motion.phase)))


def _idle(joints: Joints) -> Motion:
    motion = Motion(joints, "idle", 4.8, 73)
    breath = motion.wave(1.0, 2)
    belly = joints.index("belly")
    motion.scales[belly] = 1.0 + np.outer(0.5 + 0.5 * breath, [0.055, 0.05, 0.025])
    motion.shift("hips", x=motion.wave(0.006), y=-0.004 + 0.003 * breath)
    motion.rotate("hips", z=motion.wave(0.8))
    motion.rotate("spine", x=-0.5 * breath)
    motion.rotate("chest", x=-0.8 * breath, y=motion.wave(1.5, 1, 0.1))
    look = motion.wave(9.0, 1, 0.05) + motion.wave(3.0, 2, 0.3)
    motion.rotate("neck", x=1.0 * breath, y=0.5 * look)
    motion.rotate("head", x=motion.wave(2.5, 2, 0.2), y=0.7 * look, z=motion.wave(5.0, 1, 0.3))
    motion.rotate("jaw", x=1.0 + 1.0 * breath)
    for k, name in enumerate(_TAIL):
        motion.rotate(name, x=motion.wave(2.0, 1, 0.2 + 0.1 * k), y=motion.wave(6.0 + 1.8 * k, 1, 0.09 * k))
    flick = 18.0 * _pulse(motion, 0.30, 0.33, 0.34, 0.40) - 10.0 * _pulse(motion, 0.36, 0.39, 0.40, 0.48)
    motion.rotate_pair("ear", z=motion.wave(3.0, 1, 0.1))
    motion.rotate("ear.L", y=flick)
    motion.rotate("ear_tip.L", y=0.7 * flick)
    motion.rotate("ear.R", y=-8.0 * _pulse(motion, 0.72, 0.76, 0.78, 0.84))
    motion.rotate_pair("wing", z=4.0 * breath, x=-1.0 * breath)
    motion.rotate_pair("wing_tip", z=motion.wave(4.0, 2, 0.12))
    _plant_all(motion)
    return motion


def _walk(joints: Joints) -> Motion:
    motion = Motion(joints, "walk", 1.1, 34)
    motion.shift("hips", x=motion.wave(0.010, 1, 0.1), y=-0.022 + motion.wave(0.006, 2, 0.05))
    motion.rotate("hips", x=motion.wave(1.2, 2, 0.3), y=motion.wave(5.0, 1, -0.15), z=motion.wave(3.0, 1, 0.1))
    motion.rotate("spine", y=motion.wave(-4.0, 1, -0.12), z=motion.wave(-1.5, 1, 0.1))
    motion.rotate("chest", x=motion.wave(1.0, 2, 0.1), y=motion.wave(-5.0, 1, -0.08), z=motion.wave(-3.0, 1, 0.35))
    motion.rotate("neck", x=motion.wave(2.0, 2, 0.2), y=motion.wave(2.5, 1, -0.1))
    motion.rotate("head", x=motion.wave(-3.0, 2, 0.28), y=motion.wave(2.0, 1, -0.1), z=motion.wave(2.5, 1, 0.2))
    motion.rotate("jaw", x=2.0 + motion.wave(1.5, 2, 0.3))
    for k, name in enumerate(_TAIL):
        motion.rotate(name, x=motion.wave(2.0, 2, 0.12 * k), y=motion.wave(7.0 + 1.5 * k, 1, 0.35 + 0.12 * k))
    motion.rotate_pair("ear", x=motion.wave(4.0, 2, 0.35), z=-6.0 + motion.wave(5.0, 2, 0.4))
    motion.rotate_pair("ear_tip", z=motion.wave(7.0, 2, 0.5))
    motion.rotate_pair("wing", z=motion.wave(5.0, 2, 0.3))
    motion.rotate_pair("wing_tip", z=motion.wave(5.0, 2, 0.42))
    for end, start in _FOOTFALLS.items():
        _plant(motion, end, *_step_path((motion.phase - start) % 1.0, hand=end.startswith("hand")))
    return motion


def _step_path(phase: Floats, hand: bool) -> tuple[Floats, Floats]:
    """A foot's way (N, 3) and pitch (N,): level with the ground's speed while it stands, then an arc forwards."""
    swing = np.clip((phase - _DUTY) / (1.0 - _DUTY), 0.0, 1.0)
    # A cubic from the back of the stride to its front that leaves and lands with the ground's speed.
    speed = -_STRIDE_M * (1.0 - _DUTY) / _DUTY
    t, t2, t3 = swing, swing**2, swing**3
    hermite = 0.5 * _STRIDE_M * (-(2 * t3 - 3 * t2 + 1) + (3 * t2 - 2 * t3)) + speed * (2 * t3 - 3 * t2 + t)
    stance = 0.5 * _STRIDE_M - _STRIDE_M * np.minimum(phase / _DUTY, 1.0)
    forwards = np.where(phase < _DUTY, stance, hermite)
    height = _LIFT_M * np.sin(np.pi * swing) ** 2 * (1.0 if hand else 0.85)
    pitch = np.where(phase < _DUTY, 0.0, (42.0 if hand else 30.0) * np.sin(np.pi * swing) ** 2 * (1.0 - 1.1 * swing))
    zero = np.zeros(len(phase))
    return np.stack([zero, height, forwards], axis=1), pitch


def _greet(joints: Joints) -> Motion:
    motion = Motion(joints, "greet", 3.4, 86)
    crouch = _pulse(motion, 0.0, 0.09, 0.10, 0.20) + 0.6 * _pulse(motion, 0.80, 0.90, 0.91, 1.0)
    up = _pulse(motion, 0.09, 0.27, 0.74, 0.92)
    hold = _pulse(motion, 0.20, 0.32, 0.68, 0.82)
    wave = np.sin(2.0 * np.pi * 5.0 * (motion.phase - 0.26)) * hold
    bob = np.sin(2.0 * np.pi * 4.0 * (motion.phase - 0.2)) * hold
    motion.shift("hips", y=-0.025 * crouch + 0.006 * bob, z=-0.02 * crouch - 0.03 * up)
    motion.rotate("hips", x=5.0 * crouch - 40.0 * up + 1.5 * bob, z=2.0 * wave)
    motion.rotate("spine", x=2.0 * crouch - 8.0 * up)
    motion.rotate("chest", x=4.0 * crouch - 6.0 * up, z=-4.0 * hold)
    motion.rotate("neck", x=-6.0 * crouch + 21.0 * up)
    motion.rotate("head", x=-10.0 * crouch + 24.0 * up - 4.0 * bob, y=10.0 * hold, z=10.0 * hold + 3.0 * wave)
    motion.rotate("jaw", x=16.0 * hold + 3.0 * bob)
    motion.rotate("tail_1", x=24.0 * up)
    motion.rotate("tail_2", x=16.0 * up)
    motion.rotate("tail_3", x=4.0 * up)
    wag = np.sin(2.0 * np.pi * 3.0 * motion.phase) * (0.25 + 0.75 * hold)
    for k, name in enumerate(_TAIL[1:]):
        motion.rotate(name, y=wag * (5.0 + 4.0 * k))
    motion.rotate_pair("ear", z=14.0 * hold - 12.0 * crouch + 3.0 * bob, y=-12.0 * hold)
    motion.rotate_pair("ear_tip", z=8.0 * hold - 8.0 * crouch + 5.0 * bob)
    motion.rotate_pair("wing", z=26.0 * hold + 18.0 * bob - 6.0 * crouch, y=-10.0 * hold)
    motion.rotate_pair("wing_tip", z=8.0 * hold + 14.0 * np.sin(2 * np.pi * 4.0 * (motion.phase - 0.23)) * hold)
    _plant_all(motion, ("foot",))
    lift = _pulse(motion, 0.04, 0.24, 0.76, 0.965)  # hands leave before the chest does and come back after it
    _raise_hand(motion, "L", np.array([0.325, 0.585, 0.16]), lift, wave)
    _raise_hand(motion, "R", np.array([-0.150, 0.43, 0.20]), lift, 0.3 * bob)
    return motion


def _raise_hand(motion: Motion, side: str, raised: Floats, up: Floats, wave: Floats) -> None:
    """Hand from the ground to a raised place, waving from side to side."""
    sign = 1.0 if side == "L" else -1.0
    hand = f"hand.{side}"
    rest = motion.joints.positions[motion.joints.index(hand)]
    lifted = raised + np.outer(wave, [0.035, 0.0, 0.0])
    place = rest + up[:, None] * (lifted - rest)
    tilt = turn(x=-65.0 * up, z=-12.0 * sign * up - 16.0 * wave) if side == "L" else turn(x=25.0 * up)
    motion.reach(f"upper_arm.{side}", f"forearm.{side}", hand, place, np.array([sign * 0.6, -0.5, -1.0]), tilt)


def build_clips(joints: Joints) -> tuple[Motion, ...]:
    """The three looping clips."""
    return _idle(joints), _walk(joints), _greet(joints)
