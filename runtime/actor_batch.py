"""Many actors gathered for drawing: sorted by model, each model's posed together in arrays.

Letters in shapes: A actors, J joints, P parts of a body.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.actor import Actor, carrier_of
from runtime.bounds import box_around

Floats = NDArray[np.floating[Any]]
FARTHEST = 1e12  # entries of a transform: what lies beyond is a mistake, and overflows on the GPU


@dataclass(frozen=True)
class ActorBatch:
    """All visible actors of one model, ready to draw.

    Attributes
    ----------
    actors : tuple of A Actor
    transforms : (A, 4, 4) float64
    joint_rows : (A, J, 3, 4) float32, contiguous
    bounds : (A, 2, 3) float32
        Box of each actor's pose, object space.
    parts : two (A, P, 3) float32
        Middles and reaches of boxes, one a joint that moves anything, in whose convex hull the pose lies.
    tints : (A, 4) float32
    """

    actors: tuple[Actor, ...]
    transforms: NDArray[np.float64]
    joint_rows: Floats
    bounds: Floats
    parts: tuple[Floats, Floats]
    tints: NDArray[np.float32]


def gather(actors: Iterable[Actor]) -> list[tuple[Any, ActorBatch]]:
    """Sort actors by model and pose each model's together.

    Invisible and released actors are left out; the caller may change its own list meanwhile.

    Returns
    -------
    list of (model, ActorBatch), models in order of appearance

    Raises
    ------
    ValueError
        When a transform is not finite: it says which actor of the list.
    """
    listed = [actor for actor in tuple(actors) if actor.visible and not actor.released]
    if not listed:
        return []
    transforms = np.array([actor._transform for actor in listed], dtype=np.float64)
    usable = np.abs(transforms) <= FARTHEST  # NaN is not
    if not usable.all():
        broken = int(np.flatnonzero(~usable.all(axis=(1, 2)))[0])
        raise ValueError(
            f"the transform of actor {broken} of those to draw is not finite, or far too large; check what sets it"
        )
    groups: dict[int, list[int]] = {}
    for index, actor in enumerate(listed):
        groups.setdefault(id(actor.model), []).append(index)
    batches: list[tuple[Any, ActorBatch]] = []
    for members in groups.values():
        group = tuple(listed[index] for index in members)
        model = group[0].model
        rows = model.mixer.joint_rows([actor.row for actor in group])
        parts = carrier_of(model).carried(rows)
        bounds = np.zeros((len(rows), 2, 3), rows.dtype)
        if parts[0].shape[1]:
            box_around(*parts, out=bounds)
        else:
            parts = (np.zeros((len(rows), 1, 3), rows.dtype),) * 2
        batch = ActorBatch(
            actors=group,
            transforms=transforms[members],
            joint_rows=rows,
            bounds=bounds,
            parts=parts,
            tints=np.array([actor._tint for actor in group]),
        )
        batches.append((model, batch))
    return batches
