"""Where the picture is seen from: a view and a projection, right-handed, +Y up, looking along -Z.

Positions reach the GPU relative to the eye (float64 here, float32 there), so worlds may be kilometres wide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.errors import RenderError
from runtime.validation import describe, is_number, numbers

Matrix = NDArray[np.float64]

FARTHEST = 1e12  # metres: what lies beyond is a mistake, and overflows on the GPU
NEAR_OF_DISTANCE = 2e-3  # default near plane, of the distance from eye to target
FAR_OF_DISTANCE = 1e3
FRAMING_DIRECTION = (0.42, 0.16, 1.0)  # a little from the side and above: shows depth without hiding the face


Vector = tuple[float, float, float]
Ray = tuple[NDArray[np.float64], NDArray[np.float64]]
# `CameraMatrices.functions` out of the rows of clip space: w and x, w and y, w and z, w less each; then w, x, y alone.
_FUNCTIONS = np.concatenate([np.c_[np.eye(3), np.ones(3)], np.c_[-np.eye(3), np.ones(3)], np.eye(4)[[3, 0, 1]]])


def _cross(a: Vector, b: Vector) -> Vector:
    """Cross product of two vectors: single vectors are quicker as plain numbers than as arrays."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _vector(numbers: ArrayLike) -> Vector:
    """Three finite numbers.

    Raises
    ------
    RenderError
    """
    try:
        x, y, z = map(float, numbers)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and abs(z) <= FARTHEST):  # NaN is not
        raise RenderError(f"the camera's eye, target and up must be three finite numbers each, up to {FARTHEST:g}")
    return x, y, z


@dataclass(frozen=True)
class CameraMatrices:
    """A camera for one picture.

    Attributes
    ----------
    eye : (3,) float64
        In the world, metres.
    rotation : (3, 3) float64
        World axes to view axes.
    projection : (4, 4) float64
        View to clip space, OpenGL's depth from -1 to 1.
    clip_from_world : (4, 4) float64
        World axes with the origin at the eye to clip space.
    functions : (9, 4) float64
        Linear functions of a point seen from the eye, whose last factor is that of one: six that are negative beyond a
        side of the view, then w, x and y of clip space.
    is_perspective : bool
        Whether size shrinks with distance.
    """

    eye: NDArray[np.float64]
    rotation: Matrix
    projection: Matrix
    clip_from_world: Matrix = field(init=False)
    functions: Matrix = field(init=False)
    is_perspective: bool = field(init=False)
    _gram: tuple[tuple[float, ...], ...] = field(init=False)

    def __post_init__(self) -> None:
        clip = self.projection.copy()
        clip[:, :3] = self.projection[:, :3].dot(self.rotation)
        ways = clip[[0, 1, 3], :3]
        for name, value in (
            ("clip_from_world", clip),
            ("functions", _FUNCTIONS.dot(clip)),
            ("is_perspective", bool(self.projection[3, :3].any())),
            ("_gram", tuple(map(tuple, ways.dot(ways.T).tolist()))),
        ):
            object.__setattr__(self, name, value)

    def magnification(self, left: Any, right: Any, below: Any, above: Any, size_px: tuple[int, int]) -> Any:
        """Most pixels that a metre covers at depth w = 1, anywhere in parts (A,) of the picture, -1 to 1 each way.

        The square of the largest singular value of the derivatives of both pixel coordinates, (width / 2) (X - x W) and
        (height / 2) (Y - y W), X, Y and W being the directions along which clip space's x, y and w grow.
        """
        (xx, xy, xw), (_, yy, yw), (_, _, ww) = self._gram
        width, height = size_px[0] / 2, size_px[1] / 2
        largest: Any = 0.0
        for x in (left, right):
            across = width * width * ((x * ww - 2 * xw) * x + xx)
            shared = width * height * (x * ww - xw), width * height * (xy - x * yw)
            for y in (below, above):
                down = height * height * ((y * ww - 2 * yw) * y + yy)
                both = shared[0] * y + shared[1]
                half = across - down
                largest = np.maximum(largest, across + down + np.sqrt(half * half + 4 * both * both))
        return np.sqrt(largest / 2)

    @property
    def depth_per_metre(self) -> float:
        """Most that a metre adds to clip space's w: one with perspective as usual, nothing without."""
        return math.sqrt(self._gram[2][2])

    def focal_px(self, width: int, height: int) -> float:
        """Pixels that a metre covers at depth one, or anywhere without perspective, along the longer way."""
        (xx, _, xw), (_, yy, yw), (_, _, ww) = self._gram
        per_depth = 1.0 / ww if ww else 0.0  # what lies along the depth counts for a picture off centre alone
        return max(math.sqrt(xx - xw * xw * per_depth) * width, math.sqrt(yy - yw * yw * per_depth) * height) / 2


def _ray(camera: CameraMatrices, point_px: ArrayLike, size_px: tuple[int, int]) -> Ray:
    """The ray of `Camera.ray`, from matrices."""
    (x, y), (width, height) = numbers(point_px, "a point of the picture").reshape(2), size_px
    if width < 1 or height < 1:
        raise ValueError(f"a picture of {width} x {height} pixels has no rays")
    on_screen = np.array([2 * x / width - 1, 1 - 2 * y / height])
    ends = np.linalg.solve(camera.projection, np.array([[*on_screen, -1, 1], [*on_screen, 1, 1]]).T).T
    start, end = ends[:, :3] / ends[:, 3:]
    direction = (end - start) @ camera.rotation
    origin = np.zeros(3) if camera.is_perspective else start @ camera.rotation
    return camera.eye + origin, direction / np.linalg.norm(direction)


@dataclass(frozen=True)
class Camera:
    """An eye that looks at a target.

    Attributes
    ----------
    eye, target, up : three numbers each, metres
    fovy_deg : float
        Vertical field of view, degrees.
    near_m, far_m : float or None
        Clipping distances; None: from the distance between eye and target.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    fovy_deg: float = 35.0
    near_m: float | None = None
    far_m: float | None = None

    @classmethod
    def first_person(
        cls,
        eye: ArrayLike,
        heading: float,
        pitch: float = 0.0,
        *,
        fovy_deg: float = 60.0,
        near_m: float = 0.05,
        far_m: float = 1000.0,
    ) -> Camera:
        """A camera in somebody's head.

        Parameters
        ----------
        eye : (3,) float, metres
        heading : float
            Radians about +Y from +Z, as of `Crowd.place_on_ground`: a quarter turn looks along +X.
        pitch : float
            Radians upwards.
        fovy_deg, near_m, far_m
            As of a camera.

        Raises
        ------
        ValueError
            When a number is not finite.
        """
        x, y, z = numbers(eye, "the eye").reshape(3).tolist()
        around, above = float(numbers(heading, "heading")), float(numbers(pitch, "pitch"))
        level = math.cos(above)
        target = x + level * math.sin(around), y + math.sin(above), z + level * math.cos(around)
        up = -math.sin(above) * math.sin(around), level, -math.sin(above) * math.cos(around)
        return cls((x, y, z), target, up, fovy_deg, near_m, far_m)

    def ray(self, point_px: ArrayLike, size_px: tuple[int, int]) -> Ray:
        """What lies under a point of the picture: origin (3,), metres, and unit direction (3,) in the world.

        Parameters
        ----------
        point_px : x and y from the upper left corner, as a mouse has them
        size_px : width and height of the picture
        """
        return _ray(self.matrices(*size_px), point_px, size_px)

    def matrices(self, width: int, height: int) -> CameraMatrices:
        """View and projection for a picture of this size, pixels.

        Raises
        ------
        RenderError
            If eye and target coincide, a number is not finite, or the angle or the distances make no sense.
        """
        eye, target, up = _vector(self.eye), _vector(self.target), _vector(self.up)
        if not is_number(self.fovy_deg) or not 0.0 < self.fovy_deg < 180.0:
            told = describe(self.fovy_deg)
            raise RenderError(f"the camera's field of view is {told} degrees: it must lie between 0 and 180")
        if not (self.near_m is None or is_number(self.near_m)) or not (self.far_m is None or is_number(self.far_m)):
            raise RenderError("the camera's near_m and far_m must be numbers, or None to be chosen")
        distance = math.dist(eye, target)
        if distance == 0.0:
            raise RenderError("the camera's eye and target are the same point: move one of them")
        near = NEAR_OF_DISTANCE * distance if self.near_m is None else float(self.near_m)
        far = FAR_OF_DISTANCE * distance if self.far_m is None else float(self.far_m)
        if not 0.0 < near < far < math.inf:
            raise RenderError(
                f"the camera's near and far planes are at {near} and {far} m: near must be positive and less"
            )
        x, y, z = (target[0] - eye[0]) / distance, (target[1] - eye[1]) / distance, (target[2] - eye[2]) / distance
        forward = x, y, z
        right = _cross(forward, up)
        length = math.hypot(*right)
        if length < 1e-9 * max(math.hypot(*up), 1e-30):  # straight up or down
            right = _cross(forward, (0.0, 0.0, -1.0 if y > 0 else 1.0))
            length = math.hypot(*right)
            if length < 1e-9:
                right, length = (1.0, 0.0, 0.0), 1.0
        right = right[0] / length, right[1] / length, right[2] / length
        rotation = np.array([right, _cross(right, forward), (-x, -y, -z)])
        return CameraMatrices(np.array(eye), rotation, perspective(self.fovy_deg, width / max(height, 1), near, far))


@dataclass(frozen=True)
class MatrixCamera:
    """A camera given by matrices, for callers that have their own.

    Attributes
    ----------
    view : (4, 4) float
        World to view space, rigid.
    projection : (4, 4) float
        View to clip space.
    """

    view: ArrayLike
    projection: ArrayLike

    def ray(self, point_px: ArrayLike, size_px: tuple[int, int]) -> Ray:
        """As of `Camera`."""
        return _ray(self.matrices(*size_px), point_px, size_px)

    def matrices(self, width: int, height: int) -> CameraMatrices:
        """The same matrices, whatever the size of the picture.

        Raises
        ------
        RenderError
            If a matrix is not 4 x 4 and finite, or the view scales or shears.
        """
        view, projection = (np.asarray(matrix, np.float64) for matrix in (self.view, self.projection))
        for name, matrix in (("view", view), ("projection", projection)):
            if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
                raise RenderError(f"the camera's {name} matrix must be 4 x 4 finite numbers")
        rotation = view[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise RenderError("the camera's view matrix scales or shears: put the scale into the actors' transforms")
        return CameraMatrices(-rotation.T @ view[:3, 3], rotation, projection)


@runtime_checkable
class CameraLike(Protocol):
    """What pictures can be seen from."""

    def matrices(self, width: int, height: int) -> CameraMatrices:
        """View and projection for a picture of this size, pixels."""


def perspective(fovy_deg: float, aspect: float, near_m: float, far_m: float) -> Matrix:
    """OpenGL's perspective projection, (4, 4) float64."""
    focal, depth = 1.0 / math.tan(math.radians(fovy_deg) / 2), near_m - far_m
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = focal / aspect, focal
    projection[2, 2], projection[2, 3] = (far_m + near_m) / depth, 2 * far_m * near_m / depth
    projection[3, 2] = -1.0
    return projection


def framing(
    box: ArrayLike,
    aspect: float = 1.0,
    fovy_deg: float = 35.0,
    direction: ArrayLike = FRAMING_DIRECTION,
    margin: float = 1.0,
) -> Camera:
    """A camera that shows all of a box, with a little air around it.

    Parameters
    ----------
    box : (2, 3) float
        Smallest and largest corner, metres.
    aspect : float
        Width over height of the picture.
    fovy_deg : float
    direction : (3,) float
        From the box towards the eye.
    margin : float
        Size of the picture over the size of what it shows.

    Raises
    ------
    ValueError
        If a number is not finite, or the direction, the aspect or the angle makes no sense.
    """
    corners, towards = numbers(box, "a box"), numbers(direction, "a direction")
    if corners.shape != (2, 3) or towards.shape != (3,) or not towards.any():
        raise ValueError("framing needs a box of two points and a direction that is not zero")
    if not (is_number(aspect) and aspect > 0 and is_number(fovy_deg) and 0 < fovy_deg < 180):
        raise ValueError(
            f"framing needs an aspect above 0 and 0 to 180 degrees, not {describe(aspect)}, {describe(fovy_deg)}"
        )
    towards = towards / np.linalg.norm(towards)
    centre = corners.mean(axis=0)
    right = np.cross((0.0, 1.0, 0.0), towards)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else np.array([1.0, 0.0, 0.0])
    up = np.cross(towards, right)
    points = np.array(np.meshgrid(*corners.T, indexing="ij")).reshape(3, -1).T - centre
    tangent = np.tan(np.radians(fovy_deg) / 2)
    needed = np.maximum(np.abs(points @ up) / tangent, np.abs(points @ right) / (tangent * aspect)) * margin
    distance = float((needed + points @ towards).max())
    distance = max(distance, 1e-6)
    eye = centre + towards * distance
    return Camera(tuple(eye), tuple(centre), fovy_deg=fovy_deg)
