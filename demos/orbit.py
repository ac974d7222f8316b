"""A camera that circles a target: turned, moved and brought nearer by the mouse."""

from __future__ import annotations

import numpy as np

from runtime.scene.camera import Camera

STEEPEST = np.radians(88.0)


class Orbit:
    """The angles and the distance of an eye around its target.

    Parameters
    ----------
    camera : Camera
        Where to start.
    """

    def __init__(self, camera: Camera) -> None:
        self.target = np.array(camera.target, np.float64)
        towards = np.array(camera.eye, np.float64) - self.target
        self.distance = float(np.linalg.norm(towards))
        self.around = float(np.arctan2(towards[0], towards[2]))
        self.above = float(np.arcsin(np.clip(towards[1] / self.distance, -1, 1)))
        self.fovy_deg = camera.fovy_deg

    def turn(self, dx_px: float, dy_px: float) -> None:
        """Circle by a mouse movement."""
        self.around -= 0.008 * dx_px
        self.above = float(np.clip(self.above + 0.008 * dy_px, -STEEPEST, STEEPEST))

    def move(self, dx_px: float, dy_px: float, height_px: int) -> None:
        """Shift the target so that it stays under the mouse."""
        metres = 2 * self.distance * np.tan(np.radians(self.fovy_deg) / 2) / max(height_px, 1)
        right = np.array([np.cos(self.around), 0.0, -np.sin(self.around)])
        up = np.cross(self._towards(), right)
        self.target += metres * (up * dy_px - right * dx_px)

    def zoom(self, steps: float) -> None:
        """Come nearer (positive) or go away by steps of the wheel."""
        self.distance *= 0.9**steps

    def _towards(self) -> np.ndarray:
        level = np.cos(self.above)
        return np.array([level * np.sin(self.around), np.sin(self.above), level * np.cos(self.around)])

    def camera(self) -> Camera:
        """The camera now."""
        eye = self.target + self.distance * self._towards()
        return Camera(tuple(eye), tuple(self.target), fovy_deg=self.fovy_deg)  # type: ignore[arg-type]
