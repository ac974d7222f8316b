"""The moments that stand for all: extremes are among them, and what only moves as a whole needs none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders_gltf import bent_bar
from scipy.spatial.transform import Rotation

from preprocess.load import load_character
from preprocess.load.pose_sampling import MAX_POSES, MOST_OF_SMALL, choose_poses, sample_poses

DIFFERENCES = np.array([[0.5, -0.5, 0.0], [0.0, 1.0, -1.0], [0.2, 0.3, -0.5]])
MIDDLES = np.array([[0.0, 0.5, 0.0, 1.0], [0.2, 1.0, 0.0, 1.0], [0.0, 0.0, 0.3, 1.0]])
COUNTS = np.array([1.0, 2.0, 0.5])
EDGES = DIFFERENCES, MIDDLES, COUNTS


def matrices_of(rotations: np.ndarray, translations: np.ndarray | None = None) -> np.ndarray:
    """(M, J, 4, 4) of rotation vectors (M, J, 3)."""
    result = np.tile(np.eye(4), (*rotations.shape[:2], 1, 1))
    turns = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix()
    result[..., :3, :3] = turns.reshape(*rotations.shape[:2], 3, 3)
    if translations is not None:
        result[..., :3, 3] = translations
    return result


def test_what_moves_as_one_needs_no_poses() -> None:
    rng = np.random.default_rng(0)
    together = np.repeat(rng.normal(size=(20, 1, 3)), 3, axis=1)
    places = np.repeat(rng.normal(size=(20, 1, 3)), 3, axis=1)
    assert choose_poses(matrices_of(together, places), *EDGES) == []
    assert choose_poses(np.zeros((0, 3, 4, 4)), *EDGES) == []
    apart = places.copy()
    apart[4, 1] += 0.3  # one joint slides, and turns nothing
    assert choose_poses(matrices_of(together, apart), *EDGES) == [4]


def test_the_furthest_bend_is_taken_first_and_none_twice() -> None:
    angles = np.array([0.1, 0.7, -0.4, 0.7, 0.3])
    rotations = np.zeros((5, 3, 3))
    rotations[:, 1, 0] = angles
    chosen = choose_poses(matrices_of(rotations), *EDGES)
    assert chosen[:2] == [1, 2] and 3 not in chosen  # the other way is further from 0.7 than rest is
    assert sorted(chosen) == [0, 1, 2, 4]


def test_the_way_of_the_world_does_not_count() -> None:
    """Turning the whole character in every pose changes nothing: bends are what neighbours do to one another."""
    rng = np.random.default_rng(1)
    poses = matrices_of(rng.normal(size=(30, 3, 3)))
    turn = matrices_of(np.array([[[0.3, -1.2, 0.4]]]))[0, 0]
    assert choose_poses(turn @ poses, *EDGES) == choose_poses(poses, *EDGES)


def test_choices_are_those_of_a_slow_search() -> None:
    rng = np.random.default_rng(2)
    poses = matrices_of(rng.normal(size=(25, 3, 3)))
    differences, middles, counts = rng.normal(size=(40, 3)), rng.normal(size=(40, 4)), rng.uniform(size=40)

    def bend(pose: np.ndarray, edge: int) -> np.ndarray:
        rows = sum(differences[edge, joint] * pose[joint, :3] for joint in range(3))
        return np.concatenate([rows[:, :3].ravel(), rows @ middles[edge]])

    chosen: list[int] = []
    rest = np.tile(np.eye(4), (3, 1, 1))
    differences -= differences.mean(axis=1, keepdims=True)  # of weights that sum to one
    for _ in range(MAX_POSES):
        gains = []
        for pose in poses:
            known = [rest, *(poses[k] for k in chosen)]
            nearest = [min(((bend(pose, e) - bend(other, e)) ** 2).sum() for other in known) for e in range(40)]
            gains.append(float(np.dot(np.square(nearest), counts)))
        chosen.append(int(np.argmax(gains)))
    assert choose_poses(poses, differences, middles, counts) == chosen
    assert choose_poses(poses, differences, middles, counts, 3) == chosen[:3]


def test_a_character_without_clips_has_its_rest_pose(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    still = type(character)(**{**vars(character), "clips": ()})
    assert sample_poses(still).shape == (1, character.skeleton.num_joints, 4, 4)


def test_the_extreme_moment_of_a_clip_is_among_them(tmp_path: Path) -> None:
    character = load_character(bent_bar(tmp_path / "bar.glb"))
    poses = sample_poses(character)
    assert 2 <= len(poses) <= 1 + MOST_OF_SMALL

    def turned(pose: np.ndarray) -> float:
        between = pose[0, :3, :3].T @ pose[-1, :3, :3]
        return float(Rotation.from_matrix(between).magnitude())

    from preprocess.load.pose_sampling import _moments

    assert max(map(turned, poses)) == pytest.approx(max(map(turned, _moments(character))))
