"""KTX2 files: read back by the specification's table, every level; by Khronos' or another reader where one is there."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from preprocess.export.ktx2 import IDENTIFIER, encode_ktx2, write_ktx2

READ = """
const { read } = require('ktx-parse'); const fs = require('fs');
const k = read(fs.readFileSync(process.argv[1]));
console.log(JSON.stringify({format: k.vkFormat, width: k.pixelWidth, height: k.pixelHeight,
  levels: k.levels.map(l => [l.levelData.byteLength, l.uncompressedByteLength]), writer: k.keyValue.KTXwriter,
  orientation: k.keyValue.KTXorientation, samples: k.dataFormatDescriptor[0].samples.length,
  transfer: k.dataFormatDescriptor[0].transferFunction}));
"""


def chain(width: int, height: int, channels: int) -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    levels = []
    while True:
        levels.append(rng.integers(0, 256, (height, width, channels)) / 255.0)
        if width == height == 1:
            return levels
        width, height = max(1, width // 2), max(1, height // 2)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (8, 8), (20, 12), (5, 1)])
def test_every_level_comes_back(size: tuple[int, int], channels: int) -> None:
    levels = chain(*size, channels)
    data = encode_ktx2(levels, "uint8", True)
    assert data[:12] == IDENTIFIER
    vk_format, type_size, width, height, depth, layers, faces, count, scheme = struct.unpack_from("<9I", data, 12)
    assert (vk_format, type_size, width, height) == (43, 1, *size)
    assert (depth, layers, faces, count, scheme) == (0, 0, 1, len(levels), 0)
    descriptor_at, descriptor_size, values_at, values_size = struct.unpack_from("<4I", data, 48)
    assert struct.unpack_from("<I", data, descriptor_at)[0] == descriptor_size == 4 + 24 + 4 * 16
    assert descriptor_at % 4 == 0 and values_at == descriptor_at + descriptor_size
    ends = values_at + values_size
    for number in reversed(range(count)):  # the coarsest lies first
        offset, length, full = struct.unpack_from("<3Q", data, 80 + 24 * number)
        assert offset >= ends and offset % 4 == 0 and length == full
        texels = np.frombuffer(data, np.uint8, length, offset).reshape(*levels[number].shape[:2], 4)
        expected = np.rint(255 * levels[number])
        if channels == 1:
            assert all(np.array_equal(texels[..., c], expected[..., 0]) for c in range(3))
        else:
            assert np.array_equal(texels[..., :channels], expected)
        assert channels == 4 or (texels[..., 3] == 255).all()
        ends = offset + length
    assert ends == len(data)


@pytest.mark.parametrize("stored,dtype,vk_format", [("uint16", "<u2", 91), ("half", "<f2", 97), ("float", "<f4", 109)])
def test_wider_formats(stored: str, dtype: str, vk_format: int) -> None:
    level = np.linspace(0, 1, 4 * 2 * 3).reshape(2, 4, 3)
    data = encode_ktx2([level], stored, False)
    assert struct.unpack_from("<I", data, 12)[0] == vk_format
    offset, length, _ = struct.unpack_from("<3Q", data, 80)
    texels = np.frombuffer(data, dtype, length // np.dtype(dtype).itemsize, offset).reshape(2, 4, 4)
    unit = 65535 if stored == "uint16" else 1
    np.testing.assert_allclose(texels[..., :3] / unit, level, atol=1e-3 if stored == "half" else 1e-5)


def test_levels_of_the_wrong_size_are_refused() -> None:
    with pytest.raises(ValueError, match="level 1"):
        encode_ktx2([np.zeros((4, 4, 3)), np.zeros((3, 2, 3))], "uint8", True)
    with pytest.raises(ValueError, match="at least one"):
        encode_ktx2([], "uint8", True)


@pytest.mark.parametrize("stored,is_srgb,transfer", [("uint8", True, 2), ("uint8", False, 1), ("float", False, 1)])
def test_another_reader_agrees(tmp_path: Path, stored: str, is_srgb: bool, transfer: int) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    write_ktx2(tmp_path / "x.ktx2", chain(16, 8, 4), stored, is_srgb)
    run = subprocess.run([node, "-e", READ, str(tmp_path / "x.ktx2")], capture_output=True, text=True, check=False)
    if "Cannot find module 'ktx-parse'" in run.stderr:
        pytest.skip("npm package ktx-parse is not found (npm i ktx-parse, NODE_PATH)")
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert (found["width"], found["height"], found["samples"], found["transfer"]) == (16, 8, 4, transfer)
    size = 16 if stored == "float" else 4
    assert found["levels"] == [[size * n, size * n] for n in (128, 32, 8, 2, 1)]
    assert found["writer"] == "seamskin" and found["orientation"] == "rd"
