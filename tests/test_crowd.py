"""Crowds: the same picture as single actors, every choice as its slow twin makes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_animation import random_clip, random_skeleton
from builders_asset import build_ball

import runtime
from runtime.animation.bounds import joint_boxes, pose_bounds
from runtime.animation.clip import Clip, Track
from runtime.animation.pose import sample, skinning_rows
from runtime.crowd.animation_texture import bake_clips, dropped_shift, pick_joints, steps_between_keys
from runtime.crowd.crowd import Crowd
from runtime.crowd.lod_buffers import bake_level_animations, model_meshes
from runtime.crowd.vertex_animation_texture import bake_vertex_animation
from runtime.render.views import VIEWS
from runtime.scene.lod_selection import choose_levels

SIZE = 192
CAMERA = runtime.Camera((0, 7, 12), (0, 0, 0), fovy_deg=45)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_ball(tmp_path_factory.mktemp("crowd") / "ball.seamless")


@pytest.fixture
def model(ctx: moderngl.Context, ball: Path) -> Any:
    model = runtime.Model(ctx, runtime.load(ball))
    yield model
    model.release()


@pytest.fixture
def renderer(ctx: moderngl.Context) -> Any:
    renderer = runtime.Renderer(ctx)
    yield renderer
    renderer.release()


@pytest.fixture
def picture(ctx: moderngl.Context, renderer: Any) -> Any:
    """Function from things to draw to their picture, (H, W, 3) int."""
    framebuffer = ctx.simple_framebuffer((SIZE, SIZE))

    def draw(things: Any, camera: Any = CAMERA, **options: Any) -> np.ndarray:
        framebuffer.use()
        framebuffer.clear(0.2, 0.3, 0.4, 1.0)
        renderer.draw(things, camera, **options)
        return np.frombuffer(framebuffer.read(), np.uint8).reshape(SIZE, SIZE, 3)[::-1].astype(int)

    yield draw
    for attachment in (*framebuffer.color_attachments, framebuffer.depth_attachment):
        attachment.release()
    framebuffer.release()


def circle(count: int, radius: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Transforms on a circle, each turned and scaled its own way, every third mirrored; and phases."""
    matrices = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        angle = 2 * np.pi * index / count
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        mirror = -1.0 if index % 3 == 2 else 1.0
        matrices[index, :3, :3] = turn @ np.diag([mirror, 1.0, 0.8])
        matrices[index, :3, 3] = [radius * np.cos(angle), 0, radius * np.sin(angle)]
    return matrices, np.linspace(0, 0.97, count)


@pytest.mark.parametrize("vertex_animation_bytes", [0, 1 << 20], ids=["skinned", "placed"])
@pytest.mark.parametrize("view", VIEWS)
def test_a_crowd_looks_like_its_actors(
    ctx: Any, model: Any, picture: Any, view: str, vertex_animation_bytes: int
) -> None:
    matrices, phases = circle(9)
    crowd = Crowd(ctx, model, 9, vertex_animation_bytes=vertex_animation_bytes)
    assert any(level.animation is not None for level in crowd._levels) == (vertex_animation_bytes > 0)
    crowd.place(matrices)
    crowd.play("bend", phases_s=phases)
    crowd.tint(np.linspace([1, 0.5, 0.2], [0.2, 0.5, 1], 9))
    crowd.update(0.4)
    actors = [model.actor("bend", transform=matrix, time_s=phase + 0.4) for matrix, phase in zip(matrices, phases)]
    for actor, tint in zip(actors, np.linspace([1, 0.5, 0.2], [0.2, 0.5, 1], 9)):
        actor.tint = tint
    for lod in (0, 2):
        together = picture([crowd], view=view, lod=lod)
        alone = picture(actors, view=view, lod=lod, tessellation="off")
        background = picture([], view=view)
        assert view == "depth" or (alone != background).any(axis=2).mean() > 0.05
        # Outlines and lines may fall on the other side of a pixel's centre; inside, colours agree. A placed level takes
        # its normals from two joints.
        differs = np.abs(together - alone).max(axis=2) > (6 if crowd._levels[lod].animation is None else 10)
        assert differs.mean() < (0.02 if VIEWS[view].lines else 0.004)
    crowd.release()


def test_depth_is_written_in_the_view_of_depth(ctx: Any, model: Any, renderer: Any) -> None:
    depth = ctx.depth_texture((SIZE, SIZE))
    target = ctx.framebuffer(depth_attachment=depth)
    matrices, phases = circle(9)
    crowd = Crowd(ctx, model, 9)
    crowd.place(matrices)
    crowd.play("bend", phases_s=phases)
    actors = [model.actor("bend", transform=matrix, time_s=phase) for matrix, phase in zip(matrices, phases)]
    maps = []
    for things in ([crowd], actors):
        target.use()
        target.clear(depth=1.0)
        renderer.draw(things, CAMERA, view="depth", lod=1, tessellation="off")
        maps.append(np.frombuffer(depth.read(alignment=1), np.float32))
    assert (maps[1] < 1).mean() > 0.05
    assert (np.abs(maps[0] - maps[1]) > 1e-4).mean() < 0.004
    for thing in (crowd, target, depth):
        thing.release()


def test_ready_made_places_are_where_skinning_puts_them() -> None:
    rng = np.random.default_rng(4)
    matrices = rng.normal(size=(7, 5, 3, 4)).astype(np.float32)
    positions, joints = rng.normal(size=(40, 3)), rng.integers(0, 5, (40, 6))
    weights = rng.dirichlet(np.ones(6), 40)
    positions[20:30], joints[20:30], weights[20:30] = positions[:10], joints[:10], weights[:10]
    places = bake_vertex_animation(matrices, positions, joints, weights)
    assert places.texels.shape == (7, 30)  # the same point has the same place
    assert (places.column_of_vertex[20:30] == places.column_of_vertex[:10]).all()
    for row in range(7):
        for vertex in range(40):
            wanted = np.zeros(3)
            for joint, weight in zip(joints[vertex], weights[vertex]):
                wanted += weight * (matrices[row, joint].astype(float) @ np.append(positions[vertex], 1))
            word = int(places.texels[row, places.column_of_vertex[vertex]])
            whole = np.array([word & 2047, word >> 11 & 2047, word >> 22])
            found = whole * places.scale + places.offset
            assert np.linalg.norm(found - wanted) <= places.rounding_m * 1.001 + 1e-5
    one = bake_vertex_animation(
        np.eye(4, dtype=np.float32)[None, None, :3], np.ones((1, 3)), np.zeros((1, 1), int), np.ones((1, 1))
    )
    np.testing.assert_allclose(one.offset, 1.0)


def test_places_stay_within_their_memory_and_their_levels_error(ctx: Any, model: Any) -> None:
    meshes = model_meshes(ctx, model)
    crowd = Crowd(ctx, model, 0)
    matrices = crowd.baked.matrices
    crowd.release()
    everything = bake_level_animations(meshes, matrices, 1 << 30, 16384)
    sizes = [0 if places is None else places.texels.nbytes for places in everything]
    assert sizes[-1] > 0
    for places, mesh in zip(everything, meshes):
        assert places is None or places.rounding_m <= 0.1 * mesh.error_m
    assert [places is not None for places in everything] == sorted(places is not None for places in everything)
    some = bake_level_animations(meshes, matrices, sizes[-1], 16384)
    assert some[-1] is not None and all(places is None for places in some[:-1])
    assert all(places is None for places in bake_level_animations(meshes, matrices, sizes[-1] - 1, 16384))
    assert all(places is None for places in bake_level_animations(meshes, matrices, 1 << 30, 1))


def test_levels_and_view_are_chosen_as_one_by_one(model: Any, ctx: Any) -> None:
    rng = np.random.default_rng(0)
    count = 400
    crowd = Crowd(ctx, model, count)
    positions = rng.uniform(-60, 60, size=(count, 3)) * [1, 0.1, 1]
    scales = rng.uniform(0.3, 3, count)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, :3] *= scales[:, None, None]
    matrices[:, :3, 3] = positions
    crowd.place(matrices)
    crowd.play("bend", phases_s=rng.uniform(0, 1, count))
    camera = CAMERA.matrices(SIZE, SIZE)
    state = crowd.state
    numbers = np.arange(count)
    rows = matrices[:, :3] - np.pad(camera.eye[:, None], ((0, 0), (3, 0)))
    rows32 = rows.reshape(count, 12).astype(np.float32)
    seen, scale_px = state.measure(rows32, state._stretches, state.pose_rows(numbers), camera, (SIZE, SIZE))
    numbers = numbers[seen]
    chosen = choose_levels(crowd.errors_m, scale_px[seen], 1.0, np.full(len(numbers), -1))
    shown = set(numbers.tolist())
    boxes = crowd.baked.row_boxes[np.rint(state.pose_rows(np.arange(count))).astype(int)].astype(float)
    rotation = np.eye(4)
    rotation[:3, :3] = camera.rotation
    places = rng.uniform(0.02, 0.98, (500, 3))
    for actor in range(count):
        world = (boxes[actor, 0] + places * np.ptp(boxes[actor], axis=0)) * scales[actor] + positions[actor]
        clip = np.c_[world - camera.eye, np.ones(len(world))] @ (camera.projection @ rotation).T
        if (np.abs(clip[:, :3]) < clip[:, 3:]).all(axis=1).any():
            assert actor in shown, "an actor in view was culled"
    assert 0 < len(shown) < count
    for actor, level in zip(numbers, chosen):
        world = (boxes[actor, 0] + places * np.ptp(boxes[actor], axis=0)) * scales[actor] + positions[actor]
        clip = np.c_[world - camera.eye, np.ones(len(world))] @ (camera.projection @ rotation).T
        if (clip[:, 3] < 0.3).any():
            continue
        for direction in np.eye(3):
            moved = world + direction * crowd.errors_m[level] * scales[actor]
            after = np.c_[moved - camera.eye, np.ones(len(world))] @ (camera.projection @ rotation).T
            inside = (np.abs(clip[:, :3]) < clip[:, 3:]).all(axis=1)
            shift = (after[:, :2] / after[:, 3:] - clip[:, :2] / clip[:, 3:])[inside] * SIZE / 2
            # First order: a whole step may cross depth as well.
            assert np.linalg.norm(shift, axis=1).max(initial=0) <= 1.1
    crowd.release()


def off_centre(left: float, right: float, bottom: float, top: float) -> np.ndarray:
    """A perspective projection through a window that the axis need not pass."""
    near, far = 0.05, 500.0
    return np.array(
        [
            [2 * near / (right - left), 0, (right + left) / (right - left), 0],
            [0, 2 * near / (top - bottom), (top + bottom) / (top - bottom), 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


PROJECTIONS = {
    "as usual": off_centre(-0.02, 0.02, -0.02, 0.02),
    "aspect of 4": off_centre(-0.08, 0.08, -0.02, 0.02),
    "aspect of 1/4": off_centre(-0.005, 0.005, -0.02, 0.02),
    "off centre": off_centre(-0.01, 0.05, -0.06, 0.01),
    "twice as large in all": 2.0 * off_centre(-0.02, 0.02, -0.02, 0.02),
    "orthographic": np.diag([0.1, 0.3, -0.01, 1.0]),
    "orthographic, aside": np.array([[0.2, 0, 0, 0.4], [0, 0.05, 0, -0.1], [0, 0, -0.01, -0.2], [0, 0, 0, 1.0]]),
}


@pytest.mark.parametrize("size", [(192, 192), (320, 80), (60, 240)])
@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("where", ["view", "all in the projection"])
def test_actors_and_members_of_crowds_get_the_same_level(
    ctx: Any, ball: Path, projection: str, size: tuple[int, int], where: str
) -> None:
    asset = runtime.load(ball)
    lods = tuple(replace(asset.lods[0], error_m=0.0 if not k else 2e-4 * 1.4**k) for k in range(24))
    model = runtime.Model(ctx, replace(asset, lods=lods))
    renderer, crowd = runtime.Renderer(ctx), Crowd(ctx, model, 1)
    framebuffer = ctx.framebuffer([ctx.renderbuffer(size)])
    framebuffer.use()
    rng = np.random.default_rng(len(projection) + size[0])
    view, matrix = np.eye(4), PROJECTIONS[projection]
    view[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if where != "view":
        matrix, view = matrix @ view, np.eye(4)
    camera = runtime.MatrixCamera(view, matrix)
    levels = set()
    for _ in range(25):
        ends = np.array([[*rng.uniform(-0.9, 0.9, 2), depth, 1] for depth in (-1, 1)]).T
        ends = np.linalg.solve(matrix @ view, ends)
        near, far = (ends[:3] / ends[3]).T
        transform = np.eye(4)
        transform[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * rng.uniform(0.5, 2)
        transform[:3, 3] = near + (far - near) * 10 ** rng.uniform(-2.5, 0)
        actor = model.actor("bend", transform=transform, time_s=0.5)
        crowd.place(transform)
        crowd.play("bend", phases_s=0.5)
        crowd.state.forget_levels()
        renderer.draw([actor, crowd], camera)
        counts = crowd.last_counts if len(crowd.last_counts) else np.zeros(24, int)
        level = renderer.last_drawn[actor].level
        assert counts.tolist() == [int(one == level) for one in range(24)]
        levels.add(level)
    assert len(levels) > (1 if "ortho" in projection else 5)
    for thing in (crowd, renderer, model, *framebuffer.color_attachments, framebuffer):
        thing.release()


def test_bakes_hold_their_clips_and_end_where_they_end() -> None:
    skeleton = random_skeleton(6, 4)
    clips = [random_clip(skeleton, seed, ("LINEAR",)) for seed in range(3)]
    points = np.random.default_rng(1).normal(size=(30, 3))
    indices = np.arange(30)[:, None] % skeleton.num_joints
    boxes = joint_boxes(points, indices, np.ones((30, 1)), skeleton.num_joints)
    baked = bake_clips(skeleton, clips, boxes)
    assert baked.names == ("random", "random", "random", "rest")
    for number, clip in enumerate(clips):
        first, last = baked.first_row[number], baked.first_row[number] + baked.num_rows[number] - 1
        for row, moment in ((first, 0.0), (last, clip.duration_s)):
            exact = skinning_rows(skeleton, sample(clip, skeleton, moment))[0]
            np.testing.assert_allclose(baked.matrices[row], exact, atol=1e-5 * np.abs(exact).max())
        assert baked.rates_hz[number] >= 30
        each = pose_bounds(baked.matrices[first : last + 1], boxes)
        corners = np.concatenate([each[:, 0], each[:, 1]])
        assert (np.linalg.norm(corners - baked.centres[number], axis=1) <= baked.radii_m[number]).all()
    with pytest.raises(ValueError, match="fewer clips"):
        bake_clips(skeleton, clips, boxes, max_rows=5)
    assert len(bake_clips(skeleton, clips, boxes, max_rows=40).matrices) <= 40


def clip_with_keys(times: Any) -> Clip:
    """A node swings about +X between keys at these times."""
    angles = np.sin(7.0 * np.asarray(times))
    values = np.stack([np.sin(angles / 2), 0 * angles, 0 * angles, np.cos(angles / 2)], axis=1)
    return Clip("swing", float(times[-1]), (Track(0, "rotation", "LINEAR", np.asarray(times, float), values),))


def test_rows_lie_on_evenly_spaced_keys() -> None:
    even = np.arange(1, 28) / 24.0  # the first key is not at the start
    assert steps_between_keys(clip_with_keys(even)) == 27
    assert steps_between_keys(clip_with_keys(even.astype(np.float32))) == 27
    assert steps_between_keys(clip_with_keys(np.array([0.0, 0.2, 0.3, 1.0]))) == 10  # multiples of 0.1
    assert steps_between_keys(clip_with_keys(np.array([0.0, 0.1371, 1.0]))) == 0
    assert steps_between_keys(Clip("still", 0.0, ())) == 0
    skeleton = random_skeleton(3)
    boxes = np.tile([[-1.0] * 3, [1.0] * 3], (skeleton.num_joints, 1, 1)).reshape(-1, 2, 3)
    for times in (even, np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 30))):
        clip = clip_with_keys(times)
        baked = bake_clips(skeleton, [clip], boxes)
        rows = baked.matrices[: baked.num_rows[0]].astype(float)
        moments = np.linspace(0, clip.duration_s, 2000, endpoint=False)
        exact = skinning_rows(skeleton, sample(clip, skeleton, moments, dtype=np.float64))
        place = moments * baked.rates_hz[0]
        first = place.astype(int)
        onwards = (place - first)[:, None, None, None]
        strays = rows[first] * (1 - onwards) + rows[first + 1] * onwards - exact
        points = np.array([[x, y, z, 1.0] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        stray = np.linalg.norm(np.einsum("tjrc,pc->tjpr", strays, points), axis=3).max()
        assert stray <= 1.5 * baked.shift_m + 1e-6  # measured at three places between two rows
        assert baked.rates_hz[0] <= 240 * 1.01 and (baked.shift_m <= 2.5e-4 * np.sqrt(12) or baked.rates_hz[0] > 120)


def test_the_strongest_joints_are_kept_and_what_is_lost_is_measured() -> None:
    joints = np.arange(12)[None].repeat(2, axis=0)
    weights = np.array([[0.5, 0.3, 0.2, *[0] * 9], [0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.05, 0.04, 0.01, 0, 0, 0]])
    few, amounts = pick_joints(joints, weights, 4)
    assert few.tolist() == [[0, 1, 2, 0], [0, 1, 2, 3]]
    np.testing.assert_allclose(amounts, [[0.5, 0.3, 0.2, 0], np.array([4, 4, 3, 3]) / 14], atol=1e-6)
    one, amounts = pick_joints(np.array([[3]]), np.array([[1.0]]), 4)
    assert one.tolist() == [[3, 0, 0, 0]] and amounts.tolist() == [[1, 0, 0, 0]]
    # Joint k moves everything by k metres along x: a vertex lands at the mean of its joints' numbers.
    matrices = np.tile(np.eye(4, dtype=np.float32)[:3], (1, 12, 1, 1))
    matrices[0, :, 0, 3] = np.arange(12)
    for width in (4, 8):
        kept, amounts = pick_joints(joints, weights, width)
        lost = abs(float(weights[1] @ np.arange(12)) - float(amounts[1] @ kept[1]))
        assert dropped_shift(matrices, np.zeros((2, 3)), joints, weights, width) == pytest.approx(lost, abs=1e-6)
    assert dropped_shift(matrices, np.zeros((1, 3)), joints[:1], weights[:1], 4) == 0.0


def test_clips_phases_and_speeds(ctx: Any, model: Any) -> None:
    crowd = Crowd(ctx, model, 4)
    crowd.play("bend", phases_s=[0, 0.25, 0.5, 0.9], speeds=[1, 1, -1, 2])
    crowd.update(0.3)
    crowd.play("bend", which=[3], phases_s=0.1, loop=False)
    crowd.update(0.3)
    baked = crowd.baked
    places = (crowd.state.pose_rows(np.arange(4)) - baked.first_row[0]) / baked.rates_hz[0]
    np.testing.assert_allclose(places, [0.6, 0.85, 0.9, 0.4], atol=1e-9)
    crowd.update(1000)
    assert crowd.state.pose_rows(np.array([3]))[0] == baked.first_row[0] + baked.num_rows[0] - 1
    crowd.play(1, which=slice(0, 2))
    assert (crowd.state.pose_rows(np.arange(2)) == baked.first_row[1]).all()
    crowd.release()


def test_hidden_actors_and_no_actors_draw_nothing(ctx: Any, model: Any, picture: Any) -> None:
    crowd, nobody = Crowd(ctx, model, 2), Crowd(ctx, model, 0)
    background = picture([])
    assert (picture([nobody]) == background).all()
    assert (picture([crowd]) != background).any()
    crowd.show(False, [0])
    assert (picture([crowd]) != background).any()
    crowd.show([False, False])
    assert (picture([crowd]) == background).all()
    crowd.show(True)
    crowd.visible = False
    assert (picture([crowd]) == background).all()
    crowd.visible = True
    away = np.eye(4)
    away[2, 3] = 1000
    crowd.place(away)
    assert (picture([crowd]) == background).all()
    for thing in (crowd, nobody):
        thing.release()
        thing.release()


def test_misuse_says_what_to_do(ctx: Any, model: Any, picture: Any, renderer: Any) -> None:
    crowd = Crowd(ctx, model, 3)
    before = crowd.state._rows.copy()
    broken = np.tile(np.eye(4), (3, 1, 1))
    broken[1, 0, 0] = np.nan
    for wrong, message in (
        (lambda: crowd.place(broken), "actor 1 of those placed is not finite"),
        (lambda: crowd.place(np.eye(3)), r"\(4, 4\) or \(3, 4, 4\)"),
        (lambda: crowd.play("fly"), "no clip 'fly'"),
        (lambda: crowd.play([0, 7, 0]), "no clip 7"),
        (lambda: crowd.play(0, phases_s=np.inf), "finite"),
        (lambda: crowd.update(float("inf")), "frame clock"),
        (lambda: crowd.tint((1, 2)), r"tints \(A, 3\)"),
        (lambda: crowd.show(True, [5]), "numbers 0 to 2"),
        (lambda: Crowd(ctx, model, -1), "0 to 10,000,000 actors"),
        (lambda: Crowd(ctx, model, 1, clips=["fly"]), "no clip 'fly'"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()
    assert (crowd.state._rows == before).all()
    crowd.release()
    other = Crowd(ctx, model, 1)
    with pytest.raises(runtime.RenderError, match="no level of detail 7"):
        picture([other], lod=7)
    other.release()
    with pytest.raises(runtime.RenderError, match="crowd was released"):
        picture([crowd])


def test_another_context_is_refused(ctx: Any, ball: Path, renderer: Any) -> None:
    other = moderngl.create_context(standalone=True, backend="egl")
    try:
        foreign = runtime.Model(other, runtime.load(ball))
        with pytest.raises(runtime.RenderError, match="another context"):
            Crowd(ctx, foreign, 1)
        crowd = Crowd(other, foreign, 1)
        ctx.__enter__()
        with pytest.raises(runtime.RenderError, match="another context"):
            renderer.draw([crowd], CAMERA)
    finally:
        other.release()
    ctx.__enter__()
    crowd.release()  # its context is gone: nothing to do, nothing raised


def test_thousands_of_crowds_leave_nothing_behind(ctx: Any, model: Any) -> None:
    for _ in range(60):
        Crowd(ctx, model, 10).release()


def test_a_hundred_thousand_still_run(ctx: Any, model: Any, picture: Any) -> None:
    crowd = Crowd(ctx, model, 100_000)
    side = np.arange(316) * 2.0
    positions = np.stack(np.meshgrid(side - 316, [0.0], 10 - side), axis=-1).reshape(-1, 3)
    crowd.place_on_ground(positions, 0.0, which=slice(0, len(positions)))
    crowd.play("bend")
    crowd.show(np.arange(100_000) % 40 == 0)
    assert (picture([crowd]) != picture([])).any()
    crowd.release()


def test_the_demo_draws_a_picture_and_refuses_nonsense(ball: Path, tmp_path: Path, capsys: Any) -> None:
    from demos.crowd import main

    out = tmp_path / "crowd.png"
    assert main([str(ball), "--count", "30", "--headless", "--out", str(out), "--size", "160x90"]) == 0
    assert out.stat().st_size > 1000
    assert main([str(ball), "--count", "-3", "--headless", "--out", str(out)]) == 2
    assert main([str(ball), "--clip", "fly", "--headless", "--out", str(out), "--size", "16x16"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and "--count -3" in lines[0] and "no clip 'fly'" in lines[1]


def test_a_callers_own_view_draws_crowds_too(ctx: Any, model: Any, picture: Any, renderer: Any) -> None:
    source = (
        '#include "surface.glsl"\nuniform vec3 paint;\nout vec4 result;\nvoid main() { result = vec4(paint, 1.0); }\n'
    )
    renderer.add_view("paint", source)
    crowd = Crowd(ctx, model, 1)
    shown = picture([crowd], view="paint", uniforms={"paint": (1.0, 0.0, 0.0)})
    assert (shown == [255, 0, 0]).all(axis=2).any()
    renderer.add_view("paint", source.replace("paint, 1.0", "paint.bgr, 1.0"))
    shown = picture([crowd], view="paint", uniforms={"paint": (1.0, 0.0, 0.0)})
    assert (shown == [0, 0, 255]).all(axis=2).any() and not (shown == [255, 0, 0]).all(axis=2).any()
    crowd.release()
