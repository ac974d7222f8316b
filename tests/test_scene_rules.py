"""Which parts of a scene are shown, and which side of them: levels of detail, parts that a clip mirrors, limits."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_gltf import GltfBuilder, cube, grid

import runtime
from preprocess.cli import main
from preprocess.errors import InputError
from preprocess.load import load_character
from preprocess.load.pose_sampling import sample_poses
from runtime.gltf.limits import Limits


def block(builder: GltfBuilder, **node: Any) -> int:
    """A node with a cube of its own."""
    shape = cube()
    uvs = shape["uvs"]
    part = builder.primitive(shape["positions"], shape["faces"], NORMAL=shape["normals"], TEXCOORD_0=uvs)
    return builder.node(mesh=builder.mesh(part), **node)


def test_of_levels_of_detail_the_first_is_shown(tmp_path: Path) -> None:
    """MSFT_lod's lower levels stand in the scene too, one of them below another node."""
    builder = GltfBuilder()
    first = block(builder, name="LOD0")
    second = block(builder, name="LOD1")
    holder = builder.node(name="levels")
    block(builder, name="LOD2", parent=holder)
    block(builder, name="hat", translation=[0, 2, 0])
    builder.json["nodes"][first]["extensions"] = {"MSFT_lod": {"ids": [second, holder]}}
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.mesh.num_faces == 24
    assert any("2 meshes left out: lower levels of detail" in line for line in character.warnings)


def flipped(keys: list[list[float]], interpolation: str = "STEP", **node: Any) -> GltfBuilder:
    """A cube below a hand whose scale has those keys."""
    builder = GltfBuilder()
    hand = builder.node(name="hand", **node)
    block(builder, name="sword", parent=hand)
    builder.clip("flip", (hand, "scale", interpolation, [0, 0.5][: len(keys)], keys))
    return builder


@pytest.mark.parametrize(
    ("keys", "node", "both"),
    [
        ([[1, 1, 1], [-1, 1, 1]], {}, True),
        ([[1, 1, 1], [-1, -1, 1]], {}, False),  # half a turn
        ([[1, 1, 1], [0, 1, 1]], {}, False),
        ([[-1, 1, 1], [-2, 1, 1]], {"scale": [-1, 1, 1]}, False),  # as at rest
        ([[1, 1, 1], [1, 1, 1]], {"scale": [-1, 1, 1]}, True),
    ],
)
def test_parts_that_a_clip_mirrors_are_drawn_from_both_sides(tmp_path: Path, keys, node, both: bool) -> None:
    character = load_character(flipped(keys, **node).write(tmp_path / "a.glb"))
    used = np.unique(character.mesh.face_materials)
    assert all(character.materials[index].double_sided == both for index in used)
    assert any("that a clip mirrors are drawn double-sided" in line for line in character.warnings) == both


@pytest.mark.slow
def test_the_outside_of_a_mirrored_part_is_lit_as_the_outside(tmp_path: Path, ctx: moderngl.Context) -> None:
    """A cube looks the same when it is mirrored: so do its normals, seen from outside."""
    path = flipped([[1, 1, 1], [-1, 1, 1]]).write(tmp_path / "a.glb")
    assert main([str(path), "-o", str(tmp_path / "out"), "--color-size", "64"]) == 0
    model = runtime.Model(ctx, runtime.load(tmp_path / "out"))
    renderer = runtime.Renderer(ctx)
    target = ctx.framebuffer([ctx.texture((64, 64), 4)], ctx.depth_renderbuffer((64, 64)))
    camera = runtime.Camera(eye=(0, 0, 4), target=(0, 0, 0))
    middles = []
    for moment in (0.0, 0.5):
        actor = model.actor(clip="flip", loop=False)
        actor.update(moment)
        target.use()
        target.clear()
        renderer.draw([actor], camera, view="normal")
        pixels = np.frombuffer(target.read(components=3), np.uint8).reshape(64, 64, 3)
        middles.append(pixels[30:34, 30:34].reshape(-1, 3).astype(int))
    assert np.abs(middles[0] - (128, 128, 255)).max() <= 2
    assert np.abs(middles[1] - middles[0]).max() <= 2
    renderer.release()
    model.release()
    for attachment in (*target.color_attachments, target.depth_attachment, target):
        attachment.release()


def test_copies_of_a_mesh_are_counted(tmp_path: Path) -> None:
    builder = GltfBuilder()
    shape = grid(8, 8)
    mesh = builder.mesh(builder.primitive(shape["positions"], shape["faces"]))
    for number in range(10):
        builder.node(mesh=mesh, translation=[2 * number, 0, 0])
    path = builder.write(tmp_path / "a.glb")
    assert load_character(path).mesh.num_faces == 1280
    with pytest.raises(InputError, match="more than 1000 triangles, counting each copy"):
        load_character(path, Limits(triangles=1000))
    with pytest.raises(InputError, match="more than 4 joints"):
        load_character(path, Limits(joints=4))


@pytest.mark.parametrize("kind", ["names", "chain", "scenes", "roots"])
def test_time_grows_with_the_file_not_with_its_square(tmp_path: Path, kind: str) -> None:
    """10,000 nodes of one name, one below the other; scenes and roots that are the same again and again."""
    builder = GltfBuilder()
    top = block(builder, name="joint")
    count = 10_000
    nodes: list[dict[str, Any]] = builder.json["nodes"]
    nodes += [{"name": "joint"} for _ in range(count)]
    if kind == "chain":
        for number in range(count):
            nodes[number]["children"] = [number + 1]
    elif kind == "scenes":
        builder.json["scenes"] = [{"nodes": [count]} for _ in range(count)] + builder.json["scenes"]
        nodes[top]["children"], nodes[count]["children"] = [1], list(range(2, count))
    elif kind == "roots":
        builder.json["scenes"][0]["nodes"] = [top] * count
    else:
        nodes[top]["children"] = list(range(1, count + 1))
    path = builder.write(tmp_path / "a.glb")
    start = time.process_time()
    character = load_character(path)
    assert time.process_time() - start < 5.0
    assert character.mesh.num_faces == 12
    names = character.skeleton.names
    assert len(set(names)) == len(names)


def test_numbers_beyond_the_limits_are_refused_or_left_out(tmp_path: Path) -> None:
    builder = GltfBuilder()
    node = builder.node(scale=[1e5, 1e5, 1e5])
    node = builder.node(node, scale=[1e5, 1e5, 1e5])
    block(builder, parent=node)
    with pytest.raises(InputError, match="24 positions are not finite or beyond 1e"):
        load_character(builder.write(tmp_path / "a.glb"))
    builder = GltfBuilder()
    top = block(builder)
    builder.clip("late", (top, "translation", "LINEAR", [0, 1, 3e38], [[0, 0, 0], [1, 0, 0], [3e38, 0, 0]]))
    builder.clip("far", (top, "translation", "LINEAR", [0, 1], [[3e38, 0, 0], [-3e38, 0, 0]]))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert [clip.duration_s for clip in character.clips] == [1.0]
    assert any("1 keys that are not finite, far out of range" in line for line in character.warnings)


def test_uvs_beyond_the_limit_are_zero_and_told(tmp_path: Path) -> None:
    builder, shape = GltfBuilder(), grid(1, 1)
    uvs = shape["uvs"].copy()
    uvs[0] = 1e30
    builder.node(mesh=builder.mesh(builder.primitive(shape["positions"], shape["faces"], TEXCOORD_0=uvs)))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert np.abs(character.mesh.corner_texcoords).max() <= 1
    assert any("1 texture coordinates are not finite or beyond 65536" in line for line in character.warnings)


def test_joints_that_an_exporter_stored_as_floats(tmp_path: Path) -> None:
    builder, shape = GltfBuilder(), grid(1, 1)
    part = builder.primitive(shape["positions"], shape["faces"], WEIGHTS_0=np.tile([1.0, 0, 0, 0], (4, 1)))
    part["attributes"]["JOINTS_0"] = builder.accessor(np.tile([1.0, 0, 0, 0], (4, 1)))
    root = builder.node()
    tip = builder.node(root)
    builder.node(mesh=builder.mesh(part), skin=builder.skin([root, tip]))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.joint_nodes[character.mesh.joint_indices].max() == 1
    part["attributes"]["JOINTS_0"] = builder.accessor(np.tile([np.nan, 0, 0, 0], (4, 1)))
    with pytest.raises(InputError, match="JOINTS are not whole numbers"):
        load_character(builder.write(tmp_path / "a.glb"))


def test_mesh_and_joints_of_scales_that_disagree(tmp_path: Path) -> None:
    """Clips that move a part by millions of its sizes are left out; a rest pose that does is refused."""
    builder = GltfBuilder()
    top = block(builder, scale=[1e-5, 1e-5, 1e-5])
    builder.clip("near", (top, "translation", "LINEAR", [0, 1], [[0, 0, 0], [1, 0, 0]]))
    builder.clip("far", (top, "translation", "LINEAR", [0, 1], [[0, 0, 0], [100, 0, 0]]))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert [clip.name for clip in character.clips] == ["near"]
    assert any("clip 'far' left out: it moves parts by" in line for line in character.warnings)
    builder, shape = GltfBuilder(), grid(1, 1)
    part = builder.primitive(
        shape["positions"] * 1e-10,
        shape["faces"],
        JOINTS_0=np.tile([0, 1, 0, 0], (4, 1)),
        WEIGHTS_0=np.tile([0.5, 0.5, 0, 0], (4, 1)),
    )
    root = builder.node()
    tip = builder.node(root, translation=[0, 1, 0])
    builder.node(mesh=builder.mesh(part), skin=builder.skin([root, tip]))
    with pytest.raises(InputError, match="its joints at rest move parts by"):
        load_character(builder.write(tmp_path / "a.glb"))


def test_joints_that_move_something_come_first(tmp_path: Path) -> None:
    """Of three thousand that a skin lists, the pipeline carries the two that the mesh uses."""
    builder, shape = GltfBuilder(), grid(1, 1)
    nodes = [builder.node(name=f"joint {number}") for number in range(3000)]
    part = builder.primitive(shape["positions"], shape["faces"], WEIGHTS_0=np.tile([0.5, 0.5, 0, 0], (4, 1)))
    part["attributes"]["JOINTS_0"] = builder.accessor(np.tile([2999, 7, 0, 0], (4, 1)), np.uint16)
    builder.node(mesh=builder.mesh(part), skin=builder.skin(nodes))
    character = load_character(builder.write(tmp_path / "a.glb"))
    assert character.skeleton.joint_names[:3] == ("joint 7", "joint 2999", "joint 0")
    assert character.skeleton.num_joints == 3000 and character.mesh.num_moving_joints == 2
    assert sample_poses(character).shape == (1, 2, 4, 4)
