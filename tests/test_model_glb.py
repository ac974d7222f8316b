"""model.glb: what other viewers read is the character, and the Khronos validator finds nothing wrong."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder, bent_bar, cube, grid
from conftest import asset
from gltf_validator import issues

from preprocess.decimate.levels import Lod
from preprocess.export.glb import screen_coverage, write_model_glb
from preprocess.export.lod_vertices import build_lod_mesh, limit_influences
from preprocess.export.materials import describe_material, plan_draws
from preprocess.files.images import Image, write_image
from preprocess.fit.corner_locations import locate_corners
from preprocess.load import Character, Material, load_character
from preprocess.mesh.grouping import connected_faces
from preprocess.mesh.surface import TexturedSurface
from runtime.animation.pose import sample, skinning_matrices
from runtime.gltf.document import Document, read_document

TEXTURES = {"base_color": {"file": "base_color.png"}, "orm": {"file": "orm.png"}, "normal": {"file": "normal.png"}}


def full_lod(character: Character) -> Lod:
    """The full mesh as a level; the first texture vertex of each surface vertex owns it."""
    surface = character.mesh.surface
    canonical = np.zeros(len(surface.positions), np.int32)
    canonical[surface.faces.ravel()[::-1]] = surface.face_uvs.ravel()[::-1]
    sources = np.arange(len(surface.faces), dtype=np.int32)
    return Lod(surface.uvs, surface.face_uvs, surface.faces, canonical, sources, surface.positions)


def half_lod(lod: Lod) -> Lod:
    """Every other face of a level, compact: a stand-in for a coarser one."""
    kept = slice(None, None, 2)
    vertices, faces = np.unique(lod.faces[kept], return_inverse=True)
    return dataclasses.replace(
        lod,
        faces=faces.reshape(-1, 3).astype(np.int32),
        face_uvs=lod.face_uvs[kept],
        canonical_uvs=lod.canonical_uvs[vertices],
        positions=lod.positions[vertices],
        face_source=lod.face_source[kept],
    )


def written(character: Character, path: Path, **options: Any) -> Document:
    lod = full_lod(character)
    for name in ("base_color.png", "orm.png", "normal.png"):
        write_image(path.parent / name, Image(np.full((4, 4, 3), 0.5, np.float32)))
    write_model_glb(path, character, character.mesh, [lod, half_lod(lod)], TEXTURES, **options)
    return read_document(path)


def assert_valid(document: Document) -> None:
    """What glTF asks of such a file, checked without the validator."""
    root = document.json
    decoded = [document.accessor(i) for i in range(len(root["accessors"]))]
    for spec, values in zip(root["accessors"], decoded):
        assert np.isfinite(values).all() and spec.get("byteOffset", 0) % 4 == 0
        if "min" in spec:
            flat = values.reshape(len(values), -1)
            np.testing.assert_array_equal(flat.min(axis=0), np.float32(spec["min"]))
            np.testing.assert_array_equal(flat.max(axis=0), np.float32(spec["max"]))
    assert all(view["byteOffset"] % 4 == 0 for view in root["bufferViews"])
    (skin,) = root["skins"]
    assert len(set(skin["joints"])) == len(skin["joints"])
    parents = {child: index for index, node in enumerate(root["nodes"]) for child in node.get("children", [])}

    def top(node: int) -> int:
        return top(parents[node]) if node in parents else node

    assert len({top(joint) for joint in skin["joints"]}) == 1
    assert {top(joint) for joint in skin["joints"]} < set(root["scenes"][0]["nodes"])
    for mesh in root["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = {name: decoded[index] for name, index in primitive["attributes"].items()}
            count = len(attributes["POSITION"])
            assert all(len(values) == count for values in attributes.values())
            assert decoded[primitive["indices"]].max() < count
            np.testing.assert_allclose(np.linalg.norm(attributes["NORMAL"], axis=1), 1, atol=1e-5)
            joints = np.concatenate([v for n, v in sorted(attributes.items()) if n.startswith("JOINTS")], axis=1)
            weights = np.concatenate([v for n, v in sorted(attributes.items()) if n.startswith("WEIGHTS")], axis=1)
            assert joints.max() < len(skin["joints"]) and not joints[weights == 0].any()
            assert (weights >= 0).all() and np.abs(weights.sum(axis=1, dtype=np.float64) - 1).max() < 4e-7
    for clip in root.get("animations", []):
        targets = [(c["target"]["node"], c["target"]["path"]) for c in clip["channels"]]
        assert len(set(targets)) == len(targets)
        assert all((np.diff(decoded[s["input"]]) > 0).all() for s in clip["samplers"])


def two_binds(path: Path) -> Path:
    """Two roots, a rigid part, and a node that two skins bind differently."""
    builder = GltfBuilder()
    root, shape = builder.node(name="root"), grid(1, 1)
    skin = {"JOINTS_0": np.zeros((4, 4)), "WEIGHTS_0": np.tile([1.0, 0, 0, 0], (4, 1)), "TEXCOORD_0": shape["uvs"]}
    tip = builder.node(root, name="tip", translation=[0, 1, 0])
    binds = np.tile(np.eye(4), (2, 1, 1))
    binds[1, 2, 3] = 0.5
    # The second joint ties the placement of the second skin to the first; the first then has two binds.
    for k, joints in enumerate(([root, tip], [root, tip])):
        inverse = np.stack([binds[k], np.eye(4)])
        attributes = {**skin, "JOINTS_0": np.tile([0, 1, 0, 0], (4, 1)), "WEIGHTS_0": np.tile([0.4, 0.6, 0, 0], (4, 1))}
        primitive = builder.primitive(shape["positions"] + (2 * k, 0, 0), shape["faces"], **attributes)
        builder.node(mesh=builder.mesh(primitive), skin=builder.skin(joints, inverse))
    box = cube()
    block = builder.primitive(box["positions"], box["faces"], NORMAL=box["normals"], TEXCOORD_0=box["uvs"])
    builder.node(name="block", mesh=builder.mesh(block), translation=[0, 3, 0])
    builder.clip("nod", (tip, "rotation", "STEP", [0, 1], [[0, 0, 0, 1], [0, 0, 0.6, 0.8]]))
    return builder.write(path)


def source_of(name: str, tmp_path: Path) -> Path:
    if name == "bar":
        return bent_bar(tmp_path / "bar.glb")
    if name == "binds":
        return two_binds(tmp_path / "binds.glb")
    return asset(f"{name}.glb")


NAMES = ["bar", "binds", "Fox", "Knight", "human", "mannequiny"]


@pytest.fixture(scope="module", params=NAMES)
def model(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Character, Path]:
    """A character and its model.glb of two levels; Fox with eight influences."""
    folder = tmp_path_factory.mktemp(request.param)
    character = load_character(source_of(request.param, folder))
    written(character, folder / "model.glb", influences=8 if request.param == "Fox" else 4)
    return character, folder / "model.glb"


def test_the_file_is_valid(model: tuple[Character, Path]) -> None:
    assert_valid(read_document(model[1]))


def test_the_khronos_validator_finds_no_errors(model: tuple[Character, Path]) -> None:
    report = issues(model[1])
    assert report["numErrors"] == 0 and report["numWarnings"] == 0, report["messages"]


def drawn(character: Character, clip: int, time_s: float) -> np.ndarray:
    mesh = character.mesh
    pose = sample(character.clips[clip], character.skeleton, time_s)
    matrices = skinning_matrices(character.skeleton, pose)[0]
    blended = np.einsum("vk,vkij->vij", mesh.joint_weights, matrices[mesh.joint_indices])
    points = np.c_[mesh.surface.positions, np.ones(mesh.num_vertices)]
    return np.einsum("vij,vj->vi", blended, points)[:, :3][mesh.surface.faces]


def test_another_reader_sees_the_same_character_move(model: tuple[Character, Path]) -> None:
    """The finest level, read back as any glTF file, skins to the same triangles at moments of the clips."""
    character, path = model
    again = load_character(path)
    assert [clip.name for clip in again.clips] == [clip.name for clip in character.clips]
    assert again.skeleton.num_joints == character.skeleton.num_joints
    order = np.argsort(character.mesh.face_materials, kind="stable")
    for clip in range(0, len(character.clips), 25):
        moment = 0.4 * character.clips[clip].duration_s
        ours, theirs = drawn(character, clip, moment)[order], drawn(again, clip, moment)
        assert np.abs(ours - theirs).max() < 1e-5 * character.mesh.surface.diagonal_m
    assert len(read_document(path).items("meshes")) == 2


@pytest.mark.parametrize("name", ["Knight", "human"])
def test_hard_edges_stay_hard(name: str, tmp_path: Path) -> None:
    character = load_character(source_of(name, tmp_path))
    lod = full_lod(character)
    level = build_lod_mesh(
        character.mesh, character.skeleton.num_joints, lod.surface, lod.canonical_uvs, lod.face_source, 4
    )
    difference = np.linalg.norm(level.normals[level.faces] - character.mesh.corner_normals, axis=2)
    assert np.mean(difference < 2e-3) > 0.99
    np.testing.assert_allclose(
        level.positions[level.faces], character.mesh.surface.positions[character.mesh.surface.faces], atol=1e-5
    )


def test_clips_keep_every_key_and_interpolation(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(1, 1)
    mesh = builder.mesh(builder.primitive(shape["positions"], shape["faces"], TEXCOORD_0=shape["uvs"]))
    node = builder.node(name="box", mesh=mesh)
    rng = np.random.default_rng(2)
    turns = rng.normal(size=(3, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    builder.clip(
        "all",
        (node, "translation", "CUBICSPLINE", [0, 0.5, 2], rng.normal(size=(9, 3))),
        (node, "rotation", "LINEAR", [0, 0.5, 2], turns),
        (node, "scale", "STEP", [0.25, 1], [[1, 1, 1], [2, 2, 2]]),
    )
    character = load_character(builder.write(tmp_path / "a.glb"))
    written(character, tmp_path / "model.glb")
    again = load_character(tmp_path / "model.glb")
    for ours, theirs in zip(character.clips[0].tracks, again.clips[0].tracks):
        assert (ours.path, ours.interpolation) == (theirs.path, theirs.interpolation)
        np.testing.assert_array_equal(ours.times, theirs.times)
        np.testing.assert_allclose(ours.values, theirs.values, atol=1e-7)


def test_nodes_keep_their_names_and_hierarchy(tmp_path: Path) -> None:
    character = load_character(asset("human.glb"))
    document = written(character, tmp_path / "model.glb")
    nodes = document.items("nodes")
    skeleton = character.skeleton
    assert [node["name"] for node in nodes[: skeleton.num_nodes]] == list(skeleton.names)
    for index, parent in enumerate(skeleton.parents):
        assert parent < 0 or index in nodes[parent]["children"]
    levels = {node["name"]: index for index, node in enumerate(nodes) if "mesh" in node}
    assert list(levels) == ["human_LOD0", "human_LOD1"]
    assert nodes[levels["human_LOD0"]]["extensions"] == {"MSFT_lod": {"ids": [levels["human_LOD1"]]}}
    assert levels["human_LOD0"] in document.items("scenes")[0]["nodes"]
    assert levels["human_LOD1"] not in document.items("scenes")[0]["nodes"]


def test_screen_coverage_says_when_a_coarser_level_will_do() -> None:
    lod = full_lod(load_character(asset("Fox.glb")))
    chain = [dataclasses.replace(lod, error_m=error) for error in (0.0, 0.01, 0.02, 0.5)]
    # A character 2.16 m across with an error of 1 cm: under a pixel below 1,080 / 5 = 216 rows, a fifth of the height.
    assert screen_coverage(chain, 2.16) == pytest.approx([0.04, 0.01, (2.16 / 540) ** 2, 0.0])
    assert screen_coverage([lod, lod], 2.0) == []


def test_canonical_uvs_tell_the_topology(tmp_path: Path) -> None:
    """Copies of a surface vertex share the bits of their canonical uv, and no two surface vertices do."""
    character = load_character(asset("human.glb"))
    document = written(character, tmp_path / "model.glb")
    primitive = document.items("meshes")[0]["primitives"][0]
    canonical = document.accessor(primitive["attributes"]["_OWNER_UV"])
    positions = document.accessor(primitive["attributes"]["POSITION"])
    both = np.unique(np.concatenate([canonical, positions], axis=1), axis=0)
    assert len(both) == len(np.unique(canonical, axis=0)) == character.mesh.num_vertices


def test_colors_painted_at_the_places_of_normals_are_read_there(tmp_path: Path) -> None:
    shape = cube()
    builder = GltfBuilder()
    block = builder.primitive(shape["positions"], shape["faces"], NORMAL=shape["normals"], TEXCOORD_0=shape["uvs"])
    builder.node(name="block", mesh=builder.mesh(block))
    character = load_character(builder.write(tmp_path / "cube.glb"))
    surface, lod = character.mesh.surface, full_lod(character)
    entries = {**TEXTURES, "base_color": {**TEXTURES["base_color"], "uvs": "normal"}}
    for texture in entries.values():
        write_image(tmp_path / texture["file"], Image(np.full((4, 4, 3), 0.5, np.float32)))
    moved = 0.5 + 0.9 * (surface.uvs[surface.face_uvs] - 0.5)
    path, lods = tmp_path / "model.glb", [lod, half_lod(lod)]
    write_model_glb(path, character, character.mesh, lods, entries, normal_uvs=[moved, None])
    document = read_document(path)
    assert_valid(document)
    (material,) = document.json["materials"]
    assert material["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] == 1
    assert "texCoord" not in material["occlusionTexture"]
    fine, coarse = (mesh["primitives"][0]["attributes"] for mesh in document.json["meshes"])
    own, second = (document.accessor(fine[f"TEXCOORD_{which}"]) for which in (0, 1))
    np.testing.assert_allclose(second, 0.5 + 0.9 * (own - 0.5), atol=1e-5)
    assert coarse["TEXCOORD_1"] == coarse["TEXCOORD_0"]  # without places of its own: the same accessor
    assert not [issue for issue in issues(path)["messages"] if issue["severity"] < 2]


def test_one_level_a_file(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    half = half_lod(full_lod(character))
    write_model_glb(tmp_path / "one.glb", character, character.mesh, [half], {}, names=["bar_LOD1"])
    document = read_document(tmp_path / "one.glb")
    assert_valid(document)
    assert "extensionsUsed" not in document.json
    assert [node["name"] for node in document.items("nodes") if "mesh" in node] == ["bar_LOD1"]
    assert load_character(tmp_path / "one.glb").mesh.num_faces == len(half.faces)


def test_the_same_bytes_twice(tmp_path: Path) -> None:
    character = load_character(asset("Fox.glb"))
    written(character, tmp_path / "a.glb")
    written(character, tmp_path / "b.glb")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_misuse_is_a_value_error(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    with pytest.raises(ValueError, match="4 or 8"):
        write_model_glb(tmp_path / "x.glb", character, character.mesh, [full_lod(character)], {}, influences=5)
    with pytest.raises(ValueError, match="at least one level"):
        write_model_glb(tmp_path / "x.glb", character, character.mesh, [], {})
    assert not (tmp_path / "x.glb").exists()


def test_influences_are_limited_to_the_heaviest() -> None:
    joints, weights = limit_influences(np.array([[0.1, 0.2, 0.3, 0.15, 0.25], [0, 0, 1.0, 0, 0]]), 4)
    assert joints.tolist() == [[2, 4, 1, 3], [2, 0, 0, 0]]
    np.testing.assert_allclose(weights, [[0.3 / 0.9, 0.25 / 0.9, 0.2 / 0.9, 0.15 / 0.9], [1, 0, 0, 0]])
    joints, weights = limit_influences(np.array([[0.5, 0.5]]), 8)
    assert joints.shape == weights.shape == (1, 8)


def test_corners_are_found_where_they_were_put() -> None:
    """Random points of random faces of overlapping, touching parts: their place and weights come back."""
    character = load_character(asset("Knight.glb"))  # a palette: uvs overlap everywhere
    surface = character.mesh.surface
    rng = np.random.default_rng(5)
    chosen = rng.choice(character.mesh.num_faces, 500, replace=False)
    barycentrics = rng.dirichlet((1, 1, 1), (500, 3))
    positions = np.einsum("fnk,fkc->fnc", barycentrics, surface.positions[surface.faces[chosen]]).reshape(-1, 3)
    uvs = np.einsum("fnk,fkc->fnc", barycentrics, surface.uvs[surface.face_uvs[chosen]]).reshape(-1, 2)
    faces = np.arange(1500, dtype=np.int32).reshape(-1, 3)
    level = TexturedSurface(positions, faces, uvs, faces)
    places, points, _ = locate_corners(surface, level, chosen)
    np.testing.assert_array_equal(points, faces)
    rows = places.firsts
    found = np.einsum("rk,rkc->rc", places.barycentrics[rows], surface.positions[surface.faces[places.faces[rows]]])
    assert np.linalg.norm(found - positions, axis=1).max() < 1e-3 * surface.diagonal_m
    component = connected_faces(surface.faces, len(surface.positions))
    np.testing.assert_array_equal(component[places.faces[rows]], np.repeat(component[chosen], 3))


def test_materials_that_look_alike_are_one_draw() -> None:
    red = Material("red", base_color_factor=(1, 0, 0, 1))
    blue = Material("blue", base_color_factor=(0, 0, 1, 1))
    glass = Material("glass", alpha_mode="BLEND")
    cloth = Material("cloth", double_sided=True)
    leaf = Material("leaf", alpha_mode="MASK", alpha_cutoff=0.3, unlit=True)
    materials = (glass, red, blue, cloth, leaf)
    draws, of_material = plan_draws(materials, np.arange(5), {"base_color": {"file": "b.png"}})
    assert [draw["name"] for draw in draws] == ["red", "cloth", "leaf", "glass"]
    assert of_material.tolist() == [3, 0, 0, 1, 2]
    assert draws[2]["alphaCutoff"] == 0.3 and "KHR_materials_unlit" in draws[2]["extensions"]
    copied, _ = plan_draws(materials, np.arange(5), {"base_color": {"file": "b.png", "copied": True}})
    assert len(copied) == 5 and copied[0]["pbrMetallicRoughness"]["baseColorFactor"] == [1, 0, 0, 1]


def test_emissive_strength_goes_to_its_extension() -> None:
    spec = describe_material(Material("lamp", emissive_factor=(4.0, 2.0, 0.0)), {})
    assert spec["emissiveFactor"] == [1.0, 0.5, 0.0]
    assert spec["extensions"]["KHR_materials_emissive_strength"] == {"emissiveStrength": 4.0}


def test_unlit_survives_the_writer(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    unlit = dataclasses.replace(character, materials=(Material("flat", unlit=True, alpha_mode="MASK"),))
    written(unlit, tmp_path / "model.glb")
    again = load_character(tmp_path / "model.glb")
    assert again.materials[0].unlit and again.materials[0].alpha_mode == "MASK"
