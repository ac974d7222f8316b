"""Bounds hold what they should, at every moment, and not much more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders_animation import random_clip, random_skeleton

from runtime.animation.bounds import clip_bounds, joint_boxes, pose_bounds
from runtime.animation.clip import Clip, Track, read_clips
from runtime.animation.pose import rest_pose, sample, skinning_rows
from runtime.animation.skeleton import read_skeleton
from runtime.gltf.document import read_document


def skin(rows: np.ndarray, points: np.ndarray, indices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Linear blend skinning, (A, V, 3)."""
    blended = np.einsum("avkrc,vk->avrc", rows[:, indices], weights)
    return np.einsum("avrc,vc->avr", blended[..., :3], points) + blended[..., 3]


def random_mesh(num_joints: int, seed: int, num_points: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    weights = rng.uniform(size=(num_points, 3)) * (rng.uniform(size=(num_points, 3)) > 0.4)
    weights[:, 0] += 0.1
    return (
        rng.normal(size=(num_points, 3)),
        rng.integers(num_joints, size=(num_points, 3)),
        weights / weights.sum(axis=1, keepdims=True),
    )


@pytest.mark.parametrize("mode", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("seed", range(3))
def test_clip_bounds_hold_every_moment(seed: int, mode: str) -> None:
    skeleton = random_skeleton(7, seed)
    clip = random_clip(skeleton, seed, (mode,))
    points, indices, weights = random_mesh(skeleton.num_joints, seed)
    boxes = joint_boxes(points, indices, weights, skeleton.num_joints)
    low, high = clip_bounds(skeleton, clip, boxes)
    times = np.concatenate([np.linspace(0, clip.duration_s, 3000), clip.key_times, np.nextafter(clip.key_times, 0)])
    rows = skinning_rows(skeleton, sample(clip, skeleton, times))
    skinned = skin(rows, points, indices, weights)
    assert (skinned >= low).all() and (skinned <= high).all()
    each = pose_bounds(rows, boxes)
    assert (skinned >= each[:, None, 0] - 1e-9).all() and (skinned <= each[:, None, 1] + 1e-9).all()


def test_a_fast_spin_between_two_keys_is_held() -> None:
    """A point turns 170° between its only two keys, and is farthest out halfway."""
    skeleton = random_skeleton(1)
    skeleton.translation[:], skeleton.rotation[:], skeleton.scale[:] = 0, [0, 0, 0, 1], 1
    skeleton.inverse_bind[:] = np.eye(4)
    ends = np.deg2rad([-85.0, 85.0]) / 2
    quaternions = np.stack([0 * ends, 0 * ends, np.sin(ends), np.cos(ends)], axis=1)
    clip = Clip("spin", 0.01, (Track(0, "rotation", "LINEAR", np.array([0.0, 0.01]), quaternions),))
    boxes = joint_boxes([[1.0, 0, 0]], [[0]], [[1.0]], 1)
    low, high = clip_bounds(skeleton, clip, boxes)
    assert high[0] >= 1.0 and high[0] < 1.01 and low[0] > 0.05
    assert abs(high[1] - np.sin(np.deg2rad(85))) < 0.01


def test_faces_widen_boxes_to_whole_triangles() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    indices, weights = np.array([[0], [1], [1]]), np.ones((3, 1))
    narrow = joint_boxes(points, indices, weights, 3)
    wide = joint_boxes(points, indices, weights, 3, faces=[[0, 1, 2]], margin_m=0.5)
    assert narrow[0].tolist() == [[0, 0, 0], [0, 0, 0]]
    assert wide[0].tolist() == [[-0.5, -0.5, -0.5], [1.5, 1.5, 0.5]]
    assert not np.isfinite(wide[2]).any()


def test_nothing_to_bound() -> None:
    skeleton = random_skeleton(3)
    boxes = joint_boxes(np.zeros((0, 3)), np.zeros((0, 2), int), np.zeros((0, 2)), skeleton.num_joints)
    assert (pose_bounds(skinning_rows(skeleton, rest_pose(skeleton)), boxes) == 0).all()
    assert (clip_bounds(skeleton, Clip("none", 0.0, ()), boxes) == 0).all()
    points, indices, weights = random_mesh(skeleton.num_joints, 0)
    boxes = joint_boxes(points, indices, weights, skeleton.num_joints)
    still = pose_bounds(skinning_rows(skeleton, rest_pose(skeleton)), boxes)[0]
    np.testing.assert_allclose(clip_bounds(skeleton, Clip("none", 0.0, ()), boxes), still, atol=1e-6)


@pytest.mark.parametrize("name", ["human.glb", "Fox.glb", "mannequiny.glb"])
def test_real_clips_are_bounded_tightly(asset_path: Any, name: str) -> None:
    document = read_document(asset_path(name))
    skin_json = document.json["skins"][0]
    skeleton = read_skeleton(document, skin_json["joints"], document.accessor(skin_json["inverseBindMatrices"]))
    attributes = document.json["meshes"][0]["primitives"][0]["attributes"]
    points = document.accessor(attributes["POSITION"]).astype(float)
    indices, weights = document.accessor(attributes["JOINTS_0"]), document.accessor(attributes["WEIGHTS_0"])
    boxes = joint_boxes(points, indices, weights, skeleton.num_joints)
    for clip in read_clips(document, skeleton):
        low, high = clip_bounds(skeleton, clip, boxes)
        rows = skinning_rows(skeleton, sample(clip, skeleton, np.linspace(0, clip.duration_s, 500)))
        sampled = pose_bounds(rows, boxes)
        assert (sampled[:, 0] >= low).all() and (sampled[:, 1] <= high).all()
        tight = np.stack([sampled[:, 0].min(axis=0), sampled[:, 1].max(axis=0)])
        assert np.abs(tight - [low, high]).max() < 0.02 * np.linalg.norm(np.ptp(tight, axis=0))
