"""A pose for every frame of a clip, as arrays: local rotations, forward kinematics and two-bone inverse kinematics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from demos.creature.skeleton import Floats, Joints


def turn(x: Floats | float = 0.0, y: Floats | float = 0.0, z: Floats | float = 0.0) -> Floats:
    """Rotation matrices (N, 3, 3): about x, then y, then z, in degrees."""
    ax, ay, az = np.broadcast_arrays(*(np.atleast_1d(np.radians(angle)) for angle in (x, y, z)))
    zero, one = np.zeros(len(ax)), np.ones(len(ax))

    def matrix(rows: list[list[Floats]]) -> Floats:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    cx, sx, cy, sy, cz, sz = np.cos(ax), np.sin(ax), np.cos(ay), np.sin(ay), np.cos(az), np.sin(az)
    about_x = matrix([[one, zero, zero], [zero, cx, -sx], [zero, sx, cx]])
    about_y = matrix([[cy, zero, sy], [zero, one, zero], [-sy, zero, cy]])
    about_z = matrix([[cz, -sz, zero], [sz, cz, zero], [zero, zero, one]])
    return about_z @ about_y @ about_x


def _frames(along: Floats, pole: Floats) -> Floats:
    """Orthonormal frames (N, 3, 3), columns: along a bone, towards the pole, and across."""
    first = along / np.linalg.norm(along, axis=-1, keepdims=True)
    second = pole - (pole * first).sum(axis=-1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


class Motion:
    """One clip in the making: N frames over `duration_s`, the last frame the same as the first.

    Attributes
    ----------
    phase : (N,) float64
        From 0 to 1.
    rotations : (J, N, 3, 3) float64
        Local rotations; bind pose is the identity.
    shifts : (J, N, 3) float64
        Added to the joints' rest translations, metres.
    scales : (J, N, 3) float64
    """

    def __init__(self, joints: Joints, name: str, duration_s: float, num_frames: int) -> None:
        self.joints, self.name, self.duration_s = joints, name, duration_s
        self.phase = np.linspace(0.0, 1.0, num_frames)
        count = len(joints.names)
        self.rotations = np.tile(np.eye(3), (count, num_frames, 1, 1))
        self.shifts = np.zeros((count, num_frames, 3))
        self.scales = np.ones((count, num_frames, 3))
        self._offsets = joints.offsets()

    def wave(self, amplitude: float, cycles: int = 1, lag: float = 0.0) -> Floats:
        """A sine over the clip, (N,): whole cycles, so that it loops; `lag` in cycles."""
        return amplitude * np.sin(2.0 * np.pi * (cycles * self.phase - lag))

    def rotate(self, name: str, x: Floats | float = 0.0, y: Floats | float = 0.0, z: Floats | float = 0.0) -> None:
        """Turn one joint further, degrees about the axes of its parent."""
        joint = self.joints.index(name)
        self.rotations[joint] = turn(x, y, z) @ self.rotations[joint]

    def rotate_pair(self, name: str, x: Floats | float = 0.0, y: Floats | float = 0.0, z: Floats | float = 0.0) -> None:
        """Turn a joint of the left side and, mirrored, its partner on the right."""
        self.rotate(f"{name}.L", x, y, z)
        self.rotate(f"{name}.R", x, -np.asarray(y), -np.asarray(z))

    def shift(self, name: str, x: Floats | float = 0.0, y: Floats | float = 0.0, z: Floats | float = 0.0) -> None:
        """Move one joint, metres."""
        moved = np.broadcast_arrays(self.phase, x, y, z)[1:]
        self.shifts[self.joints.index(name)] += np.stack(moved, axis=1)

    def world(self, name: str) -> tuple[Floats, Floats]:
        """Rotation (N, 3, 3) and position (N, 3) of a joint in object space."""
        joint = self.joints.index(name)
        place = self._offsets[joint] + self.shifts[joint]
        parent = int(self.joints.parents[joint])
        if parent < 0:
            return self.rotations[joint], place
        rotation, position = self.world(self.joints.names[parent])
        return rotation @ self.rotations[joint], position + np.einsum("nij,nj->ni", rotation, place)

    def reach(self, upper: str, lower: str, end: str, target: Floats, pole: Floats, end_rotation: Floats) -> None:
        """Bend two bones so that the third joint comes to a place.

        Parameters
        ----------
        upper, lower, end : str
            Joints: hip, knee and ankle, say.
        target : (N, 3) float64
            Where `end` should be, object space. Out of reach, the limb points there.
        pole : (3,) float64
            The knee bends towards it.
        end_rotation : (N, 3, 3) float64
            Rotation of `end` in object space.
        """
        a, b, c = (self.joints.index(name) for name in (upper, lower, end))
        start, knee, tip = self.joints.positions[a], self.joints.positions[b], self.joints.positions[c]
        first, second = float(np.linalg.norm(knee - start)), float(np.linalg.norm(tip - knee))
        parent_rotation, _ = self.world(self.joints.names[int(self.joints.parents[a])])
        _, origin = self.world(upper)
        line = target - origin
        distance = np.clip(np.linalg.norm(line, axis=1), abs(first - second) + 1e-3, first + second - 1e-4)
        unit = line / np.linalg.norm(line, axis=1, keepdims=True)
        along = (distance**2 + first**2 - second**2) / (2.0 * distance)
        bend = np.sqrt(np.maximum(first**2 - along**2, 0.0))
        side = _frames(unit, np.broadcast_to(pole, unit.shape))[..., 1]
        knee_at = origin + along[:, None] * unit + bend[:, None] * side
        tip_at = origin + distance[:, None] * unit
        rest_pole = _frames((tip - start)[None], np.asarray(pole)[None])[..., 1]
        upper_world = _frames(knee_at - origin, side) @ _frames((knee - start)[None], rest_pole).transpose(0, 2, 1)
        lower_world = _frames(tip_at - knee_at, side) @ _frames((tip - knee)[None], rest_pole).transpose(0, 2, 1)
        self.rotations[a] = parent_rotation.transpose(0, 2, 1) @ upper_world
        self.rotations[b] = upper_world.transpose(0, 2, 1) @ lower_world
        self.rotations[c] = lower_world.transpose(0, 2, 1) @ end_rotation


def to_quaternions(matrices: Floats) -> NDArray[np.float32]:
    """Unit quaternions (N, 4), xyzw, of rotation matrices; neighbouring frames on the same half sphere."""
    m = matrices
    # The largest of the four squared components is found first: no division by a small number.
    diagonal = np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=1)
    trace = diagonal.sum(axis=1)
    squares = np.stack([*(1.0 + 2.0 * diagonal - trace[:, None]).T, 1.0 + trace], axis=1)
    largest = squares.argmax(axis=1)
    x = np.stack([squares[:, 0], m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] - m[:, 1, 2]], axis=1)
    y = np.stack([m[:, 1, 0] + m[:, 0, 1], squares[:, 1], m[:, 2, 1] + m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0]], axis=1)
    z = np.stack([m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2], squares[:, 2], m[:, 1, 0] - m[:, 0, 1]], axis=1)
    w = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1], squares[:, 3]], axis=1)
    quaternions = np.stack([x, y, z, w])[largest, np.arange(len(m))]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions[0] *= np.where(quaternions[0, 3] < 0, -1.0, 1.0)
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(flips)[:, None]
    result: NDArray[np.float32] = quaternions.astype(np.float32)
    return result
