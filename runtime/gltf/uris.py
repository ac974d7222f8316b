"""What a glTF file's uris stand for: data: uris, and files beside it as exporters name them.

Sources: RFC 3986; WHATWG, Infra Standard, "forgiving-base64 decode".
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote, unquote_to_bytes

from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS
from runtime.gltf.local_files import MissingFileError, find_local_file, read_regular

ADVICE = "put it beside the file"


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
    what = f"{beside.name}: {what}"
    if uri[:5].lower() == "data:":
        return _decode_data(uri, what)
    if "://" in uri:
        raise AssetError(f"{what} lies at {uri[:80]}: download it and name it relative to the file")
    missing = AssetError(f"{what} is missing: {unquote(uri)[:120]}: {ADVICE}")
    refusals = []
    for name in _spellings(uri):
        try:
            return read_regular(_find_in_any_case(beside.parent, name, what), most_bytes)
        except MissingFileError:
            continue
        except AssetError as refusal:
            refusals.append(refusal)
    raise refusals[0] if refusals else missing


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


def _find_in_any_case(folder: Path, name: str, what: str) -> Path:
    """The file of that name below a folder; one that differs in case alone, where there is just one such file.

    Raises
    ------
    AssetError
    """
    try:
        return find_local_file(folder, name, what, ADVICE)
    except MissingFileError:
        below = Path()
        for step in PurePosixPath(name).parts:
            if step in ("..", "/"):
                raise
            if not (folder / below / step).exists():
                alike = [entry.name for entry in (folder / below).iterdir() if entry.name.lower() == step.lower()]
                if len(alike) != 1:
                    raise
                step = alike[0]
            below /= step
        return find_local_file(folder, str(below), what, ADVICE)
