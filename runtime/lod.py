"""Which level of detail, and whether anything is seen at all: errors in metres become errors in pixels.

Letters in shapes: A actors, L levels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.camera import CameraMatrices
from runtime.errors import RenderError
from runtime.given import is_number, shown

Floats = NDArray[np.floating]

PREFERENCES = ("levels", "tessellation")
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


@dataclass(frozen=True)
class Bodies:
    """Where actors are, each with a box of its own and parts in whose convex hull it lies.

    Attributes
    ----------
    boxes : (A, 2, 3) float
        Object space.
    parts : two (A, P, 3) float
        Middles and reaches of the parts' boxes, object space.
    transforms : (A, 4, 4) float64
        Object space to world.
    """

    boxes: Floats
    parts: tuple[Floats, Floats]
    transforms: NDArray[np.float64]


def in_view(bodies: Bodies, camera: CameraMatrices) -> NDArray[np.bool_]:
    """False where an actor's box lies wholly beyond one side of the view, (A,)."""
    linear = bodies.transforms[:, :3, :3]
    half = (bodies.boxes[:, 1] - bodies.boxes[:, 0]) * 0.5
    centre = bodies.boxes[:, 0] + half
    sides = camera.sides[:, :3] @ linear
    reach = (np.abs(sides) * half[:, None]).sum(axis=2)
    origin = (bodies.transforms[:, :3, 3] - camera.eye) @ camera.sides[:, :3].T + camera.sides[:, 3]
    inside: NDArray[np.bool_] = ((sides * centre[:, None]).sum(axis=2) + reach + origin >= 0.0).all(axis=1)
    return inside


def pixels_a_metre(bodies: Bodies, camera: CameraMatrices, size_px: tuple[int, int]) -> NDArray[np.float64]:
    """Largest size in pixels that a displacement of one metre (object space) of each actor can have in the picture.

    A displacement `d` at view depth `z`, seen at an angle `t` off the axis, covers at most `d f / (z cos t)` pixels,
    with `f` the focal length in pixels: across the axis it covers `d f / z`, along it `d tan(t) f / z`. Depth and
    `tan(t)` of a convex hull are bounded by those of its parts.

    Parameters
    ----------
    bodies : Bodies
    camera : CameraMatrices
    size_px : width and height of the picture

    Returns
    -------
    (A,) float64, infinite where the camera's plane cuts a part
    """
    linear = bodies.transforms[:, :3, :3]
    # The largest stretch of a matrix is at most the root of the largest row sum of its Gram matrix; equal where it
    # turns and scales evenly.
    scale = np.sqrt(np.abs(linear.transpose(0, 2, 1) @ linear).sum(axis=2).max(axis=1)) * camera.focal_px(*size_px)
    if not camera.is_perspective:
        return np.asarray(scale)
    axes = camera.rotation @ linear
    middles, reaches = bodies.parts
    place = middles @ axes.transpose(0, 2, 1)
    place += ((bodies.transforms[:, :3, 3] - camera.eye) @ camera.rotation.T)[:, None]
    reach = reaches @ np.abs(axes).transpose(0, 2, 1)
    depth = -(place[..., 2] + reach[..., 2])
    aside = np.abs(place[..., :2]) + reach[..., :2]
    nearest = depth.min(axis=1)
    tangent_sq = ((aside**2).sum(axis=2) / np.maximum(depth, 1e-30) ** 2).max(axis=1)
    across = np.sqrt(1.0 + np.minimum(tangent_sq, camera.widest_sq))
    return np.where(nearest > 0.0, scale * across / np.maximum(nearest, 1e-30), np.inf)


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
    finest = np.searchsorted(errors, allowed_m, side="right") - 1  # NaN sorts last: nothing is known, nothing differs
    coarser = np.searchsorted(errors, allowed_m * (1 - HYSTERESIS), side="right") - 1
    return np.where(previous < 0, finest, np.minimum(finest, np.maximum(coarser, previous)))


def monotonic_errors(errors_m: Floats) -> NDArray[np.float64]:
    """Errors of levels, each the largest of its own and all finer ones', so that choices are monotonic in distance.

    The finest is allowed always: its error counts as nothing.
    """
    errors = np.maximum.accumulate(np.asarray(errors_m, np.float64))
    errors[0] = 0.0
    return errors
