"""How kernels are compiled: entries are called from Python and cached, helpers only from entries of the same room.

A helper has no Python wrapper and no file in the cache, and division asks for no zero: a third less to compile. numba
renews an entry's cache when the entry's own file changes, so helpers live in the file of their entries where they can.
"""

from __future__ import annotations

from typing import Any

from numba import njit

OPTIONS: dict[str, Any] = {"error_model": "numpy"}
WITHOUT_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

entry = njit(cache=True, **OPTIONS)
helper = njit(**OPTIONS, **WITHOUT_WRAPPERS)
