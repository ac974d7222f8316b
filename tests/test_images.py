"""Image files: what is damaged or foreign is refused in one line, and nothing else is said."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from builders_asset import build_ball

from preprocess.errors import InputError
from preprocess.files.images import Image, read_image, write_image
from runtime.asset.asset import load
from runtime.errors import AssetError
from runtime.gltf.limits import Limits
from runtime.gltf.png_check import find_png_fault


@pytest.fixture
def png(tmp_path: Path) -> bytes:
    """A PNG file of 16 × 16 texels of noise."""
    texels = np.random.default_rng(3).integers(0, 256, (16, 16, 3)).astype(np.uint8)
    write_image(tmp_path / "noise.png", Image(texels))
    return (tmp_path / "noise.png").read_bytes()


def test_every_changed_byte_is_found(png: bytes) -> None:
    """Signature, lengths, names, data and checksums: a byte that differs anywhere is never taken for whole."""
    assert find_png_fault(png) is None
    for at in range(8, len(png)):
        changed = bytearray(png)
        changed[at] ^= 0x24
        assert find_png_fault(bytes(changed)) is not None, at


def test_every_cut_is_found(png: bytes) -> None:
    for length in range(8, len(png)):
        assert find_png_fault(png[:length]) == "it is cut short"
    assert find_png_fault(png + b"more") is None  # what follows the end is not the picture's


def test_a_file_without_a_picture_is_found(png: bytes) -> None:
    end = struct.pack(">I4sI", 0, b"IEND", zlib.crc32(b"IEND"))
    assert find_png_fault(png[:33] + end) == "it holds no picture"
    assert find_png_fault(png[:8] + end) == "it holds no picture"


def test_other_formats_are_not_looked_into() -> None:
    assert find_png_fault(b"") is None
    assert find_png_fault(b"\xff\xd8\xff whatever") is None


@pytest.mark.parametrize("at", [18, 30, 60, -20, -2])
def test_damage_is_refused_in_one_line_and_in_silence(
    png: bytes, at: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    changed = bytearray(png)
    changed[at] ^= 0x5A
    (tmp_path / "bad.png").write_bytes(changed)
    for source in (bytes(changed), tmp_path / "bad.png"):
        with pytest.raises(InputError, match=r"the skin does not decode: .*: save it again$") as caught:
            read_image(source, "the skin")
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")  # libpng would write a line of its own


def test_a_damaged_texture_of_a_built_character(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = build_ball(tmp_path / "ball.seamless", sizes=(3,), position_px=16, weight_px=8, color_px=16)
    path = folder / "base_color.png"
    data = bytearray(path.read_bytes())
    data[-30] ^= 1
    path.write_bytes(data)
    with pytest.raises(AssetError, match=r"base_color.png does not decode: .* is damaged"):
        load(folder)
    assert capfd.readouterr() == ("", "")


def test_formats_are_told_by_content(tmp_path: Path) -> None:
    texels = np.full((8, 8, 3), 100, np.uint8)
    for extension in ("png", "jpg", "webp", "tif", "bmp"):
        write_image(tmp_path / f"a.{extension}", Image(texels))
        read = read_image((tmp_path / f"a.{extension}").read_bytes(), native=True)
        np.testing.assert_allclose(read.texels[..., :3].astype(int), 100, atol=2)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(90), "the skin is a KTX2 file: save it as PNG"),
        (b"hello", "the skin is no image of a known format: save it as PNG"),
        (b"", "the skin is no image of a known format: save it as PNG"),
        (b"\xff\xd8\xff\xe0", "the skin does not decode"),
    ],
)
def test_foreign_bytes_are_named(data: bytes, says: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match=says) as caught:
        read_image(data, "the skin")
    assert "\n" not in str(caught.value) and "tmp" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_a_picture_that_only_partly_reaches_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """libpng does not notice a full disk: the file is read back, and its path in a temporary folder left out."""
    monkeypatch.setattr("preprocess.files.images.find_png_fault", lambda data: "it is cut short")
    with pytest.raises(InputError, match=r"^cannot write a\.png: .*make room"):
        write_image(tmp_path / "a.png", Image(np.zeros((4, 4, 3), np.uint8)))


def test_a_folder_that_does_not_exist(tmp_path: Path) -> None:
    for extension in ("png", "exr"):
        with pytest.raises(InputError, match=rf"^cannot write a\.{extension}: ") as caught:
            write_image(tmp_path / "nowhere" / f"a.{extension}", Image(np.zeros((4, 4, 3), np.float32), "float"))
        assert str(tmp_path) not in str(caught.value)


@pytest.mark.parametrize("damage", ["header", "filter"])
def test_libraries_are_kept_from_standard_error(tmp_path: Path, capfd: pytest.CaptureFixture[str], damage: str) -> None:
    """Whole chunks with right checksums, which libpng refuses in a line of its own."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = 0 if damage == "header" else 4
    header = struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0)
    rows = zlib.compress(b"".join(b"\x09" + b"abc" * 4 for _ in range(4)))
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match="does not decode") as refusal:
        read_image(tmp_path / "a.png", "a.png")
    assert "\n" not in str(refusal.value) and capfd.readouterr() == ("", "")
    os.write(2, b"ours")
    assert capfd.readouterr().err == "ours"


def test_sizes_and_values_have_limits(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", Image(np.zeros((8, 16, 3))))
    with pytest.raises(InputError, match="16 x 8 x 1 of 3 channels, too large"):
        read_image(tmp_path / "a.png", limits=Limits(image_texels=100))
    texels = np.zeros((4, 4, 3))
    texels[2, 1, 0] = np.nan
    write_image(tmp_path / "a.exr", Image(texels, "float"))
    with pytest.raises(InputError, match="the first at column 1, row 2, channel 0"):
        read_image(tmp_path / "a.exr")
    with pytest.raises(InputError, match="it is a folder"):
        read_image(tmp_path)
