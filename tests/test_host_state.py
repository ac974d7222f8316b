"""Whatever state the host left the context in, the same pixels; and what the host bound is what is drawn into."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_scene import SIDE_PX, Scene

import runtime
from runtime.asset.asset import Asset
from runtime.gpu import gl_state

PRIMITIVE_RESTART_INDEX = 0x8F9E


def host_function(name: str, *arguments: Any) -> Any:
    """A GL function as another program would call it."""
    return ctypes.CFUNCTYPE(None, *arguments)(gl_state._loader()(name))


@pytest.mark.parametrize("index", [0, 3, 7])
@pytest.mark.parametrize("tessellation", ["off", 2.0])
@pytest.mark.parametrize("view", ["lit", "wireframe", "seams"])
def test_the_hosts_restart_index_takes_no_triangle(
    scene: Scene, crowd: runtime.Crowd, index: int, tessellation: Any, view: str
) -> None:
    actor, gl = scene.model.actor(clip="bend"), gl_state.functions()
    crowd.place_on_ground(np.array([[x, 0.0, -2.0] for x in range(-2, 3)]))
    plain = scene.picture([actor, crowd], view=view, tessellation=tessellation)
    set_index = host_function("glPrimitiveRestartIndex", ctypes.c_uint)
    was_on, was = bool(gl.glIsEnabled(gl_state.PRIMITIVE_RESTART)), gl.integer(PRIMITIVE_RESTART_INDEX)
    gl.switch(gl_state.PRIMITIVE_RESTART, True)
    set_index(index)
    try:
        restarted = scene.picture([actor, crowd], view=view, tessellation=tessellation)
        assert gl.glIsEnabled(gl_state.PRIMITIVE_RESTART) and gl.integer(PRIMITIVE_RESTART_INDEX) == index
    finally:
        gl.switch(gl_state.PRIMITIVE_RESTART, was_on)
        set_index(was & 0xFFFFFFFF)
    assert (restarted == plain).all()
    # Mesa holds on to a program that followed a tessellated one until the next tessellated draw.
    scene.picture([actor], tessellation=tessellation)


def test_clearing_fills_what_is_bound_behind_moderngls_back(ctx: moderngl.Context, scene: Scene) -> None:
    """As Qt does it: the framebuffer of a widget is bound by OpenGL's own call, and moderngl believes in another."""
    gl, actor = gl_state.functions(), scene.model.actor(clip="bend")
    wanted = scene.picture([actor])
    widget = ctx.simple_framebuffer((SIDE_PX, SIDE_PX), 4)
    widget.clear(1.0, 0.0, 1.0, 0.0)
    scene.framebuffer.use()
    scene.framebuffer.clear(0.0, 1.0, 0.0)
    gl.glBindFramebuffer(gl_state.DRAW_FRAMEBUFFER, widget.glo)
    scene.renderer.clear(0.0, 0.0, 0.0, 0.0)
    scene.renderer.draw([actor], scene.camera)
    assert gl.integer(gl_state.DRAW_FRAMEBUFFER_BINDING) == widget.glo
    drawn = np.frombuffer(widget.read(components=4), np.uint8).reshape(SIDE_PX, SIDE_PX, 4)[::-1]
    untouched = np.frombuffer(scene.framebuffer.read(components=3), np.uint8).reshape(-1, 3)
    assert (drawn == wanted).all() and (untouched == (0, 255, 0)).all()
    for thing in (*widget.color_attachments, widget.depth_attachment, widget):
        thing.release()


def test_what_is_cleared_is_opaque_unless_asked_otherwise(scene: Scene) -> None:
    gl = gl_state.functions()
    scene.framebuffer.use()
    gl.glDepthMask(0)
    scene.renderer.clear(0.2, 0.4, 0.6)
    assert not gl.integer(gl_state.DEPTH_WRITEMASK)
    gl.glDepthMask(1)
    assert set(np.frombuffer(scene.framebuffer.read(components=4), np.uint32)) == {0xFF996633}
    scene.renderer.clear(alpha=0.0)
    assert not any(scene.framebuffer.read(components=4))
    with pytest.raises(runtime.RenderError, match="cleared to numbers"):
        scene.renderer.clear("blue")  # type: ignore[arg-type]


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_characters_look_the_same_over_any_alpha(scene: Scene, alpha: float) -> None:
    actor = scene.model.actor(clip="bend")
    over = []
    for background in (0.0, alpha):
        scene.framebuffer.use()
        scene.renderer.clear(0.1, 0.2, 0.3, background)
        scene.renderer.draw([actor], scene.camera)
        over.append(np.frombuffer(scene.framebuffer.read(components=4), np.uint8).reshape(-1, 4))
    assert (over[0][:, :3] == over[1][:, :3]).all()
    drawn = (over[0][:, :3] != over[0][0, :3]).any(axis=1)
    assert drawn.any() and (over[0][drawn, 3] == 255).all()


WIDGET = """
import sys
from PySide6 import QtGui, QtOpenGLWidgets, QtWidgets
import moderngl, runtime

wanted = QtGui.QSurfaceFormat()
wanted.setVersion(4, 1)
wanted.setProfile(QtGui.QSurfaceFormat.CoreProfile)
wanted.setDepthBufferSize(24)
QtGui.QSurfaceFormat.setDefaultFormat(wanted)

class Widget(QtOpenGLWidgets.QOpenGLWidget):
    def initializeGL(self):
        self.ctx = moderngl.create_context()
        self.model = runtime.Model(self.ctx, runtime.load(sys.argv[1]))
        self.actor, self.renderer = self.model.actor(clip="bend"), runtime.Renderer(self.ctx)

    def paintGL(self):
        self.renderer.clear(0.62, 0.68, 0.75)
        self.renderer.draw([self.actor], runtime.framing(self.model.asset.manifest.bind_bounds))

application = QtWidgets.QApplication([])
widget = Widget()
widget.resize(96, 96)
widget.show()
for _ in range(5):
    application.processEvents()
image = widget.grab().toImage()
print(image.pixelColor(2, 2).getRgb(), image.pixelColor(48, 48).getRgb())
"""


@pytest.mark.slow
def test_the_readmes_way_works_in_a_qt_widget(ball: Asset, tmp_path: Path, free_display: Callable[[], str]) -> None:
    pytest.importorskip("PySide6.QtOpenGLWidgets", reason="PySide6 is not installed: pip install PySide6-Essentials")
    environment = {**os.environ, "DISPLAY": free_display(), "QT_QPA_PLATFORM": "xcb"}
    command = [sys.executable, "-c", WIDGET, str(ball.path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    if "platform plugin" in done.stderr:
        pytest.skip("Qt's xcb plugin lacks a library: apt install libxcb-cursor0 libxcb-icccm4 libxcb-keysyms1")
    assert done.returncode == 0, done.stderr
    corner, middle = done.stdout.strip().replace(") (", ")|(").split("|")
    assert corner == "(158, 173, 191, 255)" and middle != corner


@pytest.fixture
def free_display(request: pytest.FixtureRequest) -> Callable[[], str]:
    """Function that starts a display of its own for the test, ended with it."""

    def start() -> str:
        if shutil.which("Xvfb") is None:
            pytest.skip("no Xvfb: apt install xvfb")
        reading, writing = os.pipe()
        server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(writing), "-screen", "0", "320x240x24"],
            pass_fds=[writing],
            stderr=subprocess.DEVNULL,
        )
        os.close(writing)
        request.addfinalizer(lambda: (server.terminate(), server.wait(), os.close(reading)))
        return f":{os.read(reading, 16).decode().strip()}"

    return start
