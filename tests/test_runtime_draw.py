"""Drawing: pictures are right."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_asset import build_ball, surface_corners, weights_at
from builders_scene import SIDE_PX, Scene

import runtime
from preprocess.mesh.texels import sample_bilinear
from runtime.asset.asset import Asset, load
from runtime.asset.weight_stack import unpack_weights
from runtime.errors import RenderError
from runtime.gpu import gl_state
from runtime.gpu.gl_state import saved_state
from runtime.gpu.programs import build_program
from runtime.gpu.textures import fill_texture, make_texture
from runtime.render.views import VIEWS
from runtime.scene.camera import Camera
from runtime.scene.lighting import Environment, Lighting


@pytest.mark.parametrize("view", [*VIEWS])
@pytest.mark.parametrize("tessellation", ["off", 3.0])
def test_every_view_draws_the_body_and_nothing_else(scene: Scene, view: str, tessellation: Any) -> None:
    actor = scene.model.actor(clip="bend", time_s=0.25)
    mask = scene.picture([actor], view="mask", tessellation=tessellation)[..., 3] > 0
    picture = scene.picture([actor], view=view, tessellation=tessellation)
    assert 0.05 < mask.mean() < 0.9
    if view == "depth":
        assert not picture.any()
    elif view not in ("wireframe", "seams"):  # lines may be half a pixel wider
        assert ((picture[..., 3] == 255) == mask).all()
    if view == "seams":  # Mesa holds on to a program that followed a tessellated one until the next tessellated draw
        scene.picture([actor], tessellation=tessellation)


def test_positions_follow_the_textures_to_float_rounding(scene: Scene, ball: Asset) -> None:
    """GPU positions against float64 skinning of the same texels, through the position picture of one flat view."""
    from runtime.gpu.gl_state import functions, saved_state
    from runtime.gpu.programs import assemble
    from runtime.gpu.textures import TEXTURE_UNITS
    from runtime.gpu.vertex_layout import ACTOR_INSTANCE

    ctx, model = scene.ctx, scene.model
    mesh = ball.lods[0]
    actor = model.actor(clip="bend", time_s=0.3)
    program = ctx.program(vertex_shader=assemble("static.vert", ctx.version_code).text, varyings=["surface_position"])
    with saved_state(range(16), (0,), True):
        for name, value in {**TEXTURE_UNITS, **model.constants}.items():
            if name in program:
                program[name].value = value
        for name, texture in model.textures.items():
            texture.use(TEXTURE_UNITS[name])
        rows = np.ascontiguousarray(actor.joint_rows[None], np.float32)
        model.joint_texture(rows).use(TEXTURE_UNITS["joint_texture"])
        record = np.zeros(1, ACTOR_INSTANCE)
        record["rows"][:] = np.eye(4)[:3]
        model.levels.instance_buffer("test", record)
        out = ctx.buffer(reserve=12 * 3 * len(mesh.triangles))
        scene.framebuffer.use()
        model.levels.vertex_array(("test",), "test", program, 0, "triangles").transform(out, mode=moderngl.TRIANGLES)
        drawn = np.frombuffer(out.read(), np.float32).reshape(-1, 3)
        functions().glUseProgram(0)
        out.release()
        program.release()
    texels = ball.textures["position"].levels[0][:, :, :3].astype(np.float64)
    low, high = texels.min(axis=(0, 1)), texels.max(axis=(0, 1))
    texels = np.rint((texels - low) / (high - low) * 65535) / 65535 * (high - low) + low
    weights = unpack_weights(ball.textures["weights"].levels[0], ball.weight_size, ball.num_joints)
    rest = sample_bilinear(texels, mesh.canonical_uvs)
    blended = np.einsum("vj,jrc->vrc", sample_bilinear(weights, mesh.canonical_uvs), rows[0].astype(np.float64))
    expected = np.einsum("vrc,vc->vr", blended[:, :, :3], rest) + blended[:, :, 3]
    assert np.abs(drawn - expected[mesh.triangles.ravel()]).max() < 3e-6


def test_the_mask_is_that_of_the_formula(scene: Scene, ball: Asset) -> None:
    """At rest, drawn vertices project onto the body's own outline."""
    points = surface_corners(40)
    matrices = scene.camera.matrices(SIDE_PX, SIDE_PX)
    clip = (points - matrices.eye) @ matrices.clip_from_world[:, :3].T + matrices.clip_from_world[:, 3]
    px = (clip[:, :2] / clip[:, 3:] * [0.5, -0.5] + 0.5) * SIDE_PX
    expected = np.zeros((SIDE_PX, SIDE_PX), bool)
    expected[px[:, 1].astype(int), px[:, 0].astype(int)] = True
    drawn = scene.picture([scene.model.actor()], view="mask")[..., 0] > 0
    assert (expected & ~drawn).sum() <= 0.08 * drawn.sum()
    rows, columns = np.nonzero(drawn)
    assert abs(px[:, 0].min() - columns.min()) < 1.5 and abs(px[:, 1].max() - rows.max()) < 1.5


def test_normals_turn_with_the_body(scene: Scene) -> None:
    """A whole turn of the actor leaves the same picture only if normals turn with it."""
    camera = Camera((0.0, 1.0, 6.0), (0.0, 1.0, 0.0))
    actor = scene.model.actor()
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn
    front = scene.picture([actor], camera, view="normal")
    actor.transform = turn
    back = scene.picture([actor], Camera((0.0, 1.0, -6.0), (0.0, 1.0, 0.0)), view="normal")
    inside = (front[..., 3] > 0) & (back[..., 3] > 0)
    assert inside.mean() > 0.02
    expected = front[inside][:, :3] * [-1, 1, -1] + [255, 0, 255]
    assert np.abs(back[inside][:, :3] - expected).max() <= 2


def test_mirrored_actors_show_their_outside(scene: Scene) -> None:
    camera = Camera((0.0, 1.0, 6.0), (0.0, 1.0, 0.0))
    actor = scene.model.actor(transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    picture = scene.picture([actor], camera, view="normal")
    centre = picture[SIDE_PX // 2, SIDE_PX // 2]
    assert centre[3] == 255 and centre[2] > 200  # facing the camera, +Z


def test_worlds_far_from_the_origin_keep_their_precision(scene: Scene) -> None:
    near = scene.picture([scene.model.actor()], view="mask")
    offset = np.array([2.0e5, -1.0e5, 3.0e5])
    moved = np.eye(4)
    moved[:3, 3] = offset
    camera = Camera(
        tuple(scene.camera.eye + offset), tuple(scene.camera.target + offset), fovy_deg=scene.camera.fovy_deg
    )
    far = scene.picture([scene.model.actor(transform=moved)], camera, view="mask")
    assert (near != far).any(axis=-1).sum() <= 2


def test_three_hundred_joints_work(ctx: moderngl.Context, tmp_path: Path) -> None:
    asset = load(build_ball(tmp_path / "many.seamless", num_joints=300, sizes=(12,), weight_px=64))
    assert asset.textures["weights"].levels[0].dtype == np.uint16
    scene = Scene(ctx, asset)
    few = Scene(ctx, load(build_ball(tmp_path / "few.seamless", num_joints=1, sizes=(12,))))
    rest = scene.picture([scene.model.actor()], view="mask")
    assert (rest != few.picture([few.model.actor()], view="mask")).any(axis=-1).mean() < 0.002
    bent = scene.picture([scene.model.actor(clip="bend", time_s=0.25)], view="mask")
    assert (bent != rest).any(axis=-1).mean() > 0.01
    few.release()
    scene.release()


def test_materials_cut_out_and_blend(ctx: moderngl.Context, tmp_path: Path) -> None:
    materials = [
        {"name": "solid"},
        {"name": "hole", "alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.2]}},
        {"name": "glass", "alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]},
         "extensions": {"KHR_materials_unlit": {}}, "doubleSided": False},
    ]  # fmt: skip
    asset = load(
        build_ball(tmp_path / "b.seamless", sizes=(8,), materials=materials, face_materials=(0, 0, 0, 0, 2, 1))
    )
    scene = Scene(ctx, asset)
    actor = scene.model.actor()
    glass = scene.picture([actor], Camera((0.0, 1.0, 6.0), (0.0, 1.0, 0.0)))[SIDE_PX // 2, SIDE_PX // 2]
    assert 100 < glass[3] < 200
    hole = scene.picture([actor], Camera((0.0, 1.0, -6.0), (0.0, 1.0, 0.0)))[SIDE_PX // 2, SIDE_PX // 2]
    assert hole[3] == 0
    solid = scene.picture([actor], Camera((6.0, 1.0, 0.0), (0.0, 1.0, 0.0)))[SIDE_PX // 2, SIDE_PX // 2]
    assert solid[3] == 255
    scene.release()


def test_a_furnace_shows_no_more_light_than_there_is(scene: Scene) -> None:
    """In a uniform white room without sun nothing is brighter than the room."""
    scene.renderer.lighting = Lighting(
        sun_color=(0, 0, 0), environment=Environment.uniform(0.4 * np.ones(3)), exposure=1.0
    )
    picture = scene.picture([scene.model.actor()])
    room = 255 * (1.055 * 0.4 ** (1 / 2.4) - 0.055)
    assert 40 < picture[..., :3].max() <= room + 3


def test_levels_differ_little_and_are_shown(scene: Scene) -> None:
    actor = scene.model.actor()
    finest = scene.picture([actor], view="mask", lod=0)
    for level in (1, 2):
        coarser = scene.picture([actor], view="mask", lod=level, tessellation="off")
        assert 0 < (coarser != finest).any(axis=-1).mean() < 0.05
        tessellated = scene.picture([actor], view="mask", lod=level, tessellation=8.0)
        assert (tessellated != finest).any(axis=-1).mean() < (coarser != finest).any(axis=-1).mean()
    assert scene.renderer.last_drawn[actor].tessellated


def test_actors_out_of_view_are_not_drawn(scene: Scene) -> None:
    actor = scene.model.actor()
    aside = np.eye(4)
    aside[0, 3] = 100.0
    actor.transform = aside
    assert not scene.picture([actor]).any()
    assert scene.renderer.last_drawn[actor].level == -1


def test_many_actors_are_the_sum_of_each(scene: Scene) -> None:
    places = []
    for x in (-0.9, 0.0, 0.9):
        matrix = np.eye(4)
        matrix[0, 3] = x
        places.append(matrix)
    actors = [scene.model.actor(clip="bend", time_s=0.3 * i, transform=place) for i, place in enumerate(places)]
    camera = Camera((0.0, 1.0, 9.0), (0.0, 1.0, 0.0))
    together = scene.picture(actors, camera, view="mask")
    alone = np.maximum.reduce([scene.picture([actor], camera, view="mask") for actor in actors])
    assert (together == alone).all()


# The caller's own shaders


def test_a_caller_brings_a_fragment_shader(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "tones.glsl").write_text("vec3 tone(float t) { return vec3(t, 0.0, 1.0); }\n")
    (tmp_path / "toon.frag").write_text(
        '#include "surface.glsl"\n#include "tones.glsl"\nuniform float strength;\nout vec4 result;\n'
        "void main() { Surface s = read_surface(); result = vec4(tone(strength * step(-2.0, s.normal.y)), 1.0); }\n"
    )
    scene.renderer.add_view("toon", tmp_path / "toon.frag")
    actor = scene.model.actor()
    picture = scene.picture([actor], view="toon", uniforms={"strength": 0.5})
    assert (picture[SIDE_PX // 2, SIDE_PX // 2] == [128, 0, 255, 255]).all()
    scene.renderer.add_view("toon", "out vec4 result;\nvoid main() { result = vec4(0.0, 1.0, 0.0, 1.0); }")
    assert (scene.picture([actor], view="toon")[SIDE_PX // 2, SIDE_PX // 2] == [0, 255, 0, 255]).all()
    with pytest.raises(RenderError, match="built in"):
        scene.renderer.add_view("lit", "")
    with pytest.raises(RenderError, match="no such shader file"):
        scene.renderer.add_view("gone", tmp_path / "gone.frag")


def test_the_package_offers_its_names_lazily() -> None:
    for name in runtime.__all__:
        assert getattr(runtime, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        runtime.nonsense  # noqa: B018


def test_weights_by_formula_sum_to_one() -> None:
    assert np.allclose(weights_at(surface_corners(4), 5).sum(axis=1), 1.0)


CURVES = """
#include "surface.glsl"
out vec4 result;
void main() {
    float x = (gl_FragCoord.x - 0.5) / 1023.0;
    result = vec4(decode_srgb(vec3(x)).r, encode_srgb(vec3(x)).r, encode_srgb(decode_srgb(vec3(x))).r, 1.0);
}
"""


def test_colour_curves_are_those_of_srgb(ctx: moderngl.Context) -> None:
    """Fits in place of powers: no 8-bit colour is off by more than a fifth of a step, there or back."""
    program = build_program(ctx, ("stage.vert",), {}, CURVES)
    target = ctx.texture((1024, 1), 4, dtype="f4")
    framebuffer = ctx.framebuffer([target])
    array = ctx.vertex_array(program, [])
    with saved_state((0,), (0,), True) as gl:
        for flag in (gl_state.DEPTH_TEST, gl_state.CULL_FACE, gl_state.BLEND):
            gl.switch(flag, False)
        framebuffer.use()
        array.render(moderngl.TRIANGLES, vertices=3)
        values = np.frombuffer(target.read(), np.float32).reshape(-1, 4).astype(float)
    x = np.arange(1024) / 1023
    decoded = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    encoded = np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055)
    slope = np.gradient(decoded, x)
    assert (np.abs(values[:, 0] - decoded) / slope).max() < 0.1 / 255
    assert np.abs(values[:, 1] - encoded).max() < 0.12 / 255
    assert np.abs(values[:, 2] - x).max() < 0.2 / 255
    for thing in (array, framebuffer, target, program):
        thing.release()


@pytest.mark.parametrize("view", ["lit", "mask", "normal", "depth"])
def test_what_a_material_lacks_is_left_out_unseen(scene: Scene, view: str, monkeypatch: pytest.MonkeyPatch) -> None:
    actor = scene.model.actor(clip="bend", time_s=0.25)
    lean = scene.picture([actor], view=view)
    assert any("NO_ALPHA_TEST" in key[-1] for key in scene.renderer._passes._programs)
    channels = scene.model.channels.defines
    full = [replace(lod, ranges=[replace(part, defines=channels) for part in lod.ranges]) for lod in scene.model.lods]
    monkeypatch.setattr(scene.model.levels, "lods", full)
    assert (scene.picture([actor], view=view) == lean).all()
    assert any("NO_ALPHA_TEST" not in key[-1] for key in scene.renderer._passes._programs)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [3, 4])
def test_every_texel_of_every_mip_level_arrives(ctx: moderngl.Context, kind: type, channels: int) -> None:
    """Odd sizes and rows that are no multiple of four bytes; read back by the driver's own call."""
    rng = np.random.default_rng(4)
    levels = tuple(
        (rng.uniform(0, 1 if kind is np.float32 else np.iinfo(kind).max, (max(1, 13 >> k), max(1, 22 >> k), channels)))
        .astype(kind) for k in range(5)
    )  # fmt: skip
    read = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_int, ctypes.c_uint, ctypes.c_uint, ctypes.c_void_p)(
        gl_state._loader()("glGetTexImage")
    )
    with saved_state((ctx.default_texture_unit,), (), False):
        texture = make_texture(ctx, levels[0], levels[1:])
        for _ in fill_texture(ctx, texture, levels):
            pass
        texture.use(ctx.default_texture_unit)
        with packed_rows():
            for level, wanted in enumerate(levels):
                found = np.zeros_like(wanted)
                form, code = gl_state.TEXEL_FORMATS[channels], gl_state.TEXEL_TYPES[wanted.dtype.name]
                read(gl_state.TEXTURE_2D, level, form, code, found.ctypes.data)
                assert (found == wanted).all(), level
    texture.release()


@contextmanager
def packed_rows() -> Iterator[None]:
    """Rows read back lie close together meanwhile."""
    gl, pack_alignment = gl_state.functions(), 0x0D05
    before = gl.integer(pack_alignment)
    gl.glPixelStorei(pack_alignment, 1)
    yield
    gl.glPixelStorei(pack_alignment, before)
