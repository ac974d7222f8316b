"""An atomic output directory: a result folder appears whole or not at all, and replaces nothing but one of its kind.

A folder is one of ours if its manifest says so by a key that no other program writes, and it holds nothing beside what
the manifest lists. While a folder is made it lies beside its destination under a name of its own, locked; what a killed
build left there has no lock, and the next build of that name takes it away.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from preprocess.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: leftovers stay, as nothing tells whether they are in use
    fcntl = None  # type: ignore[assignment]

MANIFEST = "manifest.json"
GENERATOR_KEY, GENERATOR = "generator", "seamskin"
MOST_MANIFEST_BYTES = 64 << 20
LATE = ("report.html",)  # written after the manifest
# What file managers leave in every folder that somebody looked into: nobody's work.
DROPPINGS = (".DS_Store", "Thumbs.db", "desktop.ini")


def describe_contents(folder: Path) -> dict[str, Any]:
    """Manifest keys that make a folder one of ours: the generator, and SHA-256 of every file in it so far."""
    files = {
        path.relative_to(folder).as_posix(): hash_file(path) for path in sorted(folder.rglob("*")) if path.is_file()
    }
    return {GENERATOR_KEY: GENERATOR, "files": files}


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_contents(folder: Path) -> set[str] | None:
    """Names of the files that a folder of ours may hold; None for a folder that is not ours."""
    path = folder / MANIFEST
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_MANIFEST_BYTES:
            return None
        manifest = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    ours = isinstance(manifest, dict) and manifest.get(GENERATOR_KEY) == GENERATOR
    files = manifest.get("files") if ours else None
    return {MANIFEST, *LATE, *DROPPINGS, *map(str, files)} if isinstance(files, dict) else None


def _find_foreign(folder: Path, names: set[str]) -> Path | None:
    """Something in a folder that is not one of the named files or a folder above one."""
    above = {parent.as_posix() for name in names for parent in Path(name).parents}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(root) / name
            relative = path.relative_to(folder).as_posix()
            known = relative in above if name in folders else relative in names or name in DROPPINGS
            if path.is_symlink() or not known:
                return path
    return None


def check_destination(destination: Path) -> None:
    """Refuse, before any work, a destination that cannot be written or holds something that is not ours.

    Raises
    ------
    InputError
    """
    elsewhere = "name another folder with -o"
    if destination.is_symlink():
        raise InputError(f"{destination} is a link: {elsewhere}")
    real = Path(os.path.realpath(destination))
    if real.name in ("", "..") or Path.cwd().is_relative_to(real):
        raise InputError(f"{destination} is the folder that you are in, or above it: {elsewhere}")
    if destination.exists() and not destination.is_dir():
        raise InputError(f"{destination} is a file: {elsewhere}")
    if destination.is_dir() and any(destination.iterdir()):
        names = _read_contents(destination)
        if names is None:
            raise InputError(f"{destination} holds other files and no built character: {elsewhere}")
        foreign = _find_foreign(destination, names)
        if foreign is not None:
            raise InputError(f"{foreign} is none of the files that seamskin wrote there: move it, or {elsewhere}")
    parent = _existing_parent(destination)
    if not parent.is_dir():
        raise InputError(f"{parent} is a file: {elsewhere}")
    if not os.access(parent, os.W_OK):
        raise InputError(f"{parent} cannot be written to: {elsewhere}")


def _existing_parent(destination: Path) -> Path:
    parent = Path(os.path.abspath(destination)).parent
    while not os.path.lexists(parent):
        parent = parent.parent
    return parent


@contextlib.contextmanager
def atomic_folder(destination: Path) -> Iterator[Path]:
    """A new empty folder to fill, which takes the destination's place when the block ends without an error.

    Whatever stood at the destination stays untouched until then, also when the block fails or is interrupted. What an
    earlier, killed run left behind is taken away.

    Raises
    ------
    InputError
        If the destination cannot be replaced (`check_destination`): asked before the block, and again after it.
    """
    check_destination(destination)
    parent = Path(os.path.abspath(destination)).parent
    name = Path(os.path.abspath(destination)).name
    with stops_as_interrupts(), whole_parents(parent), _locked_folder(parent, f".{name}.partial-") as partial:
        _sweep(parent, name)
        yield partial
        check_destination(destination)
        _swap(partial, parent / name)


@contextlib.contextmanager
def _locked_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """A new empty folder that others see is in use, for as long as this process lives; gone at the end if still there.

    Raises
    ------
    InputError
        If it cannot be made.
    """
    try:
        made = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
    except OSError as error:
        raise InputError(f"{parent} cannot be written to ({error.strerror}): name another place with -o") from error
    lock = None
    try:
        lock = _lock(made)
        made.chmod(0o755)
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _lock(folder: Path) -> int | None:
    """Lock a folder until the descriptor is closed or the process ends; None where it is locked, or that cannot be."""
    if fcntl is None:
        return None
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _sweep(parent: Path, name: str) -> None:
    """Take away what killed runs left beside a destination; put the previous result back where one was moved away."""
    if fcntl is None:
        return
    for kind in ("previous", "partial"):
        for left in sorted(parent.glob(f".{_escaped(name)}.{kind}-????????")):
            lock = _lock(left)
            if lock is None:
                continue
            try:
                kept = left / name
                if kind == "previous" and kept.is_dir() and not os.path.lexists(parent / name):
                    kept.rename(parent / name)
                shutil.rmtree(left, ignore_errors=True)
            finally:
                os.close(lock)


def _escaped(name: str) -> str:
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


@contextlib.contextmanager
def partial_folder(parent: Path, name: str) -> Iterator[Path]:
    """A folder for files that are moved one by one into `parent` at the end; leftovers of killed runs are taken away.

    Raises
    ------
    InputError
        If it cannot be made.
    """
    with whole_parents(parent), _locked_folder(parent, f".{name}.partial-") as partial:
        _sweep(parent, name)
        yield partial


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
    with _locked_folder(partial.parent, f".{destination.name}.previous-") as previous:
        kept = previous / destination.name
        try:
            destination.rename(kept)
            partial.rename(destination)
        except BaseException:  # an interrupt between the two too
            if kept.exists() and not destination.exists():
                kept.rename(destination)
            raise


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
