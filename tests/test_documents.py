"""Every Python example of the README and of the embedding page runs, copied literally."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_asset import build_ball
from test_embedding import display  # noqa: F401  # a fixture

import runtime

ROOT = Path(__file__).resolve().parent.parent
CLIPS = ("walk", "run", "idle", "wave")
JOINTS = ("spine_02", "head", "hand_l", "hand_r")


def examples(document: str) -> list[str]:
    """Python blocks of a document, in order."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / document).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def somebody(tmp_path_factory: pytest.TempPathFactory) -> runtime.Asset:
    """A body whose clips and joints are called as in the documents."""
    asset = runtime.load(build_ball(tmp_path_factory.mktemp("documents") / "human.seamless"))
    clips = tuple(dataclasses.replace(asset.clips[0], name=name) for name in CLIPS)
    names = dict(zip((asset.skeleton.names[node] for node in asset.skeleton.joint_nodes), JOINTS))
    skeleton = dataclasses.replace(asset.skeleton, names=tuple(names.get(name, name) for name in asset.skeleton.names))
    return dataclasses.replace(asset, clips=clips, skeleton=skeleton)


class Frames:
    """True a few times."""

    def __init__(self, count: int) -> None:
        self.left = count

    def __bool__(self) -> bool:
        self.left -= 1
        return self.left >= 0


def test_the_examples_of_embedding_run_one_after_the_other(
    ctx: moderngl.Context, somebody: runtime.Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime.asset.asset, "load", lambda path: somebody)
    monkeypatch.setattr(moderngl, "create_context", lambda: ctx)
    monkeypatch.chdir(somebody.path.parent)
    target = ctx.simple_framebuffer((64, 48))
    target.use()
    vertex = "uniform mat4 clip_from_object; void main() { gl_Position = clip_from_object * vec4(1); }"
    fragment = "out vec4 color; void main() { color = vec4(1); }"
    program = ctx.program(f"#version 330\n{vertex}", f"#version 330\n{fragment}")
    count = 10_000
    given: dict[str, Any] = {
        "np": np,
        "ctx": ctx,
        "target": target,
        "width": 64,
        "height": 48,
        "dt": 1 / 60,
        "lag": 0.02,
        "matrix": np.eye(4),
        "place": np.zeros(3),
        "offset": np.eye(4),
        "body": np.eye(4),
        "sword_program": program,
        "sword": SimpleNamespace(transform=np.eye(4)),
        "mouse_position": (32, 24),
        "positions": np.random.default_rng(0).normal(0, 9, (count, 3)),
        "headings": np.zeros(count),
        "phases": np.zeros(count),
        "speeds": np.ones(count),
        "colors": np.ones((count, 3)),
        "sun_camera": runtime.Camera((5, 9, 5)),
    }
    _ = ctx.error  # what earlier tests left
    blocks = examples("docs/embedding.md")
    assert len(blocks) >= 12
    for block in blocks:
        # Frames are counted anew in each; what stands for the whole scene is there when it is needed.
        given |= {"running": Frames(3)}
        if "hero" in block and "hero" not in given:
            given["hero"] = given["actor"]
        if "crowd" in block and "crowd" not in given:
            given["crowd"] = runtime.Crowd(ctx, given["model"], 3)
            first_crowd = given["crowd"]
        if "Loading" in block:
            given["running"], model = Frames(300), given["model"]
        target.use()
        exec(compile(block, "docs/embedding.md", "exec"), given)  # it is our own document
        assert ctx.error == "GL_NO_ERROR"
    assert given["pixels"].any() and given["hit"] is not None
    given["loading"].release()
    shadow = given["shadow"]
    owned = [given["crowd"], given["renderer"], model, first_crowd, program, shadow]
    for thing in (*owned, shadow.depth_attachment, *target.color_attachments, target.depth_attachment, target):
        thing.release()


def test_the_program_of_the_readme_runs_in_a_window(display: str, somebody: runtime.Asset, tmp_path: Path) -> None:  # noqa: F811
    """As it stands, from a file of its own; only somebody closes the window, and looks at it before."""
    pytest.importorskip("pygame")
    (program,) = examples("README.md")
    (tmp_path / "game.py").write_text(program, encoding="utf-8")
    closing = f"""
import runpy, sys
import moderngl, numpy, pygame
import runtime, runtime.asset.asset
load = runtime.asset.asset.load
import dataclasses
import os
def named(path):
    asset = load({str(somebody.path)!r})
    return dataclasses.replace(asset, clips=(dataclasses.replace(asset.clips[0], name="walk"),))
runtime.asset.asset.load = named
get, frames = pygame.event.get, []
def events():
    frames.append(get())
    if len(frames) < 4:
        return []
    width, height = pygame.display.get_window_size()
    data = moderngl.get_context().detect_framebuffer().read(viewport=(0, 0, width, height), components=3, alignment=1)
    seen = numpy.frombuffer(data, numpy.uint8).reshape(height, width, 3)
    assert len(numpy.unique(seen[::7, ::7].reshape(-1, 3), axis=0)) > 20, "an empty window"
    print("looked")
    return [pygame.event.Event(pygame.QUIT)]
pygame.event.get = events
runpy.run_path("game.py", run_name="__main__")
"""
    environment = {"PATH": "", "PYTHONPATH": str(ROOT), "DISPLAY": display, "PYGAME_HIDE_SUPPORT_PROMPT": "1"}
    environment |= {"SDL_AUDIODRIVER": "dummy", "HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", closing], cwd=tmp_path, capture_output=True, text=True, timeout=240, env=environment
    )
    assert done.returncode == 0 and "looked" in done.stdout, done.stdout + done.stderr


def test_the_programs_of_the_tutorial_run_in_a_window(display: str, somebody: runtime.Asset, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("moderngl_window")
    pytest.importorskip("glfw")
    first, second = examples("docs/tutorial.md")
    closing = """
import sys
import moderngl_window, numpy
def closing(base):
    class Closing(base):
        frames = 0
        def on_render(self, time, frame_time):
            super().on_render(time, frame_time)
            self.frames += 1
            if self.frames == 4:
                width, height = self.wnd.buffer_size
                data = self.wnd.fbo.read(components=3, alignment=1)
                seen = numpy.frombuffer(data, numpy.uint8).reshape(-1, 3)
                assert len(numpy.unique(seen[::7], axis=0)) > 20, "an empty window"
                print("looked")
                self.wnd.close()
    return Closing
moderngl_window.run_window_config(closing(globals()[sys.argv[1]]), args=["--window", "glfw", "--size", "320x240"])
"""
    program = f"FOLDER = {str(somebody.path)!r}\n{first}\n{second}\n{closing}"
    (tmp_path / "game.py").write_text(program, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "DISPLAY": display}
    for name in ("Game", "Parade"):
        command = [sys.executable, "game.py", name]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, env=environment)
        assert done.returncode == 0 and "looked" in done.stdout, done.stdout + done.stderr


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Strict: dead links, missing anchors and names that the reference does not find are errors."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stdout + done.stderr
    assert "Renderer" in (tmp_path / "site/reference/runtime/index.html").read_text(encoding="utf-8")
