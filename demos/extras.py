"""Packages that programs need beyond the runtime: what is not installed is told in one line, not in a traceback."""

from __future__ import annotations

import sys
from types import TracebackType

OURS = ("runtime", "preprocess", "demos", "benchmarks", "seamskin")
EXTRA = "demos"  # what to install; it holds everything that demos use


def missing_package(error: BaseException | None, extra: str = EXTRA) -> str | None:
    """What to install where an import failed for want of somebody else's package; None for any other error."""
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if not package or package in OURS:
        return None
    return f'{package} is not installed: pip install "seamskin[{extra}]"'


class needs_packages:
    """Around imports at the top of a program: a missing package ends it with status 2 and one line.

    A module that is merely imported raises as ever.

    Parameters
    ----------
    module : str
        The module's `__name__`.
    program : str
        What the program is called.
    extra : str
        What to install.
    """

    def __init__(self, module: str, program: str, extra: str = EXTRA) -> None:
        self._is_program, self._program, self._extra = module == "__main__", program, extra

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        told = missing_package(error, self._extra)
        if self._is_program and told:
            print(f"{self._program}: {told}", file=sys.stderr)
            raise SystemExit(2) from None
