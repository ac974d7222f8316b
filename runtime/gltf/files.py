"""Files that another file names: regular ones inside its own folder, of bounded size; and data: uris.

A glTF file, a manifest and a material library come from other hands. What they name is read only where it cannot be
anything but a part of them: no path out of the folder, by dots or links, no device, no pipe.

Sources: RFC 3986; WHATWG, Infra Standard, "forgiving-base64 decode".
"""

from __future__ import annotations

import base64
import binascii
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote, unquote_to_bytes

from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS

KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
MISSING, OUTSIDE, IRREGULAR = range(3)  # the worse a fault, the more it says about a file


class _Unusable(Exception):
    """Why a name is not read: how bad that is, and in words."""

    def __init__(self, rank: int, reason: str) -> None:
        super().__init__(reason)
        self.rank, self.reason = rank, reason


def name_kind(path: Path) -> str | None:
    """What stands at a path if that is no regular file ("a pipe" ...), else None; links are followed.

    Raises
    ------
    OSError
        If nothing stands there.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return None
    return next((words for test, words in KINDS if test(mode)), "no regular file")


def read_regular(path: Path, most_bytes: int = LIMITS.file_bytes) -> bytes:
    """The bytes of a file that a person named.

    Raises
    ------
    AssetError
        If it is missing, no regular file or too large.
    """
    try:
        kind = name_kind(path)
        if kind is not None:
            raise AssetError(f"cannot read {path}: it is {kind}: save its content as a file and name that")
        size = path.stat().st_size
        if size > most_bytes:
            raise AssetError(f"{path.name} has {size} bytes, more than {most_bytes}: raise --limit file_bytes=N")
        return path.read_bytes()
    except FileNotFoundError:
        raise AssetError(f"no such file: {path}") from None
    except (OSError, ValueError) as error:
        raise AssetError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None


def find_inside(folder: Path, name: str) -> Path:
    """The regular file that a file in a folder names.

    Parameters
    ----------
    folder : Path
    name : str
        Relative, with forward slashes. One that differs in case alone will do where there is just one.

    Raises
    ------
    AssetError
        If there is none, or it lies outside the folder: in words that complete "image 3 ...".
    """
    try:
        return _find(folder, name)
    except _Unusable as fault:
        raise AssetError(fault.reason) from None


def read_inside(folder: Path, name: str, what: str, most_bytes: int = LIMITS.file_bytes) -> bytes:
    """Bytes of the regular file that a file in a folder names.

    Parameters
    ----------
    folder, name
        As for `find_inside`.
    what : str
        How the message names it: "image 3", "texture position".
    most_bytes : int

    Raises
    ------
    AssetError
    """
    try:
        return read_regular(_find(folder, name), most_bytes)
    except _Unusable as fault:
        raise AssetError(f"{what} {fault.reason}") from None


def _find(folder: Path, name: str) -> Path:
    shown = name[:120]
    steps = os.path.normpath(name).replace("\\", "/").split("/")
    if PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor or steps[0] == "..":
        raise _Unusable(OUTSIDE, f"lies outside the file's folder: {shown}: put it beside the file")
    try:
        path = folder / os.path.normpath(name)
        if not path.exists():
            path = _find_in_any_case(folder, steps)
        real = path.resolve(strict=True)
        if not real.is_relative_to(folder.resolve()):
            raise _Unusable(OUTSIDE, f"is a link out of the file's folder: {shown}: put a copy beside the file")
        kind = name_kind(real)
    except (OSError, ValueError, RuntimeError):
        raise _Unusable(MISSING, f"is missing: {shown}: put it beside the file") from None
    if kind == "a folder":
        raise _Unusable(MISSING, f"is missing: {shown}: put it beside the file")
    if kind is not None:
        raise _Unusable(IRREGULAR, f"is {kind}: {shown}: put a regular file there")
    return real


def _find_in_any_case(folder: Path, steps: list[str]) -> Path:
    for step in steps:
        exact = folder / step
        if not exact.exists():
            alike = [entry for entry in folder.iterdir() if entry.name.lower() == step.lower()]
            if len(alike) != 1:
                raise FileNotFoundError(step)
            exact = alike[0]
        folder = exact
    return folder


def read_uri(uri: str, beside: Path, what: str, most_bytes: int = LIMITS.file_bytes) -> bytes:
    """Bytes of a data: uri or of a file named relative to the file that holds the uri.

    Parameters
    ----------
    uri : str
    beside : Path
        The file that holds it.
    what : str
        How the message names what it is of.
    most_bytes : int

    Raises
    ------
    AssetError
    """
    if uri[:5].lower() == "data:":
        return _decode_data(uri, f"{beside.name}: {what}")
    if "://" in uri:
        raise AssetError(f"{beside.name}: {what} lies at {uri[:80]}: download it and name it relative to the file")
    worst = _Unusable(MISSING, f"is missing: {unquote(uri)[:120]}: put it beside the file")
    for name in _spellings(uri):
        try:
            return read_regular(_find(beside.parent, name), most_bytes)
        except _Unusable as fault:
            worst = max(worst, fault, key=lambda one: one.rank)
    raise AssetError(f"{beside.name}: {what} {worst.reason}")


def _decode_data(uri: str, what: str) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma:
        raise AssetError(f"{what} has a data uri without data: export again")
    data = unquote_to_bytes(body)
    if not head.lower().rstrip().endswith(";base64"):
        return data
    letters = re.sub(rb"[\t\n\f\r ]", b"", data)
    if len(letters) % 4 == 0:
        letters = letters[: len(letters) - min(2, len(letters) - len(letters.rstrip(b"=")))]
    try:
        if len(letters) % 4 == 1:
            raise ValueError
        return base64.b64decode(letters + b"=" * (-len(letters) % 4), validate=True)
    except (binascii.Error, ValueError):
        odd = re.search(rb"[^A-Za-z0-9+/]", letters)
        fault = f"holds {chr(odd[0][0])!a}" if odd else "is cut short"
        raise AssetError(f"{what} has a damaged base64 uri (it {fault}): export again") from None


def _spellings(uri: str) -> Iterator[str]:
    """What a relative uri may mean, the likeliest first: exporters forget to quote, or write paths of Windows."""
    for name in dict.fromkeys((unquote(uri), uri)):
        yield name
        if "\\" in name:
            yield name.replace("\\", "/")
            yield PureWindowsPath(name).name  # a path on the exporter's own drive
