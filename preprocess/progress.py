"""Progress for people: the running stage's name at once, then one line a finished stage with its time and delta."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import Any


class Progress:
    """Names stages on stderr as they run and keeps their times.

    Attributes
    ----------
    seconds : dict of str to float
        Wall time a stage, in the order they ran.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.seconds: dict[str, float] = {}
        self._quiet = quiet
        self._console: Any = None

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """Run a block as a named stage."""
        stage = Stage()
        start = time.perf_counter()
        with self._spinner(name):
            yield stage
        self.seconds[name] = time.perf_counter() - start
        if not self._quiet:
            text = f"  {name:<12}{self.seconds[name]:6.1f} s   {stage.delta}"
            print(text.rstrip(), file=sys.stderr, flush=True)

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
