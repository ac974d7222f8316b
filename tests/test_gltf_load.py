"""load_character: the unified mesh moves exactly as the file's own parts do, on real files and on hand-made ones."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, bent_bar, cube, grid
from conftest import asset

from preprocess.errors import InputError
from preprocess.gltf import Character, load_character
from preprocess.seams import find_seams
from runtime.clip import read_clips
from runtime.gltf import Document, read_document
from runtime.pose import global_transforms, rest_pose, sample, skinning_matrices
from runtime.skeleton import Skeleton, read_skeleton

CHARACTERS = ["Fox.glb", "human.glb", "Knight.glb", "robot.glb", "mannequiny.glb"]


def whole_tree(document: Document) -> Skeleton:
    """Every node of the file as a joint with an identity bind."""
    count = len(document.items("nodes"))
    return read_skeleton(document, list(range(count)), np.tile(np.eye(4), (count, 1, 1)))


def source_triangles(document: Document, pose_of: Any) -> np.ndarray:
    """The slow twin: corners (F, 3, 3) of every triangle as glTF says to draw it, primitive by primitive."""
    tree = whole_tree(document)
    globals_ = np.empty((tree.num_nodes, 4, 4))
    globals_[tree.document_nodes] = global_transforms(tree, pose_of(tree))[0]
    drawn = []
    for index in scene_order(document):
        node = document.items("nodes")[index]
        if "mesh" not in node:
            continue
        for spec in document.items("meshes")[node["mesh"]]["primitives"]:
            attributes = spec["attributes"]
            points = document.accessor(attributes["POSITION"]).astype(np.float64)
            homogeneous = np.c_[points, np.ones(len(points))]
            if "skin" in node and "JOINTS_0" in attributes:
                skin = document.items("skins")[node["skin"]]
                inverse = document.accessor(skin["inverseBindMatrices"]).astype(np.float64)
                matrices = globals_[skin["joints"]] @ inverse
                weights = document.accessor(attributes["WEIGHTS_0"]).astype(np.float64)
                weights /= weights.sum(axis=1, keepdims=True)
                blended = np.einsum("nk,nkij->nij", weights, matrices[document.accessor(attributes["JOINTS_0"])])
            else:
                blended = np.broadcast_to(globals_[index], (len(points), 4, 4))
            moved = np.einsum("nij,nj->ni", blended, homogeneous)[:, :3]
            corners = document.accessor(spec["indices"]).astype(int) if "indices" in spec else np.arange(len(points))
            drawn.append(moved[corners.reshape(-1, 3)])
    return np.concatenate(drawn)


def scene_order(document: Document) -> list[int]:
    def below(index: int) -> list[int]:
        children = document.items("nodes")[index].get("children", [])
        return [index] + [found for child in children for found in below(child)]

    scene = document.items("scenes")[document.json.get("scene", 0)]
    return [found for root in scene["nodes"] for found in below(root)]


def drawn_triangles(character: Character, pose: Any) -> np.ndarray:
    mesh = character.mesh
    matrices = skinning_matrices(character.skeleton, pose)[0]
    blended = np.einsum("vk,vkij->vij", mesh.joint_weights, matrices[mesh.joint_indices])
    points = np.c_[mesh.surface.positions, np.ones(mesh.num_vertices)]
    return np.einsum("vij,vj->vi", blended, points)[:, :3][mesh.surface.faces]


def assert_same_triangles(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    """Equal in order, or turned over; the source may hold triangles without area that ours lacks."""
    if len(ours) != len(theirs):
        area = np.linalg.norm(np.cross(theirs[:, 1] - theirs[:, 0], theirs[:, 2] - theirs[:, 0]), axis=1)
        theirs = theirs[area > 1e-9]
    assert ours.shape == theirs.shape
    straight = np.abs(ours - theirs).max(axis=(1, 2))
    turned = np.abs(ours - theirs[:, [0, 2, 1]]).max(axis=(1, 2))
    assert np.minimum(straight, turned).max() <= tolerance


@pytest.mark.parametrize("name", CHARACTERS)
def test_skinning_the_one_mesh_gives_the_files_own_picture(name: str) -> None:
    character = load_character(asset(name))
    document = read_document(asset(name))
    tolerance = 1e-6 * max(1.0, character.mesh.surface.diagonal_m)
    rest = drawn_triangles(character, rest_pose(character.skeleton))
    assert_same_triangles(rest, source_triangles(document, rest_pose), tolerance)
    tree = whole_tree(document)
    clips = read_clips(document, tree)
    assert [clip.name for clip in character.clips] == [clip.name for clip in clips]
    for ours, theirs in list(zip(character.clips, clips))[::5]:
        moment = 0.37 * ours.duration_s
        assert_same_triangles(
            drawn_triangles(character, sample(ours, character.skeleton, moment)),
            source_triangles(document, lambda tree, clip=theirs, at=moment: sample(clip, tree, at)),
            tolerance,
        )


@pytest.mark.parametrize(
    ("name", "faces", "joints", "clips"),
    [
        ("Fox.glb", 576, 24, 3),
        ("human.glb", 26756, 53, 3),
        ("Knight.glb", 6952, 50, 76),  # 41 of the skin, nine rigid parts
        ("robot.glb", 3234, 43, 14),  # 3,238 with four that have no area
        ("mannequiny.glb", 13932, 45, 10),
    ],
)
def test_counts_of_the_characters(name: str, faces: int, joints: int, clips: int) -> None:
    character = load_character(asset(name))
    assert (character.mesh.num_faces, character.skeleton.num_joints, len(character.clips)) == (faces, joints, clips)
    character.mesh.validate()
    assert np.allclose(np.linalg.norm(character.mesh.corner_normals, axis=2), 1)
    assert_manifold(character)


def test_known_seam_counts() -> None:
    """The reference programs find the same pairs on these files."""
    assert len(find_seams(load_character(asset("Fox.glb")).mesh.surface).vertices) == 136
    assert len(find_seams(load_character(asset("human.glb")).mesh.surface).vertices) == 1133


def test_knight_loads_in_three_seconds() -> None:
    path = asset("Knight.glb")
    start = time.process_time()
    load_character(path)
    assert time.process_time() - start < 3.0  # 0.35 s


@pytest.mark.parametrize("name", ["Fox.glb", "human.glb", "Knight.glb", "robot.glb"])
def test_bind_pose_stands_where_the_rest_pose_is_drawn(name: str) -> None:
    """These files rest in (or near) their bind pose, which is then the scene's; mannequiny rests in a clip's pose."""
    character = load_character(asset(name))
    drawn = drawn_triangles(character, rest_pose(character.skeleton))
    bind = character.mesh.surface.positions[character.mesh.surface.faces]
    assert np.median(np.linalg.norm(drawn - bind, axis=2)) < 0.1 * character.mesh.surface.diagonal_m


def assert_manifold(character: Character) -> None:
    """No edge with three faces, neighbours wind one way, one fan of faces a vertex."""
    faces = character.mesh.surface.faces.astype(np.int64)
    find_seams(character.mesh.surface)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    directed = start * (faces.max() + 1) + end
    assert len(np.unique(directed)) == len(directed)  # each directed edge once
    num_vertices = len(character.mesh.surface.positions)
    assert len(np.unique(faces)) == num_vertices
    # Around a manifold vertex, the faces form one chain: corners joined across edges are one group a vertex.
    group = np.arange(faces.size)
    reverse = {int(key): h for h, key in enumerate(end * (faces.max() + 1) + start)}

    def root(corner: int) -> int:
        while group[corner] != corner:
            corner = group[corner]
        return corner

    for h, key in enumerate(directed):
        mate = reverse.get(int(key))
        if mate is not None:
            here, there = root(h), root(mate // 3 * 3 + (mate % 3 + 1) % 3)
            group[here] = there
    assert len({root(corner) for corner in range(faces.size)}) == num_vertices


def test_a_bar_without_frills(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    assert character.name == "bar" and len(character.source_hash) == 64 and not character.warnings
    assert character.mesh.num_vertices == 27 and len(character.mesh.surface.uvs) == 27
    assert character.skeleton.joint_names == ("root", "tip")
    np.testing.assert_array_equal(character.mesh.surface.positions.max(axis=0), [0.5, 2, 0])
    bent = drawn_triangles(character, sample(character.clips[0], character.skeleton, 1.0)).reshape(-1, 3)
    np.testing.assert_allclose(bent[:, 1].max(), 1.5, atol=1e-6)  # a quarter turn lays the tip down: x = -1


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


def check_against_source(path: Path, tolerance: float = 1e-6) -> Character:
    character, document = load_character(path), read_document(path)
    assert_manifold(character)
    clips = read_clips(document, whole_tree(document))
    for ours, theirs in zip(character.clips, clips):
        for moment in (0.0, 0.4, 1.0):
            assert_same_triangles(
                drawn_triangles(character, sample(ours, character.skeleton, moment)),
                source_triangles(document, lambda tree, clip=theirs, at=moment: sample(clip, tree, at)),
                tolerance,
            )
    return character


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


def test_default_morph_weights_are_applied_and_targets_dropped(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    primitive = builder.primitive(shape["positions"], shape["faces"])
    primitive["targets"] = [{"POSITION": builder.accessor(np.tile([0.0, 0, k], (4, 1)))} for k in (4, 8)]
    builder.node(mesh=builder.mesh(primitive, weights=[0.5, 0]))
    character = load_character(builder.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(character.mesh.surface.positions[:, 2], 2)
    assert any("2 morph targets dropped" in warning for warning in character.warnings)


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


def test_loading_twice_gives_the_same_bytes() -> None:
    first, second = (load_character(asset("mannequiny.glb")).mesh for _ in range(2))
    for field in dataclasses.fields(first.surface):
        assert getattr(first.surface, field.name).tobytes() == getattr(second.surface, field.name).tobytes()
    assert first.joint_weights.tobytes() == second.joint_weights.tobytes()
