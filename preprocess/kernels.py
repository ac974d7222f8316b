"""Says so when kernels must be compiled first: a person who waits wants to know why, and that it is once."""

from __future__ import annotations

from pathlib import Path

from preprocess.raster import _rasterise

FIRST_RUN = "first run: compiling kernels, up to half a minute, once"


def are_compiled() -> bool:
    """Whether numba's cache on disk holds the kernels already, judged by the one that every build needs first."""
    folder = Path(vars(_rasterise)["_cache"].cache_path)
    return any(folder.glob("raster._rasterise-*.nbc"))
