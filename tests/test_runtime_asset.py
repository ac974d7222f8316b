"""Reading built characters: what is read is what was written, and every damage is named."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_asset import build_ball, lod_mesh, weights_at

from preprocess.errors import InputError
from preprocess.files.images import Image, read_image, write_image
from runtime.asset.asset import load
from runtime.asset.weight_stack import pack_weights, unpack_weights
from runtime.errors import AssetError
from runtime.gpu.weight_records import MORE_RECORDS, WeightCells, build_weight_cells


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return build_ball(tmp_path / "ball.seamless", sizes=(6, 3), position_px=32, weight_px=16, color_px=32)


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "manifest.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_what_is_read_is_what_was_written(folder: Path) -> None:
    asset = load(folder)
    assert (asset.name, asset.num_joints, len(asset.lods), len(asset.clips)) == ("ball", 4, 2, 1)
    assert asset.textures["normal"].size == (32, 32) and len(asset.textures["normal"].levels) == 3
    assert asset.textures["base_color"].levels[1].dtype == np.uint8
    uvs, canonical_uvs, triangles, _ = lod_mesh(6)
    mesh = asset.lods[0]
    assert len(mesh.triangles) == len(triangles) and len(mesh.uvs) == len(uvs)
    read = np.concatenate([mesh.uvs[mesh.triangles], mesh.canonical_uvs[mesh.triangles]], axis=2).reshape(-1, 12)
    written = np.concatenate([uvs[triangles], canonical_uvs[triangles]], axis=2).reshape(-1, 12).astype(np.float32)
    assert (np.unique(read, axis=0) == np.unique(written, axis=0)).all()  # drawn in another order
    assert len(np.unique(mesh.canonical_uvs, axis=0)) == 6 * 6 * 6 + 2  # points of a cube's grid


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(schema=99), r"schema 99.*upgrade"),
        (lambda m: m.pop("schema"), "names no schema"),
        (lambda m: m.pop("textures"), "required field `textures`"),
        (lambda m: m["textures"].pop("position"), "textures: .*required field `position`"),
        (lambda m: m["textures"]["normal"].update(size=[3, 3]), r"textures.normal has 3 levels of 3 texels"),
        (lambda m: m["textures"]["normal"].update(size=7), r"textures.normal.size"),
        (lambda m: m["textures"]["normal"].update(format="jpeg"), r"textures.normal.format"),
        (lambda m: m["textures"]["weights"].pop("slots"), r"textures.weights: .*required field `slots`"),
        (lambda m: m["joints"].append("extra"), "bounds.joints has 4 entries for 5 joints"),
        (lambda m: m["bounds"].update(bind=[[0, 0], [1, 1]]), r"bounds.bind\[0\]: Expected `array`"),
        (lambda m: m["bounds"].update(joints=None) or m["joints"].append("extra"), "of different builds"),
        (lambda m: m["lods"][1].update(node="nobody"), "no mesh node 'nobody'"),
        (lambda m: m["lods"][1].update(error_m=float("nan")), "not JSON"),
        (lambda m: m["textures"]["normal"].update(size=[30, 32]), r"texture normal.*is 32 x 32, not 30 x 32"),
        (lambda m: m["textures"]["normal"].update(format="uint8"), "holds uint16, not uint8"),
        (lambda m: m["textures"]["normal"].update(file="../normal.png"), "outside of"),
        (lambda m: m["textures"]["normal"].update(file="/dev/zero"), "outside of"),
        (lambda m: m["textures"]["normal"].update(file="mips"), "not a regular file"),
        (lambda m: m.update(model="../ball.seamless/../../x/model.glb"), "outside of"),
        (lambda m: m["bounds"].update(bind=[[1, 1, 1], [0, 0, 0]]), "not a box"),
        (lambda m: m["clips"][0].update(name="jump"), "the clips of manifest.json"),
        (lambda m: m["clips"][0].update(duration_s=2.0), "the clips of manifest.json"),
        (lambda m: m["bounds"]["clips"].clear(), "the bounds.clips of manifest.json"),
        (lambda m: m["lods"][1].update(faces=3), "has 108 faces, the manifest says 3"),
        (lambda m: m["lods"][1].update(error_m=None), r"lods\[1\].error_m: Expected `float`"),
    ],
)
def test_a_bad_manifest_is_refused(folder: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    edit(folder, change)
    with pytest.raises(AssetError, match=message) as caught:
        load(folder)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("name", ["position.exr", "normal.png", "weights.png", "base_color.png", "mips/normal.1.png"])
def test_missing_and_truncated_textures_are_named(folder: Path, name: str) -> None:
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(AssetError, match=Path(name).name.replace(".", r"\.")):
        load(folder)
    (folder / name).unlink()
    with pytest.raises(AssetError, match="is missing"):
        load(folder)


def test_damage_that_the_library_quotes_is_refused_in_a_line(folder: Path) -> None:
    """OpenEXR's message holds the damaged bytes, which are no UTF-8."""
    data = bytearray((folder / "position.exr").read_bytes()[:23])
    data[8] = 128
    (folder / "position.exr").write_bytes(data)
    with pytest.raises(AssetError, match=r"position\.exr does not decode \(it is damaged\)"):
        load(folder)
    with pytest.raises(InputError, match="does not decode"):
        read_image(folder / "position.exr")


def test_positions_that_are_not_finite_are_refused(folder: Path) -> None:
    texels = read_image(folder / "position.exr").texels.copy()
    texels[3, 4, 1] = np.nan
    write_image(folder / "position.exr", Image(texels, "float"))
    with pytest.raises(AssetError, match="texture position holds values that are not finite"):
        load(folder)


def test_joints_that_do_not_exist_are_refused(folder: Path) -> None:
    texels = read_image(folder / "weights.png").texels.copy()
    texels[0, 0, 0] = 4 / 255
    write_image(folder / "weights.png", Image(texels, "uint8"))
    with pytest.raises(AssetError, match="names joint 4 of 4"):
        load(folder)


def test_links_out_of_the_folder_are_not_followed(folder: Path, tmp_path: Path) -> None:
    (folder / "normal.png").rename(tmp_path / "normal.png")
    (folder / "normal.png").symlink_to(tmp_path / "normal.png")
    with pytest.raises(AssetError, match="outside of"):
        load(folder)


def test_missing_folders_and_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="no such folder"):
        load(tmp_path / "nothing")
    with pytest.raises(AssetError, match=r"no manifest\.json"):
        load(tmp_path)
    (folder / "model.glb").unlink()
    with pytest.raises(AssetError, match=r"model\.glb"):
        load(folder)
    (folder / "manifest.json").write_text("{")
    with pytest.raises(AssetError, match="not JSON"):
        load(folder)


def test_importing_the_runtime_is_quick_and_needs_nothing_of_preprocessing() -> None:
    code = (
        "import sys, time; t = time.process_time(); import runtime, runtime.asset.asset, runtime.render.renderer\n"
        "print(time.process_time() - t)\n"
        "bad = [m for m in ('scipy', 'numba', 'preprocess', 'OpenImageIO', 'pygltflib', 'glfw') if m in sys.modules]\n"
        "assert not bad, bad"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert float(out) < 1.0  # usually under 0.2 s


def test_loading_is_quick(folder: Path) -> None:
    load(folder)
    start = time.process_time()
    load(folder)
    assert time.process_time() - start < 0.5


# Weights


def random_weights(rng: np.random.Generator, shape: tuple[int, int], num_joints: int, influences: int) -> np.ndarray:
    dense = np.zeros((*shape, num_joints))
    joints = np.argsort(rng.random((*shape, num_joints)), axis=-1)[..., :influences]
    np.put_along_axis(dense, joints, rng.random(joints.shape) + 0.01, axis=-1)
    return dense / dense.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize(("num_joints", "influences"), [(1, 1), (3, 3), (53, 4), (300, 6), (40, 8)])
def test_packed_weights_are_a_partition_of_unity_close_to_the_given(num_joints: int, influences: int) -> None:
    dense = random_weights(np.random.default_rng(1), (9, 12), num_joints, influences)
    packed = pack_weights(dense)
    assert packed.stack.dtype == (np.uint8 if num_joints <= 256 else np.uint16)
    assert packed.size == (12, 9) and packed.stack.shape == (9 * 2 * -(-packed.slots // 4), 12, 4)
    stored = unpack_weights(packed.stack, packed.size, num_joints)
    assert np.abs(stored.sum(axis=-1) - 1).max() < 1e-12
    assert np.abs(stored - dense).max() < 1.01 / 255
    again = pack_weights(stored)
    assert (unpack_weights(again.stack, again.size, num_joints) == stored).all()
    assert packed.dropped_max == pytest.approx(0.0, abs=1e-12)


def test_too_many_joints_a_texel_are_reported() -> None:
    packed = pack_weights(np.full((2, 2, 10), 0.1))
    assert packed.slots == 8 and packed.dropped_max == pytest.approx(0.2)


@pytest.mark.parametrize("bad", [np.zeros((3, 4)), np.zeros((2, 2, 0)), np.full((2, 2, 2), np.nan)])
def test_packing_refuses_what_are_no_weights(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="dense weights"):
        pack_weights(bad)


def weights_of_cell(cells: WeightCells, row: int, column: int, num_joints: int) -> np.ndarray:
    """Slow twin: the four texels' dense weights (4, J) of a cell, as the shader would add them up."""
    dense = np.zeros((4, num_joints))
    left = np.ones(4)
    record = int(cells.first_record[row, column])
    while True:
        words = [int(word) for word in cells.records.reshape(-1, 4)[record]]
        joints = [words[0] >> (8 * slot) & 255 for slot in range(4)]
        more = joints[3] == MORE_RECORDS
        if cells.joints is not None:
            joints = [int(joint) for joint in cells.joints.reshape(-1, 4)[record]]
        for slot in range(3):
            given = np.array([words[1 + slot] >> (8 * texel) & 255 for texel in range(4)]) / 255
            dense[:, joints[slot]] += given
            left -= given
        if not more:
            dense[:, joints[3]] += left
            return dense
        record += 1


@pytest.mark.parametrize(("num_joints", "influences"), [(1, 1), (5, 2), (53, 4), (40, 8), (255, 5), (256, 5), (300, 5)])
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (7, 5)])
def test_cells_hold_exactly_what_is_stored(num_joints: int, influences: int, shape: tuple[int, int]) -> None:
    packed = pack_weights(random_weights(np.random.default_rng(2), shape, num_joints, influences))
    stored = unpack_weights(packed.stack, packed.size, num_joints)
    cells = build_weight_cells(packed.stack, packed.size, num_joints)
    for row in range(max(shape[0] - 1, 1)):
        for column in range(max(shape[1] - 1, 1)):
            far_row, far_column = min(row + 1, shape[0] - 1), min(column + 1, shape[1] - 1)
            expected = [
                stored[row, column],
                stored[row, far_column],
                stored[far_row, column],
                stored[far_row, far_column],
            ]
            assert np.allclose(weights_of_cell(cells, row, column, num_joints), expected, atol=1e-12)


def test_rigid_parts_cost_one_record() -> None:
    dense = np.zeros((64, 64, 3))
    dense[:, :32, 0] = dense[:, 32:, 2] = 1.0
    packed = pack_weights(dense)
    cells = build_weight_cells(packed.stack, packed.size, 3)
    assert len(np.unique(cells.first_record)) == 3 and cells.max_records == 1


def test_weights_of_the_ball_come_back(folder: Path) -> None:
    asset = load(folder)
    stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, 4)
    assert (stored.argmax(axis=-1)[:, :1] <= 3).all()
    assert np.abs(weights_at(np.array([[0.0, 0.0, 0.0]]), 4).sum() - 1) < 1e-12
