"""Where the actors of a crowd stand and what they play, in arrays; who is seen, at which level, in which pose.

Everything here is plain NumPy over all actors at once: a frame of 10,000 costs about a millisecond. Nothing depends
on the number of joints. Letters in shapes: A actors, S seen actors, L levels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.bounds import JointBoxes
from runtime.crowd.animation_texture import BakedClips
from runtime.gpu.vertex_layout import CROWD_INSTANCE
from runtime.scene.camera import CameraMatrices
from runtime.scene.lod_selection import carry_boxes, carry_parts, choose_levels, largest_stretch, measure
from runtime.validation import describe
from runtime.validation import numbers as finite

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Selection:
    """Instance records of one picture, sorted by level.

    Attributes
    ----------
    records : (S,) CROWD_INSTANCE
    first : (L,) int64
        First record of each level; mirrored actors of a level come last.
    counts, mirrored : (L,) int64
        Actors of each level that are not and that are mirrored.
    """

    records: NDArray[Any]
    first: NDArray[np.int64]
    counts: NDArray[np.int64]
    mirrored: NDArray[np.int64]


class CrowdState:
    """State of A actors.

    Parameters
    ----------
    baked : BakedClips
    joint_boxes : JointBoxes
    count : int
    """

    def __init__(self, baked: BakedClips, joint_boxes: JointBoxes, count: int) -> None:
        self.baked, self.joint_boxes = baked, joint_boxes
        self.count = count
        self.clock_s = 0.0
        self.clips = np.full(count, len(baked.names) - 1, dtype=np.int64)
        self.phases_s = np.zeros(count)
        self.speeds = np.ones(count)
        self.loops = np.ones(count, dtype=bool)
        self.tints = np.full((count, 4), 255, dtype=np.uint8)
        self.visible = np.ones(count, dtype=bool)
        self._row_boxes = np.ascontiguousarray(baked.row_boxes.reshape(-1, 6).T)
        self._rows = np.zeros((count, 12), dtype=np.float32)
        self._rows[:, [0, 5, 10]] = 1
        self._positions = np.zeros((count, 3))
        self._stretches = np.ones(count, dtype=np.float32)
        self._mirrored = np.zeros(count, dtype=bool)
        self._centres = np.zeros((count, 3))
        self._radii = np.zeros(count, dtype=np.float32)
        self._levels = np.full(count, -1, dtype=np.int8)
        self.place_spheres(slice(None))

    def set_bounds(self, baked: BakedClips, joint_boxes: JointBoxes) -> None:
        """Take other bounds of the same clips."""
        self.baked, self.joint_boxes = baked, joint_boxes
        self._row_boxes = np.ascontiguousarray(baked.row_boxes.reshape(-1, 6).T)
        self.place_spheres(slice(None))

    def index(self, which: Any) -> NDArray[np.int64]:
        """Numbers of the actors that a caller means: None for all, a slice, a mask or numbers."""
        if which is None:
            return np.arange(self.count)
        if isinstance(which, slice):
            return np.arange(self.count)[which]
        numbers = np.atleast_1d(np.asarray(which))
        kind = numbers.dtype.kind
        if numbers.ndim != 1 or (numbers.size and kind not in "biu") or (kind == "b" and len(numbers) != self.count):
            raise ValueError(
                f"`which` must be a slice, a mask of {self.count} or numbers of actors, not {describe(which)}"
            )
        numbers = np.flatnonzero(numbers) if kind == "b" else numbers.astype(np.int64)
        if len(numbers) and not (-self.count <= numbers.min() and numbers.max() < self.count):
            raise ValueError(f"the crowd has {self.count} actors, numbers 0 to {self.count - 1}")
        return numbers

    def place(self, transforms: ArrayLike, which: Any = None) -> None:
        """Put actors somewhere: (A, 4, 4) or (4, 4) float, object space to world.

        Raises
        ------
        ValueError
            When a matrix is not finite or the shape is wrong; nobody is moved then.
        """
        numbers = self.index(which)
        try:
            matrices = np.asarray(transforms, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"transforms must be 4×4 matrices, not {describe(transforms)}") from None
        if matrices.shape not in ((4, 4), (len(numbers), 4, 4)):
            raise ValueError(f"transforms must be (4, 4) or ({len(numbers)}, 4, 4), not {matrices.shape}")
        if not np.isfinite(matrices).all():
            broken = 0 if matrices.ndim == 2 else int(np.flatnonzero(~np.isfinite(matrices).all(axis=(1, 2)))[0])
            raise ValueError(f"the transform of actor {broken} of those placed is not finite; check what sets it")
        matrices = np.broadcast_to(matrices, (len(numbers), 4, 4))
        linear = matrices[:, :3, :3]
        self._rows[numbers] = matrices[:, :3].reshape(-1, 12)
        self._positions[numbers] = matrices[:, :3, 3]
        self._stretches[numbers] = largest_stretch(linear) * (1 + 1e-5)
        self._mirrored[numbers] = np.linalg.det(linear) < 0
        self.place_spheres(numbers)

    def place_upright(self, positions: ArrayLike, headings: ArrayLike, which: Any = None) -> None:
        """Put actors at (A, 3) positions, metres, turned by (A,) headings about +Y, radians: quicker than `place`.

        Raises
        ------
        ValueError
            When a number is not finite or the shape is wrong; nobody is moved then.
        """
        numbers = self.index(which)
        places, angles = finite(positions, "positions"), finite(headings, "headings")
        if places.shape not in ((3,), (len(numbers), 3)) or angles.shape not in ((), (len(numbers),)):
            raise ValueError(f"{len(numbers)} actors need positions (A, 3) and headings (A,), not {places.shape}")
        where: Any = slice(None) if which is None else numbers
        rows = np.zeros((len(numbers), 12), dtype=np.float32)
        rows[:, 0] = rows[:, 10] = np.cos(angles)
        rows[:, 2] = np.sin(angles)
        rows[:, 8] = -rows[:, 2]
        rows[:, 5] = 1
        rows[:, 3:12:4] = places
        self._rows[where] = rows
        self._positions[where] = places
        self._stretches[where] = 1 + 1e-5
        self._mirrored[where] = False
        self.place_spheres(where)

    def place_spheres(self, numbers: Any) -> None:
        """Bring the bounding spheres of actors up to date after they moved or changed clips."""
        clips = self.clips[numbers]
        rows = self._rows[numbers].reshape(-1, 3, 4)
        local = self.baked.centres[clips]
        x, y, z = (rows[:, :, axis] * local[:, axis, None] for axis in range(3))
        self._centres[numbers] = self._positions[numbers] + (x + y + z)
        self._radii[numbers] = self.baked.radii_m[clips] * self._stretches[numbers]

    @property
    def spheres(self) -> tuple[NDArray[np.float64], Floats]:
        """Centres (A, 3) in the world and radii (A,), metres: each holds its actor in all poses of its clip."""
        return self._centres, self._radii

    def _spheres_in_view(self, camera: CameraMatrices) -> NDArray[np.int64]:
        """Visible actors whose sphere touches the view, (S,): a quick pick of whom to look at more closely."""
        sides = camera.functions[:6] / np.linalg.norm(camera.functions[:6, :3], axis=1).clip(1e-300)[:, None]
        sides32 = sides.astype(np.float32)
        offsets = (self._centres - camera.eye).astype(np.float32)
        inside = self.visible.copy()
        for side in sides32:
            inside &= offsets @ side[:3] >= -self._radii - side[3]
        return np.flatnonzero(inside)

    def measure(
        self, rows: Floats, stretches: Floats, pose_rows: Floats, camera: CameraMatrices, size_px: tuple[int, int]
    ) -> tuple[NDArray[np.bool_], Floats]:
        """Whether actors are in view, and pixels per metre of each, (S,) both, as of single actors (lod_selection).

        Parameters
        ----------
        rows : (S, 12) float32
            Transforms to the world's axes around the eye.
        stretches : (S,) float32
            From `largest_stretch`.
        pose_rows : (S,) float64
        camera : CameraMatrices
        size_px : width and height of the picture
        """
        first = pose_rows.astype(np.int64)
        onwards = (pose_rows - first).astype(np.float32)
        following = np.minimum(first + 1, len(self.baked.matrices) - 1)
        boxes = self._row_boxes.take(first, axis=1)
        boxes += (self._row_boxes.take(following, axis=1) - boxes) * onwards

        def parts(near: NDArray[np.int64]) -> Floats:
            share = onwards[near, None, None, None]
            matrices = self.baked.matrices[first[near]] * (1 - share) + self.baked.matrices[following[near]] * share
            return carry_parts(self.joint_boxes.carried(matrices), rows[near].reshape(-1, 3, 4))

        carried = carry_boxes(boxes[:3], boxes[3:], np.ascontiguousarray(rows.T).reshape(3, 4, -1))
        return measure(carried, stretches, camera, size_px, parts)

    def forget_levels(self) -> None:
        """Choose levels anew at the next picture, as if it were the first: no hysteresis from the last one."""
        self._levels[:] = -1

    def pose_rows(self, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        """Place of actors in the baked clips, (S,) float64: a row, and a fraction of the way to the next."""
        baked, clips = self.baked, self.clips[numbers]
        times = self.phases_s[numbers] + self.speeds[numbers] * self.clock_s
        durations = baked.durations_s[clips]
        lengths = np.where(durations > 0, durations, 1.0)
        wrapped = times - np.floor(times / lengths) * lengths
        inside = np.where(self.loops[numbers], np.minimum(wrapped, durations), np.clip(times, 0.0, durations))
        return np.asarray(baked.first_row[clips] + inside * baked.rates_hz[clips])

    def select(
        self,
        camera: CameraMatrices,
        size_px: tuple[int, int],
        errors_m: Floats,
        threshold_px: float,
        level: int | None = None,
    ) -> Selection:
        """Instance records of everybody in view.

        Parameters
        ----------
        camera : CameraMatrices
        size_px : width and height of the picture
        errors_m : (L,) float
            Error of each level.
        threshold_px : float
        level : int, optional
            One level for all.
        """
        numbers = self._spheres_in_view(camera)
        rows, pose_rows = self._rows[numbers], self.pose_rows(numbers)
        rows[:, 3::4] = self._positions[numbers] - camera.eye
        seen, scale_px = self.measure(rows, self._stretches[numbers], pose_rows, camera, size_px)
        chosen = np.flatnonzero(seen)
        numbers, scale_px = numbers[chosen], scale_px[chosen]
        if level is None:
            levels = choose_levels(errors_m, scale_px, threshold_px, self._levels[numbers]).astype(np.uint8)
            self._levels[numbers] = levels
        else:
            levels = np.full(len(numbers), level, np.uint8)
        keys = levels * 2 + self._mirrored[numbers]
        order = np.argsort(keys, kind="stable")  # a radix sort: linear in time
        counts = np.bincount(keys, minlength=2 * len(errors_m)).reshape(len(errors_m), 2)
        records = np.empty(len(numbers), CROWD_INSTANCE)
        records["rows"] = rows[chosen[order]].reshape(-1, 3, 4)
        records["pose_row"], records["tint"] = pose_rows[chosen[order]], self.tints[numbers[order]]
        records["actor"] = numbers[order]
        totals = counts.sum(axis=1)
        return Selection(records, np.cumsum(totals) - totals, counts[:, 0], counts[:, 1])
