"""A camera for shadow maps: parallel rays from the sun onto a ball."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from runtime.scene.camera import MatrixCamera


def sun_camera(sun_direction: ArrayLike, centre: ArrayLike, radius_m: float) -> MatrixCamera:
    """A camera that sees all of a ball from the sun.

    Parameters
    ----------
    sun_direction : (3,) float
        Towards the sun.
    centre : (3,) float
    radius_m : float
    """
    backward = np.asarray(sun_direction, np.float64) / np.linalg.norm(np.asarray(sun_direction, np.float64))
    helper = np.array([0.0, 0.0, 1.0]) if abs(backward[1]) > 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(helper, backward)
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(backward, right), backward])
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = -rotation @ (np.asarray(centre, np.float64) + 2 * radius_m * backward)
    projection = np.diag([1 / radius_m, 1 / radius_m, -1 / radius_m, 1.0])
    projection[2, 3] = -2.0
    return MatrixCamera(view, projection)
