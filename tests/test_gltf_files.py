"""What a file may name and how much it may ask for: regular files inside its own folder, and the stated limits."""

from __future__ import annotations

import base64
import os
from pathlib import Path

import numpy as np
import pytest
from builders_gltf import GltfBuilder, bent_bar

from preprocess.load import load_character
from runtime.errors import MOST_LETTERS, AssetError
from runtime.gltf.document import read_document
from runtime.gltf.limits import Limits
from runtime.gltf.local_files import find_local_file, read_regular


def external(folder: Path, uri: str) -> Path:
    """A character whose buffer lies at a uri."""
    folder.mkdir(exist_ok=True)
    path = bent_bar(folder / "a.external.gltf")
    path.write_text(path.read_text().replace("its%20buffer.bin", uri))
    return path


def refusal(path: Path) -> str:
    with pytest.raises(AssetError) as caught:
        read_document(path).accessor(0)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 300
    return message


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "%2e%2e/secret.bin", "sub/../../secret.bin", "..\\\\secret.bin", "/etc/passwd"]
)
def test_nothing_outside_the_folder_is_read(tmp_path: Path, uri: str) -> None:
    path = external(tmp_path / "job", uri)
    (tmp_path / "job" / "sub").mkdir()
    (tmp_path / "job" / "its buffer.bin").rename(tmp_path / "secret.bin")
    assert "is outside of" in refusal(path)


def test_links_out_of_the_folder_and_what_is_no_regular_file(tmp_path: Path) -> None:
    path = external(tmp_path / "job", "b.bin")
    data = (tmp_path / "job" / "its buffer.bin").read_bytes()
    (tmp_path / "secret.bin").write_bytes(data)
    link = tmp_path / "job" / "b.bin"
    link.symlink_to(tmp_path / "secret.bin")
    assert "is outside of" in refusal(path)
    link.unlink()
    link.symlink_to("its buffer.bin")  # within the folder a link is as good as a file
    assert len(read_document(path).accessor(0)) == 27
    link.unlink()
    link.symlink_to("/dev/zero")
    assert "is outside of" in refusal(path)
    link.unlink()
    os.mkfifo(link)
    assert "is a pipe" in refusal(path)
    link.unlink()
    link.mkdir()
    assert "is a folder, not a regular file" in refusal(path)
    inner = tmp_path / "job" / "sub" / ".." / "its buffer.bin"
    assert find_local_file(tmp_path / "job", "sub/../its buffer.bin", "buffer 0", "") == inner.resolve()


def test_sizes_are_asked_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "large.bin"
    with path.open("wb") as file:
        file.truncate(2**40)  # a hole: it takes no place
    with pytest.raises(AssetError, match="1099511627776 bytes, more than 1000: raise --limit file_bytes"):
        read_regular(path, 1000)
    with pytest.raises(AssetError, match="it is a folder"):
        read_regular(tmp_path)


@pytest.mark.parametrize(
    "wrap", [lambda t: t.rstrip("="), lambda t: "\n".join(t[i : i + 76] for i in range(0, 999, 76))]
)
def test_base64_as_browsers_read_it(tmp_path: Path, wrap) -> None:
    data = b"".join(np.arange(10, dtype="<f4"))
    builder = GltfBuilder()
    builder.accessor(np.arange(10))
    builder.node()
    path = builder.write(tmp_path / "a.gltf")
    text = base64.b64encode(bytes(builder.data)).decode()
    assert text in path.read_text()
    path.write_text(path.read_text().replace(text, wrap(text).replace("\n", "\\n")))
    assert read_document(path).accessor(0).tobytes() == data
    for letters, fault in (("AAAAA", "is cut short"), ("AA%00AA==", "holds"), ("AA=A", "holds '='")):
        path.write_text(path.read_text().replace(path.read_text().split("base64,")[1].split('"')[0], letters))
        assert f"damaged base64 uri (it {fault}" in refusal(path)


def test_text_that_no_encoding_can_write(tmp_path: Path) -> None:
    """Half of an emoji, as old JavaScript cuts it; and a name in Latin-1."""
    builder = GltfBuilder()
    builder.node(name="half \ud83d emoji")
    document = read_document(builder.write(tmp_path / "half.glb"))
    assert document.items("nodes")[0]["name"] == "half ? emoji" and len(document.notes) == 1
    path = builder.write(tmp_path / "latin.gltf")
    path.write_bytes(path.read_bytes().replace(b"half \\ud83d emoji", b"caf\xe9"))
    document = read_document(path)
    assert document.items("nodes")[0]["name"] == "caf\ufffd" and len(document.notes) == 1
    path.write_text(path.read_text(errors="replace"))  # the file's own question mark is no damage
    assert not read_document(path).notes


def test_json_padded_with_nul(tmp_path: Path) -> None:
    whole = bent_bar(tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(whole[12:16], "little")
    text = whole[20 : 20 + length].rstrip(b" ")
    (tmp_path / "a.glb").write_bytes(whole[:20] + text.ljust(length, b"\0") + whole[20 + length :])
    assert len(load_character(tmp_path / "a.glb").mesh.surface.faces) == 32


def empty_accessors(count: int, elements: int) -> GltfBuilder:
    builder = GltfBuilder()
    for _ in range(count):
        builder.add("accessors", componentType=5126, count=elements, type="VEC4")
    builder.node()
    return builder


def test_accessors_without_data_are_bounded_together(tmp_path: Path) -> None:
    path = empty_accessors(8, 2**19).write(tmp_path / "a.glb")  # 8 MiB each
    document = read_document(path)
    for index in (0, 1, 2, 3, 0, 0, 0):
        document.accessor(index)  # once read, again and again
    with pytest.raises(AssetError, match="no data for them: export again, or raise --limit unbacked_bytes"):
        document.accessor(4)
    document = read_document(path, Limits(unbacked_bytes=2**27))
    for index in range(8):
        document.accessor(index)


def test_accessors_that_share_bytes_are_bounded_together(tmp_path: Path) -> None:
    builder = GltfBuilder()
    first = builder.accessor(np.zeros((1000, 3)))
    builder.json["accessors"] += [builder.json["accessors"][first]] * 20
    builder.node()
    document = read_document(builder.write(tmp_path / "a.glb"))
    for index in range(16):
        document.accessor(index)
    with pytest.raises(AssetError, match="more than 16 times over"):
        document.accessor(16)


@pytest.mark.parametrize(
    ("node", "says"),
    [
        ({"rotation": [1e300, 0, 0, 1]}, "nodes[0].rotation[0] must be a finite number within limits"),
        ({"scale": [1e150, 1, 1]}, "nodes[0].scale[0] must be a finite number within limits"),
        ({"mesh": 10**300}, "nodes[0].mesh must be a whole number, zero or more, within limits"),
        ({"translation": [int("9" * 4000), 0, 0]}, "nodes[0].translation[0] must be"),
    ],
)
def test_numbers_have_a_range(tmp_path: Path, node: dict[str, object], says: str) -> None:
    builder = GltfBuilder()
    builder.node(**node)
    with pytest.raises(AssetError) as caught:
        read_document(builder.write(tmp_path / "a.glb"))
    assert says in str(caught.value)


def test_messages_are_one_line_of_bounded_length() -> None:
    message = str(AssetError("name\n" + "x" * 5000 + " the end"))
    assert len(message) <= MOST_LETTERS < 300 and message.startswith("name x") and message.endswith("the end")
