"""How programs of ours have their kernels compiled, and that they say so: a person who waits wants to know why."""

from __future__ import annotations

import contextlib
import gc
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

COMPILING = "compiling kernels, once: up to half a minute in all"


def compile_quickly() -> None:
    """Ask numba for LLVM's first level: kernels run as fast, and compile in three quarters of the time.

    For programs, before anything imports numba. A library must not change what its host's own kernels get.
    """
    os.environ.setdefault("NUMBA_OPT", "1")


@dataclass
class Compiling:
    """What `watch_compiling` has seen: seconds spent on kernels that were in no cache."""

    seconds: float = 0.0


@contextlib.contextmanager
def watch_compiling(say: Callable[[], None]) -> Iterator[Compiling]:
    """Tell of kernels that are compiled meanwhile, in any thread; Python's collector of cycles rests as they are.

    What numba builds for a kernel has nothing to collect before it is done, but is walked again and again: a tenth of
    the time.

    Parameters
    ----------
    say : function
        Called as the first one starts: not at all where numba finds every kernel in its cache.

    Yields
    ------
    Compiling
    """
    from numba.core import event

    seen = Compiling()

    class Listener(event.Listener):
        """Kernels that call others have them compiled on the way; numba compiles in one thread at a time."""

        depth = 0
        start: float | None = None
        collects = True

        def on_start(self, event: Any) -> None:
            if self.start is None:
                say()
            if self.depth == 0:
                self.start = time.perf_counter()
                self.collects = gc.isenabled()
                gc.disable()
            self.depth += 1

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0 and self.start is not None:
                seen.seconds += time.perf_counter() - self.start
                if self.collects:
                    gc.enable()

    listener = Listener()
    event.register("numba:compile", listener)
    try:
        yield seen
    finally:
        event.unregister("numba:compile", listener)
