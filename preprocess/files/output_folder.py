"""A result folder appears whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType

from preprocess.errors import InputError

MANIFEST = "manifest.json"


def check_destination(destination: Path) -> None:
    """Refuse, before any work, a destination that cannot be written or holds something else.

    Raises
    ------
    InputError
    """
    if destination.exists() and not destination.is_dir():
        raise InputError(f"{destination} is a file: name another folder with -o")
    if destination.is_dir() and any(destination.iterdir()) and not (destination / MANIFEST).is_file():
        raise InputError(f"{destination} holds other files and no built character: name another folder with -o")
    parent = _existing_parent(destination)
    if not os.access(parent, os.W_OK):
        raise InputError(f"{parent} cannot be written to: name another folder with -o")


def _existing_parent(destination: Path) -> Path:
    parent = destination.absolute().parent
    while not parent.exists():
        parent = parent.parent
    return parent


@contextlib.contextmanager
def whole_folder(destination: Path) -> Iterator[Path]:
    """A new empty folder to fill, which takes the destination's place when the block ends without an error.

    Whatever stood at the destination stays untouched until then, also when the block fails or is interrupted.
    """
    parent = destination.absolute().parent
    with stops_as_interrupts(), whole_parents(parent):
        partial = Path(tempfile.mkdtemp(prefix=f".{destination.name}.partial-", dir=parent))
        try:
            partial.chmod(0o755)
            yield partial
            _swap(partial, destination)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def whole_parents(folder: Path) -> Iterator[None]:
    """Make a folder and those above it that are missing; take them away again if the block fails.

    Raises
    ------
    InputError
        If the folder cannot be made.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}): name another folder with -o") from error
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # somebody else has put something there meanwhile: it stays
            for path in missing:
                path.rmdir()
        raise


def _swap(partial: Path, destination: Path) -> None:
    if not destination.exists():
        partial.rename(destination)
        return
    previous = Path(tempfile.mkdtemp(prefix=f".{destination.name}.previous-", dir=partial.parent))
    kept = previous / destination.name
    try:
        destination.rename(kept)
        partial.rename(destination)
    except BaseException:  # an interrupt between the two too
        if kept.exists() and not destination.exists():
            kept.rename(destination)
        raise
    finally:
        shutil.rmtree(previous, ignore_errors=True)


@contextlib.contextmanager
def stops_as_interrupts() -> Iterator[None]:
    """Let a polite kill (SIGTERM) and a closed terminal (SIGHUP) clean up like Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(signum: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.Signals[name] for name in ("SIGTERM", "SIGHUP") if name in signal.Signals.__members__]
    ignored = [number for number in numbers if signal.getsignal(number) == signal.SIG_IGN]  # nohup: on purpose
    before = {number: signal.signal(number, interrupt) for number in numbers if number not in ignored}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def check_not_input(output: Path, inputs: Iterable[Path]) -> None:
    """Refuse an output that would take the place of a file it is made from: nobody's original is lost.

    Raises
    ------
    InputError
    """
    for path in inputs:
        if output.exists() and path.exists() and output.samefile(path):
            raise InputError(f"{output} is the input itself: name another place with -o")
