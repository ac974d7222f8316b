"""Root motion: the way a clip carries its root over the ground, taken out of the pose and given to the actor.

What is taken is a motion of the ground plane (glTF: +Y is up): a way along x and z and, where asked for, a turn about
+Y. Bobbing up and down and leaning stay in the pose. The root is the topmost node that a clip moves, or, where it moves
none, the topmost that it turns.

A motion is three numbers (x, z, turn): turn about the vertical through the origin, then move. At the time t of a clip
M(t) is the motion that has carried the root from where it was at the clip's start; whole rounds add M(duration) each.
From one time to another an actor goes M(before)⁻¹ M(after), and M(t)⁻¹ is what the pose loses.
Letters in shapes: A actors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.animation.clip import Clip
from runtime.animation.keyframes import evaluate
from runtime.animation.pose import Pose, global_transforms, rest_pose, wrap_times
from runtime.animation.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]
Doubles = NDArray[np.float64]

# A track that changes by less than this (metres, or parts of a unit quaternion) is a constant written out.
_STILL = 1e-6


def _rotated(way: Doubles, turn: Doubles) -> Doubles:
    """Ways (A, 2) along x and z, turned about +Y by (A,) radians."""
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.stack([cosine * way[:, 0] + sine * way[:, 1], cosine * way[:, 1] - sine * way[:, 0]], axis=1)


def compose(first: Doubles, second: Doubles) -> Doubles:
    """Motions (A, 3) one after the other, the second in the frame that the first has carried along."""
    way = first[:, :2] + _rotated(second[:, :2], first[:, 2])
    return np.concatenate([way, first[:, 2:] + second[:, 2:]], axis=1)


def inverse(motion: Doubles) -> Doubles:
    """The motions (A, 3) that undo these."""
    return np.concatenate([-_rotated(motion[:, :2], -motion[:, 2]), -motion[:, 2:]], axis=1)


def repeated(motion: Doubles, times: Doubles) -> Doubles:
    """Motions (A, 3) done (A,) times over; whole numbers, negative ones undo."""
    turn = motion[:, 2]
    half = turn / 2
    # The sum of a way turned 0, 1 … n - 1 times: a chord of a circle, or n ways where nothing turns.
    bent = np.abs(np.sin(half)) > 1e-12
    factor = np.where(bent, np.sin(times * half) / np.where(bent, np.sin(half), 1.0), times)
    way = _rotated(motion[:, :2], (times - 1) * half) * factor[:, None]
    return np.concatenate([way, (turn * times)[:, None]], axis=1)


def motion_matrix(motion: Doubles) -> Doubles:
    """A motion (3,) as a matrix, (4, 4)."""
    x, z, turn = motion
    matrix = np.eye(4)
    matrix[0, 0] = matrix[2, 2] = np.cos(turn)
    matrix[0, 2], matrix[2, 0] = np.sin(turn), -np.sin(turn)
    matrix[0, 3], matrix[2, 3] = x, z
    return matrix


class _Root:
    """The root of one clip: its own tracks, and the frame above it.

    Parameters
    ----------
    skeleton : Skeleton
    clip : Clip
        Kept, so that its id stays its own.
    node : int
    above : (4, 4) float64
        Object-space matrix of the node's parent at rest.
    """

    def __init__(self, skeleton: Skeleton, clip: Clip, node: int, above: Doubles) -> None:
        self.clip, self.node = clip, node
        tracks = tuple(one for one in clip.tracks if one.node == node and one.path in ("translation", "rotation"))
        self._own = Clip(clip.name, clip.duration_s, tracks)
        self._rest = skeleton.translation[node], skeleton.rotation[node]
        self.above = above
        linear = above[:3, :3]
        size = np.cbrt(abs(np.linalg.det(linear)))
        gram = linear @ linear.T
        # A turn stays a turn below a frame that stretches all directions alike.
        self.turns = bool(size > 0 and np.abs(gram - size**2 * np.eye(3)).max() < 1e-4 * size**2)
        axis = np.linalg.det(linear) * np.linalg.solve(linear, [0.0, 1.0, 0.0]) if self.turns else np.zeros(3)
        self.axis = axis / max(float(np.linalg.norm(axis)), 1e-30)
        self.start_translation, self.start_rotation = (part[0] for part in self.local(np.zeros(1)))

    def local(self, times_s: Doubles) -> tuple[Doubles, Doubles]:
        """Translation (A, 3) and rotation (A, 4) of the root in its parent at times within the clip."""
        values = {name: np.tile(rest, (len(times_s), 1)) for name, rest in zip(("translation", "rotation"), self._rest)}
        for bank, found in evaluate(self._own.keys, times_s, np.dtype(np.float64)):
            values[bank.path] = np.asarray(found[:, 0].T, dtype=np.float64)
        return values["translation"], values["rotation"]

    def turn(self, rotation: Floats) -> Doubles:
        """How far rotations (A, 4) are turned about +Y from the clip's start: the twist of what lies between."""
        x, y, z, w = self.start_rotation * [-1, -1, -1, 1]
        ax, ay, az, aw = np.asarray(rotation, dtype=np.float64).T
        between = np.stack([aw * x + ax * w + ay * z - az * y, aw * y - ax * z + ay * w + az * x,
                            aw * z + ax * y - ay * x + az * w], axis=1)  # fmt: skip
        twist = 2.0 * np.arctan2(between @ self.axis, aw * w - ax * x - ay * y - az * z)
        return np.asarray(np.remainder(twist + np.pi, 2.0 * np.pi) - np.pi)

    def ground(self, translation: Floats) -> Doubles:
        """Where translations (A, 3) put the root on the ground, object space, (A, 2): x and z."""
        return np.asarray(translation @ self.above[[0, 2], :3].T + self.above[[0, 2], 3], dtype=np.float64)

    def motion(self, times_s: Doubles, turns: NDArray[np.bool_]) -> Doubles:
        """M at times within the clip, (A, 3); without the turn where `turns` (A,) is False."""
        translation, rotation = self.local(times_s)
        turn = np.where(turns & self.turns, self.turn(rotation), 0.0)
        start = np.tile(self.ground(self.start_translation[None]), (len(times_s), 1))
        return np.concatenate([self.ground(translation) - _rotated(start, turn), turn[:, None]], axis=1)


class RootMotion:
    """Root motion of a skeleton's clips."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        self._global = global_transforms(skeleton, rest_pose(skeleton))[0]
        self._roots: dict[int, tuple[Clip, _Root | None]] = {}

    def root(self, clip: Clip) -> int | None:
        """The topmost node that a clip moves, or else turns; None where it does neither."""
        found = self._root(clip)
        return None if found is None else found.node

    def _root(self, clip: Clip) -> _Root | None:
        """The root of a clip, kept for the next time."""
        if id(clip) not in self._roots:
            changing = [track for track in clip.tracks if float(np.ptp(track.values, axis=0).max()) > _STILL]
            moved = [track.node for track in changing if track.path == "translation"]
            turned = [track.node for track in changing if track.path == "rotation"]
            node = min(moved or turned, default=None)
            root = None if node is None else _Root(self._skeleton, clip, node, self._above(node))
            self._roots[id(clip)] = clip, root
        return self._roots[id(clip)][1]

    def _above(self, node: int) -> Doubles:
        """What lies above a node, at rest, (4, 4)."""
        parent = int(self._skeleton.parents[node])
        matrix = self._skeleton.root_transform if parent < 0 else self._global[parent]
        return np.asarray(matrix, dtype=np.float64)

    def step(
        self, clip: Clip, before_s: Doubles, after_s: Doubles, loops: NDArray[np.bool_], turns: NDArray[np.bool_]
    ) -> Doubles:
        """How the root moves over the ground between two times, whole rounds included.

        Parameters
        ----------
        clip : Clip
        before_s, after_s : (A,) float64, seconds, not yet wrapped
        loops : (A,) bool
        turns : (A,) bool
            Whether turning counts.

        Returns
        -------
        (A, 3) float64: x, z, metres, and turn, radians, in the frame that the actor has before
        """
        root = self._root(clip)
        if root is None or clip.duration_s <= 0:
            return np.zeros((len(before_s), 3))
        rounds = np.floor(after_s / clip.duration_s) - np.floor(before_s / clip.duration_s)
        a_round = root.motion(np.full(len(turns), clip.duration_s), turns)
        before, after = (root.motion(wrap_times(times, clip.duration_s, loops), turns) for times in (before_s, after_s))
        between = repeated(a_round, np.where(loops, rounds, 0.0))
        step = compose(inverse(before), compose(between, after))
        step[:, 2] = np.remainder(step[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        return step

    def hold(self, clip: Clip, pose: Pose, actors: NDArray[np.bool_], turns: NDArray[np.bool_]) -> None:
        """Take the motion since the clip's start out of a sampled pose, in place.

        Parameters
        ----------
        clip : Clip
        pose : Pose of A actors
        actors, turns : (A,) bool
            Whose way is taken out, and whose turn as well.
        """
        root = self._root(clip)
        if root is None:
            return
        linear = root.above[:3, :3]
        way = pose.translation[actors, root.node] - root.start_translation
        horizontal = np.linalg.solve(linear, np.diag([1.0, 0.0, 1.0]) @ linear)
        pose.translation[actors, root.node] -= (way @ horizontal.T).astype(pose.dtype)
        turned = actors & turns
        if root.turns and turned.any():
            rotation = pose.rotation[turned, root.node].astype(np.float64)
            half = -root.turn(rotation) / 2
            x, y, z = (np.sin(half)[:, None] * root.axis).T
            w = np.cos(half)
            bx, by, bz, bw = rotation.T
            back = (w * bx + x * bw + y * bz - z * by, w * by - x * bz + y * bw + z * bx,
                    w * bz + x * by - y * bx + z * bw, w * bw - x * bx - y * by - z * bz)  # fmt: skip
            pose.rotation[turned, root.node] = np.stack(back, axis=1).astype(pose.dtype)
