"""How kernels are compiled: entries are called from Python and cached; helpers are compiled into the entries alone.

A helper has no Python wrapper and no cache file of its own, which halves the time of a cold start. numba renews an
entry's cache when the entry's own file changes, not when a helper's does. An entry whose helpers live in other files
therefore closes over `SOURCES`, a digest of them all: numba's cache is keyed by what a function closes over.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from numba import njit

# Kernels allocate nothing, so they need no reference counts: half of the running and a third of the compiling.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
entry = njit(cache=True, **_OPTIONS)
_WITHOUT_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
helper = njit(**_OPTIONS, **_WITHOUT_WRAPPERS)

SOURCES = int.from_bytes(
    hashlib.sha256(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))).digest()[:7]
)
