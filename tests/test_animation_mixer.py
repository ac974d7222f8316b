"""Mixing, layers, joints from code, root motion, attachment: what an actor promises."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders_animation import random_clip, random_skeleton
from builders_mixer import angle_about_x, make_walker, model_of, straight_skeleton, turn_clip

from runtime.animation.clip import Clip, Track
from runtime.animation.mixer import Mixer
from runtime.animation.pose import global_transforms, rest_pose, sample, skinning_rows
from runtime.animation.skeleton import Skeleton
from runtime.scene.actor import Actor
from runtime.scene.actor_batch import gather


@pytest.fixture
def walker() -> Any:
    return make_walker()


def test_updates_pile_up_to_the_same_pose_as_one_seek(walker: Any) -> None:
    actor, other = Actor(walker, "bend"), Actor(walker, "bend", time_s=0.7)
    for _ in range(7):
        actor.update(0.1)
    np.testing.assert_allclose(actor.joint_rows, other.joint_rows, atol=1e-6)
    assert actor.time_s == pytest.approx(0.7) and actor.clip == "bend"
    actor.update(0.5)
    assert actor.time_s == pytest.approx(0.2)  # looped
    actor.time_s = 0.25
    actor.set_speed(-2.0)
    actor.update(0.25)
    assert actor.time_s == pytest.approx(0.75)  # backwards over the start
    actor.play("bend", loop=False)
    actor.update(9)
    assert actor.time_s == pytest.approx(1.0)  # held


def test_a_crossfade_is_linear_in_time_and_then_only_the_new_clip(walker: Any) -> None:
    actor = Actor(walker, "bend", time_s=1.0, loop=False)
    actor.play("bow", fade_s=0.5, time_s=1.0, loop=False)
    seen = []
    for _ in range(6):
        seen.append(angle_about_x(walker.mixer.pose(actor.row).rotation[0, 1]))
        actor.update(0.1)
    np.testing.assert_allclose(seen, 0.8 - 0.4 * np.arange(6) / 5, atol=2e-3)  # nlerp of near rotations
    assert seen[0] == pytest.approx(0.8, abs=1e-6) and seen[-1] == pytest.approx(0.4, abs=1e-6)


def test_an_interrupted_fade_never_pops(walker: Any) -> None:
    actor = Actor(walker, "bend", time_s=1.0, loop=False)
    angle = 0.8
    for step in range(60):
        if step % 7 == 0:
            actor.play(("bow", "nod", "bend", "walk")[step // 7 % 4], fade_s=0.4, time_s=1.0, loop=False)
        now = angle_about_x(walker.mixer.pose(actor.row).rotation[0, 1])
        assert abs(now - angle) < 0.07
        angle = now
        actor.update(0.02)


def test_a_masked_layer_moves_its_nodes_alone(walker: Any) -> None:
    walker.mixer.add_layer("head", nodes=["bone2"])
    actor = Actor(walker, "bend", time_s=1.0, loop=False)
    before = walker.mixer.pose(actor.row)
    actor.play("nod", layer="head", time_s=1.0, loop=False)
    after = walker.mixer.pose(actor.row)
    assert (after.rotation[0, :2] == before.rotation[0, :2]).all()
    assert angle_about_x(after.rotation[0, 2]) == pytest.approx(0.6, abs=1e-5)
    actor.set_layer_weight("head", 0.5)
    assert angle_about_x(walker.mixer.pose(actor.row).rotation[0, 2]) == pytest.approx(0.3, abs=1e-3)
    actor.stop("head")
    assert (walker.mixer.pose(actor.row).rotation == before.rotation).all()


def test_a_layer_fades_in_and_out(walker: Any) -> None:
    walker.mixer.add_layer("head")
    actor = Actor(walker, "bow", time_s=1.0, loop=False)
    actor.play("nod", layer="head", time_s=1.0, loop=False, fade_s=1.0)
    angles = []
    for step in range(8):
        if step == 4:
            actor.stop("head", fade_s=1.0)
        angles.append(angle_about_x(walker.mixer.pose(actor.row).rotation[0, 2]))
        actor.update(0.25)
    np.testing.assert_allclose(angles, 0.6 * np.array([0, 0.25, 0.5, 0.75, 1, 0.75, 0.5, 0.25]), atol=5e-3)


def test_an_additive_layer_adds_and_zero_weight_changes_nothing(walker: Any) -> None:
    walker.mixer.add_layer("lean", "additive")
    actor = Actor(walker, "bend", time_s=1.0, loop=False)
    before = walker.mixer.pose(actor.row)
    actor.play("bow", layer="lean", time_s=1.0, loop=False)
    assert angle_about_x(walker.mixer.pose(actor.row).rotation[0, 1]) == pytest.approx(1.2, abs=1e-5)
    actor.set_layer_weight("lean", 0.25)
    assert angle_about_x(walker.mixer.pose(actor.row).rotation[0, 1]) == pytest.approx(0.9, abs=1e-5)
    actor.set_layer_weight("lean", 0)
    assert (walker.mixer.pose(actor.row).rotation == before.rotation).all()


@pytest.mark.parametrize("seed", range(3))
def test_batched_rows_equal_rows_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    skeleton = random_skeleton(8, seed)
    clips = [random_clip(skeleton, number) for number in range(4)]
    mixer = Mixer(skeleton, clips)
    mixer.add_layer("top", nodes=rng.uniform(size=8))
    mixer.add_layer("extra", "additive")
    rows = np.array([mixer.add_row() for _ in range(12)])
    for _ in range(20):
        some = rng.choice(rows, 5, replace=False)
        layer = int(rng.integers(3))
        mixer.play(
            some, int(rng.integers(4)), layer=layer, fade_s=float(rng.choice([0, 0.3])), speed=rng.uniform(-2, 2, 5)
        )
        mixer.note_time_all(float(rng.uniform(0, 0.2)))
    together = mixer.pose(rows)
    for index, row in enumerate(rows):
        alone = mixer.pose(row)
        for path in ("translation", "rotation", "scale"):
            np.testing.assert_allclose(getattr(alone, path)[0], getattr(together, path)[index], atol=1e-5, rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(together.rotation, axis=2), 1, atol=1e-5)


def test_root_motion_walks_the_actor_and_not_the_root(walker: Any) -> None:
    turned = np.eye(4)
    turned[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # a quarter turn: +X becomes −Z
    actor = Actor(walker, "walk", root_motion=True, transform=turned)
    in_column = Actor(walker, "walk")
    for _ in range(35):
        actor.update(0.1)
        in_column.update(0.1)
    np.testing.assert_allclose(actor.transform[:3, 3], [0, 0, -7.0], atol=1e-9)  # 3.5 rounds of 2 m
    held = walker.mixer.pose(actor.row).translation[0, 0]
    free = walker.mixer.pose(in_column.row).translation[0, 0]
    np.testing.assert_allclose(held, [0, 1.2, 0], atol=1e-6)  # bobbing stays
    np.testing.assert_allclose(free, [1, 1.2, 0], atol=1e-6)
    assert (in_column.transform == np.eye(4)).all()


def walking_clip(skeleton: Skeleton, root: int, seed: int, rotates: bool = True) -> Clip:
    """The root wanders, bobs and turns, and does not end where it began; a node below swings."""
    rng = np.random.default_rng(seed)
    times = np.linspace(0, 1.3, 7)
    way = Track(root, "translation", "LINEAR", times, np.cumsum(rng.normal(0.2, 0.3, (7, 3)), axis=0))
    angles = np.cumsum(rng.uniform(0.1, 0.9, 7))
    lean = 0.15 * rng.normal(size=7)
    # A turn about +Y after a lean about +X.
    turn = np.stack([np.cos(angles / 2) * np.sin(lean), np.sin(angles / 2) * np.cos(lean),
                     -np.sin(angles / 2) * np.sin(lean), np.cos(angles / 2) * np.cos(lean)], axis=1)  # fmt: skip
    tracks = [way, Track(root, "rotation", "LINEAR", times, turn)] if rotates else [way]
    below = turn_clip("", skeleton.num_nodes - 1, 0.7, 1.3).tracks
    return Clip("wander", 1.3, (*tracks, *below))


def free_motion(model: Any, clip: Clip, root: int, time_s: float, turns: bool) -> np.ndarray:
    """The root's motion over the ground since the start of the first round, (4, 4): one actor, one time, by hand."""
    skeleton = model.mixer.skeleton
    rounds, inside = divmod(time_s, clip.duration_s)

    def since_start(moment: float) -> np.ndarray:
        places = []
        for at in (0.0, moment):
            places.append(global_transforms(skeleton, sample(clip, skeleton, at))[0, root])
        angle = 0.0
        if turns:
            between = places[1][:3, :3] @ np.linalg.inv(places[0][:3, :3])
            angle = 2 * np.arctan2(between[0, 2] - between[2, 0], 1 + np.trace(between))
        result = np.eye(4)
        result[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        ground = np.array([1.0, 0.0, 1.0])
        result[:3, 3] = ground * places[1][:3, 3] - result[:3, :3] @ (ground * places[0][:3, 3])
        return result

    return np.linalg.matrix_power(since_start(clip.duration_s), int(rounds)) @ since_start(inside)


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("speed", [1.0, -0.7])
@pytest.mark.parametrize("above", [False, True])
def test_root_motion_and_the_held_pose_together_are_the_clip(turns: bool, speed: float, above: bool) -> None:
    skeleton = straight_skeleton(4)
    if above:  # the root hangs below a node that is turned, mirrored and scaled
        skeleton.rotation[0] = [0.5, 0.1, -0.3, np.sqrt(1 - 0.35)]
        skeleton.root_transform[:3, :3] = np.diag([-1.7, 1.7, 1.7])
        skeleton.root_transform[:3, 3] = [0.3, 0.2, -4]
    root = 1 if above else 0
    clip = walking_clip(skeleton, root, 3)
    model = model_of(skeleton, [clip])
    start = np.eye(4)
    start[:3, :3] = 1.2 * np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    actor = Actor(model, "wander", root_motion="turn" if turns else True, transform=start, speed=speed)
    total = 0.0
    for dt in (0.0, 0.3, 0.01, 0.7, 0.4, 2.9, 0.0, 0.2):  # over one seam of the loop and over several at once
        actor.update(dt)
        total += speed * dt
        carried = free_motion(model, clip, root, total, turns)
        np.testing.assert_allclose(actor.transform, start @ carried, atol=1e-9)
        # In the world every joint is where the clip alone, round after round, would have it.
        rounds, inside = divmod(total, clip.duration_s)
        free = global_transforms(skeleton, sample(clip, skeleton, inside))[0]
        whole = free_motion(model, clip, root, rounds * clip.duration_s, turns)
        for node in range(root, skeleton.num_nodes):  # what is above the root goes with the actor
            wanted = start @ whole @ free[node]
            np.testing.assert_allclose(actor.joint_transform(node), wanted, atol=2e-5)
    held = actor.joint_transform(root)
    np.testing.assert_allclose(
        (np.linalg.inv(actor.transform) @ held)[[0, 2], 3],
        global_transforms(skeleton, sample(clip, skeleton, 0.0))[0, root, [0, 2], 3],
        atol=1e-5,
    )


def test_a_turn_below_a_stretched_frame_is_left_alone() -> None:
    skeleton = straight_skeleton(3)
    skeleton.root_transform[:3, :3] = np.diag([1.0, 1.0, 3.0])
    model = model_of(skeleton, [walking_clip(skeleton, 0, 1)])
    actor, other = Actor(model, 0, root_motion="turn"), Actor(model, 0, root_motion=True)
    for one in (actor, other):
        one.update(1.0)
    np.testing.assert_allclose(actor.transform, other.transform)
    np.testing.assert_allclose(actor.joint_rows, other.joint_rows)


def test_a_constant_written_out_is_no_root(walker: Any) -> None:
    skeleton = walker.mixer.skeleton
    still = Track(0, "translation", "LINEAR", np.array([0.0, 1.0]), np.array([[0, 1, 0], [0, 1, 0.0]]))
    way = Track(1, "translation", "LINEAR", np.array([0.0, 1.0]), np.array([[0, 1, 0], [2, 1, 0.0]]))
    actor = Actor(walker, Clip("walk", 1.0, (still, way)), root_motion=True)
    actor.update(0.5)
    np.testing.assert_allclose(actor.transform[:3, 3], [1, 0, 0], atol=1e-9)
    spin = Actor(walker, turn_clip("turn", 0, 0.5), root_motion="turn")  # about +X: no turn over the ground
    spin.update(0.5)
    np.testing.assert_allclose(spin.transform, np.eye(4), atol=1e-9)
    assert skeleton.num_nodes == 3


def test_whole_turns_add_up_while_clips_fade() -> None:
    skeleton = straight_skeleton(3)
    times = np.linspace(0, 1, 9)
    angles = np.linspace(0, 2 * np.pi, 9)
    values = np.stack([0 * angles, np.sin(angles / 2), 0 * angles, np.cos(angles / 2)], axis=1)
    spin = Clip("spin", 1.0, (Track(0, "rotation", "LINEAR", times, values),))
    model = model_of(skeleton, [spin, Clip("stand", 1.0, ())])
    actor = Actor(model, "spin", root_motion="turn")
    heading = 0.0
    for _ in range(23):
        before = actor.transform.copy()
        actor.update(0.1)
        step = np.linalg.inv(before) @ actor.transform
        heading += np.arctan2(step[0, 2], step[0, 0])
        np.testing.assert_allclose(actor.joint_rows[0], model.mixer.skeleton.inverse_bind[0, :3] + [[0, 0, 0, 0],
                                   [0, 0, 0, 1], [0, 0, 0, 0]], atol=1e-5)  # fmt: skip
    assert heading == pytest.approx(2.3 * 2 * np.pi)
    actor.play("stand", fade_s=1.0)
    turned = 0.0
    for _ in range(20):
        before = actor.transform.copy()
        actor.update(0.05)
        step = np.linalg.inv(before) @ actor.transform
        turned += np.arctan2(step[0, 2], step[0, 0])
    assert 0.4 * 2 * np.pi < turned < 0.6 * 2 * np.pi  # slower and slower: half a turn
    actor.update(5.0)
    after = actor.transform.copy()
    actor.update(1.0)
    np.testing.assert_allclose(actor.transform, after, atol=1e-9)


def test_joints_from_code(walker: Any) -> None:
    actor = Actor(walker, "bend", time_s=0.5)
    own = actor.joint_rows.copy()
    joints = np.full((walker.mixer.skeleton.num_joints, 4, 4), np.nan)
    joints[1] = np.eye(4)
    joints[1, 0, 3] = 5
    actor.set_joints(joints)
    np.testing.assert_allclose(actor.joint_rows[1], joints[1, :3])
    np.testing.assert_allclose(actor.joint_rows[0], own[0])
    actor.set_joints(None)
    np.testing.assert_allclose(actor.joint_rows, own)
    rotations = np.full((walker.mixer.skeleton.num_joints, 4), np.nan)
    rotations[0] = [0, 0, 2, 0]  # not unit: it is made so
    actor.set_joint_rotations(rotations)
    np.testing.assert_allclose(walker.mixer.pose(actor.row).rotation[0, 0], [0, 0, 1, 0], atol=1e-6)
    actor.set_joint_rotations(None)
    np.testing.assert_allclose(actor.joint_rows, own)
    with pytest.raises(ValueError, match="one entry a joint"):
        actor.set_joints(np.eye(4))
    with pytest.raises(ValueError, match="infinite"):
        actor.set_joints(np.full_like(joints, np.inf))


def test_an_attached_thing_follows_its_joint(walker: Any) -> None:
    actor, lantern = Actor(walker, "bend"), SimpleNamespace(transform=None)
    offset = np.eye(4)
    offset[1, 3] = 0.5
    actor.attach(lantern, "bone2", offset)
    for _ in range(3):
        actor.transform[0, 3] += 1
        actor.update(0.2)
        pose = sample(walker.mixer.clips[0], walker.mixer.skeleton, actor.time_s)
        wanted = actor.transform @ global_transforms(walker.mixer.skeleton, pose)[0, 2] @ offset
        np.testing.assert_allclose(lantern.transform, wanted, atol=1e-6)
    actor.detach(lantern)
    kept = lantern.transform
    actor.update(1)
    assert lantern.transform is kept


def test_a_clip_from_elsewhere_joins_in(walker: Any) -> None:
    actor = Actor(walker, turn_clip("new", 1, 0.5), time_s=1.0, loop=False)
    assert actor.clip == "new" and len(walker.mixer.clips) == 5
    assert angle_about_x(walker.mixer.pose(actor.row).rotation[0, 1]) == pytest.approx(0.5, abs=1e-6)


def test_misuse_says_what_to_do(walker: Any) -> None:
    actor = Actor(walker)
    for wrong, message in (
        (lambda: actor.play("fly"), "no clip 'fly'; the character has 'bend'"),
        (lambda: actor.play(99), "no clip 99"),
        (lambda: actor.play("walk", layer="tail"), "no layer 'tail'"),
        (lambda: actor.play("walk", speed=np.nan), "finite"),
        (lambda: actor.update(float("nan")), "frame clock"),
        (lambda: actor.joint_transform("tail"), "no joint 'tail'"),
        (lambda: setattr(actor, "transform", np.full((4, 4), np.inf)), "finite 4×4"),
        (lambda: setattr(actor, "tint", (1, 2)), "three or four"),
        (lambda: Actor(walker, "fly"), "no clip"),
        (lambda: Actor(walker, "walk", root_motion="fly"), "use False, True or 'turn'"),
        (lambda: walker.mixer.add_layer("base"), "already"),
        (lambda: walker.mixer.add_layer("x", "sum"), "unknown"),
        (lambda: walker.mixer.add_layer("x", nodes=[1, 0]), "one number a node"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()
    rows = walker.mixer.num_rows
    actor.release()
    actor.release()
    assert walker.mixer.num_rows == rows - 1
    with pytest.raises(ValueError, match="released"):
        actor.update(0.1)


def test_gathering(walker: Any) -> None:
    other = model_of(straight_skeleton(4), [])
    actors = [Actor(walker, "bend", time_s=0.1 * i) for i in range(5)] + [Actor(other)]
    actors[1].visible = False
    actors[2].release()
    (first, batch), (second, single) = gather(actors[index] for index in (0, 5, 1, 2, 3, 4))
    assert first is walker and second is other
    assert batch.actors == (actors[0], actors[3], actors[4]) and single.actors == (actors[5],)
    for index, actor in enumerate(batch.actors):
        np.testing.assert_allclose(batch.joint_rows[index], actor.joint_rows)
        np.testing.assert_allclose(batch.bounds[index], actor.bounds)
    assert batch.joint_rows.flags.c_contiguous and batch.joint_rows.dtype == np.float32
    assert gather([]) == []
    actors[3].transform[0, 0] = np.nan
    with pytest.raises(ValueError, match="actor 1 of those"):
        gather([actors[0], actors[3]])


def test_the_rest_pose_without_a_clip(walker: Any) -> None:
    skeleton = walker.mixer.skeleton
    np.testing.assert_allclose(Actor(walker).joint_rows, skinning_rows(skeleton, rest_pose(skeleton))[0], atol=1e-6)


def test_updating_and_posing_a_thousand_actors_is_fast() -> None:
    skeleton = random_skeleton(53, 1)
    clips = [random_clip(skeleton, number, ("LINEAR",)) for number in range(3)]
    model = model_of(skeleton, clips)
    actors = [Actor(model, index % 3, time_s=index * 0.01) for index in range(1000)]
    spent = []
    for _ in range(5):
        start = time.process_time()
        for actor in actors:
            actor.update(0.016)
        model.mixer.joint_rows([actor.row for actor in actors])
        spent.append(time.process_time() - start)
    assert min(spent) < 0.05, f"{min(spent) * 1e3:.1f} ms"
