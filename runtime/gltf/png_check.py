"""What is wrong with a PNG file, found without decoding it.

libpng writes a line of its own to stderr when it meets damage, past every exception; asking first keeps refusals to
the one line they should be. Each chunk of a PNG carries a checksum, so damage and cuts show without decompressing.

Source: W3C, Portable Network Graphics (PNG) Specification (Third Edition), section 5 (datastream structure).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def find_png_fault(data: bytes) -> str | None:
    """Say what is wrong with the bytes of a PNG file, or None if its chunks are whole.

    Parameters
    ----------
    data : bytes
        Of a file of any format; only PNG files are looked into.
    """
    if not data.startswith(SIGNATURE):
        return None
    view, at = memoryview(data), len(SIGNATURE)
    kinds: list[bytes] = []
    while not kinds or kinds[-1] != b"IEND":
        if at + 12 > len(data):
            return "it is cut short"
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            return "it is cut short"
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[at + 4 : end - 4]) != checksum:
            return f"its {kind.decode('latin-1')!r} chunk is damaged"
        kinds.append(kind)
        at = end
    if kinds[0] != b"IHDR" or b"IDAT" not in kinds:
        return "it holds no picture"
    return None


def first_line(read: Callable[[], str], otherwise: str) -> str:
    """The first line of what an image library says about a failure; it may quote damaged bytes, which are no text."""
    try:
        words = read().strip()
    except UnicodeDecodeError:
        return "it is damaged"
    return words.splitlines()[0][:120] if words else otherwise
