"""Root motion: the way a clip carries its root over the ground, taken out of the pose and given to the actor.

Only the horizontal part of the translation is taken (glTF: +Y is up); bobbing up and down stays in the pose. The root
is the topmost node that a clip translates. Letters in shapes: A actors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.clip import Clip
from runtime.keys import evaluate
from runtime.pose import Pose, global_transforms, rest_pose, wrap_times
from runtime.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]

_HORIZONTAL = np.diag([1.0, 0.0, 1.0])


class RootMotion:
    """Root motion of a skeleton's clips."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        self._global = global_transforms(skeleton, rest_pose(skeleton))[0]
        self._root_clips: dict[int, tuple[Clip, Clip]] = {}

    def root(self, clip: Clip) -> int | None:
        """The topmost node that a clip translates; None where it translates none."""
        moved = [track.node for track in clip.tracks if track.path == "translation" and len(track.times) > 1]
        return min(moved, default=None)

    def _root_clip(self, clip: Clip) -> Clip:
        """The clip with its root's translation alone, kept for the next time."""
        known = self._root_clips.get(id(clip))
        if known is None:
            root = self.root(clip)
            tracks = tuple(track for track in clip.tracks if track.node == root and track.path == "translation")
            # The clip itself is kept too, so that its id stays its own.
            known = self._root_clips[id(clip)] = clip, Clip(clip.name, clip.duration_s, tracks)
        return known[1]

    def _positions(self, clip: Clip, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Translation of the root inside its parent at times within the clip, (A, 3); zeros where it never moves."""
        found = evaluate(self._root_clip(clip).keys, times_s, np.dtype(np.float64))
        if not found:
            return np.zeros((len(times_s), 3))
        return np.asarray(found[0][1][:, 0].T, dtype=np.float64)

    def _above(self, root: int) -> NDArray[np.float64]:
        """Linear part of what lies above the root, at rest, (3, 3)."""
        parent = int(self._skeleton.parents[root])
        matrix = self._skeleton.root_transform if parent < 0 else self._global[parent]
        return np.asarray(matrix[:3, :3], dtype=np.float64)

    def displacement(
        self,
        clip: Clip,
        before_s: NDArray[np.float64],
        after_s: NDArray[np.float64],
        loops: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Way of the root over the ground between two times, whole rounds included.

        Parameters
        ----------
        clip : Clip
        before_s, after_s : (A,) float64, seconds, not yet wrapped
        loops : (A,) bool

        Returns
        -------
        (A, 3) float64, metres, object space
        """
        root = self.root(clip)
        if root is None or clip.duration_s <= 0:
            return np.zeros((len(before_s), 3))
        way = self._positions(clip, wrap_times(after_s, clip.duration_s, loops)) - self._positions(
            clip, wrap_times(before_s, clip.duration_s, loops)
        )
        rounds = np.floor(after_s / clip.duration_s) - np.floor(before_s / clip.duration_s)
        ends = self._positions(clip, np.array([0.0, clip.duration_s]))
        way += np.where(loops, rounds, 0.0)[:, None] * (ends[1] - ends[0])
        return way @ (_HORIZONTAL @ self._above(root)).T

    def hold(self, clip: Clip, pose: Pose, actors: NDArray[np.bool_]) -> None:
        """Take the horizontal way since the clip's start out of a sampled pose, in place, for some of its actors."""
        root = self.root(clip)
        if root is None:
            return
        above = self._above(root)
        start = self._positions(clip, np.zeros(1))
        way = pose.translation[actors, root] - start
        horizontal = np.linalg.inv(above) @ _HORIZONTAL @ above
        pose.translation[actors, root] -= (way @ horizontal.T).astype(pose.dtype)
