"""runtime/gltf/document.py: accessors of every kind, buffers from everywhere, and one line for every kind of damage."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from builders_gltf import GltfBuilder, bent_bar
from conftest import asset

from runtime.errors import AssetError
from runtime.gltf.document import read_document


def written(builder: GltfBuilder, tmp_path: Path):
    builder.node()
    return read_document(builder.write(tmp_path / "a.glb"))


def test_plain_accessors_come_back_as_written(tmp_path: Path) -> None:
    builder = GltfBuilder()
    rng = np.random.default_rng(1)
    tables = [
        (rng.integers(0, 99, 7), np.uint8),
        (rng.integers(0, 9999, 5), np.uint32),
        (rng.normal(size=(4, 3)), np.float32),
        (rng.integers(0, 99, (6, 4)), np.uint16),
        (rng.normal(size=(3, 4, 4)), np.float32),
        (rng.integers(-99, 99, (5, 3)), np.int8),  # three bytes in a stride of four
    ]
    indices = [builder.accessor(values, dtype) for values, dtype in tables]
    document = written(builder, tmp_path)
    for index, (values, dtype) in zip(indices, tables):
        read = document.accessor(index)
        assert read.dtype == dtype and read.flags.c_contiguous
        np.testing.assert_array_equal(read, values.astype(dtype))


def test_columns_of_byte_matrices_start_at_multiples_of_four(tmp_path: Path) -> None:
    builder = GltfBuilder()
    stored = bytes([1, 2, 3, 99, 4, 5, 6, 99, 7, 8, 9, 99])
    view = builder.view(stored)
    index = builder.add("accessors", bufferView=view, componentType=5121, count=1, type="MAT3")
    read = written(builder, tmp_path).accessor(index)
    np.testing.assert_array_equal(read, [[[1, 4, 7], [2, 5, 8], [3, 6, 9]]])


@pytest.mark.parametrize(
    ("dtype", "stored", "expected"),
    [
        (np.uint8, [0, 255, 51], [0, 1, 0.2]),
        (np.uint16, [0, 65535, 13107], [0, 1, 0.2]),
        (np.int8, [-128, -127, 127], [-1, -1, 1]),
        (np.int16, [-32768, 0, 32767], [-1, 0, 1]),
    ],
)
def test_normalised_integers(tmp_path: Path, dtype, stored, expected) -> None:
    builder = GltfBuilder()
    index = builder.accessor(stored, dtype, normalized=True)
    read = written(builder, tmp_path).accessor(index)
    assert read.dtype == np.float32
    np.testing.assert_allclose(read, expected, atol=1e-7)


def test_sparse_accessors_with_and_without_a_base(tmp_path: Path) -> None:
    builder = GltfBuilder()
    at = builder.view(np.array([1, 3], np.uint16).tobytes())
    new = builder.view(np.array([[10, 11, 12], [20, 21, 22]], np.float32).tobytes())
    sparse = {"count": 2, "indices": {"bufferView": at, "componentType": 5123}, "values": {"bufferView": new}}
    base = np.arange(12, dtype=np.float32).reshape(4, 3)
    over = builder.accessor(base, sparse=sparse)
    alone = builder.add("accessors", componentType=5126, count=4, type="VEC3", sparse=sparse)
    document = written(builder, tmp_path)
    expected = base.copy()
    expected[[1, 3]] = [[10, 11, 12], [20, 21, 22]]
    np.testing.assert_array_equal(document.accessor(over), expected)
    expected[[0, 2]] = 0
    np.testing.assert_array_equal(document.accessor(alone), expected)


def test_interleaved_views_with_offsets(tmp_path: Path) -> None:
    builder = GltfBuilder()
    record = np.zeros(5, [("p", "<f4", 3), ("id", "<u2"), ("pad", "<u2")])
    record["p"] = np.arange(15).reshape(5, 3)
    record["id"] = [7, 8, 9, 10, 11]
    view = builder.view(b"skip" + record.tobytes(), byteStride=16)
    p = builder.add("accessors", bufferView=view, byteOffset=4, componentType=5126, count=5, type="VEC3")
    i = builder.add("accessors", bufferView=view, byteOffset=16, componentType=5123, count=5, type="SCALAR")
    document = written(builder, tmp_path)
    np.testing.assert_array_equal(document.accessor(p), record["p"])
    np.testing.assert_array_equal(document.accessor(i), record["id"])


def compress(builder: GltfBuilder, required: bool) -> None:
    """Say of the first view that it is compressed."""
    builder.json["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {}}
    if required:
        builder.json["extensionsRequired"] = ["EXT_meshopt_compression"]


@pytest.mark.parametrize("name", ["a.glb", "a.vrm", "a.gltf", "a.external.gltf"])
def test_buffers_inside_beside_and_in_base64(tmp_path: Path, name: str) -> None:
    document = read_document(bent_bar(tmp_path / name))
    positions = document.accessor(document.items("meshes")[0]["primitives"][0]["attributes"]["POSITION"])
    assert positions.shape == (27, 3) and positions[:, 1].max() == 2


@pytest.mark.parametrize("name", ["Fox.glb", "Knight.glb", "human.glb", "mannequiny.glb", "robot.glb"])
def test_every_accessor_of_the_characters_reads(name: str) -> None:
    document = read_document(asset(name))
    for index, spec in enumerate(document.items("accessors")):
        assert len(document.accessor(index)) == spec["count"]


def test_whole_numbers_may_be_written_with_a_point(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = builder.primitive([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    shape["indices"] = float(shape["indices"])
    builder.node(mesh=builder.mesh(shape))
    for accessor in builder.json["accessors"]:
        accessor["count"] = float(accessor["count"])
    builder.json["scenes"][0]["nodes"] = [0.0]
    document = read_document(builder.write(tmp_path / "a.glb"))
    assert document.accessor(int(shape["indices"])).tolist() == [0, 1, 2]
    assert document.json["scenes"][0]["nodes"] == [0] and type(document.json["scenes"][0]["nodes"][0]) is int


def test_nothing_is_decoded_before_it_is_asked_for() -> None:
    path = asset("Knight.glb")
    read_document(path)
    start = time.process_time()
    document = read_document(path)
    assert time.process_time() - start < 0.5  # 0.03 s; pygltflib takes 5.4 s
    assert len(document.items("accessors")) == 8839


def broken(tmp_path: Path, change) -> Path:
    builder = GltfBuilder()
    builder.accessor(np.zeros((4, 3)))
    builder.node()
    change(builder)
    return builder.write(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda b: b.json["accessors"][0].update(count=5), "reaches outside"),
        (lambda b: b.json["accessors"][0].update(count=-1), "accessors[0].count must be a whole number"),
        (lambda b: b.json["accessors"][0].update(byteOffset=4), "reaches outside"),
        (lambda b: b.json["accessors"][0].update(byteOffset=-4), "malformed"),
        (lambda b: b.json["accessors"][0].update(type="VEC5"), "malformed"),
        (lambda b: b.json["accessors"][0].update(componentType=1), "malformed"),
        (lambda b: b.json["accessors"][0].update(bufferView=9), "does not exist"),
        (lambda b: b.json["accessors"][0].update(sparse={"count": 1}), "sparse part is malformed"),
        (lambda b: b.json["bufferViews"][0].update(byteLength=10**6), "cut short"),
        (lambda b: b.json["bufferViews"][0].update(buffer=1), "does not exist"),
        (lambda b: compress(b, required=True), "decompress"),
        (lambda b: b.json.update(asset={"version": "1.0"}), "glTF 2.0"),
        (lambda b: b.json.pop("asset"), "not a glTF file"),
        (lambda b: b.json.update(nodes=[1, 2]), "nodes[0] must be an object"),
        (lambda b: b.json.update(nodes=5), "nodes must be a list"),
        (lambda b: b.json["nodes"][0].update(scale=[1, "2", 3]), "nodes[0].scale[1] must be a finite number"),
        (lambda b: b.json["nodes"][0].update(scale=[1, float("nan"), 3]), "nodes[0].scale[1] must be a finite number"),
        (lambda b: b.json["nodes"][0].update(mesh=True), "nodes[0].mesh must be a whole number"),
        (lambda b: b.json.update(images=[{"uri": 3}]), "images[0].uri must be text"),
        (
            lambda b: b.json["accessors"].__setitem__(0, {"componentType": 5126, "count": 10**9, "type": "VEC3"}),
            "no data",
        ),
    ],
)
def test_damage_is_told_in_one_line(tmp_path: Path, change, says: str) -> None:
    path = broken(tmp_path, change)
    with pytest.raises(AssetError) as caught:
        read_document(path).accessor(0)
    message = str(caught.value)
    assert says in message and "\n" not in message and "a.glb" in message


def test_files_that_are_no_gltf(tmp_path: Path) -> None:
    whole = bent_bar(tmp_path / "whole.glb").read_bytes()
    cases = {
        "cut.glb": whole[: len(whole) // 2],
        "header.glb": whole[:11],
        "garbage.glb": b"\x00\x01\x02" * 50,
        "empty.glb": b"",
        "array.gltf": b"[1, 2]",
        "broken.gltf": b'{"asset": {"version": "2.0"',
        "latin.gltf": b'{"asset": "\xe9"}',
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(AssetError) as caught:
            read_document(tmp_path / name)
        assert "\n" not in str(caught.value), name
    with pytest.raises(AssetError, match="no such file"):
        read_document(tmp_path / "missing.glb")
    with pytest.raises(AssetError, match="cannot read"):
        read_document(tmp_path)


def test_missing_and_remote_buffers(tmp_path: Path) -> None:
    path = bent_bar(tmp_path / "a.external.gltf")
    (tmp_path / "its buffer.bin").unlink()
    with pytest.raises(AssetError, match="is missing"):
        read_document(path).accessor(0)
    path.write_text(path.read_text().replace("its%20buffer.bin", "https://example.org/x.bin"))
    with pytest.raises(AssetError, match="download"):
        read_document(path).accessor(0)
    path.write_text(path.read_text().replace("https://example.org/x.bin", "data:;base64,@@@"))
    with pytest.raises(AssetError, match="base64"):
        read_document(path).accessor(0)


def test_names_that_exporters_write_badly(tmp_path: Path) -> None:
    path = bent_bar(tmp_path / "a.external.gltf")
    text = path.read_text()
    data = (tmp_path / "its buffer.bin").read_bytes()
    (tmp_path / "its buffer.bin").unlink()
    (tmp_path / "Data").mkdir()
    for uri, file in {
        "Data/50%25 %2341.bin": "Data/50% #41.bin",
        "Data/50% #42.bin": "Data/50% #42.bin",
        "Data/a%20b.bin": "Data/a%20b.bin",
        "Data\\\\c.bin": "Data/c.bin",
        "DATA/d.BIN": "Data/D.bin",
        "C:\\\\Users\\\\me\\\\e.bin": "e.bin",
    }.items():
        (tmp_path / file).write_bytes(data)
        path.write_text(text.replace("its%20buffer.bin", uri))
        assert len(read_document(path).accessor(0)) == 27
    path.write_text(text.replace("its%20buffer.bin", "Data"))
    with pytest.raises(AssetError, match="buffer 0: 'Data' is a folder, not a regular file: put it beside"):
        read_document(path).accessor(0)


def test_a_compressed_view_with_an_uncompressed_copy_is_read(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.accessor([[1, 2, 3]])
    compress(builder, required=False)
    assert written(builder, tmp_path).accessor(0).tolist() == [[1, 2, 3]]
    document = written(builder, tmp_path)
    document.json["buffers"].append({"byteLength": 12})  # a length and no data
    document.json["bufferViews"][0]["buffer"] = 1
    with pytest.raises(AssetError, match="EXT_meshopt_compression: decompress"):
        document.accessor(0)


def test_required_extensions(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.json["extensionsRequired"] = ["KHR_mesh_quantization", "KHR_texture_basisu"]
    document = written(builder, tmp_path)
    document.require_extensions(["KHR_mesh_quantization", "KHR_texture_basisu"])
    with pytest.raises(AssetError, match=r"KHR_texture_basisu.*PNG or JPEG"):
        document.require_extensions(["KHR_mesh_quantization"])
