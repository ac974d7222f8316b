"""No cracks, and why: shared points are the same bits, static and tessellated. With controls that must fail."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import moderngl
import numpy as np
import pytest
from builders_asset import CENTRE, RADII, build_ball, surface_point

from benchmarks._points import MIN_VERSION_CODE, PointCapture, differing_points
from runtime.asset.asset import Asset, load
from runtime.asset.lod_mesh import LodMesh
from runtime.gpu.gl_state import saved_state
from runtime.gpu.model import Model
from runtime.gpu.patches import build_patches
from runtime.gpu.programs import assemble
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.gpu.vertex_layout import ACTOR_INSTANCE
from runtime.render.renderer import Renderer
from runtime.scene.camera import Camera

SIDE_PX = 384
NUM_FRAMES = 6


@pytest.fixture(autouse=True)
def _intact_state(ctx: moderngl.Context) -> Iterator[None]:
    """A program that a test leaves in use would live on after its release."""
    with saved_state(range(16), (0,), True):
        yield


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return load(build_ball(tmp_path_factory.mktemp("watertight") / "ball.seamless", sizes=(10, 4), num_joints=4))


@dataclasses.dataclass(frozen=True)
class Shot:
    """A random frame."""

    camera: Camera
    time_s: float
    inside: bool


def shots(seed: int, count: int) -> Iterator[Shot]:
    """Random frames: from afar in the middle of the clip, from inside, and right before a seam at rest."""
    rng = np.random.default_rng(seed)
    for index in range(count):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        target = np.array([0.0, rng.uniform(0.5, 1.5), 0.0])
        fovy = float(rng.uniform(20, 80))
        time_s = float(rng.uniform())
        if index % 3 == 0:
            eye, look = target + direction * rng.uniform(1.6, 4.0), target + rng.normal(size=3) * 0.4
            yield Shot(Camera(tuple(eye), tuple(look), fovy_deg=fovy, near_m=0.4, far_m=8.0), time_s, False)
        elif index % 3 == 1:
            seam = surface_point(int(rng.integers(6)), np.array([1.0, rng.uniform(-0.9, 0.9)]))
            outwards = (seam - CENTRE) / RADII**2
            eye = seam + outwards / np.linalg.norm(outwards) * 0.12
            yield Shot(Camera(tuple(eye), tuple(seam), fovy_deg=30.0, near_m=0.01, far_m=4.0), 0.0, False)
        else:
            eye = target + direction * 0.03
            yield Shot(
                Camera(tuple(eye), tuple(eye + rng.normal(size=3)), fovy_deg=fovy, near_m=0.01, far_m=8.0), time_s, True
            )


def count_cracks(framebuffer: moderngl.Framebuffer, inside: bool) -> int:
    """Pixels where something shows that a closed surface hides."""
    pixels = np.frombuffer(framebuffer.read(components=3), np.uint8).reshape(-1, 3)
    is_back = (pixels[:, 0] == 255) & (pixels[:, 1] == 0)
    return int((~is_back).sum() if inside else is_back.sum())


def sweep(
    ctx: moderngl.Context,
    asset: Asset,
    *,
    seed: int = 1,
    frames: int = NUM_FRAMES,
    defines: dict | None = None,
    **how: object,
) -> int:
    """Cracks in all pixels of random frames over the clip."""
    model, renderer = Model(ctx, asset), Renderer(ctx, shader_defines=defines)
    framebuffer = ctx.simple_framebuffer((SIDE_PX, SIDE_PX), 4)
    total = 0
    try:
        for shot in shots(seed, frames):
            actor = model.actor(clip="bend", time_s=shot.time_s)
            framebuffer.use()
            framebuffer.clear(depth=1.0)
            renderer.draw([actor], shot.camera, view="facing", **how)  # type: ignore[arg-type]
            total += count_cracks(framebuffer, shot.inside)
            actor.release()
    finally:
        release_framebuffer(framebuffer)
        renderer.release()
        model.release()
    return total


def release_framebuffer(framebuffer: moderngl.Framebuffer) -> None:
    for attachment in (*framebuffer.color_attachments, framebuffer.depth_attachment):
        attachment.release()
    framebuffer.release()


def shift_copies(mesh: LodMesh, shift_uv: float) -> LodMesh:
    """Move the canonical uv of every copy that is not at its canonical uv, as rounding would."""
    canonical_uvs = mesh.canonical_uvs.copy()
    copies = (mesh.uvs != mesh.canonical_uvs).any(axis=1)
    canonical_uvs[copies] += np.float32(shift_uv)
    return dataclasses.replace(mesh, canonical_uvs=canonical_uvs)


@pytest.mark.parametrize("lod", [0, 1])
def test_no_cracks_in_static_levels(ctx: moderngl.Context, ball: Asset, lod: int) -> None:
    assert sweep(ctx, ball, lod=lod, tessellation="off") == 0


@pytest.mark.parametrize("tessellation", [1.0, 2.6, 7.0, 33.3, 64.0])
@pytest.mark.parametrize("spacing", ["fractional", "equal"])
def test_no_cracks_when_tessellated(ctx: moderngl.Context, ball: Asset, tessellation: float, spacing: str) -> None:
    defines = {"EQUAL_SPACING": 1} if spacing == "equal" else {}
    frames = 6 if tessellation < 20 else 3
    assert sweep(ctx, ball, lod=1, tessellation=tessellation, frames=frames, defines=defines) == 0


def test_no_cracks_where_every_edge_has_its_own_factor(ctx: moderngl.Context, ball: Asset) -> None:
    assert sweep(ctx, ball, lod=1, tessellation="auto", seed=4) == 0


def test_without_canonical_uvs_the_same_frames_have_cracks(ctx: moderngl.Context, ball: Asset) -> None:
    assert sweep(ctx, ball, lod=0, tessellation="off", defines={"WITHOUT_CANONICAL_UVS": 1}) > 100
    assert sweep(ctx, ball, lod=1, tessellation=7.0, defines={"WITHOUT_CANONICAL_UVS": 1}) > 100


def test_one_side_moved_by_a_millionth_is_seen(ctx: moderngl.Context, ball: Asset) -> None:
    shift_uv = 1e-6 * 2.0 * 0.27  # a chart of 0.27 spans about a metre of a body two metres tall
    moved = dataclasses.replace(ball, lods=tuple(shift_copies(mesh, shift_uv) for mesh in ball.lods))
    assert sweep(ctx, moved, lod=0, tessellation="off") > 0


def captured_points(
    ctx: moderngl.Context, asset: Asset, tessellation: float | str, defines: dict[str, int]
) -> np.ndarray:
    """Every point of the coarsest level in one bent pose."""
    if ctx.version_code < MIN_VERSION_CODE:
        pytest.skip("reading points back needs storage buffers, OpenGL 4.3")
    model = Model(ctx, asset)
    capture = PointCapture(model, defines)
    framebuffer = ctx.simple_framebuffer((256, 256), 4)
    framebuffer.use()
    camera = Camera((0.7, 1.4, 2.0), (0.0, 1.0, 0.0), fovy_deg=60.0)
    points = capture.points(model.actor(clip="bend", time_s=0.2), camera, len(asset.lods) - 1, tessellation)
    release_framebuffer(framebuffer)
    capture.release()
    model.release()
    return points


@pytest.mark.parametrize("tessellation", [1.0, 5.0, 12.7, "auto"])
@pytest.mark.parametrize("defines", [{}, {"EQUAL_SPACING": 1}], ids=["fractional", "equal"])
def test_tessellated_points_are_the_same_bits_on_both_sides(
    ctx: moderngl.Context, ball: Asset, tessellation: float | str, defines: dict[str, int]
) -> None:
    points = captured_points(ctx, ball, tessellation, defines)
    assert len(points) >= 3 * len(ball.lods[-1].triangles)
    assert differing_points(points) == (0, 0)


def test_without_canonical_uvs_the_bits_differ(ctx: moderngl.Context, ball: Asset) -> None:
    points = captured_points(ctx, ball, 5.0, {"WITHOUT_CANONICAL_UVS": 1})
    assert differing_points(points)[0] > 50


def test_static_copies_are_the_same_bits(ctx: moderngl.Context, ball: Asset) -> None:
    model = Model(ctx, ball)
    program = ctx.program(vertex_shader=assemble("static.vert", ctx.version_code).text, varyings=["surface_position"])
    for sampler, unit in TEXTURE_UNITS.items():
        if sampler in program:
            program[sampler].value = unit
    for name, value in model.constants.items():
        if name in program:
            program[name].value = value
    for name, texture in model.textures.items():
        texture.use(TEXTURE_UNITS[name])
    actor = model.actor(clip="bend", time_s=0.2)
    model.joint_texture(np.ascontiguousarray(actor.joint_rows[None], np.float32)).use(TEXTURE_UNITS["joint_texture"])
    record = np.zeros(1, ACTOR_INSTANCE)
    record["rows"][:] = np.eye(4)[:3]
    model.levels.instance_buffer("test", record)
    array = model.levels.vertex_array(("test",), "test", program, 0, "triangles")
    mesh = ball.lods[0]
    out = ctx.buffer(reserve=12 * 3 * len(mesh.triangles))
    framebuffer = ctx.simple_framebuffer((1, 1))
    framebuffer.use()
    array.transform(out, mode=moderngl.TRIANGLES)
    release_framebuffer(framebuffer)
    bits = np.frombuffer(out.read(), np.int32).reshape(-1, 3)
    assert np.ptp(bits.view(np.float32), axis=0).min() > 0.5
    _, owner = np.unique(mesh.canonical_uvs, axis=0, return_inverse=True)
    corner = owner.ravel()[mesh.triangles.ravel()]
    order = np.argsort(corner, kind="stable")
    same = corner[order[1:]] == corner[order[:-1]]
    assert not ((bits[order[1:]] != bits[order[:-1]]).any(axis=1) & same).any()
    out.release()
    model.release()
    program.release()


def test_both_patches_of_an_edge_name_the_same_owning_ends(ball: Asset) -> None:
    mesh = ball.lods[0]
    patches = build_patches(mesh.uvs, mesh.canonical_uvs, mesh.triangles)
    assert (patches[:, :3] == mesh.triangles).all()
    _, point = np.unique(mesh.canonical_uvs, axis=0, return_inverse=True)
    point = point.ravel()
    owners: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for patch in patches.astype(int):
        for edge in range(3):
            a, b = patch[3 + 2 * edge], patch[4 + 2 * edge]
            assert (point[a], point[b]) == (point[patch[edge]], point[patch[(edge + 1) % 3]])
            key, ends = ((point[a], point[b]), (a, b)) if point[a] < point[b] else ((point[b], point[a]), (b, a))
            owners.setdefault(key, set()).add(ends)
    assert all(len(ends) == 1 for ends in owners.values())
    assert len(owners) == len(mesh.triangles) * 3 // 2


def test_assets_are_only_read(ball: Asset, tmp_path: Path) -> None:
    assert not list(tmp_path.iterdir())
    mesh = ball.lods[0]
    before = mesh.canonical_uvs.copy()
    shift_copies(mesh, 0.1)
    assert (mesh.canonical_uvs == before).all()
