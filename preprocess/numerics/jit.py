"""How kernels are compiled: entries are called from Python and cached; helpers are compiled into the entries alone.

A helper has no Python wrapper and no file in the cache, and division asks for no zero: a third less to compile. numba
renews an entry's cache when the entry's own file changes, not when a helper's does, so helpers live in the file of
their entries where they can. An entry whose helpers live in other files closes over `digest_sources` of their folder:
numba's cache is keyed by what a function closes over.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from numba import njit

OPTIONS: dict[str, Any] = {"error_model": "numpy"}
# Kernels that allocate nothing need no reference counts: half of the running and a third of the compiling.
WITHOUT_ALLOCATION: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
WITHOUT_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

entry = njit(cache=True, **OPTIONS)
helper = njit(**OPTIONS, **WITHOUT_WRAPPERS)
fixed_memory_entry = njit(cache=True, **WITHOUT_ALLOCATION)
fixed_memory_helper = njit(**WITHOUT_ALLOCATION, **WITHOUT_WRAPPERS)


def digest_sources(folder: Path) -> int:
    """A number that changes with any Python file of a folder, of 56 bits."""
    content = b"".join(path.read_bytes() for path in sorted(folder.glob("*.py")))
    return int.from_bytes(hashlib.sha256(content).digest()[:7])
