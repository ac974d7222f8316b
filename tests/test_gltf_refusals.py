"""load_character on bad files: one line that says what is wrong and where; or a report, and a sound mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, bent_bar

from preprocess.errors import InputError
from preprocess.load import load_character


def refused(builder: GltfBuilder, tmp_path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_character(builder.write(tmp_path / "bad.glb"))
    message = str(caught.value)
    assert "\n" not in message and "bad.glb" in message
    return message


def one_triangle(**changes: Any) -> GltfBuilder:
    builder = GltfBuilder()
    positions = changes.pop("positions", [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    primitive = builder.primitive(positions, changes.pop("faces", [[0, 1, 2]]), **changes)
    builder.node(mesh=builder.mesh(primitive))
    return builder


@pytest.mark.filterwarnings("ignore:invalid value")
def test_bad_meshes_are_refused_in_one_line(tmp_path: Path) -> None:
    assert "not finite" in refused(one_triangle(positions=[[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]), tmp_path)
    assert "outside its 3 vertices" in refused(one_triangle(faces=[[0, 1, 3]]), tmp_path)
    assert "entries for 3 vertices" in refused(one_triangle(TEXCOORD_0=np.zeros((2, 2))), tmp_path)
    assert "wrong type" in refused(one_triangle(NORMAL=np.zeros((3, 2))), tmp_path)
    assert "area" in refused(one_triangle(positions=[[0, 0, 0], [1, 0, 0], [2, 0, 0]]), tmp_path)
    assert "no mesh" in refused(one_triangle(faces=np.zeros((0, 3))), tmp_path)
    empty = GltfBuilder()
    empty.node()
    assert "no mesh" in refused(empty, tmp_path)
    compressed = one_triangle()
    compressed.json["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}
    compressed.json["accessors"][0].pop("bufferView")
    assert "Draco" in refused(compressed, tmp_path)
    hidden = one_triangle()
    hidden.json["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {}}
    hidden.json["extensionsRequired"] = ["EXT_meshopt_compression"]
    assert "gltf-transform" in refused(hidden, tmp_path)
    required = one_triangle()
    required.json["extensionsRequired"] = ["XX_future"]
    assert "XX_future" in refused(required, tmp_path)


def test_bad_skins_are_refused_in_one_line(tmp_path: Path) -> None:
    def skinned(joint: int, num_binds: int) -> GltfBuilder:
        builder = one_triangle(JOINTS_0=np.full((3, 4), joint), WEIGHTS_0=np.full((3, 4), 0.25))
        builder.json["nodes"][0]["skin"] = 0
        builder.skin([0], np.tile(np.eye(4), (num_binds, 1, 1)))
        return builder

    assert "outside its skin's 1 joints" in refused(skinned(1, 1), tmp_path)
    assert "0 inverse bind matrices" in refused(skinned(0, 0), tmp_path)
    no_joints = skinned(0, 1)
    no_joints.json["skins"][0]["joints"] = []
    assert "no joints" in refused(no_joints, tmp_path)
    nowhere = skinned(0, 1)
    nowhere.json["skins"][0]["joints"] = [7]
    assert "does not exist" in refused(nowhere, tmp_path)
    cycle = one_triangle()
    cycle.json["nodes"][0]["children"] = [0]
    assert "bad.glb" in refused(cycle, tmp_path)


def test_bad_files_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_character(tmp_path / "missing.glb")
    whole = bent_bar(tmp_path / "whole.glb").read_bytes()
    (tmp_path / "cut.glb").write_bytes(whole[:-100])
    with pytest.raises(InputError, match="cut short"):
        load_character(tmp_path / "cut.glb")
    (tmp_path / "text.glb").write_text("hello")
    with pytest.raises(InputError, match="not a glTF file"):
        load_character(tmp_path / "text.glb")


def test_uvs_that_are_not_finite_are_reported_and_survive(tmp_path: Path) -> None:
    character = load_character(one_triangle(TEXCOORD_0=[[0, 0], [1, np.nan], [np.inf, 1]]).write(tmp_path / "a.glb"))
    assert any("2 texture coordinates are not finite" in warning for warning in character.warnings)
    character.mesh.validate()
