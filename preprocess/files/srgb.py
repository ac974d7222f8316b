"""sRGB encoding and decoding (IEC 61966-2-1), odd about zero, so that values out of range survive."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats


def srgb_to_linear(values: NDArray[np.floating[Any]]) -> Floats:
    """Linear light from sRGB values, any shape."""
    size = np.abs(np.asarray(values, np.float64))
    result: Floats = np.sign(values) * np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return result


def linear_to_srgb(light: NDArray[np.floating[Any]]) -> Floats:
    """Inverse of `srgb_to_linear`."""
    size = np.abs(np.asarray(light, np.float64))
    result: Floats = np.sign(light) * np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055)
    return result
