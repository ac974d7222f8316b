"""KTX2 files: a texture with all of its mip levels, so that other engines use the closed ones.

Uncompressed, in the formats that every engine reads: colours as R8G8B8A8 (sRGB where they are), 16-bit and float
textures with four channels. Levels lie in the file from the coarsest to the finest, each at a multiple of its texel.

Khronos Group: KTX File Format Specification, version 2.0; Khronos Data Format Specification 1.3, section 5 (basic
data format descriptor).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
KEY_VALUES = {"KTXorientation": b"rd\0", "KTXwriter": b"seamskin\0"}  # sorted, as the specification wants them
RGBSDA, BT709, LINEAR, SRGB = 1, 1, 1, 2  # colour model, primaries, transfer functions of the descriptor
CHANNEL_IDS = (0, 1, 2, 15)  # red, green, blue, alpha
LINEAR_SAMPLE, SIGNED_SAMPLE, FLOAT_SAMPLE = 0x10, 0x40, 0x80


class _Format(NamedTuple):
    """How texels are stored: VkFormat, NumPy type, largest integer (0 for floats), whether colours are sRGB."""

    vk_format: int
    dtype: str
    levels: int
    is_srgb: bool


FORMATS = {
    ("uint8", True): _Format(43, "u1", 255, True),  # VK_FORMAT_R8G8B8A8_SRGB
    ("uint8", False): _Format(37, "u1", 255, False),  # VK_FORMAT_R8G8B8A8_UNORM
    ("uint16", False): _Format(91, "<u2", 65535, False),  # VK_FORMAT_R16G16B16A16_UNORM
    ("half", False): _Format(97, "<f2", 0, False),  # VK_FORMAT_R16G16B16A16_SFLOAT
    ("float", False): _Format(109, "<f4", 0, False),  # VK_FORMAT_R32G32B32A32_SFLOAT
}


def _descriptor(form: _Format) -> bytes:
    """The basic data format descriptor, with its total size in front."""
    size = np.dtype(form.dtype).itemsize
    lower, upper = (0, form.levels) if form.levels else (0xBF800000, 0x3F800000)  # -1.0 and 1.0 as bits
    samples = b""
    for number, channel in enumerate(CHANNEL_IDS):
        kind = channel
        if not form.levels:
            kind |= SIGNED_SAMPLE | FLOAT_SAMPLE
        elif form.is_srgb and channel == 15:
            kind |= LINEAR_SAMPLE
        samples += struct.pack("<HBB4BII", 8 * size * number, 8 * size - 1, kind, 0, 0, 0, 0, lower, upper)
    transfer = SRGB if form.is_srgb else LINEAR
    block = struct.pack(
        "<IHH4B4B8B", 0, 2, 24 + len(samples), RGBSDA, BT709, transfer, 0, *(0,) * 4, 4 * size, *(0,) * 7
    )
    return struct.pack("<I", 4 + len(block) + len(samples)) + block + samples


def _key_values() -> bytes:
    """Entries of key and value, each padded to four bytes."""
    data = b""
    for key, value in KEY_VALUES.items():
        entry = key.encode() + b"\0" + value
        data += struct.pack("<I", len(entry)) + entry + b"\0" * (-len(entry) % 4)
    return data


def _texels(level: NDArray[Any], form: _Format) -> bytes:
    """A level's texels with four channels: what is missing is zero, and one in alpha."""
    height, width, channels = level.shape
    full = np.zeros((height, width, 4))
    full[..., 3] = 1.0
    full[..., : min(channels, 4)] = level[..., :4]
    if channels == 1:
        full[..., 1:3] = full[..., :1]
    if form.levels:
        full = np.rint(np.clip(full, 0.0, 1.0) * form.levels)
    return full.astype(form.dtype).tobytes()


def encode_ktx2(levels: Sequence[NDArray[Any]], stored: str, is_srgb: bool) -> bytes:
    """A texture as a KTX2 file.

    Parameters
    ----------
    levels : sequence of (H, W, C) float
        Mip levels, the finest first, each max(1, size >> k) texels per side; integer formats in [0, 1]. C from 1 to 4.
    stored : str
        "uint8", "uint16", "half" or "float".
    is_srgb : bool
        Whether 8-bit colours are sRGB-encoded.

    Raises
    ------
    ValueError
        If a level has not the size that its number wants, or there is none.
    """
    if not levels:
        raise ValueError("a texture needs at least one level")
    height, width = levels[0].shape[:2]
    for number, level in enumerate(levels):
        wanted = (max(1, height >> number), max(1, width >> number))
        if level.shape[:2] != wanted:
            raise ValueError(f"level {number} is {level.shape[:2]}, not {wanted}")
    form = FORMATS[stored, is_srgb and stored == "uint8"]
    size = np.dtype(form.dtype).itemsize
    descriptor, key_values = _descriptor(form), _key_values()
    descriptor_at = 80 + 24 * len(levels)
    values_at = descriptor_at + len(descriptor)
    header = IDENTIFIER + struct.pack("<9I", form.vk_format, size, width, height, 0, 0, 1, len(levels), 0)
    header += struct.pack("<4I2Q", descriptor_at, len(descriptor), values_at, len(key_values), 0, 0)
    start = values_at + len(key_values)
    data = bytearray()
    index = []
    for level in reversed(levels):
        data += b"\0" * (-(start + len(data)) % (4 * size))
        texels = _texels(level, form)
        index.append(struct.pack("<3Q", start + len(data), len(texels), len(texels)))
        data += texels
    return header + b"".join(reversed(index)) + descriptor + key_values + bytes(data)


def write_ktx2(path: Path, levels: Sequence[NDArray[Any]], stored: str, is_srgb: bool) -> None:
    """Write `encode_ktx2` to a file."""
    path.write_bytes(encode_ktx2(levels, stored, is_srgb))
