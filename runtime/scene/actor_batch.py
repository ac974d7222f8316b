"""Many actors gathered for drawing: sorted by model, each model's posed together in arrays.

Letters in shapes: A actors, J joints, P parts of a body.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.animation.bounds import box_around
from runtime.scene.actor import Actor

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
    parts : (A, 3, 4, P) float32
        Boxes in whose convex hull the pose lies, one a joint that moves anything, object space: three half edges and
        the middle of each, as columns.
    tints : (A, 4) float32
    morph_weights : (A, M) float32 or None
        Where the character has morphs.
    """

    actors: tuple[Actor, ...]
    transforms: NDArray[np.float64]
    joint_rows: Floats
    parts: Floats
    tints: NDArray[np.float32]
    morph_weights: Floats | None = None

    @property
    def bounds(self) -> Floats:
        """Box of each actor's pose, object space, (A, 2, 3) float32."""
        return box_around(self.parts)


def refuse_broken_transforms(actors: Sequence[Actor]) -> None:
    """See that all transforms are finite.

    Raises
    ------
    ValueError
    """
    for index, actor in enumerate(actors):
        if not (np.abs(actor._transform) <= FARTHEST).all():  # NaN is not
            raise ValueError(
                f"the transform of actor {index} of those to draw is not finite, or far too large; check what sets it"
            )


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
    groups: dict[int, list[Actor]] = {}
    for actor in listed:
        groups.setdefault(id(actor.model), []).append(actor)
    batches: list[tuple[Any, ActorBatch]] = []
    for group in groups.values():
        model = group[0].model
        transforms = np.array([actor._transform for actor in group], dtype=np.float64)
        if not np.vdot(transforms, transforms) <= FARTHEST**2:  # one call tells of nearly all; NaN is not
            refuse_broken_transforms(listed)
        rows = model.mixer.joint_rows([actor.row for actor in group])
        morphs = model.mixer.morph_weights([actor.row for actor in group]) if model.mixer.skeleton.morphs else None
        parts = model.joint_boxes.carried(rows, morphs)
        if not parts.shape[3]:
            parts = np.zeros((len(rows), 3, 4, 1), rows.dtype)
        batch = ActorBatch(
            actors=tuple(group),
            transforms=transforms,
            joint_rows=rows,
            parts=parts,
            tints=np.array([actor._tint for actor in group]),
            morph_weights=morphs,
        )
        batches.append((model, batch))
    return batches
