"""Who is drawn together: actors of one model are seen or not, get a level of detail, and become instance records.

Letters in shapes: A actors.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import RenderError
from runtime.gpu.model import Model
from runtime.scene.actor_batch import ActorBatch
from runtime.scene.camera import CameraMatrices
from runtime.scene.lod_selection import Quality, around_eye, choose_levels, measure

if TYPE_CHECKING:
    from runtime.scene.actor import Actor


@dataclass(frozen=True)
class DrawnActor:
    """What was done with one actor in the last picture: its level of detail (-1: not in view), tessellated or not."""

    level: int
    tessellated: bool


@lru_cache(maxsize=256)
def _drawn_actor(level: int, tessellated: bool) -> DrawnActor:
    """One record for all actors of which the same is said."""
    return DrawnActor(level, tessellated)


@dataclass(frozen=True)
class Group:
    """Actors of one model that are drawn with one call: the same level, tessellated or not, mirrored or not.

    Attributes
    ----------
    model : Model
    key : (int, bool, bool)
        Level, tessellated, mirrored: what tells the groups of one model apart.
    records : (A, 18) float32, the words of `INSTANCE`
    """

    model: Model
    key: tuple[int, bool, bool]
    records: NDArray[Any]

    @property
    def level(self) -> int:
        """Level of detail."""
        return self.key[0]

    @property
    def tessellated(self) -> bool:
        """Whether faces are divided."""
        return self.key[1]

    @property
    def mirrored(self) -> bool:
        """Whether transforms turn faces inside out."""
        return self.key[2]


@dataclass(frozen=True)
class Wish:
    """How a picture is to be drawn, as far as levels go.

    Attributes
    ----------
    size_px : width and height of the picture
    lod : int or None
        One level for all, None to choose.
    tessellation : "auto", "off" or number
    has_tessellation : bool
        Whether the context can.
    quality : Quality
    """

    size_px: tuple[int, int]
    lod: int | None
    tessellation: float | str
    has_tessellation: bool
    quality: Quality


def refuse_broken_poses(model: Model, batch: ActorBatch) -> None:
    """See that all joints of all actors are finite.

    Raises
    ------
    RenderError
    """
    if math.isfinite(np.vdot(batch.joint_rows, batch.joint_rows)):  # one call tells of all; it may only overflow
        return
    if not np.isfinite(batch.joint_rows).all():
        broken = int(np.flatnonzero(~np.isfinite(batch.joint_rows).all(axis=(1, 2, 3)))[0])
        raise RenderError(f"the pose of actor {broken} of {model.asset.name} is not finite: check what sets its joints")


def _is_mirrored(row: Sequence[float]) -> bool:
    """Whether a transform, given by the numbers of its upper three rows, turns things inside out."""
    a, b, c, _, d, e, f, _, g, h, i, _ = row
    return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0


def place(
    model: Model, batch: ActorBatch, matrices: CameraMatrices, wish: Wish, levels_before: MutableMapping[Actor, int]
) -> tuple[list[Group], dict[Actor, DrawnActor]]:
    """Choose a level for each actor in view, and fill the instance records of those drawn together.

    Parameters
    ----------
    model : Model
    batch : ActorBatch
    matrices : CameraMatrices
    wish : Wish
    levels_before : mapping of actors to the level chosen last time
        Brought up to date. A level that was asked for says nothing about the next choice and is not noted.

    Returns
    -------
    groups to draw, and what was decided for each actor
    """
    refuse_broken_poses(model, batch)
    transforms = around_eye(matrices.eye, batch.transforms)
    seen, scale_px = measure(batch.parts, transforms, matrices, wish.size_px)
    is_auto = wish.tessellation == "auto" and wish.has_tessellation
    divides = is_auto and wish.lod is None and wish.quality.prefer == "tessellation"
    errors = model.levels.divided_errors_m if divides else model.levels.errors_m
    before = [levels_before.get(actor, -1) for actor in batch.actors]
    tessellated = [not isinstance(wish.tessellation, str)] * len(before)
    if wish.lod is None:
        chosen = choose_levels(errors, scale_px, wish.quality.threshold_px, np.array(before))
        levels = chosen.tolist()
        if divides:
            tessellated = (chosen > 0).tolist()
    else:
        levels = [wish.lod] * len(before)
        if is_auto and wish.lod:
            tessellated = (np.minimum(scale_px, 1e300) * errors[wish.lod] > wish.quality.threshold_px).tolist()
    drawn: dict[Actor, DrawnActor] = {}
    members: dict[tuple[int, bool, bool], list[int]] = {}
    rows = transforms.reshape(-1, 16)[:, :12]
    together = zip(batch.actors, seen.tolist(), levels, tessellated, rows.tolist(), before)
    for index, (actor, is_seen, level, divided, row, level_before) in enumerate(together):
        drawn[actor] = _drawn_actor(level if is_seen else -1, divided)
        if not is_seen:
            continue
        members.setdefault((level, divided, _is_mirrored(row)), []).append(index)
        if wish.lod is None and level != level_before:
            levels_before[actor] = level
    if not members:
        return [], drawn
    numbers = np.array([*enumerate(levels)], np.int32).view(np.float32)
    records = np.concatenate((rows, batch.tints, numbers), axis=1, dtype=np.float32)
    groups = [
        Group(model, key, records if len(indices) == len(records) else records[indices])
        for key, indices in sorted(members.items())
    ]
    return groups, drawn
