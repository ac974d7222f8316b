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
from runtime.gpu.vertex_layout import ACTOR_INSTANCE
from runtime.scene.actor_batch import ActorBatch
from runtime.scene.camera import CameraMatrices
from runtime.scene.lod_selection import (
    Quality,
    around_eye,
    carry_boxes,
    carry_parts,
    choose_levels,
    largest_stretch,
    measure,
)

if TYPE_CHECKING:
    from runtime.scene.actor import Actor

Floats = NDArray[np.floating[Any]]


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
class DrawBatch:
    """Actors of one model that are drawn with one call: the same level, tessellated or not, mirrored or not.

    Attributes
    ----------
    model : Model
    level : int
        Level of detail.
    tessellated : bool
        Whether faces are divided.
    mirrored : bool
        Whether transforms turn faces inside out.
    instances : (A,) ACTOR_INSTANCE
    """

    model: Model
    level: int
    tessellated: bool
    mirrored: bool
    instances: NDArray[Any]

    @property
    def key(self) -> tuple[int, bool, bool]:
        """What tells the batches of one model apart."""
        return self.level, self.tessellated, self.mirrored


@dataclass(frozen=True)
class LodRequest:
    """How a picture is to be drawn, as far as levels go.

    Attributes
    ----------
    size_px : width and height of the picture
    level : int or None
        One level for all, None to choose.
    tessellation : "auto", "off" or number
    has_tessellation : bool
        Whether the context can.
    quality : Quality
    """

    size_px: tuple[int, int]
    level: int | None
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


def _choose(
    model: Model, size_px_per_m: Floats, request: LodRequest, before: NDArray[np.int64]
) -> tuple[list[int], list[bool]]:
    """Level of each actor, and whether it is tessellated."""
    count, quality = len(before), request.quality
    is_auto = request.tessellation == "auto" and request.has_tessellation
    if request.level is not None:
        errors, over = model.levels.errors_m[request.level], [not isinstance(request.tessellation, str)] * count
        if is_auto and request.level:
            over = (np.minimum(size_px_per_m, 1e300) * errors > quality.threshold_px).tolist()
        return [request.level] * count, over
    divides = is_auto and quality.prefer == "tessellation"
    errors = model.levels.divided_errors_m if divides else model.levels.errors_m
    levels = choose_levels(errors, size_px_per_m, quality.threshold_px, before)
    return levels.tolist(), (levels > 0).tolist() if divides else [not isinstance(request.tessellation, str)] * count


def make_draw_batches(
    model: Model,
    batch: ActorBatch,
    camera: CameraMatrices,
    request: LodRequest,
    levels_before: MutableMapping[Actor, int],
) -> tuple[list[DrawBatch], dict[Actor, DrawnActor]]:
    """Choose a level for each actor in view, and fill the instance records of those drawn together.

    Parameters
    ----------
    model : Model
    batch : ActorBatch
    camera : CameraMatrices
    request : LodRequest
    levels_before : mapping of actors to the level chosen last time
        Brought up to date. A level that was asked for says nothing about the next choice and is not noted.

    Returns
    -------
    draw batches, and what was decided for each actor
    """
    refuse_broken_poses(model, batch)
    rows = around_eye(camera.eye, batch.transforms)
    low, high = batch.bounds.transpose(1, 2, 0)
    boxes, stretch = carry_boxes(low, high, rows.transpose(1, 2, 0)), largest_stretch(rows[:, :, :3])
    seen, scale_px = measure(
        boxes, stretch, camera, request.size_px, lambda near: carry_parts(batch.parts[near], rows[near])
    )
    before = [levels_before.get(actor, -1) for actor in batch.actors]
    levels, tessellated = _choose(model, scale_px, request, np.array(before))
    drawn: dict[Actor, DrawnActor] = {}
    members: dict[tuple[int, bool, bool], list[int]] = {}
    together = zip(batch.actors, seen.tolist(), levels, tessellated, rows.reshape(-1, 12).tolist(), before)
    for index, (actor, is_seen, level, divided, row, level_before) in enumerate(together):
        drawn[actor] = _drawn_actor(level if is_seen else -1, divided)
        if not is_seen:
            continue
        members.setdefault((level, divided, _is_mirrored(row)), []).append(index)
        if request.level is None and level != level_before:
            levels_before[actor] = level
    if not members:
        return [], drawn
    records = np.empty(len(rows), ACTOR_INSTANCE)
    records["rows"], records["tint"] = rows, batch.tints
    records["pose"], records["level"] = np.arange(len(rows)), levels
    if any(part.material.alpha_mode == "BLEND" for lod in model.lods for part in lod.ranges):
        far = np.square(rows[:, :, 3]).sum(axis=1)
        members = {key: sorted(indices, key=lambda index: -far[index]) for key, indices in members.items()}
    elif len(members) == 1 and all(seen):
        return [DrawBatch(model, *next(iter(members)), records)], drawn
    batches = [DrawBatch(model, *key, records[indices]) for key, indices in sorted(members.items())]
    return batches, drawn
