"""Offline tools: from a glTF character to textures and levels of detail that `runtime` draws."""

import os

# numba's kernels run as fast at LLVM's first level, and a first run compiles them in three quarters of the time.
os.environ.setdefault("NUMBA_OPT", "1")
