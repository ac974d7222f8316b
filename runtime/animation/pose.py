"""Poses of many actors at once: sample a clip, walk the hierarchy level by level, apply the inverse bind matrices.

A pose is seen as (A, N, C), actors first. Its memory runs the other way (components, nodes, actors), which makes every
step one pass over contiguous numbers: 1,000 actors of 53 joints take a few milliseconds on one core, where batched
4×4 products in actors-first order take about five times as long.

Precision follows the pose: float64 offline, float32 in the runtime. Letters in shapes: A actors, N nodes, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from runtime.animation.clip import Clip
from runtime.animation.keyframes import evaluate
from runtime.animation.skeleton import Skeleton

Floats = NDArray[np.floating[Any]]

# Actors posed at a time. 128 actors of 53 joints keep a step's arrays in a core's second-level cache.
_BLOCK = 128


@dataclass(frozen=True)
class Pose:
    """Local transforms of every node of A actors.

    Attributes
    ----------
    translation : (A, N, 3) float, metres
    rotation : (A, N, 4) float, unit quaternions (x, y, z, w)
    scale : (A, N, 3) float
    weights : (A, M) float or None
        Of the morphs, where the character has any.
    """

    translation: Floats
    rotation: Floats
    scale: Floats
    weights: Floats | None = None

    @property
    def num_actors(self) -> int:
        """Number of actors, A."""
        return len(self.translation)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Precision of the pose and of the matrices made from it."""
        return self.translation.dtype

    def select(self, actors: ArrayLike) -> Pose:
        """The pose of some actors, in the order given."""
        index = np.asarray(actors)

        def picked(part: Floats) -> Floats:
            return np.ascontiguousarray(part.T[..., index]).T

        weights = None if self.weights is None else picked(self.weights)
        return Pose(picked(self.translation), picked(self.rotation), picked(self.scale), weights)


def rest_pose(skeleton: Skeleton, num_actors: int = 1, dtype: DTypeLike = np.float64) -> Pose:
    """The skeleton's own pose, once for each of A actors. The arrays may be written to."""

    def repeated(values: NDArray[np.float64]) -> Floats:
        return np.repeat(values.T.astype(dtype)[..., None], num_actors, axis=values.ndim).T

    weights = repeated(np.array(skeleton.morph_weights)) if skeleton.morphs else None
    return Pose(repeated(skeleton.translation), repeated(skeleton.rotation), repeated(skeleton.scale), weights)


def wrap_times(times_s: NDArray[np.float64], duration_s: float, loop: bool | NDArray[np.bool_]) -> NDArray[np.float64]:
    """Times inside a clip: taken modulo its duration where looping, clamped otherwise. (A,) float64 seconds."""
    clamped = np.clip(times_s, 0.0, duration_s)
    if duration_s <= 0.0 or not np.any(loop):
        return clamped
    return np.where(loop, np.mod(times_s, duration_s), clamped)


def sample(
    clip: Clip,
    skeleton: Skeleton,
    times_s: ArrayLike,
    loop: bool = False,
    dtype: DTypeLike = np.float64,
) -> Pose:
    """Pose of a clip at many times.

    Parameters
    ----------
    clip : Clip
    skeleton : Skeleton
        Gives the rest pose of what the clip does not move.
    times_s : (A,) or scalar float, seconds
        Clamped to the clip, or taken modulo its duration with `loop`. Must be finite.
    loop : bool
    dtype : float64 or float32

    Returns
    -------
    Pose of A actors; its arrays are new

    Raises
    ------
    ValueError
        When a time is not finite.
    """
    times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
    if not np.isfinite(times).all():
        raise ValueError(f"clip {clip.name!r} asked for a time that is not finite; check the actor's clock")
    pose = rest_pose(skeleton, len(times), dtype)
    for bank, values in evaluate(clip.keys, wrap_times(times, clip.duration_s, loop), np.dtype(dtype)):
        if bank.path == "weights":
            if pose.weights is not None:  # a clip of a character with morphs, on a skeleton without
                pose.weights.T[bank.nodes] = values[0]
        else:
            getattr(pose, bank.path).T[:, bank.nodes] = values
    return pose


def _local_rows(skeleton: Skeleton, pose: Pose) -> Floats:
    """Local matrices without their last row, (3, 4, N, A): row, column, node, actor."""
    x, y, z, w = pose.rotation.T
    out = np.empty((3, 4, *x.shape), dtype=pose.dtype)
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    np.subtract(1, yy + zz, out=out[0, 0])
    np.subtract(xy, wz, out=out[0, 1])
    np.add(xz, wy, out=out[0, 2])
    np.add(xy, wz, out=out[1, 0])
    np.subtract(1, xx + zz, out=out[1, 1])
    np.subtract(yz, wx, out=out[1, 2])
    np.subtract(xz, wy, out=out[2, 0])
    np.add(yz, wx, out=out[2, 1])
    np.subtract(1, xx + yy, out=out[2, 2])
    scale = pose.scale.T
    if not (scale == 1).all():
        out[:, :3] *= scale
    out[:, 3] = pose.translation.T
    if len(skeleton.matrix_nodes):
        out[:, :, skeleton.matrix_nodes] = np.moveaxis(skeleton.matrices[:, :3], 0, 2)[..., None]
    return out


def _affine_product(left: Floats, right: Floats, out: Floats) -> None:
    """Product of matrices stored as (3, 4, …), both with last row 0 0 0 1, into `out`."""
    np.multiply(left[:, 0, None], right[None, 0], out=out)
    out += left[:, 1, None] * right[None, 1]
    out += left[:, 2, None] * right[None, 2]
    out[:, 3] += left[:, 3]


def _global_rows(skeleton: Skeleton, pose: Pose, overrides: Floats | None = None) -> Floats:
    """Global matrices of one block of actors, (3, 4, N, A).

    overrides : (3, 4, N, A), NaN where a node keeps its own; nodes below follow an override.
    """
    rows = _local_rows(skeleton, pose)
    for level in skeleton.levels:
        local = rows[:, :, level]
        parents = skeleton.parents[level]
        if parents[0] < 0:
            above = skeleton.root_transform[:3].astype(pose.dtype)[:, :, None, None]
        else:
            above = rows[:, :, parents]
        product = np.empty_like(local)
        _affine_product(above, local, product)
        if overrides is not None:
            given = overrides[:, :, level]
            np.copyto(product, given, where=~np.isnan(given))
        rows[:, :, level] = product
    return rows


def _blocks(num_actors: int) -> list[slice]:
    """Actors in runs that keep a core's cache warm."""
    return [slice(start, min(start + _BLOCK, num_actors)) for start in range(0, num_actors, _BLOCK)]


def _block(pose: Pose, actors: slice) -> Pose:
    """Views of the pose of some actors."""
    return Pose(pose.translation[actors], pose.rotation[actors], pose.scale[actors])


def global_transforms(skeleton: Skeleton, pose: Pose) -> Floats:
    """Object-space matrices of every node.

    Parameters
    ----------
    skeleton : Skeleton
    pose : Pose of A actors

    Returns
    -------
    (A, N, 4, 4) float in the pose's precision
    """
    out = np.zeros((pose.num_actors, skeleton.num_nodes, 4, 4), dtype=pose.dtype)
    out[:, :, 3, 3] = 1
    for actors in _blocks(pose.num_actors):
        out[actors, :, :3] = _global_rows(skeleton, _block(pose, actors)).transpose(3, 2, 0, 1)
    return out


def skinning_rows(
    skeleton: Skeleton,
    pose: Pose,
    overrides: Floats | None = None,
    nodes_out: Floats | None = None,
) -> Floats:
    """Skinning matrices without their last row (0 0 0 1), as graphics cards want them.

    Parameters
    ----------
    skeleton : Skeleton
    pose : Pose of A actors
    overrides : (A, N, 3, 4) float, optional
        Object-space matrices from code (physics, IK). NaN where a node keeps the clip's; what hangs below follows.
    nodes_out : (A, N, 3, 4) float, optional
        Filled with the object-space matrices of the nodes, for attaching objects.

    Returns
    -------
    (A, J, 3, 4) float, contiguous: global matrix of each joint times its inverse bind matrix
    """
    out = np.empty((pose.num_actors, skeleton.num_joints, 3, 4), dtype=pose.dtype)
    inverse = np.moveaxis(skeleton.inverse_bind, 0, 2)[:3, :, :, None].astype(pose.dtype)
    for actors in _blocks(pose.num_actors):
        given = None if overrides is None else np.ascontiguousarray(overrides[actors].transpose(2, 3, 1, 0))
        rows = _global_rows(skeleton, _block(pose, actors), given)
        if nodes_out is not None:
            nodes_out[actors] = rows.transpose(3, 2, 0, 1)
        product = np.empty((3, 4, skeleton.num_joints, rows.shape[3]), dtype=pose.dtype)
        _affine_product(rows[:, :, skeleton.joint_nodes], inverse, product)
        out[actors] = product.transpose(3, 2, 0, 1)
    return out


def skinning_matrices(skeleton: Skeleton, pose: Pose) -> Floats:
    """Skinning matrices: global matrix of each joint times its inverse bind matrix.

    Parameters
    ----------
    skeleton : Skeleton
    pose : Pose of A actors

    Returns
    -------
    (A, J, 4, 4) float in the pose's precision, acting on column vectors in the mesh's space at rest
    """
    out = np.zeros((pose.num_actors, skeleton.num_joints, 4, 4), dtype=pose.dtype)
    out[:, :, 3, 3] = 1
    out[:, :, :3] = skinning_rows(skeleton, pose)
    return out
