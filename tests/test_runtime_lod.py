"""Levels of detail: errors in pixels are never underestimated, choices are calm, bounds hold."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_asset import CHART, build_ball, chart_origin, surface_point
from scipy.ndimage import distance_transform_edt

from preprocess.mesh.texels import sample_bilinear
from runtime.animation.bounds import box_around, pose_bounds
from runtime.asset.asset import Asset, load
from runtime.errors import RenderError
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.scene.camera import Camera, CameraMatrices, MatrixCamera
from runtime.scene.lod_selection import (
    HYSTERESIS,
    NEAR_DEPTHS,
    Quality,
    around_eye,
    carry_boxes,
    carry_parts,
    choose_levels,
    largest_stretch,
    measure,
)

SIDE_PX = 256
ERRORS = np.array([0.0, 0.002, 0.01, 0.05, 0.2])


def random_cameras(count: int, seed: int = 5) -> Iterator[Camera]:
    rng = np.random.default_rng(seed)
    for _ in range(count):
        eye = rng.normal(size=3) * rng.uniform(2, 10)
        yield Camera(tuple(eye), tuple(rng.normal(size=3)), fovy_deg=float(rng.uniform(10, 110)))


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Actors: their parts' boxes (A, 3, 4, P), and where they are (A, 4, 4)."""

    parts: np.ndarray
    transforms: np.ndarray


def upright(middles: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """Parts of boxes along the axes, from (A, 3, P) each."""
    return np.concatenate([np.eye(3)[:, :, None] * reaches[:, :, None], middles[:, :, None]], axis=2)


def bodies_of(boxes: np.ndarray, transforms: np.ndarray | None = None) -> Bodies:
    """Actors that are their boxes."""
    half = np.ptp(boxes, axis=1) / 2
    where = np.tile(np.eye(4), (len(boxes), 1, 1)) if transforms is None else transforms
    return Bodies(upright((boxes[:, 0] + half)[..., None], half[..., None]), where)


def measured(bodies: Bodies, camera: CameraMatrices, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rows = around_eye(camera.eye, bodies.transforms)
    boxes = carry_boxes(*box_around(bodies.parts).transpose(1, 2, 0), rows.transpose(1, 2, 0))
    stretch = largest_stretch(rows[:, :, :3])
    return measure(boxes, stretch, camera, size_px, lambda near: carry_parts(bodies.parts[near], rows[near]))


def in_view(bodies: Bodies, camera: CameraMatrices) -> np.ndarray:
    return measured(bodies, camera, (320, 200))[0]


def pixels_per_metre(bodies: Bodies, camera: CameraMatrices, size_px: tuple[int, int]) -> np.ndarray:
    return measured(bodies, camera, size_px)[1]


def project(points: np.ndarray, camera: Camera, width: int, height: int) -> np.ndarray:
    """Pixel coordinates (N, 2) and depth in front of the eye (N,)."""
    matrices = camera.matrices(width, height)
    clip = (points - matrices.eye) @ matrices.clip_from_world[:, :3].T + matrices.clip_from_world[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.concatenate([clip[:, :2] / clip[:, 3:] * [width / 2, height / 2], clip[:, 3:]], axis=1)


def test_no_displacement_is_larger_on_the_screen_than_said() -> None:
    rng = np.random.default_rng(0)
    width, height, metres = 320, 200, 1e-4
    for camera in random_cameras(60):
        transform = np.eye(4)
        transform[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * rng.uniform(0.2, 3)
        box = np.sort(rng.normal(size=(1, 2, 3)), axis=1)
        body = bodies_of(box, transform[None])
        allowed = pixels_per_metre(body, camera.matrices(width, height), (width, height))[0] * metres
        points = rng.uniform(box[0, 0], box[0, 1], (400, 3))
        moved = points + metres * (steps := rng.normal(size=(400, 3))) / np.linalg.norm(steps, axis=1, keepdims=True)
        a, b = (project(p @ transform[:3, :3].T, camera, width, height) for p in (points, moved))
        inside = (np.abs(a[:, :2]) < [width / 2, height / 2]).all(axis=1) & (a[:, 2] > 0)
        if inside.any() and np.isfinite(allowed):
            assert np.linalg.norm(a[inside, :2] - b[inside, :2], axis=1).max() <= allowed * 1.01


def test_boxes_are_seen_and_measured_as_by_their_corners() -> None:
    """The slow twin: all eight corners, sides of the view one by one, the nearest depth."""
    rng = np.random.default_rng(7)
    picks = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)])
    for camera in random_cameras(100, seed=8):
        transform = np.eye(4)
        transform[:3] = rng.normal(size=(3, 4))  # sheared and mirrored too
        box = np.sort(rng.normal(size=(1, 2, 3)), axis=1)
        matrices = camera.matrices(320, 200)
        body = bodies_of(box, transform[None])
        scale_px = pixels_per_metre(body, matrices, (320, 200))[0]
        corners = box[0][picks, np.arange(3)] @ transform[:3, :3].T + transform[:3, 3]
        clip = (corners - matrices.eye) @ matrices.clip_from_world[:, :3].T + matrices.clip_from_world[:, 3]
        beyond = [(side * clip[:, axis] > clip[:, 3]).all() for axis in range(3) for side in (1, -1)]
        assert in_view(body, matrices)[0] == (not any(beyond))
        depth = -((corners - matrices.eye) @ matrices.rotation[2])
        if depth.min() <= 0:
            assert np.isinf(scale_px)
            continue
        stretch = np.linalg.norm(transform[:3, :3], 2)
        straight_on = stretch * matrices.projection[1, 1] * 100 / depth.min()
        assert straight_on <= scale_px * (1 + 1e-9)
        widest = np.sqrt(1 + (1 / matrices.projection[[0, 1], [0, 1]] ** 2).sum()) * np.sqrt(3)
        assert scale_px <= straight_on * widest * (1 + 1e-9)


def test_parts_bound_their_hull_and_no_more_than_the_box() -> None:
    """A body of several parts: its hull's points are measured safely, and closer than by the box around all."""
    rng = np.random.default_rng(11)
    tighter = []
    for camera in random_cameras(60, seed=12):
        middles, reaches = rng.normal(size=(1, 5, 3)), rng.uniform(0.05, 0.3, (1, 5, 3))
        box = np.stack([(middles - reaches).min(axis=1), (middles + reaches).max(axis=1)], axis=1)
        matrices = camera.matrices(320, 200)
        whole = pixels_per_metre(bodies_of(box), matrices, (320, 200))[0]
        boxes = upright(middles.transpose(0, 2, 1), reaches.transpose(0, 2, 1))
        parts = pixels_per_metre(Bodies(boxes, np.eye(4)[None]), matrices, (320, 200))[0]
        assert parts <= whole * (1 + 1e-9)
        tighter.append(parts / whole if np.isfinite(whole) else 1.0)
        inside = middles[0] + reaches[0] * rng.uniform(-1, 1, (200, 5, 3))
        points = np.einsum("np,npi->ni", rng.dirichlet(np.ones(5) / 2, 200), inside)
        steps = rng.normal(size=points.shape)
        moved = points + 1e-5 * steps / np.linalg.norm(steps, axis=1, keepdims=True)
        a, b = (project(p, camera, 320, 200) for p in (points, moved))
        seen = (np.abs(a[:, :2]) < [160, 100]).all(axis=1) & (a[:, 2] > 0)
        if seen.any() and np.isfinite(parts):
            assert np.linalg.norm(a[seen, :2] - b[seen, :2], axis=1).max() <= parts * 1e-5 * 1.01
    assert np.mean(tighter) < 0.97


def measured_by_corners(body: np.ndarray, transform: np.ndarray, camera: CameraMatrices) -> tuple[bool, float]:
    """The slow twin of `measure` for one actor, parts (3, 4, P), in a picture of 320 x 200."""
    signs = np.array([(*along, 1) for along in itertools.product((-1, 1), repeat=3)])
    corners = np.einsum("ikp,ck->pci", body, signs).reshape(-1, 3)
    whole = np.array(list(itertools.product(*np.stack([corners.min(axis=0), corners.max(axis=0)]).T)))
    linear = transform[:3, :3]
    stretch = np.sqrt(np.abs(linear.T @ linear).sum(axis=1).max())
    seen, size = True, np.inf
    for points in (whole, corners):  # the box around all, and its parts where it is near
        view = (points @ linear.T + transform[:3, 3] - camera.eye) @ camera.rotation.T
        clip = view @ camera.projection[:, :3].T + camera.projection[:, 3]
        by_part = clip.reshape(-1, 8, 4)
        seen = not any((side * by_part[..., k] > by_part[..., 3]).all() for k in range(3) for side in (1, -1))
        depth = clip[:, 3]
        if depth.min() <= 0:
            size = np.inf
        else:
            ends = [[-1.0, 1.0], [-1.0, 1.0]]
            for axis, side in itertools.product((0, 1), (0, 1)):
                sign = 2 * side - 1
                far = [(sign * part[:, axis]).max() for part in by_part]
                by_depth = [far_x / (w.min() if far_x > 0 else w.max()) for far_x, w in zip(far, by_part[..., 3])]
                ends[axis][side] = sign * np.clip(max(by_depth), -1, 1)
            rows = camera.clip_from_world[:, :3]
            ways = [[160 * (rows[0] - x * rows[3]), 100 * (rows[1] - y * rows[3])] for x in ends[0] for y in ends[1]]
            size = stretch * np.linalg.norm(ways, 2, axis=(1, 2)).max() / depth.min()
        if not seen or (0 < depth.min() and depth.max() <= NEAR_DEPTHS * depth.min()):
            break
    return seen, size


@pytest.mark.parametrize("perspective", [True, False])
def test_many_bodies_are_measured_as_one_by_one_by_their_corners(perspective: bool) -> None:
    rng = np.random.default_rng(21)
    num_seen = 0
    for camera in random_cameras(40, seed=22):
        matrices = camera.matrices(320, 200)
        projection = matrices.projection.copy()
        projection[:2, 2] = rng.normal(size=2) / 2  # off centre
        if not perspective:
            projection = np.diag([*rng.uniform(0.1, 1, 2), -0.1, 1.0])
            projection[:3, 3] = rng.normal(size=3) / 2
        matrices = CameraMatrices(matrices.eye, matrices.rotation, projection)
        transforms = rng.normal(size=(6, 4, 4))  # the last row says nothing
        transforms[:, :3, 3] *= 4
        parts = rng.normal(size=(6, 3, 4, 5)) * 0.2  # turned, and sheared
        parts[:, :, 3] = rng.normal(size=(6, 3, 5))
        seen, scale_px = measured(Bodies(parts, transforms), matrices, (320, 200))
        wanted = [measured_by_corners(body, where, matrices) for body, where in zip(parts, transforms)]
        assert seen.tolist() == [one for one, _ in wanted]
        np.testing.assert_allclose(scale_px[seen], [size for one, size in wanted if one], rtol=1e-9)
        num_seen += sum(seen)
    assert 40 < num_seen < 200


def test_parts_are_seen_no_more_often_than_the_box_around_them() -> None:
    rng = np.random.default_rng(31)
    fewer = 0
    for camera in random_cameras(60, seed=32):
        matrices = camera.matrices(320, 200)
        parts = upright(rng.normal(size=(8, 3, 4)) * 3, rng.uniform(0.05, 0.3, (8, 3, 4)))
        seen = in_view(Bodies(parts, transforms := np.linalg.qr(rng.normal(size=(8, 4, 4)))[0]), matrices)
        whole = in_view(bodies_of(box_around(parts), transforms), matrices)
        assert (seen <= whole).all()
        fewer += int((seen < whole).sum())
    assert fewer > 0


def test_what_is_in_view_is_never_culled() -> None:
    rng = np.random.default_rng(1)
    for camera in random_cameras(200):
        box = np.sort(rng.normal(size=(1, 2, 3)), axis=1) * 2
        points = rng.uniform(box[0, 0], box[0, 1], (300, 3))
        px = project(points, camera, 300, 200)
        shown = ((np.abs(px[:, :2]) < [150, 100]).all(axis=1) & (px[:, 2] > 0)).any()
        if shown:
            assert in_view(bodies_of(box), camera.matrices(300, 200))[0]


def test_what_is_behind_or_aside_is_culled() -> None:
    camera = Camera((0, 0, 5), (0, 0, 0)).matrices(100, 100)
    boxes = np.array([[[-1, -1, -1], [1, 1, 1]], [[-1, -1, 6], [1, 1, 8]], [[50, -1, -1], [52, 1, 1]]], float)
    assert in_view(bodies_of(boxes), camera).tolist() == [True, False, False]


def test_orthographic_cameras_measure_without_distance() -> None:
    camera = MatrixCamera(np.eye(4), np.diag([0.5, 0.5, -0.1, 1.0])).matrices(100, 100)
    box = np.array([[[-1, -1, -9], [1, 1, -1]]], float)
    assert pixels_per_metre(bodies_of(box), camera, (100, 100))[0] == pytest.approx(25.0)


def test_levels_are_monotonic_and_under_the_threshold() -> None:
    scale = np.geomspace(1e5, 1e-3, 400)
    chosen = choose_levels(ERRORS, scale, 1.0, np.full(400, -1))
    assert chosen[0] == 0 and chosen[-1] == 4
    assert (np.diff(chosen) >= 0).all()
    assert (ERRORS[chosen] * scale <= 1.0).all()
    assert choose_levels(ERRORS, np.array([np.inf, np.nan]), 1.0, np.array([3, -1]))[0] == 0


def test_errors_that_do_not_grow_are_taken_as_growing() -> None:
    assert choose_levels(np.array([0.0, 0.1, 0.01]), np.array([20.0]), 1.0, np.array([-1]))[0] == 0


def test_nothing_changes_at_rest_or_while_trembling() -> None:
    rng = np.random.default_rng(2)
    for scale in np.geomspace(1e4, 1e-2, 200):
        level = choose_levels(ERRORS, np.array([scale]), 1.0, np.array([-1]))
        level = choose_levels(ERRORS, np.array([scale]), 1.0, level)
        seen = set()
        for _ in range(30):
            trembling = scale * (1 + rng.uniform(-0.4, 0.4) * HYSTERESIS)
            level = choose_levels(ERRORS, np.array([trembling]), 1.0, level)
            seen.add(int(level[0]))
        assert len(seen) <= 2
        changes = 0
        for _ in range(30):
            new = choose_levels(ERRORS, np.array([scale * (1 + rng.uniform(-0.4, 0.4) * HYSTERESIS)]), 1.0, level)
            changes += int(new[0] != level[0])
            level = new
        assert changes <= 1  # once finer, it stays so


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """With its levels' errors measured against the formula, as drawn."""
    asset = load(build_ball(tmp_path_factory.mktemp("lod") / "b.seamless", sizes=(24, 8, 4, 2), position_px=128))
    texels = asset.textures["position"].levels[0]
    shares = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8
    lods = []
    for mesh in asset.lods:
        corners = sample_bilinear(texels, mesh.canonical_uvs)[mesh.triangles]
        uvs = np.einsum("sk,fkc->fsc", shares, mesh.uvs[mesh.triangles].astype(float)).reshape(-1, 2)
        face = np.argmin([np.abs(uvs - chart_origin(f) - CHART / 2).max(axis=1) for f in range(6)], axis=0)
        origins = np.array([chart_origin(f) for f in range(6)])[face]
        truth = surface_point(face, (uvs - origins) / CHART * 2 - 1)
        drawn = np.einsum("sk,fkc->fsc", shares, corners).reshape(-1, 3)
        lods.append(dataclasses.replace(mesh, error_m=float(np.linalg.norm(drawn - truth, axis=1).max())))
    return dataclasses.replace(asset, lods=tuple(lods))


class Flight:
    """A model seen from close up to a pixel or two."""

    def __init__(self, ctx: moderngl.Context, asset: Asset, quality: Quality) -> None:
        self.model, self.renderer = Model(ctx, asset), Renderer(ctx, quality=quality)
        self.framebuffer = ctx.simple_framebuffer((SIDE_PX, SIDE_PX), 4)
        self.actor = self.model.actor()

    def cameras(self) -> Iterator[Camera]:
        for distance in np.geomspace(1.5, 600.0, 40):
            direction = np.array([np.sin(distance), 0.3, np.cos(distance)])
            eye = np.array([0.0, 1.0, 0.0]) + distance * direction / np.linalg.norm(direction)
            yield Camera(tuple(eye), (0.0, 1.0, 0.0), fovy_deg=50.0)

    def mask(self, camera: Camera, **how: Any) -> np.ndarray:
        self.framebuffer.use()
        self.framebuffer.clear(depth=1.0)
        self.renderer.draw([self.actor], camera, view="mask", **how)
        return np.frombuffer(self.framebuffer.read(components=1), np.uint8).reshape(SIDE_PX, SIDE_PX) > 0

    def release(self) -> None:
        framebuffer = self.framebuffer
        for thing in (*framebuffer.color_attachments, framebuffer.depth_attachment, framebuffer):
            thing.release()
        self.renderer.release()
        self.model.release()


def shift_px(a: np.ndarray, b: np.ndarray) -> float:
    """How far the silhouettes of two masks lie apart."""
    extra = [distance_transform_edt(~y)[x & ~y].max() for x, y in ((a, b), (b, a)) if (x & ~y).any() and y.any()]
    return float(max(extra, default=0.0))


@pytest.mark.parametrize("prefer", ["levels", "tessellation"])
def test_silhouettes_move_no_more_than_the_threshold(ctx: moderngl.Context, ball: Asset, prefer: str) -> None:
    """Each picture of a fly-through against full detail; and where the level changes, against the level before."""
    threshold = 1.0
    flight = Flight(ctx, ball, Quality(threshold_px=threshold, prefer=prefer))
    levels, divided = [], []
    for camera in flight.cameras():
        chosen = flight.mask(camera)
        drawn = flight.renderer.last_drawn[flight.actor]
        levels.append(drawn.level)
        divided.append(drawn.tessellated)
        assert shift_px(chosen, flight.mask(camera, lod=0, tessellation="off")) <= threshold + 0.5
        if len(levels) > 1 and levels[-2] != drawn.level:
            before = flight.mask(camera, lod=levels[-2], tessellation="off")
            assert shift_px(chosen, before) <= threshold + 0.5
    assert levels == sorted(levels) and set(levels) == {0, 1, 2, 3}
    assert divided == [prefer == "tessellation" and level > 0 for level in levels]
    flight.release()


def test_preferred_tessellation_is_rounder_and_calm(ctx: moderngl.Context, ball: Asset) -> None:
    """A divided level's silhouette differs in fewer pixels than the same level's; and factors rest with the camera."""
    flight = Flight(ctx, ball, Quality(prefer="tessellation", threshold_px=4.0, segment_px=4.0))
    camera = Camera((0.0, 1.0, 9.0), (0.0, 1.0, 0.0), fovy_deg=30.0)
    finest = flight.mask(camera, lod=0, tessellation="off")
    divided = flight.mask(camera)
    drawn = flight.renderer.last_drawn[flight.actor]
    assert drawn.tessellated and drawn.level > 0
    assert all((flight.mask(camera) == divided).all() for _ in range(5))
    flat = flight.mask(camera, lod=drawn.level, tessellation="off")
    assert (divided ^ finest).sum() < 0.7 * (flat ^ finest).sum()
    assert (flight.mask(camera, tessellation="off") ^ finest).any()
    assert not flight.renderer.last_drawn[flight.actor].tessellated
    flight.release()


@pytest.mark.parametrize(
    "how", [{"threshold_px": 0.0}, {"segment_px": -1.0}, {"texels_per_segment": np.nan}, {"prefer": "magic"}]
)
def test_qualities_that_make_no_sense_are_named(how: dict[str, Any]) -> None:
    with pytest.raises(RenderError, match=f"quality: .*{next(iter(how)).split('_')[0][:6]}"):
        Quality(**how)


def test_drawn_levels_are_remembered_per_actor(ctx: moderngl.Context, ball: Asset) -> None:
    model, renderer = Model(ctx, ball), Renderer(ctx)
    framebuffer = ctx.simple_framebuffer((64, 64), 4)
    framebuffer.use()
    near, far = model.actor(), model.actor()
    matrix = np.eye(4)
    matrix[2, 3] = -200.0
    far.transform = matrix
    renderer.draw([near, far], Camera((0.0, 1.0, 6.0), (0.0, 1.0, 0.0)))
    assert renderer.last_drawn[near].level < renderer.last_drawn[far].level
    renderer.draw([near, far], Camera((0.0, 1.0, 6.0), (0.0, 1.0, 0.0)), lod=3, tessellation="auto")
    assert renderer.last_drawn[near].tessellated and not renderer.last_drawn[far].tessellated
    for attachment in (*framebuffer.color_attachments, framebuffer.depth_attachment, framebuffer):
        attachment.release()
    renderer.release()
    model.release()


def test_bounds_hold_every_vertex_of_every_moment(ctx: moderngl.Context, ball: Asset) -> None:
    model = Model(ctx, ball)
    mesh = ball.lods[0]
    from runtime.asset.weight_stack import unpack_weights

    rest = sample_bilinear(ball.textures["position"].levels[0], mesh.canonical_uvs)
    stored = unpack_weights(ball.textures["weights"].levels[0], ball.weight_size, ball.num_joints)
    weights = sample_bilinear(stored, mesh.canonical_uvs)
    for time_s in np.linspace(0, 1, 7):
        rows = model.actor(clip="bend", time_s=float(time_s)).joint_rows[None].astype(float)
        blended = np.einsum("vj,jrc->vrc", weights, rows[0])
        positions = np.einsum("vrc,vc->vr", blended[:, :, :3], rest) + blended[:, :, 3]
        low, high = pose_bounds(rows, model.joint_boxes.boxes)[0]
        assert (positions >= low - 1e-5).all() and (positions <= high + 1e-5).all()
    model.release()
