"""How programs of ours have their kernels compiled, and that they say so: a person who waits wants to know why."""

from __future__ import annotations

import os
from pathlib import Path

FIRST_RUN = "first run: compiling kernels, up to half a minute, once"


def compile_quickly() -> None:
    """Ask numba for LLVM's first level: kernels run as fast, and compile in three quarters of the time.

    For programs, before anything imports numba. A library must not change what its host's own kernels get.
    """
    os.environ.setdefault("NUMBA_OPT", "1")


def are_compiled() -> bool:
    """Whether numba's cache on disk holds the kernels already, judged by the one that every build needs first."""
    from preprocess.raster import _rasterise

    folder = Path(vars(_rasterise)["_cache"].cache_path)
    return any(folder.glob("raster._rasterise-*.nbc"))
