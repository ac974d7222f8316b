"""Which level of detail, and whether anything is seen at all: errors in metres become errors in pixels.

Letters in shapes: A actors, L levels, P parts of a body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.errors import RenderError
from runtime.scene.camera import CameraMatrices
from runtime.validation import is_number, shown

Floats = NDArray[np.floating]

_CUT = -1e-30  # depth, as a negative number, of what the plane of the camera cuts: nearer than anything else
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
PREFERENCES = ("levels", "tessellation")
HYSTERESIS = 0.15  # a coarser level is taken only where its error is this part below the threshold: no flicker at rest
_FINEST_AND_COARSER = np.array([[1.0], [1.0 - HYSTERESIS]])  # parts of the error that is allowed


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
    prefer : "levels" or "tessellation"
        Whether chosen levels are drawn as they are, or divided where OpenGL 4.1 is there: rounder, and dearer. Their
        largest error is then taken as all that dividing may add to it.

    Raises
    ------
    RenderError
        If a number is not positive, or there is no such preference.
    """

    threshold_px: float = 1.0
    segment_px: float = 6.0
    texels_a_segment: float = 1.0
    prefer: str = "levels"

    def __post_init__(self) -> None:
        for name in ("threshold_px", "segment_px", "texels_a_segment"):
            value = getattr(self, name)
            if not is_number(value) or not 0.0 < value < math.inf:
                raise RenderError(f"quality: {name} is {shown(value)}, it must be a positive number")
        if self.prefer not in PREFERENCES:
            raise RenderError(f"quality: no preference {self.prefer!r}, one of {', '.join(PREFERENCES)}")


def around_eye(eye: NDArray[np.float64], transforms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Object spaces to the world's axes around the eye, (A, 4, 4) float64, of (A, 4, 4) transforms to the world."""
    rows = transforms.copy()
    rows[:, :3, 3] -= eye
    rows[:, 3] = _LAST_ROW
    return rows


def measure(
    parts: Floats, transforms: NDArray[np.float64], camera: CameraMatrices, size_px: tuple[int, int]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether actors are in view, and how large a displacement of one metre (object space) can be in the picture.

    A linear function's largest value over a box is that of the middle, and as much more as it gains along each half
    edge, this way or that. An actor is out of view where all its parts lie wholly beyond one side.

    A displacement `d` at view depth `z`, seen at an angle `t` off the axis, covers at most `d f / (z cos t)` pixels,
    with `f` the focal length in pixels: across the axis it covers `d f / z`, along it `d tan(t) f / z`. Depth and
    `tan(t)` of a convex hull are bounded by those of its parts.

    Parameters
    ----------
    parts : (A, 3, 4, P) float
        Boxes in whose convex hull an actor lies, object space: three half edges and the middle of each, as columns.
    transforms : (A, 4, 4) float64
        From `around_eye`.
    camera : CameraMatrices
    size_px : width and height of the picture

    Returns
    -------
    (A,) bool, and (A,) float64, pixels a metre, infinite where the camera's plane cuts a part
    """
    functions = camera.functions @ transforms
    along = (functions[:, :, :3] @ parts.reshape(len(parts), 3, -1)).reshape(*functions.shape, -1)
    np.abs(along[:, :, :3], out=along[:, :, :3])
    values: NDArray[np.float64] = np.add.reduce(along, axis=2)
    values += functions[:, :, 3:]
    if camera.is_perspective:  # the squared tangent of each part, in place of one of the axes that it is made of
        behind = np.minimum(values[:, 10:], _CUT, out=values[:, 10:])
        tangents = np.maximum(values[:, 6:10:2], values[:, 7:10:2])
        tangents /= behind
        tangents *= tangents
        np.add(tangents[:, 0], tangents[:, 1], out=values[:, 6])
    largest = np.maximum.reduce(values, axis=2)
    seen: NDArray[np.bool_] = np.minimum.reduce(largest[:, :6], axis=1) >= 0.0
    # The largest stretch of a matrix is at most the root of the largest row sum of its Gram matrix; equal where it
    # turns and scales evenly.
    linear = transforms[:, :3, :3]
    gram = np.abs(linear.transpose(0, 2, 1) @ linear)
    stretch_sq = np.maximum.reduce(np.add.reduce(gram, axis=2), axis=1)
    if not camera.is_perspective:
        return seen, np.sqrt(stretch_sq) * camera.focal_px(*size_px)
    stretch_sq *= 1.0 + np.minimum(largest[:, 6], camera.widest_sq)
    nearest = largest[:, 10]  # as a negative number
    size = np.sqrt(stretch_sq) * -camera.focal_px(*size_px) / nearest
    return seen, np.where(nearest < _CUT, size, np.inf)


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
    errors = monotonic_errors(errors_m)
    allowed_m = threshold_px / np.maximum(pixels_a_metre, 1e-300)
    # NaN sorts last: nothing is known, nothing differs.
    finest, coarser = errors.searchsorted(_FINEST_AND_COARSER * allowed_m, side="right") - 1
    return np.where(previous < 0, finest, np.minimum(finest, np.maximum(coarser, previous)))


def monotonic_errors(errors_m: Floats) -> NDArray[np.float64]:
    """Errors of levels, each the largest of its own and all finer ones', so that choices are monotonic in distance.

    The finest is allowed always: its error counts as nothing.
    """
    errors = np.maximum.accumulate(np.asarray(errors_m, np.float64))
    errors[0] = 0.0
    return errors
