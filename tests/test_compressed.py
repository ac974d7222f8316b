"""Files compressed with Draco and meshoptimizer, made here with the packages' own encoders; damaged streams."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, grid

from preprocess.errors import InputError
from preprocess.load import load_character


def _plain(builder: GltfBuilder) -> dict[str, Any]:
    shape = grid(4, 6)
    primitive = builder.primitive(
        shape["positions"],
        shape["faces"],
        TEXCOORD_0=shape["uvs"],
        JOINTS_0=np.tile([0, 1, 0, 0], (len(shape["uvs"]), 1)),
        WEIGHTS_0=np.tile([0.25, 0.75, 0, 0], (len(shape["uvs"]), 1)),
    )
    root = builder.node(name="root")
    tip = builder.node(root, name="tip")
    builder.node(mesh=builder.mesh(primitive), skin=builder.skin([root, tip]))
    return primitive


def _compress_views(builder: GltfBuilder, extension: str) -> None:
    """Every accessor's view in the mode that suits it."""
    meshopt = pytest.importorskip("meshopt")
    plain, builder.data = bytes(builder.data), bytearray()
    kinds = {spec["bufferView"]: spec for spec in builder.json["accessors"]}
    for number, view in enumerate(builder.json["bufferViews"]):
        data = plain[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        spec = kinds[number]
        if spec["type"] == "SCALAR":
            values, mode, stride = np.frombuffer(data, np.uint16).astype(np.uint32), "TRIANGLES", 2
        else:
            values, mode, stride = np.frombuffer(data, np.uint8).reshape(spec["count"], -1), "ATTRIBUTES", 0
            stride = values.shape[1]
        packed = meshopt.encode_gltf_buffer(np.ascontiguousarray(values), mode)
        start = len(builder.data)
        builder.data += packed + b"\0" * (-len(packed) % 4)
        inner = {"buffer": 0, "byteOffset": start, "byteLength": len(packed), "byteStride": stride, "mode": mode}
        view.update(byteOffset=0, extensions={extension: {**inner, "count": spec["count"]}})
    builder.json["extensionsRequired"] = [extension]


@pytest.mark.parametrize("extension", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_meshopt(tmp_path: Path, extension: str) -> None:
    plain = GltfBuilder()
    _plain(plain)
    expected = load_character(plain.write(tmp_path / "plain.glb")).mesh
    packed = GltfBuilder()
    _plain(packed)
    _compress_views(packed, extension)
    found = load_character(packed.write(tmp_path / "packed.glb")).mesh
    order = np.lexsort(found.surface.positions.round(6).T), np.lexsort(expected.surface.positions.round(6).T)
    np.testing.assert_array_equal(found.surface.positions[order[0]], expected.surface.positions[order[1]])
    np.testing.assert_allclose(found.joint_weights, 0 * found.joint_weights + [0.75, 0.25])
    assert found.num_faces == expected.num_faces
    for change in ({"count": 10**9}, {"mode": "X"}, {"byteStride": 0}, {"byteLength": 9}, {"count": 7}):
        damaged = GltfBuilder()
        _plain(damaged)
        _compress_views(damaged, extension)
        damaged.json["bufferViews"][0]["extensions"][extension].update(change)
        with pytest.raises(InputError, match=r"damaged|malformed|unknown|outside|cut short"):
            load_character(damaged.write(tmp_path / "damaged.glb"))


def _draco(builder: GltfBuilder, cut: int | None = None) -> None:
    draco_py = pytest.importorskip("DracoPy")
    primitive = _plain(builder)
    shape = grid(4, 6)
    count = len(shape["uvs"])
    data = draco_py.encode(
        np.ascontiguousarray(shape["positions"], np.float32),
        np.ascontiguousarray(shape["faces"], np.uint32),
        quantization_bits=16,
        preserve_order=True,
        tex_coord=np.ascontiguousarray(shape["uvs"], np.float64),
        generic_attributes={
            7: np.tile(np.array([0, 1, 0, 0], np.uint8), (count, 1)),
            8: np.tile(np.array([0.25, 0.75, 0, 0], np.float32), (count, 1)),
        },
    )
    by_type = {one["attribute_type"]: one["unique_id"] for one in draco_py.decode(data).attributes}
    ids = {"POSITION": by_type[0], "TEXCOORD_0": by_type[3], "JOINTS_0": 7, "WEIGHTS_0": 8}
    view = builder.view(data[:cut])
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": ids}}
    for index in [primitive["indices"], *primitive["attributes"].values()]:
        builder.json["accessors"][index].pop("bufferView")
    builder.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def test_draco(tmp_path: Path) -> None:
    builder = GltfBuilder()
    _draco(builder)
    mesh = load_character(builder.write(tmp_path / "a.glb")).mesh
    expected = np.unique(grid(4, 6)["positions"].round(3), axis=0)
    np.testing.assert_allclose(np.unique(mesh.surface.positions.round(3), axis=0), expected, atol=1.1e-3)
    np.testing.assert_allclose(mesh.joint_weights, 0 * mesh.joint_weights + [0.75, 0.25])
    assert mesh.num_faces == 48
    for cut in (40, 11, 3):
        damaged = GltfBuilder()
        _draco(damaged, cut)
        with pytest.raises(InputError, match=r"Draco data is damaged"):
            load_character(damaged.write(tmp_path / "damaged.glb"))
    missing = GltfBuilder()
    _draco(missing)
    extension = missing.json["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]
    extension["attributes"]["JOINTS_0"] = 99
    with pytest.raises(InputError, match="has no JOINTS_0"):
        load_character(missing.write(tmp_path / "missing.glb"))
