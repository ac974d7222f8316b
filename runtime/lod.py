"""Which level of detail, and whether anything is seen at all: errors in metres become errors in pixels.

Letters in shapes: A actors, L levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.camera import CameraMatrices

Floats = NDArray[np.floating]

HYSTERESIS = 0.15  # a coarser level is taken only where its error is this part below the threshold: no flicker at rest


@dataclass(frozen=True)
class Quality:
    """How good the picture is to be.

    Attributes
    ----------
    threshold_px : float
        Largest error on the screen that the chosen level of detail may have, pixels.
    segment_px : float
        Adaptive tessellation divides edges into pieces of about this length, pixels.
    texels_a_segment : float
        But not into pieces shorter than this many texels of the position texture, which have nothing to add.
    """

    threshold_px: float = 1.0
    segment_px: float = 6.0
    texels_a_segment: float = 1.0


def corners_of(boxes: Floats) -> NDArray[np.float64]:
    """The eight corners of boxes, (A, 2, 3) to (A, 8, 3) float64."""
    picks = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)])
    return np.asarray(boxes, np.float64)[:, picks, np.arange(3)]


def transform_boxes(boxes: Floats, transforms: Floats) -> NDArray[np.float64]:
    """Corners of object-space boxes in the world: (A, 2, 3) and (A, 4, 4) to (A, 8, 3) float64."""
    matrices = np.asarray(transforms, np.float64)
    return corners_of(boxes) @ matrices[:, :3, :3].transpose(0, 2, 1) + matrices[:, None, :3, 3]


def visible(corners: Floats, camera: CameraMatrices) -> NDArray[np.bool_]:
    """Which boxes may be seen: not all eight corners beyond one side of the view. (A, 8, 3) to (A,) bool."""
    seen_from_eye = corners - camera.eye
    clip = seen_from_eye @ camera.clip_from_world[:, :3].T + camera.clip_from_world[:, 3]
    position, limit = clip[..., :3], clip[..., 3:]
    beyond = np.all(position < -limit, axis=1) | np.all(position > limit, axis=1)
    inside: NDArray[np.bool_] = ~np.any(beyond, axis=1)
    return inside


def pixels_per_metre(
    corners: Floats, transforms: Floats, camera: CameraMatrices, height_px: int
) -> NDArray[np.float64]:
    """Largest size in pixels that a displacement of one metre (object space) of each actor can have in the picture.

    A displacement `d` at view depth `z`, seen at an angle `t` off the axis, covers at most `d f / (z cos t)` pixels,
    with `f` the focal length in pixels: across the axis it covers `d f / z`, along it `d tan(t) f / z`.

    Parameters
    ----------
    corners : (A, 8, 3) float
        Of the actors' boxes in the world.
    transforms : (A, 4, 4) float
    camera : CameraMatrices
    height_px : int

    Returns
    -------
    (A,) float64, infinite where the camera is inside the box
    """
    scale = np.linalg.norm(np.asarray(transforms, np.float64)[:, :3, :3], axis=(1, 2), ord=2)
    focal_px = camera.projection[1, 1] * height_px / 2
    if not camera.is_perspective:
        return scale * focal_px
    seen = (corners - camera.eye) @ camera.rotation.T
    depth = -seen[..., 2]
    nearest = depth.min(axis=1)
    half_picture = 1.0 / np.array([camera.projection[0, 0], camera.projection[1, 1]])
    widest = float(np.hypot(*half_picture))
    with np.errstate(divide="ignore", invalid="ignore"):
        off_axis = np.where(
            nearest > 0, (np.hypot(seen[..., 0], seen[..., 1]) / np.maximum(depth, 1e-300)).max(axis=1), widest
        )
        across = np.sqrt(1.0 + np.minimum(off_axis, widest) ** 2)
        return np.where(nearest > 0, scale * focal_px * across / np.maximum(nearest, 1e-300), np.inf)


def choose_levels(
    errors_m: Floats, pixels_a_metre: Floats, threshold_px: float, previous: NDArray[np.integer]
) -> NDArray[np.int64]:
    """The coarsest level of each actor whose error stays under the threshold.

    Parameters
    ----------
    errors_m : (L,) float
        Of each level, the finest first.
    pixels_a_metre : (A,) float
    threshold_px : float
    previous : (A,) int
        Levels of the last picture, -1 for none. A coarser one than that is taken only well below the threshold
        (`HYSTERESIS`), so that nothing changes while nothing moves.

    Returns
    -------
    (A,) int64
    """
    # A level's error is the largest of its own and all finer ones', so that the choice is monotonic in distance.
    errors = np.maximum.accumulate(np.asarray(errors_m, np.float64))
    errors[0] = 0.0  # the finest is allowed always
    with np.errstate(invalid="ignore"):
        error_px = np.nan_to_num(
            errors[None, :] * np.asarray(pixels_a_metre, np.float64)[:, None], nan=0.0, posinf=np.inf
        )
    allowed = np.where(
        np.arange(len(errors)) > np.where(previous < 0, len(errors), previous)[:, None], 1 - HYSTERESIS, 1.0
    )
    good = error_px <= threshold_px * allowed
    good[:, 0] = True
    return len(errors) - 1 - np.argmax(good[:, ::-1], axis=1)
