"""The viewer's window under a virtual display: its panel draws and acts, files are opened directly and when dropped."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from builders_asset import build_ball
from test_embedding import display  # noqa: F401  # a fixture

from demos.errors import DemoError
from demos.model_cache import MOST_ENTRIES, _forget_old, built_folder
from demos.panel import sun_angles, sun_direction

ROOT = Path(__file__).resolve().parent.parent

PROGRAM = """
import sys
from pathlib import Path
import numpy as np
from demos.options import Parser, add_arguments, parse
from demos.panel import Panel
from demos.viewer import Viewer
from demos.window import Window

parser = Parser("viewer")
add_arguments(parser)
_, options = parse(parser, [sys.argv[1], "--size", "640x480"])

def look(window):
    width, height = window.size
    data = window.framebuffer.read(components=3, alignment=1)
    window.ctx.error  # see Viewer._save_picture
    return np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1].astype(int)

with Window("test", options.size) as window:
    viewer = Viewer(window, options)
    viewer.panel = Panel(window)
    viewer.paused = True
    def frames(count):
        for _ in range(count):
            window.next_frame()
            viewer.frame(0.01)
        return look(window)
    with_panel = frames(4)
    viewer.key("h")
    without = frames(3)
    difference = np.abs(with_panel - without).max(axis=2) > 8
    left, right = difference[:, :375].mean(), difference[:, 375:].mean()
    assert left > 0.2 and right < 0.01, (left, right)
    viewer.key("h")
    # A click on the check box "paused": the panel acts, and what lies below it does not turn.
    imgui, io = viewer.panel._imgui, viewer.panel._imgui.get_io()
    before = viewer.orbit.camera().eye
    places = []
    checkbox = imgui.checkbox
    def noted(label, value):
        result = checkbox(label, value)
        low = imgui.get_item_rect_min()
        places.append((low.x + 8, low.y + 8))
        return result
    imgui.checkbox = noted
    frames(2)
    io.add_mouse_pos_event(*places[-1]); frames(1)
    io.add_mouse_button_event(0, True); frames(1)
    io.add_mouse_button_event(0, False); frames(2)
    assert viewer.paused is False and io.want_capture_mouse
    assert np.array_equal(before, viewer.orbit.camera().eye)
    # A dropped folder is opened; what is none leaves the character that is there.
    viewer.drop([sys.argv[2]])
    assert viewer.model.asset.name == "other", viewer.model.asset.name
    viewer.drop([sys.argv[0]])
    assert viewer.model.asset.name == "other"
    frames(1)
    # The folder is built anew: the viewer shows it from where it stood.
    import shutil
    eye = viewer.orbit.camera().eye
    shutil.copytree(sys.argv[1], sys.argv[2], dirs_exist_ok=True)
    shutil.copystat(sys.argv[0] if Path(sys.argv[0]).exists() else sys.executable, Path(sys.argv[2]) / "manifest.json")
    for _ in range(130): viewer.look_for_changes(0.01)
    assert viewer.model.asset.name == "ball", viewer.model.asset.name
    assert np.array_equal(eye, viewer.orbit.camera().eye)
    viewer.key("p")
    frames(1)
    assert Path("ball-1.png").is_file()
    assert window.ctx.error == "GL_NO_ERROR"
    viewer.release()
print("looked")
"""


def test_the_panel_draws_acts_and_hides(display: str, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("imgui_bundle")
    pytest.importorskip("OpenGL")
    ball = build_ball(tmp_path / "ball.seamless")
    other = build_ball(tmp_path / "other.seamless")
    manifest = other / "manifest.json"
    name = '"name": "ball"'
    text = manifest.read_text()
    assert name in text
    manifest.write_text(text.replace(name, '"name": "other"', 1))
    environment = {**os.environ, "DISPLAY": display, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PROGRAM, str(ball), str(other)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, env=environment)
    assert done.returncode == 0 and "looked" in done.stdout, done.stdout + done.stderr
    told = [line for line in done.stderr.splitlines() if line.startswith("viewer:")]
    assert len(told) == 2 and "ball-1.png" in told[1]


@pytest.mark.parametrize("heading,height", [(0, 0), (120, 30), (-75, -60), (10, 89)])
def test_sun_angles_and_direction_are_inverse(heading: float, height: float) -> None:
    assert sun_angles(sun_direction(heading, height)) == pytest.approx((heading, height), abs=1e-9)


def test_folders_are_taken_as_they_are(tmp_path: Path) -> None:
    assert built_folder(tmp_path) == tmp_path
    assert built_folder(tmp_path / "none.seamless") == tmp_path / "none.seamless"


def test_a_character_file_is_built_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from builders_gltf import bent_bar

    monkeypatch.setenv("SEAMSKIN_CACHE", str(tmp_path / "cache"))
    model = bent_bar(tmp_path / "bar.glb")
    first = built_folder(model)
    assert (first / "manifest.json").is_file() and first.parent == tmp_path / "cache"
    made = (first / "manifest.json").stat().st_mtime_ns
    assert built_folder(model) == first and (first / "manifest.json").stat().st_mtime_ns == made
    model.write_bytes(model.read_bytes()[:-4])
    with pytest.raises(DemoError) as refusal:
        built_folder(model)
    assert "\n" not in str(refusal.value)
    with pytest.raises(DemoError, match="cannot be read"):
        built_folder(tmp_path / "none.glb")


def test_the_oldest_entries_go(tmp_path: Path) -> None:
    for number in range(MOST_ENTRIES + 3):
        entry = tmp_path / f"{number}.seamless"
        entry.mkdir()
        os.utime(entry, (number, number))
    _forget_old(tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) == MOST_ENTRIES and "0.seamless" not in left and "34.seamless" in left
