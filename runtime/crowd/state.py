"""Where the actors of a crowd stand and what they play, in arrays; who is seen, at which level, in which pose.

Everything here is plain NumPy over all actors at once: a frame of 10,000 costs about a millisecond. Nothing depends
on the number of joints. Letters in shapes: A actors, S seen actors, L levels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.crowd.animation_texture import BakedClips
from runtime.scene.camera import CameraMatrices
from runtime.scene.lod_selection import HYSTERESIS
from runtime.validation import numbers as finite
from runtime.validation import shown

Floats = NDArray[np.floating[Any]]
CLOSE_RADII = 20.0  # actors at so many radii or less are looked at more closely
INSTANCE_WORDS = 14  # rows (3, 4) float32, row of the baked clips float32, tint 4 × uint8


@dataclass(frozen=True)
class Selection:
    """Instance records of one picture, sorted by level.

    Attributes
    ----------
    records : (S, 14) float32
        World matrix rows (from the eye), pose row, tint as four bytes.
    first : (L,) int64
        First record of each level; mirrored actors of a level come last.
    counts, mirrored : (L,) int64
        Actors of each level that are not and that are mirrored.
    """

    records: NDArray[np.float32]
    first: NDArray[np.int64]
    counts: NDArray[np.int64]
    mirrored: NDArray[np.int64]


class Stage:
    """State of A actors.

    Parameters
    ----------
    baked : BakedClips
    count : int
    """

    def __init__(self, baked: BakedClips, count: int) -> None:
        self.baked = baked
        self.count = count
        self.clock_s = 0.0
        self.clips = np.full(count, len(baked.names) - 1, dtype=np.int64)
        self.phases_s = np.zeros(count)
        self.speeds = np.ones(count)
        self.loops = np.ones(count, dtype=bool)
        self.tints = np.full((count, 4), 255, dtype=np.uint8)
        self.visible = np.ones(count, dtype=bool)
        self._rows = np.zeros((count, 12), dtype=np.float32)
        self._rows[:, [0, 5, 10]] = 1
        self._positions = np.zeros((count, 3))
        self._scales = np.ones(count, dtype=np.float32)
        self._mirrored = np.zeros(count, dtype=bool)
        self._centres = np.zeros((count, 3))
        self._radii = np.zeros(count, dtype=np.float32)
        self._levels = np.full(count, -1, dtype=np.int8)
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
                f"`which` must be a slice, a mask of {self.count} or numbers of actors, not {shown(which)}"
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
            raise ValueError(f"transforms must be 4×4 matrices, not {shown(transforms)}") from None
        if matrices.shape not in ((4, 4), (len(numbers), 4, 4)):
            raise ValueError(f"transforms must be (4, 4) or ({len(numbers)}, 4, 4), not {matrices.shape}")
        if not np.isfinite(matrices).all():
            broken = 0 if matrices.ndim == 2 else int(np.flatnonzero(~np.isfinite(matrices).all(axis=(1, 2)))[0])
            raise ValueError(f"the transform of actor {broken} of those placed is not finite; check what sets it")
        matrices = np.broadcast_to(matrices, (len(numbers), 4, 4))
        linear = matrices[:, :3, :3]
        self._rows[numbers] = matrices[:, :3].reshape(-1, 12)
        self._positions[numbers] = matrices[:, :3, 3]
        # The Frobenius norm bounds every stretch; of a rotation with one scale it is √3 too large: take columns then.
        columns = np.linalg.norm(linear, axis=1)
        product = np.einsum("arc,ard->acd", linear, linear)
        skew = np.abs(product - columns[:, :, None] * columns[:, None, :] * np.eye(3)).max(axis=(1, 2))
        largest = columns.max(axis=1)
        rigid = skew <= 1e-5 * np.maximum(largest, 1e-30) ** 2
        self._scales[numbers] = np.where(rigid, largest, np.linalg.norm(linear, axis=(1, 2))) * (1 + 1e-5)
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
        self._scales[where] = 1 + 1e-5
        self._mirrored[where] = False
        self.place_spheres(where)

    def place_spheres(self, numbers: Any) -> None:
        """Bring the bounding spheres of actors up to date after they moved or changed clips."""
        clips = self.clips[numbers]
        rows = self._rows[numbers].reshape(-1, 3, 4)
        local = self.baked.centres[clips]
        x, y, z = (rows[:, :, axis] * local[:, axis, None] for axis in range(3))
        self._centres[numbers] = self._positions[numbers] + (x + y + z)
        self._radii[numbers] = self.baked.radii_m[clips] * self._scales[numbers]

    @property
    def spheres(self) -> tuple[NDArray[np.float64], Floats]:
        """Centres (A, 3) in the world and radii (A,), metres: each holds its actor in all poses of its clip."""
        return self._centres, self._radii

    def seen(self, camera: CameraMatrices) -> tuple[NDArray[np.int64], Floats, Floats]:
        """Actors whose sphere touches the view: numbers (S,), view-space centres (S, 3) float32, radii (S,)."""
        rotation = camera.rotation.astype(np.float32)
        offsets = (self._centres - camera.eye).astype(np.float32)
        view = offsets @ rotation.T
        projection = camera.projection
        planes = np.concatenate([projection[3] + projection[:3], projection[3] - projection[:3]])
        planes = (planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)).astype(np.float32)
        inside = self.visible.copy()
        for plane in planes:
            inside &= view @ plane[:3] >= -self._radii - plane[3]
        numbers = np.flatnonzero(inside)
        return numbers, view[numbers], self._radii[numbers]

    def pixels_per_metre(
        self, numbers: NDArray[np.int64], view: Floats, radii: Floats, camera: CameraMatrices, height_px: int
    ) -> Floats:
        """Largest size on the screen of a displacement of one metre of each seen actor, (S,) pixels.

        By the depth of the nearest point of the clip's box, and how far aside its sphere reaches (scene.lod_selection).
        """
        focal_px = np.float32(camera.projection[1, 1] * height_px / 2)
        scales = self._scales[numbers]
        if not camera.is_perspective:
            return scales * focal_px
        nearest = -view[:, 2] - radii
        close = np.flatnonzero(nearest < CLOSE_RADII * radii)  # farther away it makes no difference
        # How far the box reaches towards the eye: the sum of its half sizes, each as long as it is seen along the view.
        linear = self._rows[numbers[close]].reshape(-1, 3, 4)[:, :, :3]
        along = np.abs(np.einsum("src,r->sc", linear, camera.rotation[2]))
        reach = np.einsum("sc,sc->s", along, self.baked.halves[self.clips[numbers[close]]])
        nearest[close] = -view[close, 2] - np.minimum(reach, radii[close])
        safe = np.maximum(nearest, np.float32(1e-6))
        aside = (np.hypot(view[:, 0], view[:, 1]) + radii) / safe
        widest = float(np.hypot(1 / camera.projection[0, 0], 1 / camera.projection[1, 1]))
        across = np.sqrt(1 + np.minimum(aside, np.float32(widest)) ** 2)
        return np.where(nearest > 0, scales * focal_px * across / safe, np.float32(np.inf))

    def choose_levels(
        self, numbers: NDArray[np.int64], pixels_a_metre: Floats, errors_m: Floats, threshold_px: float
    ) -> NDArray[np.int8]:
        """Coarsest level of each seen actor whose error stays under the threshold, with hysteresis. (S,) int8."""
        errors = np.maximum.accumulate(np.asarray(errors_m, dtype=np.float64))
        errors[0] = 0.0
        with np.errstate(divide="ignore"):
            limits = np.where(errors > 0, threshold_px / errors, np.inf)
        free = np.searchsorted(-limits, -pixels_a_metre, side="right") - 1
        strict = np.searchsorted(-limits * (1 - HYSTERESIS), -pixels_a_metre, side="right") - 1
        before = self._levels[numbers]
        levels = np.where((before >= 0) & (free > before), np.maximum(strict, before), free)
        chosen = np.maximum(levels, 0).astype(np.int8)
        self._levels[numbers] = chosen
        return chosen

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
        height_px: int,
        errors_m: Floats,
        threshold_px: float,
        level: int | None = None,
    ) -> Selection:
        """Instance records of everybody in view.

        Parameters
        ----------
        camera : CameraMatrices
        height_px : int
        errors_m : (L,) float
            Error of each level.
        threshold_px : float
        level : int, optional
            One level for all.
        """
        numbers, view, radii = self.seen(camera)
        num_levels = len(errors_m)
        if level is None:
            scale_px = self.pixels_per_metre(numbers, view, radii, camera, height_px)
            levels = self.choose_levels(numbers, scale_px, errors_m, threshold_px)
        else:
            levels = np.full(len(numbers), level, dtype=np.int8)
        keys = (levels * 2 + self._mirrored[numbers]).astype(np.uint8)
        order = np.argsort(keys, kind="stable")  # a radix sort: linear in time
        numbers = numbers[order]
        counts = np.bincount(keys, minlength=2 * num_levels).reshape(num_levels, 2)
        records = np.empty((len(numbers), INSTANCE_WORDS), dtype=np.float32)
        records[:, :12] = self._rows[numbers]
        records[:, 3:12:4] = self._positions[numbers] - camera.eye
        records[:, 12] = self.pose_rows(numbers)
        records[:, 13] = self.tints[numbers].view(np.float32)[:, 0]
        totals = counts.sum(axis=1)
        return Selection(records, np.cumsum(totals) - totals, counts[:, 0], counts[:, 1])
