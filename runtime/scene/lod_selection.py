"""Which level of detail, and whether anything is seen at all: errors in metres become errors in pixels.

Actors and the members of crowds are bodies that lie in boxes; one rule culls them and chooses their levels.
Letters in shapes: A bodies, L levels, P parts of a body.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import RenderError
from runtime.scene.camera import CameraMatrices
from runtime.validation import describe, is_number

Floats = NDArray[np.floating[Any]]

NEAR_DEPTHS = 1.2  # a body whose farthest point is so many times as far as its nearest is measured part by part
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
    texels_per_segment : float
        But not into pieces shorter than this many texels of the position texture, which have nothing to add.
    prefer : "levels" or "tessellation"
        Whether chosen levels are drawn as they are, or divided where OpenGL 4.1 is there: rounder, and dearer. Their
        largest error is then taken as all that dividing may add to it.
    blend_prepass : bool
        Whether blended materials first write the depth of what is nearly opaque in them: hair, leaves and feathers hide
        what lies behind them, whatever the order of their faces. Not for panes of glass behind one another.

    Raises
    ------
    RenderError
        If a number is not positive, or there is no such preference.
    """

    threshold_px: float = 1.0
    segment_px: float = 6.0
    texels_per_segment: float = 1.0
    prefer: str = "levels"
    blend_prepass: bool = False

    def __post_init__(self) -> None:
        for name in ("threshold_px", "segment_px", "texels_per_segment"):
            value = getattr(self, name)
            if not is_number(value) or not 0.0 < value < math.inf:
                raise RenderError(f"quality: {name} is {describe(value)}, it must be a positive number")
        if self.prefer not in PREFERENCES:
            raise RenderError(f"quality: no preference {self.prefer!r}, one of {', '.join(PREFERENCES)}")


def around_eye(eye: NDArray[np.float64], transforms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Object spaces to the world's axes around the eye, (A, 3, 4) float64, of (A, 4, 4) transforms to the world."""
    rows = transforms[:, :3].copy()
    rows[:, :, 3] -= eye
    return rows


def carry_boxes(low: Floats, high: Floats, rows: Floats) -> Floats:
    """Boxes carried by transforms: three half edges and the middle as columns, (3, 4, 1, A).

    Parameters
    ----------
    low, high : (3, A) float
        Corners of the boxes.
    rows : (3, 4, A) float
        Transforms. Bodies come last everywhere: inner loops are long then.
    """
    carried = np.empty((3, 4, 1, rows.shape[2]), rows.dtype)
    np.multiply(rows[:, :3], (high - low) / 2, out=carried[:, :3, 0])
    middle = (low + high) / 2
    carried[:, 3, 0] = rows[:, 0] * middle[0] + rows[:, 1] * middle[1] + rows[:, 2] * middle[2] + rows[:, 3]
    return carried


def carry_parts(parts: Floats, rows: Floats) -> Floats:
    """Boxes of the parts of bodies, (A, 3, 4, P), carried by transforms (A, 3, 4): (3, 4, P, A) as there."""
    carried = np.einsum("arc,ackp->rkpa", rows[:, :, :3], parts)
    carried[:, 3] += rows[:, :, 3].T[:, None]
    return np.ascontiguousarray(carried)


def largest_stretch(linear: Floats) -> Floats:
    """How many times as long matrices (A, 3, 3) can make a vector at most, (A,).

    The root of the largest row sum of the Gram matrix: exact where a matrix turns and scales evenly.
    """
    gram = np.abs(linear.transpose(0, 2, 1) @ linear)
    stretch: Floats = np.sqrt(np.maximum.reduce(np.add.reduce(gram, axis=2), axis=1))
    return stretch


def _measure(parts: Floats, camera: CameraMatrices, size_px: tuple[int, int]) -> tuple[NDArray[np.bool_], Floats]:
    """Seen (A,), and pixels per metre (A,); see `measure`.

    A linear function's largest value over a box is that of the middle, and as much more as it gains along each half
    edge, this way or that. Ratios of such functions are largest and smallest over the corners of a convex hull.
    """
    functions = camera.functions.astype(parts.dtype)
    along = np.einsum("fr,r...->f...", functions[:, :3], parts)
    edges = np.abs(along[:, :3], out=along[:, :3])
    reach = edges[:, 0] + edges[:, 1] + edges[:, 2]
    middle = along[:, 3] + functions[:, 3, None, None]
    inside = np.maximum.reduce(middle[:6] + reach[:6], axis=1)
    seen: NDArray[np.bool_] = np.minimum.reduce(inside, axis=0) >= 0.0
    low, high = middle[6:] - reach[6:], middle[6:] + reach[6:]  # of clip space's w, x and y
    nearest = np.minimum.reduce(low[0], axis=0)
    in_front = nearest > 0.0
    near, far = np.where(in_front, low[0], 1.0), np.where(in_front, high[0], 1.0)
    left, below = (np.minimum.reduce(low[k] / np.where(low[k] < 0, near, far), axis=0).clip(-1, 1) for k in (1, 2))
    right, above = (np.maximum.reduce(high[k] / np.where(high[k] > 0, near, far), axis=0).clip(-1, 1) for k in (1, 2))
    magnified = camera.magnification(left, right, below, above, size_px)
    size = np.where(in_front, magnified / np.where(in_front, nearest, 1.0), np.inf)
    return seen, size


def measure(
    boxes: Floats,
    stretch: Floats,
    camera: CameraMatrices,
    size_px: tuple[int, int],
    parts_of: Callable[[NDArray[np.int64]], Floats],
) -> tuple[NDArray[np.bool_], Floats]:
    """Whether bodies are in view, and how large a displacement of one metre (object space) can be in the picture.

    A body is out of view where it lies wholly beyond one side. A point is seen at x = X / W of clip space, so a
    displacement d moves it by (X(d) - x W(d)) / W, and y likewise: largest at the least W and, being convex, at a
    corner of the body's extent in the picture. So it holds for any matrix: of any aspect, off centre, without
    perspective.

    Parameters
    ----------
    boxes : (3, 4, 1, A) float
        Box of each body in the world's axes around the eye, from `carry_boxes`.
    stretch : (A,) float
        From `largest_stretch`.
    camera : CameraMatrices
    size_px : width and height of the picture
    parts_of : function from (K,) numbers of bodies to (3, 4, P, K) float
        Boxes in whose convex hull they lie, from `carry_parts`. Asked of those in view that are so near that it makes
        a difference.

    Returns
    -------
    (A,) bool, and (A,) float, pixels per metre, infinite where the camera's plane cuts a body
    """
    w = camera.functions[6].astype(boxes.dtype)
    along = np.einsum("r,rka->ka", w[:3], boxes[:, :, 0])
    reach, middle = np.add.reduce(np.abs(along[:3]), axis=0), along[3] + w[3]
    near = np.flatnonzero(~(middle + reach <= NEAR_DEPTHS * (middle - reach)))
    if len(near) == boxes.shape[3]:
        seen, size = _measure(parts_of(near), camera, size_px)
    else:
        seen, size = _measure(boxes, camera, size_px)
        near = near[seen[near]]
        if len(near):
            seen[near], size[near] = _measure(parts_of(near), camera, size_px)
    return seen, size * stretch


def choose_levels(
    errors_m: Floats, pixels_per_metre: Floats, threshold_px: float, previous: NDArray[np.integer]
) -> NDArray[np.int64]:
    """The coarsest level of each actor whose error stays under the threshold.

    Parameters
    ----------
    errors_m : (L,) float
        Of each level, the finest first.
    pixels_per_metre : (A,) float
    threshold_px : float
    previous : (A,) int
        Levels of the last picture, -1 for none. A coarser one than that is taken only well below the threshold
        (`HYSTERESIS`), so that nothing changes while nothing moves.

    Returns
    -------
    (A,) int64
    """
    errors = monotonic_errors(errors_m)
    allowed_m = threshold_px / np.maximum(pixels_per_metre, 1e-300)
    # NaN sorts last: nothing is known, nothing differs.
    finest, coarser = errors.searchsorted(_FINEST_AND_COARSER * allowed_m, side="right") - 1
    return np.asarray(np.where(previous < 0, finest, np.minimum(finest, np.maximum(coarser, previous))))


def monotonic_errors(errors_m: Floats) -> NDArray[np.float64]:
    """Errors of levels, each the largest of its own and all finer ones', so that choices are monotonic in distance.

    The finest is allowed always: its error counts as nothing.
    """
    errors = np.maximum.accumulate(np.asarray(errors_m, np.float64))
    errors[0] = 0.0
    return errors
