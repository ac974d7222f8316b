"""Libraries that write to the program's standard error of their own accord, kept from it."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

_LOCK = threading.Lock()  # the descriptor is the whole process's


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Send what is written to standard error below Python nowhere while a block runs.

    libpng, libjpeg and libtiff tell of damage there, past every exception; their callers say what is wrong in a line of
    their own. Python's own lines of that time go the same way: the block is to be short.
    """
    with _LOCK, contextlib.ExitStack() as undo:
        try:
            sys.stderr.flush()
            kept = os.dup(2)
        except (OSError, ValueError, AttributeError):  # there is none: nothing to keep quiet
            yield
            return
        undo.callback(os.close, kept)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        undo.callback(os.close, nowhere)
        os.dup2(nowhere, 2)
        undo.callback(os.dup2, kept, 2)
        yield
