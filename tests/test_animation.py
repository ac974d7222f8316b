"""Clips, poses and matrices against slow, obvious twins, and against what must hold for any of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders_animation import random_clip, random_quaternions, random_skeleton

from runtime.animation.clip import Clip, Track, read_clips
from runtime.animation.pose import Pose, global_transforms, rest_pose, sample, skinning_matrices, skinning_rows
from runtime.animation.skeleton import Skeleton, decompose, read_skeleton, rotation_matrices, rotation_quaternion
from runtime.errors import AssetError
from runtime.gltf.document import read_document

RNG = np.random.default_rng(7)


def slow_value(track: Track, time_s: float) -> np.ndarray:
    """The glTF specification's appendix C, one key at a time."""
    times, values = track.times, track.values
    cubic = track.interpolation == "CUBICSPLINE"
    points = values[:, 1] if cubic else values
    if time_s <= times[0] or len(times) == 1:
        result = points[0]
    elif time_s >= times[-1]:
        result = points[-1]
    else:
        k = max(i for i in range(len(times)) if times[i] <= time_s)
        span = times[k + 1] - times[k]
        u = (time_s - times[k]) / span
        if track.interpolation == "STEP":
            result = points[k]
        elif cubic:
            result = (
                (2 * u**3 - 3 * u**2 + 1) * points[k]
                + span * (u**3 - 2 * u**2 + u) * values[k, 2]
                + (-2 * u**3 + 3 * u**2) * points[k + 1]
                + span * (u**3 - u**2) * values[k + 1, 0]
            )
        elif track.path == "rotation":
            dot = float(points[k] @ points[k + 1])
            angle = np.arccos(min(abs(dot), 1.0))
            if angle < 1e-9:
                result = points[k]
            else:
                result = (
                    np.sin(angle * (1 - u)) * points[k] + (1 if dot >= 0 else -1) * np.sin(angle * u) * points[k + 1]
                ) / np.sin(angle)
        else:
            result = (1 - u) * points[k] + u * points[k + 1]
    return result / np.linalg.norm(result) if track.path == "rotation" else result


def slow_matrices(skeleton: Skeleton, pose: Pose, actor: int) -> np.ndarray:
    """Skinning matrices of one actor, one 4×4 product at a time."""
    matrices: list[np.ndarray] = []
    for node in range(skeleton.num_nodes):
        local = np.eye(4)
        local[:3, :3] = rotation_matrices(pose.rotation[actor, node]) @ np.diag(pose.scale[actor, node])
        local[:3, 3] = pose.translation[actor, node]
        if node in skeleton.matrix_nodes:
            local = skeleton.matrices[list(skeleton.matrix_nodes).index(node)]
        parent = skeleton.parents[node]
        matrices.append((skeleton.root_transform if parent < 0 else matrices[parent]) @ local)
    return np.array([matrices[node] @ inverse for node, inverse in zip(skeleton.joint_nodes, skeleton.inverse_bind)])


@pytest.mark.parametrize("seed", range(4))
def test_sampling_equals_the_specification_key_by_key(seed: int) -> None:
    skeleton = random_skeleton(9, seed)
    clip = random_clip(skeleton, seed)
    times = np.concatenate([RNG.uniform(-0.5, clip.duration_s + 0.5, 40), clip.key_times, [0.0, clip.duration_s]])
    pose = sample(clip, skeleton, times)
    for track in clip.tracks:
        for actor, time_s in enumerate(times):
            wanted = slow_value(track, min(max(float(time_s), 0.0), clip.duration_s))
            np.testing.assert_allclose(getattr(pose, track.path)[actor, track.node], wanted, atol=1e-9)


def test_rotations_take_the_shorter_arc_and_small_arcs_stay_exact() -> None:
    skeleton = random_skeleton(1)
    for angle in (0.0, 1e-8, 1e-4, 0.3, np.pi - 1e-3):
        end = np.array([np.sin(angle / 2), 0, 0, np.cos(angle / 2)])
        for sign in (1.0, -1.0):  # −q is the same rotation: the way there must not change
            track = Track(0, "rotation", "LINEAR", np.array([0.0, 1.0]), np.array([[0, 0, 0, 1.0], sign * end]))
            pose = sample(Clip("arc", 1.0, (track,)), skeleton, [0.25])
            wanted = np.array([np.sin(angle / 8), 0, 0, np.cos(angle / 8)])
            np.testing.assert_allclose(pose.rotation[0, 0], wanted, atol=1e-12)


def test_looping_repeats_and_not_looping_clamps() -> None:
    skeleton = random_skeleton(5)
    clip = random_clip(skeleton, 3, ("LINEAR",))
    times = np.array([0.1, 0.5])
    once = sample(clip, skeleton, times)
    looped = sample(clip, skeleton, times + 3 * clip.duration_s, loop=True)
    np.testing.assert_allclose(looped.translation, once.translation, atol=1e-9)
    before = sample(clip, skeleton, times - clip.duration_s, loop=True)
    np.testing.assert_allclose(before.scale, once.scale, atol=1e-9)
    held = sample(clip, skeleton, [clip.duration_s, clip.duration_s + 9])
    assert (held.translation[0] == held.translation[1]).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("num_actors", [1, 5, 300])
def test_matrices_equal_one_product_at_a_time(seed: int, num_actors: int) -> None:
    skeleton = random_skeleton(12, seed)
    pose = sample(random_clip(skeleton, seed), skeleton, RNG.uniform(0, 2, num_actors))
    matrices = skinning_matrices(skeleton, pose)
    for actor in {0, num_actors // 2, num_actors - 1}:
        wanted = slow_matrices(skeleton, pose, actor)
        np.testing.assert_allclose(matrices[actor], wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_a_sheared_node_keeps_its_matrix() -> None:
    shear = np.eye(4)
    shear[0, 1] = 0.7
    turned = np.eye(4)
    turned[:3, :3] = rotation_matrices(random_quaternions(1, RNG)[0]) * [2, 3, -1]
    turned[:3, 3] = [1, 2, 3]
    nodes = [
        {"matrix": shear.T.ravel().tolist(), "children": [1]},
        {"matrix": turned.T.ravel().tolist(), "children": [2]},
        {"translation": [0, 1, 0]},
    ]
    document: Any = SimpleNamespace(json={"nodes": nodes}, path=None)
    skeleton = read_skeleton(document, [2], np.eye(4)[None])
    assert list(skeleton.matrix_nodes) == [0]
    lifted = np.eye(4)
    lifted[1, 3] = 1
    np.testing.assert_allclose(
        skinning_matrices(skeleton, rest_pose(skeleton))[0, 0], shear @ turned @ lifted, atol=1e-12
    )


def test_decompose_gives_back_the_matrix() -> None:
    for quaternion in random_quaternions(50, RNG):
        scale = RNG.uniform(0.2, 3, 3) * RNG.choice([-1, 1], 3)
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrices(quaternion) * scale
        matrix[:3, 3] = RNG.normal(size=3)
        translation, rotation, found_scale, exact = decompose(matrix)
        assert exact
        np.testing.assert_allclose(rotation_matrices(rotation) * found_scale, matrix[:3, :3], atol=1e-12)
        np.testing.assert_allclose(translation, matrix[:3, 3])
        again = rotation_quaternion(rotation_matrices(quaternion))
        assert abs(abs(again @ quaternion) - 1) < 1e-12
    assert not decompose(np.diag([0.0, 1, 1, 1]))[3]


def test_zero_one_and_two_of_everything() -> None:
    empty = random_skeleton(2)
    nothing = Clip("nothing", 0.0, ())
    assert sample(nothing, empty, np.zeros(0)).translation.shape == (0, 2, 3)
    assert skinning_rows(empty, rest_pose(empty, 0)).shape == (0, 1, 3, 4)
    assert nothing.key_times.tolist() == [0.0]
    one_key = Clip("still", 0.0, (Track(1, "scale", "STEP", np.array([0.0]), np.array([[2.0, 3, 4]])),))
    for loop in (False, True):
        pose = sample(one_key, empty, [0.0, 5.0], loop=loop)
        assert (pose.scale[:, 1] == [2, 3, 4]).all()
    late = Clip(
        "late", 2.0, (Track(0, "translation", "LINEAR", np.array([1.0, 2.0]), np.array([[1.0, 0, 0], [2, 0, 0]])),)
    )
    np.testing.assert_allclose(sample(late, empty, [0.0, 1.5, 2.0]).translation[:, 0, 0], [1, 1.5, 2])
    with pytest.raises(ValueError, match="not finite"):
        sample(late, empty, [np.nan])


def test_single_precision_follows_double() -> None:
    skeleton = random_skeleton(30, 2, scaled=False)
    clip = random_clip(skeleton, 2).restricted(range(30))
    clip = Clip("unscaled", clip.duration_s, tuple(track for track in clip.tracks if track.path != "scale"))
    times = RNG.uniform(0, 2, 50)
    double = global_transforms(skeleton, sample(clip, skeleton, times))
    single = global_transforms(skeleton, sample(clip, skeleton, times, dtype=np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, atol=2e-5 * np.abs(double).max())


def test_overrides_replace_a_node_and_what_hangs_below_follows() -> None:
    skeleton = random_skeleton(10, 1)
    pose = rest_pose(skeleton, 2)
    own = global_transforms(skeleton, pose)
    child = int(np.flatnonzero(skeleton.parents == 1)[0]) if (skeleton.parents == 1).any() else 1
    given = np.full((2, 10, 3, 4), np.nan)
    given[1, 1] = np.eye(4)[:3]
    nodes = np.empty((2, 10, 3, 4))
    skinning_rows(skeleton, pose, given, nodes)
    np.testing.assert_allclose(nodes[0], own[0, :, :3])
    np.testing.assert_allclose(nodes[1, 1], np.eye(4)[:3])
    if child != 1:
        followed = np.linalg.inv(own[1, 1]) @ own[1, child]
        np.testing.assert_allclose(nodes[1, child], followed[:3], atol=1e-9)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([{"children": [1]}, {"children": [0]}], "own ancestor"),
        ([{"children": [2]}, {"children": [2]}, {}], "two parents"),
        ([{"children": [7]}], "does not exist"),
        ([{"rotation": [0, 0, 0, 0]}], "rotation is zero"),
        ([{"translation": [0, float("nan"), 0]}], "finite"),
        ([{"matrix": [1, 2, 3]}], "16 finite numbers"),
    ],
)
def test_broken_trees_are_refused_in_one_line(nodes: list[dict[str, Any]], message: str) -> None:
    document: Any = SimpleNamespace(json={"nodes": nodes}, path=Path("broken.gltf"))
    with pytest.raises(AssetError, match=message) as caught:
        read_skeleton(document, [0], np.eye(4)[None])
    assert "\n" not in str(caught.value)


def clip_document(times: Any, values: Any, path: str = "translation", mode: str = "LINEAR", **sampler: Any) -> Any:
    arrays = [np.asarray(times, dtype=np.float32), np.asarray(values, dtype=np.float32)]
    json = {
        "nodes": [{"name": "root"}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 0, "path": path}}],
                "samplers": [{"input": 0, "output": 1, "interpolation": mode, **sampler}],
            }
        ],
    }
    return SimpleNamespace(json=json, path=Path("clip.gltf"), accessor=lambda index: arrays[index])


@pytest.mark.parametrize(
    ("times", "values", "path", "mode", "message"),
    [
        ([0, 0], np.zeros((2, 3)), "translation", "LINEAR", "must rise"),
        ([1, 0.5], np.zeros((2, 3)), "translation", "LINEAR", "must rise"),
        ([-1, 0.5], np.zeros((2, 3)), "translation", "LINEAR", "must rise"),
        ([], np.zeros((0, 3)), "translation", "LINEAR", "no key times"),
        ([0, 1], np.zeros((3, 3)), "translation", "LINEAR", "needs 2 rows"),
        ([0, 1], np.zeros((2, 3)), "translation", "CUBICSPLINE", "needs 6 rows"),
        ([0, 1], np.zeros((2, 4)), "rotation", "LINEAR", "rotation key is zero"),
        ([0, 1], [[0, 0, 0], [np.inf, 0, 0]], "scale", "STEP", "not finite"),
        ([0, 1], np.zeros((2, 3)), "translation", "BEZIER", "unknown"),
    ],
)
def test_broken_clips_are_refused_in_one_line(times: Any, values: Any, path: str, mode: str, message: str) -> None:
    document = clip_document(times, values, path, mode)
    skeleton = read_skeleton(document, [0], np.eye(4)[None])
    with pytest.raises(AssetError, match=message) as caught:
        read_clips(document, skeleton)
    assert "\n" not in str(caught.value)


def mended_clip(*arguments: Any, **options: Any) -> tuple[Any, list[str]]:
    document = clip_document(*arguments, **options)
    faults: list[str] = []
    (clip,) = read_clips(document, read_skeleton(document, [0], np.eye(4)[None]), faults=faults)
    assert all("\n" not in fault and "clip 'clip 0'" in fault for fault in faults)
    return clip, faults


def test_damaged_keys_are_mended_where_it_is_clear_how() -> None:
    steps = np.arange(12.0).reshape(4, 3)
    clip, faults = mended_clip([0, 1, 1, 2], steps)  # a jump at 1 s stays one
    (track,) = clip.tracks
    assert len(faults) == 1 and "1 keys at the time of another" in faults[0]
    np.testing.assert_array_equal(track.values, steps)
    assert (np.diff(track.times.astype(np.float32)) > 0).all() and track.times[2] == pytest.approx(1, abs=1e-6)
    clip, faults = mended_clip([0, 1, 1, 1, 1, 2], np.arange(18.0).reshape(6, 3))
    np.testing.assert_array_equal(clip.tracks[0].values[:, 0], [0, 3, 12, 15])
    clip, faults = mended_clip([0, np.nan, 2], [[0, 0, 0], [1, 1, 1], [2, np.inf, 2]])
    assert len(clip.tracks[0].times) == 1 and "2 keys" in faults[0]
    turn = [[0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 1, 0]]
    clip, faults = mended_clip([0, 1, 2], turn, "rotation")
    np.testing.assert_array_equal(clip.tracks[0].times, [0, 2])
    tangents = np.zeros((6, 4))
    tangents[[1, 4], 3] = 1
    clip, faults = mended_clip([0, 1], tangents, "rotation", "CUBICSPLINE")  # its tangents may be zero
    assert not faults and clip.tracks[0].values.shape == (2, 3, 4)


def test_clips_from_before_zero_start_at_zero() -> None:
    clip, faults = mended_clip([-1, 0.5], [[0, 0, 0], [3, 0, 0]])
    np.testing.assert_array_equal(clip.tracks[0].times, [0, 1.5])
    assert clip.duration_s == 1.5 and "1 s before 0" in faults[0]


@pytest.mark.parametrize(("times", "rows"), [([1, 0.5], 2), ([0, 1], 3), ([], 0), ([np.nan, np.nan], 2)])
def test_tracks_beyond_mending_are_left_out(times: list[float], rows: int) -> None:
    clip, faults = mended_clip(times, np.zeros((rows, 3)))
    assert clip.tracks == () and len(faults) == 1 and faults[0].startswith("left out: ")


def test_clips_from_another_file_match_by_name() -> None:
    document = clip_document([0, 1], [[0, 0, 0], [0, 2, 0]])
    nodes = [{"name": "armature", "children": [1]}, {"name": "root"}]
    other: Any = SimpleNamespace(json={"nodes": nodes}, path=None)
    skeleton = read_skeleton(other, [1], np.eye(4)[None])
    (clip,) = read_clips(document, skeleton, by_name=True)
    assert sample(clip, skeleton, 0.5).translation[0, skeleton.node("root"), 1] == 1
    stranger = read_skeleton(SimpleNamespace(json={"nodes": [{"name": "tail"}]}, path=None), [0], np.eye(4)[None])  # type: ignore[arg-type]
    with pytest.raises(AssetError, match="none of its nodes"):
        read_clips(document, stranger, by_name=True)


@pytest.mark.parametrize("name", ["human.glb", "Fox.glb", "Knight.glb", "mannequiny.glb", "robot.glb"])
def test_real_characters_pose(asset_path: Any, name: str) -> None:
    document = read_document(asset_path(name))
    skin = document.json["skins"][0]
    skeleton = read_skeleton(document, skin["joints"], document.accessor(skin["inverseBindMatrices"]))
    clips = read_clips(document, skeleton)
    assert len(clips) == len(document.json["animations"])
    for clip in clips[:6]:
        pose = sample(clip, skeleton, np.linspace(0, clip.duration_s, 3))
        matrices = skinning_matrices(skeleton, pose)
        np.testing.assert_allclose(matrices[1], slow_matrices(skeleton, pose, 1), atol=1e-9 * np.abs(matrices).max())
