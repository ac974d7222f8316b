"""Who is drawn together: actors of one model are seen or not, get a level of detail, and become instance records.

Letters in shapes: A actors.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.actor import ActorBatch
from runtime.camera import CameraMatrices
from runtime.errors import RenderError
from runtime.gpu_asset import Model
from runtime.gpu_levels import INSTANCE
from runtime.lod import Quality, choose_levels, pixels_per_metre, transform_boxes, visible

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
    records : (A,) of `INSTANCE`
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
    height_px : int
    lod : int or None
        One level for all, None to choose.
    tessellation : "auto", "off" or number
    has_tessellation : bool
        Whether the context can.
    quality : Quality
    """

    height_px: int
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
    transforms = np.array([actor.transform for actor in batch.actors], np.float64)
    corners = transform_boxes(batch.bounds, transforms)
    seen = visible(corners, matrices)
    scale_px = pixels_per_metre(corners, transforms, matrices, wish.height_px)
    errors = np.array([level.mesh.error_m for level in model.lods])
    if wish.lod is None:
        previous = np.array([levels_before.get(actor, -1) for actor in batch.actors])
        levels = choose_levels(errors, scale_px, wish.quality.threshold_px, previous)
    else:
        levels = np.full(len(batch.actors), wish.lod)
    if isinstance(wish.tessellation, str):
        with np.errstate(invalid="ignore"):
            too_coarse = np.nan_to_num(errors[levels] * scale_px) > wish.quality.threshold_px
        tessellated = too_coarse & (levels > 0) & (wish.tessellation == "auto") & wish.has_tessellation
    else:
        tessellated = np.ones(len(levels), bool)
    drawn = {}
    for index, actor in enumerate(batch.actors):
        if seen[index] and wish.lod is None:
            levels_before[actor] = int(levels[index])
        drawn[actor] = DrawnActor(int(levels[index]) if seen[index] else -1, bool(tessellated[index]))
    if not seen.any():
        return [], drawn
    records = np.zeros(len(levels), INSTANCE)
    records["rows"] = transforms[:, :3]
    records["rows"][:, :, 3] = transforms[:, :3, 3] - matrices.eye
    records["tint"] = batch.tints
    records["numbers"][:, 0] = np.arange(len(levels))
    records["numbers"][:, 1] = levels
    mirrored = np.linalg.det(transforms[:, :3, :3]) < 0
    keys = levels * 4 + tessellated * 2 + mirrored
    groups = [
        Group(model, int(key) >> 2, bool(key & 2), bool(key & 1), records[seen & (keys == key)])
        for key in np.unique(keys[seen])
    ]
    return groups, drawn
