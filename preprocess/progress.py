"""Progress for people: the running stage's name at once, then one line a finished stage with its time and delta.

Kernels that are compiled on the way, on a first run or after an update, are told of as it happens.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import Any

from preprocess.numerics.compile_progress import COMPILING, watch_compiling

WORTH_SAYING_S = 1.0  # of compiling, in a stage's line


@contextlib.contextmanager
def tell_of_compiling() -> Iterator[None]:
    """Say on stderr that kernels compile, if they do: for commands without stages."""
    with watch_compiling(lambda: print(COMPILING, file=sys.stderr, flush=True)):
        yield


class Progress:
    """Names stages on stderr as they run and keeps their times.

    Attributes
    ----------
    seconds : dict of str to float
        Wall time of each stage, all its runs together, in the order they first ran.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.seconds: dict[str, float] = {}
        self._quiet = quiet
        self._console: Any = None
        self._told = False

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """Run a block as a named stage."""
        stage = Stage()
        start = time.perf_counter()
        with self._spinner(name), watch_compiling(self._tell) as compiling:
            yield stage
        seconds = time.perf_counter() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        text = f"  {name:<12}{seconds:6.1f} s   {stage.delta}".rstrip()
        if compiling.seconds >= WORTH_SAYING_S:
            text += f" ({compiling.seconds:.0f} s of it compiling)"
        self._print(text)

    def _tell(self) -> None:
        if not self._told:
            self._told = True
            self._print(f"  {COMPILING}")

    def _print(self, text: str) -> None:
        if not self._quiet:
            print(text, file=sys.stderr, flush=True)

    @contextlib.contextmanager
    def _spinner(self, name: str) -> Iterator[None]:
        if self._quiet or not sys.stderr.isatty():
            yield
            return
        if self._console is None:
            from rich.console import Console

            self._console = Console(stderr=True)
        with self._console.status(f"{name} ..."):
            yield


class Stage:
    """What a stage reports when it ends: `delta`, a short text such as "26756 faces → 4 levels"."""

    delta: str = ""
