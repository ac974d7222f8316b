"""load_character on hand-made files: nodes, skins, rigid parts, primitives and their attributes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, cube, grid
from source_triangles import (
    check_against_source,
    drawn_triangles,
)

from preprocess.load import load_character
from runtime.animation.pose import sample


def rigid_robot() -> tuple[GltfBuilder, list[int]]:
    """A skinned bar, a cube on its tip and one on a node of its own, all under a turned, scaled armature."""
    builder = GltfBuilder()
    armature = builder.node(name="armature", rotation=[0, np.sqrt(0.5), 0, np.sqrt(0.5)], scale=[0.01, 0.01, 0.01])
    root = builder.node(armature, name="root", translation=[0, 10, 0])
    tip = builder.node(root, name="tip", translation=[0, 100, 0])
    shape, box = grid(2, 8, (50, 200)), cube()
    weight = np.clip(shape["positions"][:, 1] / 100 - 0.5, 0, 1)
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[0, 1, 3], inverse[1, 1, 3] = -10, -110
    bar = builder.primitive(
        shape["positions"],
        shape["faces"],
        TEXCOORD_0=shape["uvs"],
        JOINTS_0=np.tile([0, 1, 0, 0], (len(weight), 1)),
        WEIGHTS_0=np.stack([1 - weight, weight, 0 * weight, 0 * weight], axis=1),
    )
    block = builder.mesh(
        builder.primitive(box["positions"] * 20, box["faces"], NORMAL=box["normals"], TEXCOORD_0=box["uvs"])
    )
    builder.node(mesh=builder.mesh(bar), skin=builder.skin([root, tip], inverse))
    hand = builder.node(tip, name="hand", mesh=block, translation=[0, 30, 0], scale=[1, 2, 1])
    alone = builder.node(name="alone", mesh=block, translation=[3, 0, 0], scale=[-0.01, 0.01, 0.01])
    half = np.sqrt(0.5)
    builder.clip(
        "bend",
        (tip, "rotation", "LINEAR", [0, 1], [[0, 0, 0, 1], [0, 0, half, half]]),
        (hand, "scale", "LINEAR", [0, 1], [[1, 2, 1], [2, 2, 2]]),
        (alone, "translation", "STEP", [0, 0.5], [[3, 0, 0], [4, 0, 0]]),
    )
    return builder, [root, tip, hand, alone]


def test_rigid_parts_move_with_their_nodes(tmp_path: Path) -> None:
    builder, nodes = rigid_robot()
    character = check_against_source(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.document_nodes[character.skeleton.joint_nodes].tolist() == nodes
    assert character.mesh.surface.diagonal_m < 10  # the armature's scale stands in object space


def test_a_mirrored_part_keeps_its_outside(tmp_path: Path) -> None:
    builder, _ = rigid_robot()
    character = load_character(builder.write(tmp_path / "a.glb"))
    mesh = character.mesh
    corners = mesh.surface.positions[mesh.surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    boxes = mesh.face_parts > 0
    assert (np.einsum("fc,fkc->fk", normals, mesh.corner_normals)[boxes] > 0).all()


def test_two_skins_with_different_binds_of_one_joint(tmp_path: Path) -> None:
    """Each skin was bound in another pose and unit: the same nodes, four exact joints."""
    builder = GltfBuilder()
    root = builder.node(name="root")
    tip = builder.node(root, name="tip", translation=[0, 1, 0], rotation=[0, 0, 0.6, 0.8])
    shape = grid(1, 4)
    weight = shape["positions"][:, 1]
    attributes = {
        "JOINTS_0": np.tile([0, 1, 0, 0], (len(weight), 1)),
        "WEIGHTS_0": np.stack([1 - weight, weight, 0 * weight, 0 * weight], axis=1),
    }
    first = np.tile(np.eye(4), (2, 1, 1))
    first[1, 1, 3] = -1
    second = first * 0.01
    second[:, 3, 3] = 1
    second[1, :3, 3] = [0.3, -0.7, 0.1]
    for inverse, scale in ((first, 1), (second, 100)):
        primitive = builder.primitive(shape["positions"] * scale, shape["faces"], **attributes)
        builder.node(mesh=builder.mesh(primitive), skin=builder.skin([root, tip], inverse))
    builder.clip("turn", (tip, "rotation", "LINEAR", [0, 1], [[0, 0, 0, 1], [0.6, 0, 0, 0.8]]))
    character = check_against_source(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.num_joints == 3  # one of the two joints agrees: it is shared


def test_equal_skins_share_their_joints_and_weld(tmp_path: Path) -> None:
    builder = GltfBuilder()
    root = builder.node(name="root", translation=[0, 5, 0])
    inverse = np.eye(4)[None].copy()
    inverse[0, 1, 3] = -5
    shape = grid(2, 2)
    skin = {"JOINTS_0": np.zeros((9, 4)), "WEIGHTS_0": np.tile([1.0, 0, 0, 0], (9, 1))}
    for offset in (0.0, 1.0):
        positions = shape["positions"] + (offset, 0, 0)
        mesh = builder.mesh(builder.primitive(positions, shape["faces"], **skin))
        builder.node(mesh=mesh, skin=builder.skin([root], inverse))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.num_joints == 1
    assert character.mesh.num_vertices == 15  # two grids of nine share a column of three


def test_a_rigid_part_that_touches_the_body_stays_apart(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(2, 2)
    first = builder.node(name="a", mesh=builder.mesh(builder.primitive(shape["positions"], shape["faces"])))
    builder.node(first, name="b", mesh=0, translation=[1, 0, 0])
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.num_joints == 2 and character.mesh.num_vertices == 18


def test_no_skin_makes_joints_of_the_nodes_with_a_warning(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(2, 2)
    primitive = builder.primitive(shape["positions"], shape["faces"], TEXCOORD_0=shape["uvs"])
    builder.node(name="statue", mesh=builder.mesh(primitive), scale=[2, 2, 2])
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.joint_names == ("statue",)
    assert any("no skin" in warning for warning in character.warnings)
    assert character.mesh.surface.positions.max() == 2


@pytest.mark.parametrize("key", ["matrix", "trs"])
def test_node_transforms_as_matrix_and_as_parts(tmp_path: Path, key: str) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    half = np.sqrt(0.5)
    transform: dict[str, Any] = {"translation": [1, 2, 3], "rotation": [0, 0, half, half], "scale": [2, 3, 4]}
    if key == "matrix":
        matrix = np.array([[0, -3, 0, 1], [2, 0, 0, 2], [0, 0, 4, 3], [0, 0, 0, 1.0]])
        transform = {"matrix": matrix.T.ravel().tolist()}
    parent = builder.node(**transform)
    builder.node(parent, mesh=builder.mesh(builder.primitive(shape["positions"], shape["faces"])))
    surface = load_character(builder.write(tmp_path / "a.glb")).mesh.surface
    expected = shape["positions"] @ np.array([[0, -3, 0], [2, 0, 0], [0, 0, 4]]).T + (1, 2, 3)
    np.testing.assert_allclose(surface.positions[surface.faces], expected[shape["faces"]], atol=1e-6)


def test_a_hidden_part_of_zero_scale_can_still_be_shown(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    primitive = builder.primitive(shape["positions"], shape["faces"])
    node = builder.node(mesh=builder.mesh(primitive), scale=[0, 0, 0])
    builder.clip("show", (node, "scale", "LINEAR", [0, 1], [[0, 0, 0], [1, 1, 1]]))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.mesh.num_faces == 2 and character.mesh.surface.diagonal_m == pytest.approx(np.sqrt(2))
    shown = drawn_triangles(character, sample(character.clips[0], character.skeleton, 1.0))
    np.testing.assert_allclose(shown, shape["positions"][shape["faces"]], atol=1e-6)


def test_strips_fans_missing_indices_lines_and_points(tmp_path: Path) -> None:
    builder = GltfBuilder()
    strip = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], float)
    fan = np.array([[5, 0, 0], [6, 0, 0], [6, 1, 0], [5, 1, 0]], float)
    loose = np.array([[9, 0, 0], [10, 0, 0], [9, 1, 0]], float)
    primitives = [
        builder.primitive(strip, mode=5),
        builder.primitive(fan, np.arange(4), mode=6),
        builder.primitive(loose),
        builder.primitive(loose, mode=1),
        builder.primitive(loose, mode=0),
    ]
    builder.node(mesh=builder.mesh(*primitives))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.mesh.num_faces == 4 + 2 + 1
    corners = character.mesh.surface.positions[character.mesh.surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()  # all wind one way
    assert sum("points or lines dropped" in warning for warning in character.warnings) == 2


def test_eight_influences_are_normalised_and_kept(tmp_path: Path) -> None:
    builder = GltfBuilder()
    joints = [builder.node(name=f"j{k}", translation=[k, 0, 0]) for k in range(8)]
    shape = grid(1, 1)
    primitive = builder.primitive(
        shape["positions"],
        shape["faces"],
        JOINTS_0=np.tile([0, 1, 2, 3], (4, 1)),
        JOINTS_1=np.tile([4, 5, 6, 7], (4, 1)),
        WEIGHTS_0=np.tile([1.0, 1, 1, 1], (4, 1)),
        WEIGHTS_1=np.tile([3.0, 3, 3, 3], (4, 1)),
    )
    builder.node(mesh=builder.mesh(primitive), skin=builder.skin(joints))
    character = load_character(builder.write(tmp_path / "a.glb"))
    dense = character.mesh.dense_weights(8)
    np.testing.assert_allclose(dense, np.tile([1 / 16] * 4 + [3 / 16] * 4, (4, 1)))
    assert any("do not sum to one" in warning for warning in character.warnings)


def test_repeated_joints_add_up_and_weightless_vertices_are_hung_somewhere(tmp_path: Path) -> None:
    builder = GltfBuilder()
    joints = [builder.node(name="a"), builder.node(name="b")]
    shape = grid(1, 1)
    primitive = builder.primitive(
        shape["positions"],
        shape["faces"],
        JOINTS_0=np.tile([1, 1, 0, 0], (4, 1)),
        WEIGHTS_0=[[0.25, 0.25, 0.5, 0], [0.5, 0.5, 0, 0], [0, 0, 0, 0], [-1, np.nan, 1, 0]],
    )
    builder.node(mesh=builder.mesh(primitive), skin=builder.skin(joints))
    character = load_character(builder.write(tmp_path / "a.glb"))
    order = np.lexsort(character.mesh.surface.positions.T)
    dense = character.mesh.dense_weights(2)[order]
    np.testing.assert_allclose(dense, [[0.5, 0.5], [0, 1], [1, 0], [1, 0]])
    assert character.mesh.joint_indices.shape[1] == 2
    assert any("no weight" in warning for warning in character.warnings)
    assert any("negative or not finite" in warning for warning in character.warnings)


def test_quantised_attributes(tmp_path: Path) -> None:
    """KHR_mesh_quantization: integer positions under a scaling node, normalised uvs and normals."""
    builder = GltfBuilder()
    builder.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    shape = grid(1, 1)
    spec = {
        "attributes": {
            "POSITION": builder.accessor(shape["positions"] * 1000, np.int16),
            "NORMAL": builder.accessor(np.tile([0, 0, 127], (4, 1)), np.int8, normalized=True),
            "TEXCOORD_0": builder.accessor(shape["uvs"] * 65535, np.uint16, normalized=True),
        },
        "indices": builder.accessor(shape["faces"].ravel(), np.uint8),
    }
    builder.node(mesh=builder.mesh(spec), scale=[0.001, 0.001, 0.001])
    mesh = load_character(builder.write(tmp_path / "a.glb")).mesh
    np.testing.assert_allclose(mesh.surface.positions[mesh.surface.faces], shape["positions"][shape["faces"]])
    np.testing.assert_allclose(mesh.surface.uvs[mesh.surface.face_uvs], shape["uvs"][shape["faces"]])
    np.testing.assert_allclose(mesh.corner_normals, np.broadcast_to([0, 0, 1.0], (2, 3, 3)))


def test_default_morph_weights_are_those_at_rest(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    primitive = builder.primitive(shape["positions"], shape["faces"])
    primitive["targets"] = [{"POSITION": builder.accessor(np.tile([0.0, 0, k], (4, 1)))} for k in (4, 8)]
    builder.node(mesh=builder.mesh(primitive, weights=[0.5, 0]))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.morph_weights == (0.5, 0)
    np.testing.assert_array_equal(character.mesh.surface.positions[:, 2], 0)
    np.testing.assert_array_equal([morph.shifts[:, 2] for morph in character.mesh.morphs], [[4] * 4, [8] * 4])


def test_only_the_default_scene_is_built(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    mesh = builder.mesh(builder.primitive(shape["positions"], shape["faces"]))
    builder.node(mesh=mesh)
    other = builder.add("nodes", mesh=mesh, translation=[9, 0, 0])
    builder.json["scenes"].append({"nodes": [other]})
    assert load_character(builder.write(tmp_path / "a.glb")).mesh.num_faces == 2
    builder.json["scene"] = 1
    assert load_character(builder.write(tmp_path / "b.glb")).mesh.surface.positions.min(axis=0)[0] == 9


def test_a_default_scene_without_meshes_gives_way_to_one_with(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    builder.node(mesh=builder.mesh(builder.primitive(shape["positions"], shape["faces"])))
    camera = builder.add("nodes", name="Camera")
    builder.json["scenes"].insert(0, {"nodes": [camera]})
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.mesh.num_faces == 2
    assert "scene 0 shows no mesh: scene 1 is built instead" in character.warnings
