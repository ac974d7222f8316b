"""Light: one sun, and all that comes from around, mirrored and on a white sheet, as small maps by direction.

The maps are two half spheres laid flat side by side, each from the opposite pole (stereographically), in which a shader
finds its way without trigonometry. Each goes on a little beyond the horizon, so that filtering sees no seam. Light on a
white sheet comes from nine harmonics.

Sources: Ramamoorthi and Hanrahan 2001 (irradiance from nine spherical harmonics); Karis 2013 (a radiance map filtered
a level a roughness); Heidrich and Seidel 1998 (maps of two half spheres).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.errors import RenderError
from runtime.validation import describe, is_number, numbers

NUM_LEVELS = 6  # roughness of level k is (k / 5)^2 (shaders/include/lighting.glsl)
MAP_SIZE = 160  # a side of a half sphere's square at level 0
REACH = 0.8  # of it belongs to the half sphere; the rest is half a texel a side at the last level
PANORAMA_SIZE = (128, 256)  # rows, columns that a panorama is brought to
FILTER_SIZE = (32, 64)  # what the rough levels are filtered from
FILTERED_AT_ONCE = 64  # directions: what is computed for them stays in the processor's cache


def map_directions(size: int) -> NDArray[np.float64]:
    """Unit vectors (size, 2 size, 3) of a map's texels: x along columns, z along rows, +Y in the left middle."""
    places = ((np.arange(size) + 0.5) / size * 2 - 1) / REACH
    x, z = np.meshgrid(places, places)
    far_sq = x * x + z * z
    upper = np.stack([2 * x, 1 - far_sq, 2 * z], axis=-1) / (1 + far_sq)[..., None]
    return np.concatenate([upper, upper * (1, -1, 1)], axis=1)


def _directions(rows: int, columns: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (rows, columns, 3) of a longitude-latitude image, row 0 up, and the solid angle of each row."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    around = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    level = np.sin(polar)[:, None]
    directions = np.stack(
        [level * np.sin(around), np.broadcast_to(np.cos(polar)[:, None], (rows, columns)), -level * np.cos(around)],
        axis=-1,
    )
    return directions, np.sin(polar) * (np.pi / rows) * (2 * np.pi / columns)


def _shrink(image: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float64]:
    """Area average to a size that divides the image's."""
    cells = image.reshape(rows, image.shape[0] // rows, columns, image.shape[1] // columns, 3)
    return np.asarray(cells.mean(axis=(1, 3)))


def _resample(image: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float64]:
    """Averages over equal cells of any image, or repeated texels of a smaller one."""
    at_rows = np.linspace(0, image.shape[0], rows * 4, endpoint=False).astype(int)
    at_columns = np.linspace(0, image.shape[1], columns * 4, endpoint=False).astype(int)
    return _shrink(image[at_rows][:, at_columns], rows, columns)


def _irradiance(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (9, 3) of irradiance / pi in the polynomials of `diffuse_light`."""
    directions, solid_angle = _directions(*image.shape[:2])
    x, y, z = np.moveaxis(directions, -1, 0)
    basis = np.stack([
        np.full_like(x, 0.282095), 0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z,
        0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y),
    ])  # fmt: skip
    moments = np.einsum("krc,rcn,r->kn", basis, image, solid_angle)
    cosine_lobe = np.array([1.0] + [2 / 3] * 3 + [1 / 4] * 5)  # divided by pi
    factors = np.array([0.282095] + [0.488603] * 3 + [1.092548] * 2 + [0.315392, 1.092548, 0.546274])
    return np.asarray(moments * (cosine_lobe * factors)[:, None])


def _looked_up(image: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A panorama's radiance in directions (..., 3), blended between its texels."""
    rows, columns = image.shape[:2]
    down = np.arccos(np.clip(directions[..., 1], -1, 1)) / np.pi * rows - 0.5
    across = (np.arctan2(directions[..., 0], -directions[..., 2]) / (2 * np.pi) + 0.5) * columns - 0.5
    row, column = np.floor(down).astype(int), np.floor(across).astype(int)
    lower, right = (down - row)[..., None], (across - column)[..., None]
    above, below = np.clip(row, 0, rows - 1), np.clip(row + 1, 0, rows - 1)
    here, beside = column % columns, (column + 1) % columns
    upper_texels = image[above, here] * (1 - right) + image[above, beside] * right
    lower_texels = image[below, here] * (1 - right) + image[below, beside] * right
    return np.asarray(upper_texels * (1 - lower) + lower_texels * lower)


def _halved(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average of every 2 x 2 texels."""
    return _shrink(image, image.shape[0] // 2, image.shape[1] // 2)


def _filtered(image: NDArray[np.float64], size: int, roughness: float) -> NDArray[np.float64]:
    """What a surface of this roughness mirrors, by direction: GGX around it, seen head on, weighted by the cosine."""
    directions = map_directions(size)
    lights, solid_angle = _directions(*image.shape[:2])
    towards = lights.reshape(-1, 3).T.astype(np.float32)
    shares = np.repeat(solid_angle, image.shape[1]).astype(np.float32)
    radiance = np.concatenate([image.reshape(-1, 3), np.ones((image[..., 0].size, 1))], axis=1).astype(np.float32)
    radiance *= shares[:, None]
    alpha_sq = roughness**4
    rows = []
    for some in np.array_split(directions.reshape(-1, 3).astype(np.float32), -(-size * 2 * size // FILTERED_AT_ONCE)):
        cosine = some @ towards
        lobe = cosine * np.float32((alpha_sq - 1) / 2)  # view = normal: (n.h)^2 = (1 + n.l) / 2
        lobe += np.float32((alpha_sq + 1) / 2)
        np.square(lobe, out=lobe)
        np.maximum(cosine, 0, out=cosine)
        cosine /= lobe
        rows.append(cosine @ radiance)
    filtered = np.concatenate(rows).astype(np.float64)
    return (filtered[:, :3] / filtered[:, 3:]).reshape(directions.shape)


@dataclass(frozen=True)
class Environment:
    """Light from all around.

    Attributes
    ----------
    irradiance : (9, 3) float64
        Coefficients of the diffuse light, as the radiance of a white sheet.
    levels : tuple of 6 arrays (160 >> k, 320 >> k, 3) float64
        Mirrored radiance in the directions of `map_directions`; level k for the roughness (k / 5)^2.
    """

    irradiance: NDArray[np.float64]
    levels: tuple[NDArray[np.float64], ...] = field(repr=False)

    @staticmethod
    def from_image(radiance: ArrayLike) -> Environment:
        """Make one from a longitude-latitude image of linear radiance, (H, W, 3) float, any size.

        Raises
        ------
        RenderError
            If the array is not such an image, or not finite.
        """
        image = np.asarray(radiance, np.float64)
        image = np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image
        if image.ndim != 3 or image.shape[2] < 3 or 0 in image.shape or not np.isfinite(image).all():
            raise RenderError(f"an environment must be an image (H, W, 3) of finite radiance, not {image.shape}")
        full = _resample(image[:, :, :3], *PANORAMA_SIZE)
        small = _shrink(full, *FILTER_SIZE)
        sharp = _looked_up(full, map_directions(MAP_SIZE))
        levels = [sharp, _halved(sharp)]
        for level in range(2, NUM_LEVELS):
            levels.append(_filtered(small, MAP_SIZE >> level, (level / (NUM_LEVELS - 1)) ** 2))
        return Environment(_irradiance(small), tuple(levels))

    def diffuse_light(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radiance (..., 3) of a white sheet that faces a direction, unit vectors (..., 3)."""
        x, y, z = np.moveaxis(directions, -1, 0)
        basis = np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], axis=-1)
        return np.asarray(np.maximum(basis @ self.irradiance, 0.0))

    @staticmethod
    def uniform(color: ArrayLike = (1.0, 1.0, 1.0)) -> Environment:
        """The same radiance from everywhere."""
        return Environment.from_image(np.broadcast_to(np.asarray(color, np.float64), (32, 64, 3)))

    @staticmethod
    @lru_cache(maxsize=1)
    def studio() -> Environment:
        """A bright room: a soft ceiling, a cool window at one side, a warm bounce from the floor."""
        directions, _ = _directions(*PANORAMA_SIZE)
        height = directions[..., 1:2]
        ceiling, wall, floor = (
            np.array(color) for color in ((0.53, 0.54, 0.58), (0.23, 0.235, 0.25), (0.11, 0.097, 0.086))
        )
        image = np.where(
            height > 0,
            wall + (ceiling - wall) * np.clip(height, 0, 1) ** 1.5,
            wall + (floor - wall) * np.clip(-2.2 * height, 0, 1),
        )
        for towards, color, narrow in (
            ((-0.75, 0.45, 0.5), (0.83, 0.97, 1.15), 14.0),
            ((0.9, 0.25, -0.55), (1.2, 1.02, 0.83), 26.0),
            ((0.1, 0.95, 0.3), (0.77, 0.77, 0.77), 8.0),
        ):
            unit = np.array(towards) / np.linalg.norm(towards)
            image = image + np.array(color) * np.exp(narrow * ((directions @ unit)[..., None] - 1.0))
        return Environment.from_image(image)


@dataclass(frozen=True)
class Lighting:
    """All light in a picture.

    By default a white sheet that faces the sun is just white: what is white shows its form, and what glows is not paler
    than its file says.

    Attributes
    ----------
    sun_direction : (3,) float
        Towards the sun; need not be a unit vector.
    sun_color : (3,) float
        Radiance of a white sheet that faces it.
    environment : Environment
    exposure : float
        Multiplies radiance before tone mapping.

    Raises
    ------
    RenderError
        If something is no number, or not finite.
    """

    sun_direction: tuple[float, float, float] = (0.55, 0.75, 0.65)
    sun_color: tuple[float, float, float] = (0.69, 0.65, 0.58)
    environment: Environment = field(default_factory=Environment.studio)
    exposure: float = 1.0

    def __post_init__(self) -> None:
        for name in ("sun_direction", "sun_color"):
            value = getattr(self, name)
            try:
                fits = numbers(value, name).shape == (3,)
            except ValueError:
                fits = False
            if not fits:
                raise RenderError(f"lighting: {name} must be three finite numbers, not {describe(value)}")
        if not isinstance(self.environment, Environment):
            raise RenderError(f"lighting: environment must be a runtime.Environment, not {describe(self.environment)}")
        if not is_number(self.exposure) or not 0.0 <= self.exposure < np.inf:
            raise RenderError(f"lighting: exposure is {describe(self.exposure)}, it must be a number of at least 0")
