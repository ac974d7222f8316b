"""The caller's GL state survives drawing, and misuse is named."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_scene import Scene

from runtime.asset.asset import Asset
from runtime.errors import RenderError
from runtime.gpu import gl_state
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.render.views import VIEWS
from runtime.scene.camera import Camera, MatrixCamera, framing
from runtime.scene.lighting import Environment, Lighting


def uniform_binding(gl: gl_state.Functions, binding: int) -> tuple[int, int, int]:
    """Buffer, start and size (0: all of it) at a uniform buffer binding point."""
    buffer, place = ctypes.c_int(), ctypes.c_int64()
    gl.glGetIntegeri_v(gl_state.UNIFORM_BUFFER_BINDING, binding, ctypes.byref(buffer))
    gl.glGetInteger64i_v(gl_state.UNIFORM_BUFFER_START, binding, ctypes.byref(place))
    start = place.value
    gl.glGetInteger64i_v(gl_state.UNIFORM_BUFFER_SIZE, binding, ctypes.byref(place))
    return buffer.value, start, place.value


def driver_state(gl: gl_state.Functions) -> dict[str, Any]:
    """All that drawing could disturb, asked of the driver."""
    state: dict[str, Any] = {f"enabled {flag:#x}": bool(gl.glIsEnabled(flag)) for flag in (
        *gl_state.CAPABILITIES, 0x0C11, 0x0B90, 0x0BF2, 0x8642, 0x809D, 0x8F9D, 0x8C89)}  # fmt: skip
    words = [name for name in vars(gl_state) if name.isupper() and isinstance(getattr(gl_state, name), int)]
    for name in ("CULL_FACE_MODE", "FRONT_FACE", "DEPTH_FUNC", "DEPTH_WRITEMASK", "POLYGON_MODE", "BLEND_DST_RGB",
                 "BLEND_SRC_RGB", "BLEND_DST_ALPHA", "BLEND_SRC_ALPHA", "BLEND_EQUATION_RGB", "BLEND_EQUATION_ALPHA",
                 "CURRENT_PROGRAM", "VERTEX_ARRAY_BINDING", "ARRAY_BUFFER_BINDING", "UNIFORM_BUFFER_BINDING",
                 "ACTIVE_TEXTURE", "PATCH_VERTICES", "UNPACK_ALIGNMENT", "PIXEL_UNPACK_BUFFER_BINDING"):  # fmt: skip
        assert name in words
        state[name] = gl.integer(getattr(gl_state, name))
    state["COLOR_WRITEMASK"] = gl.integers(gl_state.COLOR_WRITEMASK, 4)
    state["viewport"], state["framebuffer"] = gl.integers(gl_state.VIEWPORT, 4), gl.integer(0x8CA6)
    state["offset"] = gl.number(gl_state.POLYGON_OFFSET_FACTOR), gl.number(gl_state.POLYGON_OFFSET_UNITS)
    state["line width"] = gl.number(gl_state.LINE_WIDTH)
    active = state["ACTIVE_TEXTURE"]
    for unit in range(16):
        gl.glActiveTexture(gl_state.TEXTURE0 + unit)
        state[f"unit {unit}"] = gl.integer(gl_state.TEXTURE_BINDING_2D), gl.integer(gl_state.SAMPLER_BINDING)
    gl.glActiveTexture(active)
    for binding in range(4):
        state[f"block {binding}"] = uniform_binding(gl, binding)
    return state


def test_the_state_is_left_as_found(ctx: moderngl.Context, ball: Asset) -> None:
    gl = gl_state.functions()
    textures = [ctx.texture((2, 2), 4) for _ in range(3)]
    sampler, block = ctx.sampler(), ctx.buffer(reserve=256)
    framebuffer = ctx.simple_framebuffer((32, 32), 4)
    framebuffer.use()
    with gl_state.saved_state(range(16), range(4), True):
        for unit, texture in enumerate(textures):
            texture.use(unit * 2)
        sampler.use(4)
        block.bind_to_uniform_block(0, offset=0, size=64)
        block.bind_to_uniform_block(1)
        gl.switch(gl_state.BLEND, True)
        gl.switch(gl_state.CULL_FACE, True)
        gl.switch(gl_state.DEPTH_TEST, False)
        gl.glCullFace(gl_state.FRONT)
        gl.glFrontFace(gl_state.CW)
        gl.glDepthFunc(0x0207)
        gl.glDepthMask(0)
        gl.glColorMask(1, 0, 1, 1)
        gl.glPolygonOffset(3.0, 4.0)
        gl.glPixelStorei(gl_state.UNPACK_ALIGNMENT, 8)
        gl.glActiveTexture(gl_state.TEXTURE0 + 5)
        before = driver_state(gl)
        model = Model(ctx, ball)
        assert driver_state(gl) == before, "Model()"
        renderer = Renderer(ctx)
        assert driver_state(gl) == before, "Renderer()"
        actor = model.actor(clip="bend")
        for view in VIEWS:
            renderer.draw([actor], framing(ball.manifest.bind_bounds), view=view, tessellation=2.0)
            renderer.draw([actor], framing(ball.manifest.bind_bounds), view=view, tessellation="off")
            assert driver_state(gl) == before, view
        renderer.lighting = Lighting(environment=Environment.uniform())
        assert driver_state(gl) == before, "lighting"
        with pytest.raises(RenderError, match="same point"):
            renderer.draw([actor], Camera((0, 0, 0), (0, 0, 0)))
        assert driver_state(gl) == before, "after a refusal"
        renderer.release()
        model.release()
        assert driver_state(gl) == before, "release()"
        gl.glPixelStorei(gl_state.UNPACK_ALIGNMENT, 4)
    for thing in (*textures, sampler, block, *framebuffer.color_attachments, framebuffer.depth_attachment, framebuffer):
        thing.release()


# Old contexts

OLD_CONTEXT = """
import sys, moderngl, numpy as np
import runtime
asset = runtime.load(sys.argv[1])
ctx = moderngl.create_context(standalone=True, require=310, backend="egl")
framebuffer = ctx.simple_framebuffer((32, 32), 4)
framebuffer.use()
camera = runtime.framing(asset.manifest.bind_bounds)
try:
    model, renderer = runtime.Model(ctx, asset), runtime.Renderer(ctx)
    for view in ("lit", "weights", "wireframe", "seams"):
        framebuffer.clear(depth=1.0)
        renderer.draw([model.actor(clip="bend")], camera, view=view)
        print(ctx.version_code, view, len(set(framebuffer.read())) > 5)
    renderer.draw([model.actor()], camera, tessellation=2.0)
except runtime.RenderError as error:
    print(error)
"""


@pytest.mark.parametrize(("version", "lines"), [("4.1", 4), ("3.3", 5), ("3.1", 1)])
def test_old_contexts_draw_or_say_what_they_lack(ball: Asset, version: str, lines: int) -> None:
    """Mesa can pretend to be older than it is."""
    glsl = "410" if version == "4.1" else "330"
    environment = {**os.environ, "MESA_GL_VERSION_OVERRIDE": version, "MESA_GLSL_VERSION_OVERRIDE": glsl}
    command = [sys.executable, "-c", OLD_CONTEXT, str(ball.path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    printed = done.stdout.splitlines()
    if printed and version != "3.1" and not printed[0].startswith(glsl):
        pytest.skip("this driver cannot pretend to be older")
    refused = printed[4:] if version != "3.1" else printed
    assert len(printed) == lines and all(line.endswith("True") for line in printed[:-1])
    assert all("4.1" in line for line in refused)


# Misuse


def test_what_was_released_is_named(ctx: moderngl.Context, ball: Asset) -> None:
    scene = Scene(ctx, ball)
    actor = scene.model.actor()
    scene.model.release()
    scene.model.release()
    with pytest.raises(RenderError, match="model ball was released"):
        scene.picture([actor])
    with pytest.raises(RenderError, match="model ball was released"):
        scene.model.actor()
    scene.renderer.release()
    scene.renderer.release()
    with pytest.raises(RenderError, match="renderer was released"):
        scene.picture([])
    scene.release()


def test_a_released_context_is_named(ctx: moderngl.Context, ball: Asset) -> None:
    other = moderngl.create_context(standalone=True, backend="egl")
    model, renderer = Model(other, ball), Renderer(other)
    actor = model.actor()
    other.release()
    ctx.__enter__()
    with pytest.raises(RenderError, match=r"context of this renderer was released"):
        renderer.draw([actor], Camera((0, 0, 3)))
    with pytest.raises(RenderError, match=r"context of this model was released"):
        Model(other, ball)
    model.release()
    renderer.release()


def test_a_model_of_another_context_is_named(scene: Scene, ctx: moderngl.Context, ball: Asset) -> None:
    other = moderngl.create_context(standalone=True, backend="egl")
    model = Model(other, ball)
    actor = model.actor()
    ctx.__enter__()
    with pytest.raises(RenderError, match="belongs to another context"):
        scene.picture([actor])
    other.__enter__()
    model.release()
    other.release()
    ctx.__enter__()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"view": "xray"}, "no view 'xray'"),
        ({"lod": 3}, r"no level of detail 3: auto or 0 to 2"),
        ({"lod": -1}, "no level of detail -1"),
        ({"tessellation": 65}, "not between 1 and 64"),
        ({"tessellation": float("nan")}, "not between 1 and 64"),
        ({"tessellation": "much"}, "no tessellation 'much'"),
        ({"tessellation": None}, "not between 1 and 64"),
        ({"lod": True}, "no level of detail True"),
        ({"lod": 1.5}, "no level of detail 1.5"),
        ({"view": "own", "uniforms": {"wanted": (1, 2)}}, "uniform 'wanted' does not take"),
        ({"view": "own", "uniforms": {"wanted": "red"}}, "uniform 'wanted' does not take"),
        ({"view": "broken"}, r"caller.frag:2"),
        ({"camera": Camera((0, 0, 0), (0, 0, 0))}, "same point"),
        ({"camera": Camera((0, 0, float("nan")))}, "finite"),
        ({"camera": Camera((0, 0, 1), fovy_deg=200)}, "field of view"),
        ({"camera": Camera((0, 0, 1), near_m=-1.0)}, "near"),
        ({"camera": MatrixCamera(np.eye(3), np.eye(4))}, "view matrix must be 4 x 4"),
        ({"camera": MatrixCamera(np.eye(4) * 2, np.eye(4))}, "scales or shears"),
    ],
)
def test_bad_arguments_are_named(scene: Scene, how: dict[str, Any], message: str) -> None:
    """And the state of the context is what it was; the next picture is drawn as ever."""
    actor = scene.model.actor()
    scene.renderer.add_view("own", "uniform vec3 wanted;\nout vec4 result;\nvoid main() { result = wanted.xyzz; }")
    scene.renderer.add_view("broken", "out vec4 result;\nvoid main() { result = 1.0 }")
    good = scene.picture([actor], lod=np.int64(1), view="mask")
    gl = gl_state.functions()
    before = driver_state(gl)
    with pytest.raises(RenderError, match=message):
        scene.picture([actor], **how)
    scene.framebuffer.use()
    assert driver_state(gl) == before
    assert (scene.picture([actor], lod=1, view="mask") == good).all()


def test_only_actors_and_crowds_are_drawn_and_models_made_of_assets(scene: Scene, ball: Asset) -> None:
    with pytest.raises(RenderError, match="only actors and crowds can be drawn, not 5"):
        scene.picture([5])
    with pytest.raises(RenderError, match=r"what runtime\.load gives, not of"):
        Model(scene.ctx, str(ball.path))  # type: ignore[arg-type]


def test_poses_that_are_not_finite_are_named(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.tile(np.eye(3, 4, dtype=np.float32), (2, scene.model.asset.num_joints, 1, 1))
    rows[1, 0, 0, 0] = np.nan
    monkeypatch.setattr(scene.model.mixer, "joint_rows", lambda numbers: rows)
    with pytest.raises(RenderError, match="pose of actor 1 of ball is not finite"):
        scene.picture([scene.model.actor(), scene.model.actor()])


def test_poses_and_transforms_that_are_not_numbers_are_named(scene: Scene) -> None:
    actor = scene.model.actor()
    actor.transform[0, 0] = np.nan
    with pytest.raises(ValueError, match="transform"):
        scene.picture([actor])
    with pytest.raises(ValueError, match="nope"):
        scene.model.actor(clip="nope")
