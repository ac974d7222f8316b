"""load_character on real files: the one mesh moves exactly as the file's own parts do."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
from builders_gltf import bent_bar
from conftest import asset
from source_triangles import (
    assert_manifold,
    assert_same_triangles,
    drawn_triangles,
    source_triangles,
    whole_tree,
)

from preprocess.load import load_character
from preprocess.mesh.seams import find_seams
from runtime.animation.clip import read_clips
from runtime.animation.pose import rest_pose, sample
from runtime.gltf.document import read_document

CHARACTERS = ["Fox.glb", "human.glb", "Knight.glb", "robot.glb", "mannequiny.glb"]


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


def test_a_bar_without_frills(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    assert character.name == "bar" and len(character.source_hash) == 64 and not character.warnings
    assert character.mesh.num_vertices == 27 and len(character.mesh.surface.uvs) == 27
    assert character.skeleton.joint_names == ("root", "tip")
    np.testing.assert_array_equal(character.mesh.surface.positions.max(axis=0), [0.5, 2, 0])
    bent = drawn_triangles(character, sample(character.clips[0], character.skeleton, 1.0)).reshape(-1, 3)
    np.testing.assert_allclose(bent[:, 1].max(), 1.5, atol=1e-6)  # a quarter turn lays the tip down: x = -1


def test_loading_twice_gives_the_same_bytes() -> None:
    first, second = (load_character(asset("mannequiny.glb")).mesh for _ in range(2))
    for field in dataclasses.fields(first.surface):
        assert getattr(first.surface, field.name).tobytes() == getattr(second.surface, field.name).tobytes()
    assert first.joint_weights.tobytes() == second.joint_weights.tobytes()
