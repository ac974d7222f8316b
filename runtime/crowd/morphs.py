"""Morph targets (blend shapes) of a crowd: what each vertex does for each target, as lists that crowd.vert walks.

Single actors have their sums made once a picture (runtime/asset/morphs.py); for thousands that would be too much, and
most are far away, at levels of few vertices. A vertex's list has a record for each target that touches it: three rows,
turn and shift, and the target's number. Weights lie in two textures: of every row of the baked clips, and, once a
caller has set any, of every actor.
Letters in shapes: A actors, M targets, R rows of the baked clips, V vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.bounds import JointBoxes, grown_boxes, weight_ranges
from runtime.animation.clip import Clip
from runtime.animation.mixer import given_weights
from runtime.animation.pose import sample
from runtime.animation.skeleton import Skeleton
from runtime.asset.asset import Asset
from runtime.asset.morphs import Morphs
from runtime.crowd.animation_texture import BakedClips, bounds_of_rows
from runtime.errors import RenderError
from runtime.gpu.textures import TEXTURE_UNITS

RECORDS_A_ROW = WEIGHTS_A_ROW = 1024  # shaders/crowd.vert: MORPH_ROW_LOG2
THE_CLIPS = 1e9  # in place of an actor's own weight
# Units of textures that crowds do not read.
UNITS = {
    "crowd_morphs": TEXTURE_UNITS["weight_cells"],
    "clip_morph_weights": TEXTURE_UNITS["weight_records"],
    "own_morph_weights": TEXTURE_UNITS["joint_records"],
}


def morph_lists(
    morphs: Morphs, canonical_uvs: NDArray[np.floating[Any]], first: int
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Records of vertices that fetch their geometry at these places (V, 2): (N, 4, 4), and (V, 2) first and count.

    first : int
        Number of the first record.
    """
    vertices, records = [], []
    for number in range(len(morphs.targets)):
        rows = morphs.rows_at(number, canonical_uvs)
        touched = np.flatnonzero(rows.any(axis=(1, 2)))
        block = np.zeros((len(touched), 4, 4), np.float32)
        block[:, :3], block[:, 3, 0] = rows[touched], number
        vertices.append(touched)
        records.append(block)
    vertex = np.concatenate(vertices)
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex, minlength=len(canonical_uvs))
    starts = first + np.cumsum(counts) - counts
    return np.concatenate(records)[order], np.stack([starts, counts], axis=1).astype(np.uint32)


def clip_weights(baked: BakedClips, clips: Sequence[Clip], skeleton: Skeleton) -> NDArray[np.float32]:
    """Morph weights of every row of the baked clips, the last one at rest, (R, M)."""
    blocks = []
    for clip, count in zip(clips, baked.num_rows.tolist()):
        weights = sample(clip, skeleton, np.linspace(0.0, clip.duration_s, count)).weights
        assert weights is not None
        blocks.append(weights)
    return np.concatenate([*blocks, [skeleton.morph_weights]]).astype(np.float32)


class CrowdMorphs:
    """Textures and bounds of a crowd whose character has morphs.

    Parameters
    ----------
    ctx : moderngl.Context
    asset : Asset
    clips : sequence of Clip
        Those that the crowd can play.
    baked : BakedClips
    boxes : (J, 2, 3) float64
        Of joints, without morphs.
    count : int
        Actors.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        asset: Asset,
        clips: Sequence[Clip],
        baked: BakedClips,
        boxes: NDArray[np.float64],
        count: int,
    ) -> None:
        assert asset.morphs is not None
        self._ctx, self._asset, self._boxes, self._count = ctx, asset, boxes, count
        self._ranges = np.repeat(np.array([asset.skeleton.morph_weights], np.float64), 2, axis=0)
        for clip in clips:
            own = weight_ranges(clip, asset.skeleton)
            self._ranges[0], self._ranges[1] = np.minimum(self._ranges[0], own[0]), np.maximum(self._ranges[1], own[1])
        self.own: NDArray[np.float32] | None = None  # (A, M), NaN for the clip's
        self._textures: dict[str, moderngl.Texture] = {}
        self.lists: list[moderngl.Buffer] = []
        records: list[NDArray[np.float32]] = []
        first = 0
        for lod in asset.lods:
            block, starts = morph_lists(asset.morphs, lod.canonical_uvs, first)
            first += len(block)
            records.append(block)
            self.lists.append(ctx.buffer(starts.tobytes()))
        self._upload("crowd_morphs", np.concatenate(records).reshape(-1, 16), RECORDS_A_ROW, 4)
        weights = clip_weights(baked, clips, asset.skeleton)
        self._textures["clip_morph_weights"] = self._make(weights.shape[::-1], 1, weights)

    @property
    def uniforms(self) -> dict[str, int]:
        """What programs are told."""
        return {"num_morphs": len(self._asset.morph_names), "has_own_morphs": int(self.own is not None)}

    def _make(self, size: tuple[int, ...], components: int, values: NDArray[np.float32]) -> moderngl.Texture:
        limit = self._ctx.info["GL_MAX_TEXTURE_SIZE"]
        if max(size) > limit:
            raise RenderError(
                f"the morphs of this crowd need textures of {max(size)} texels, not {limit}: draw in parts"
            )
        texture = self._ctx.texture((size[0], size[1]), components, np.ascontiguousarray(values).tobytes(), dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def _upload(self, name: str, rows: NDArray[np.float32], a_row: int, texels: int) -> None:
        """A texture of rows of numbers, so many of them side by side, each as many texels."""
        height = max(1, -(-len(rows) // a_row))
        padded = np.zeros((height * a_row, rows.shape[1]), np.float32)
        padded[: len(rows)] = rows
        if name in self._textures:
            self._textures.pop(name).release()
        self._textures[name] = self._make((a_row * texels, height), rows.shape[1] // texels, padded)

    def set_weights(self, weights: Mapping[str, Any] | ArrayLike | None, actors: NDArray[np.int64]) -> bool:
        """Set weights of actors, as `Actor.set_morph_weights`; whether their bounds have grown."""
        skeleton = self._asset.skeleton
        own = np.full((self._count, len(skeleton.morphs)), np.nan, np.float32) if self.own is None else self.own.copy()
        own[actors] = given_weights(skeleton, own[actors], weights)
        self.own = own
        stored = np.where(np.isnan(own), np.float32(THE_CLIPS), own)
        self._upload("own_morph_weights", stored.reshape(-1, 1), WEIGHTS_A_ROW, 1)
        given = own[actors]
        least = np.fmin(self._ranges[0], np.fmin.reduce(given, axis=0, initial=np.inf))
        greatest = np.fmax(self._ranges[1], np.fmax.reduce(given, axis=0, initial=-np.inf))
        grown = bool((least < self._ranges[0]).any() or (greatest > self._ranges[1]).any())
        self._ranges = np.stack([least, greatest])
        return grown

    def bound(self, baked: BakedClips) -> tuple[BakedClips, JointBoxes]:
        """The baked clips with bounds that hold every weight that was met, and the joints' boxes."""
        boxes = grown_boxes(self._boxes, self._asset.morph_reaches, self._ranges)
        return bounds_of_rows(baked, boxes), JointBoxes(boxes)

    def bind(self) -> None:
        """Put the textures into their units."""
        for name, texture in self._textures.items():
            texture.use(UNITS[name])

    @property
    def nbytes(self) -> int:
        """Bytes in GPU memory."""
        textures = sum(4 * one.width * one.height * one.components for one in self._textures.values())
        return textures + sum(int(one.size) for one in self.lists)

    def release(self) -> None:
        """Free everything."""
        for texture in self._textures.values():
            texture.release()
        for buffer in self.lists:
            buffer.release()
        self._textures.clear()
        self.lists.clear()
