"""Fixtures: real headless contexts that fail a test which leaks GL objects, and the test characters."""

from __future__ import annotations

import ctypes
import ctypes.util
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import moderngl
import pytest
from builders_asset import build_ball
from builders_scene import Scene

import runtime
from runtime.asset.asset import Asset, load

ROOT = Path(__file__).resolve().parent.parent
ASSETS = ROOT.parent / "shared" / "assets"
KINDS = ("Buffer", "Texture", "VertexArray", "Framebuffer", "Renderbuffer", "Program", "Shader", "Query")
HIGHEST_NAME = 4096  # names are handed out from 1 upwards; tests never come near this


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--renew-goldens", action="store_true", help="draw the golden images anew (tests/golden)")


def asset(name: str) -> Path:
    """A test character, or a skip that says which file is missing."""
    path = ASSETS / name
    if not path.is_file():
        pytest.skip(f"{name} is not in ../shared/assets")
    return path


def live_gl_objects() -> dict[str, set[int]]:
    """Names of all live objects of the current context, by kind, asked of the driver itself."""
    library = ctypes.CDLL(ctypes.util.find_library("GL") or "libGL.so.1")
    library.glUseProgram(0)  # a released program lives on while it is the current one
    return {
        kind: {name for name in range(1, HIGHEST_NAME) if getattr(library, f"glIs{kind}")(ctypes.c_uint(name))}
        for kind in KINDS
    }


@pytest.fixture(scope="session")
def _shared_context() -> Iterator[moderngl.Context]:
    context = moderngl.create_context(standalone=True, backend="egl")
    yield context
    context.release()


@pytest.fixture
def ctx(_shared_context: moderngl.Context) -> Iterator[moderngl.Context]:
    """A headless context. The test fails if GL objects that it made outlive it."""
    context = _shared_context
    context.__enter__()
    before = live_gl_objects()
    yield context
    context.__enter__()
    after = live_gl_objects()
    leaked = {kind: len(after[kind] - before[kind]) for kind in KINDS if after[kind] - before[kind]}
    for kind in leaked:  # do not let one test's leak fail the next
        before[kind] |= after[kind]
    assert not leaked, f"GL objects leaked by this test: {leaked}"


@pytest.fixture(scope="session")
def asset_path() -> Any:
    """Function from a file name in ../shared/assets to its path; skips where it is missing."""
    return asset


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Callable[[str], Path]:
    """Function from a file name in ../shared/assets to its built folder.

    The command line makes each once a session; parallel workers share them and wait for one another.
    """
    folder = tmp_path_factory.getbasetemp()
    folder = (folder if worker_id == "master" else folder.parent) / "built"
    folder.mkdir(exist_ok=True)

    def build(name: str) -> Path:
        source = asset(name)
        destination = folder / f"{source.stem}.seamless"
        taken = folder / f"{source.stem}.taken"
        try:
            taken.touch(exist_ok=False)
        except FileExistsError:
            deadline = time.monotonic() + 600
            while not destination.exists() and not (folder / f"{source.stem}.failed").exists():
                assert time.monotonic() < deadline, f"{name} is still being built"
                time.sleep(0.2)
        else:
            command = [sys.executable, "-m", "preprocess", str(source), "-o", str(destination), "--report"]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
            if done.returncode:
                (folder / f"{source.stem}.failed").write_text(done.stderr)
        failed = folder / f"{source.stem}.failed"
        assert not failed.exists(), failed.read_text()
        return destination

    return build


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A small body of three levels."""
    return load(build_ball(tmp_path_factory.mktemp("draw") / "ball.seamless", sizes=(12, 6, 3)))


@pytest.fixture
def scene(ctx: moderngl.Context, ball: Asset) -> Iterator[Scene]:
    """The body in a scene."""
    made = Scene(ctx, ball)
    yield made
    made.release()


@pytest.fixture
def actor(scene: Scene) -> runtime.Actor:
    """Somebody who moves, alone in the scene."""
    return scene.model.actor(clip="bend")


@pytest.fixture
def crowd(scene: Scene) -> Iterator[runtime.Crowd]:
    """Five in the scene."""
    made = runtime.Crowd(scene.ctx, scene.model, 5)
    yield made
    made.release()
