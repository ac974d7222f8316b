"""Who is drawn together: actors of one model are seen or not, get a level of detail, and become instance records.

Letters in shapes: A actors.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.actor_batch import ActorBatch
from runtime.camera import CameraMatrices
from runtime.errors import RenderError
from runtime.gpu_asset import Model
from runtime.gpu_levels import INSTANCE
from runtime.lod import Bodies, Quality, choose_levels, in_view, pixels_a_metre

if TYPE_CHECKING:
    from runtime.actor import Actor


@dataclass(frozen=True)
class DrawnActor:
    """What was done with one actor in the last picture: its level of detail (-1: not in view), tessellated or not."""

    level: int
    tessellated: bool


@dataclass(frozen=True)
class Group:
    """Actors of one model that are drawn with one call: the same level, tessellated or not, mirrored or not.

    Attributes
    ----------
    model : Model
    level : int
    tessellated, mirrored : bool
    records : (A, 18) float32, the words of `INSTANCE`
    """

    model: Model
    level: int
    tessellated: bool
    mirrored: bool
    records: NDArray[Any]

    @property
    def key(self) -> tuple[int, bool, bool]:
        """What tells the groups of one model apart."""
        return self.level, self.tessellated, self.mirrored


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
    flat = batch.joint_rows.ravel()
    if math.isfinite(float(np.dot(flat, flat))):  # one call tells of all; it may only overflow
        return
    if not np.isfinite(batch.joint_rows).all():
        broken = int(np.flatnonzero(~np.isfinite(batch.joint_rows).all(axis=(1, 2, 3)))[0])
        raise RenderError(f"the pose of actor {broken} of {model.asset.name} is not finite: check what sets its joints")


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
    transforms = batch.transforms
    bodies = Bodies(batch.bounds, batch.parts, transforms)
    scale_px = pixels_a_metre(bodies, matrices, wish.size_px)
    seen, is_auto = in_view(bodies, matrices), wish.tessellation == "auto" and wish.has_tessellation
    divides = is_auto and wish.lod is None and wish.quality.prefer == "tessellation"
    errors = model.levels.divided_errors_m if divides else model.levels.errors_m
    if wish.lod is None:
        previous = np.array([levels_before.get(actor, -1) for actor in batch.actors])
        levels = choose_levels(errors, scale_px, wish.quality.threshold_px, previous)
    else:
        levels = np.full(len(batch.actors), wish.lod)
    if not isinstance(wish.tessellation, str):
        tessellated = np.ones(len(levels), bool)
    elif divides:
        tessellated = levels > 0
    elif is_auto and wish.lod:
        tessellated = np.minimum(scale_px, 1e300) * errors[levels] > wish.quality.threshold_px
    else:
        tessellated = np.zeros(len(levels), bool)
    drawn = {}
    for actor, level, is_seen, divided in zip(batch.actors, levels.tolist(), seen.tolist(), tessellated.tolist()):
        if is_seen and wish.lod is None:
            levels_before[actor] = level
        drawn[actor] = DrawnActor(level if is_seen else -1, divided)
    if not seen.any():
        return [], drawn
    records = np.empty((len(levels), INSTANCE.itemsize // 4), np.float32)
    records[:, :12] = transforms[:, :3].reshape(-1, 12)
    records[:, 3:12:4] = transforms[:, :3, 3] - matrices.eye
    records[:, 12:16] = batch.tints
    numbers = records.view(np.int32)
    numbers[:, 16] = np.arange(len(levels))
    numbers[:, 17] = levels
    keys = levels * 4 + tessellated * 2 + (np.linalg.det(transforms[:, :3, :3]) < 0)
    groups = []
    for key in sorted(set(keys[seen].tolist())):
        together = records[seen & (keys == key)]
        groups.append(Group(model, key >> 2, bool(key & 2), bool(key & 1), together))
    return groups, drawn
