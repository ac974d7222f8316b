"""Files that another file names: regular files inside its own folder, of bounded size, and nothing else.

A name in a file from elsewhere may be an absolute path, climb out with `..`, follow a link, or stand for a device or a
pipe. All readers of such names (a glTF's buffers and images, a manifest's textures and model) ask here.
"""

from __future__ import annotations

import stat
from pathlib import Path

from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS
from runtime.validation import describe

KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class MissingFileError(AssetError):
    """Nothing stands where a file should: another spelling of its name may find it."""


def name_kind(mode: int) -> str | None:
    """What a file's mode says it is, if that is no regular file ("a pipe" ...)."""
    if stat.S_ISREG(mode):
        return None
    return next((words for test, words in KINDS if test(mode)), "no regular file")


def find_local_file(folder: Path, name: str, what: str, advice: str) -> Path:
    """The regular file of that name inside a folder, links followed.

    Parameters
    ----------
    folder : Path
    name : str
        Relative to the folder, as a file says it.
    what : str
        What the file is, first in the message.
    advice : str
        What to do, last in the message.

    Raises
    ------
    AssetError
        If the name leads out of the folder, to nothing (`MissingFileError`), or to something that is not a regular
        file.
    """
    try:
        root, path = folder.resolve(), (folder / name).resolve()
        inside = path.is_relative_to(root) and path != root
        mode = path.stat().st_mode if inside else 0
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFileError(f"{what}: {folder / name} is missing: {advice}") from None
    except (OSError, ValueError, RuntimeError):  # too long, a zero byte, a circle of links
        raise AssetError(f"{what}: {describe(name)} is no name of a file: {advice}") from None
    if not inside:
        raise AssetError(f"{what}: {describe(name)} is outside of {folder}: {advice}")
    if (kind := name_kind(mode)) is not None:
        raise AssetError(f"{what}: {describe(name)} is {kind}, not a regular file: {advice}")
    return path


def check_regular(path: Path, most_bytes: int = LIMITS.file_bytes) -> None:
    """Refuse a file that a person named before it is read.

    Raises
    ------
    AssetError
        If it is missing, no regular file or too large.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise AssetError(f"no such file: {path}") from None
    except (OSError, ValueError) as error:
        raise AssetError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    if (kind := name_kind(status.st_mode)) is not None:
        raise AssetError(f"cannot read {path}: it is {kind}: save its content as a file and name that")
    if status.st_size > most_bytes:
        raise AssetError(f"{path.name} has {status.st_size} bytes, more than {most_bytes}: raise --limit file_bytes=N")


def read_regular(path: Path, most_bytes: int = LIMITS.file_bytes) -> bytes:
    """The bytes of a file that a person named.

    Raises
    ------
    AssetError
        As `check_regular`.
    """
    check_regular(path, most_bytes)
    try:
        return path.read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read {path}: {error.strerror}") from None
