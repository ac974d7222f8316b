"""Where the picture is seen from: a view and a projection, right-handed, +Y up, looking along -Z.

Positions reach the GPU relative to the eye (float64 here, float32 there), so worlds may be kilometres wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.errors import RenderError

Matrix = NDArray[np.float64]

NEAR_OF_DISTANCE = 2e-3  # default near plane, of the distance from eye to target
FAR_OF_DISTANCE = 1e3
FRAMING_DIRECTION = (0.42, 0.16, 1.0)  # a little from the side and above: shows depth without hiding the face


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product of two vectors; NumPy's takes ten times as long."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


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
    """

    eye: NDArray[np.float64]
    rotation: Matrix
    projection: Matrix

    @property
    def is_perspective(self) -> bool:
        """Whether size shrinks with distance."""
        return bool(self.projection[3, 2] != 0.0)

    @property
    def clip_from_world(self) -> Matrix:
        """World axes with the origin at the eye to clip space, (4, 4) float64."""
        view = np.eye(4)
        view[:3, :3] = self.rotation
        return self.projection @ view


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

    def matrices(self, width: int, height: int) -> CameraMatrices:
        """View and projection for a picture of this size, pixels.

        Raises
        ------
        RenderError
            If eye and target coincide, a number is not finite, or the angle or the distances make no sense.
        """
        eye, target, up = (np.asarray(point, np.float64) for point in (self.eye, self.target, self.up))
        if not all(point.shape == (3,) and np.isfinite(point).all() for point in (eye, target, up)):
            raise RenderError("the camera's eye, target and up must be three finite numbers each")
        if not 0.0 < self.fovy_deg < 180.0:
            raise RenderError(f"the camera's field of view is {self.fovy_deg} degrees: it must lie between 0 and 180")
        forward = target - eye
        distance = float(np.linalg.norm(forward))
        if distance == 0.0:
            raise RenderError("the camera's eye and target are the same point: move one of them")
        near = NEAR_OF_DISTANCE * distance if self.near_m is None else float(self.near_m)
        far = FAR_OF_DISTANCE * distance if self.far_m is None else float(self.far_m)
        if not 0.0 < near < far < np.inf:
            raise RenderError(
                f"the camera's near and far planes are at {near} and {far} m: near must be positive and less"
            )
        forward = forward / distance
        right = _cross(forward, up)
        if np.linalg.norm(right) < 1e-9 * max(float(np.linalg.norm(up)), 1e-30):  # straight up or down
            right = _cross(forward, np.array([0.0, 0.0, -1.0 if forward[1] > 0 else 1.0]))
            if np.linalg.norm(right) < 1e-9:
                right = np.array([1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.array([right, _cross(right, forward), -forward])
        return CameraMatrices(eye, rotation, perspective(self.fovy_deg, width / max(height, 1), near, far))


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


def perspective(fovy_deg: float, aspect: float, near_m: float, far_m: float) -> Matrix:
    """OpenGL's perspective projection, (4, 4) float64."""
    focal = 1.0 / np.tan(np.radians(fovy_deg) / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = focal / aspect, focal
    matrix[2, 2], matrix[2, 3] = (far_m + near_m) / (near_m - far_m), 2 * far_m * near_m / (near_m - far_m)
    matrix[3, 2] = -1.0
    return matrix


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
    """
    corners = np.asarray(box, np.float64)
    towards = np.asarray(direction, np.float64) / np.linalg.norm(np.asarray(direction, np.float64))
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
    return Camera(tuple(eye), tuple(centre), fovy_deg=fovy_deg)  # type: ignore[arg-type]
