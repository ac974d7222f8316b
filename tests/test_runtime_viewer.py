"""The viewer: pictures without a window, one line for every fault, and the camera's arithmetic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders_asset import build_ball

from demos.options import VIEW_NAMES, Parser, add_arguments
from demos.orbit import Orbit
from demos.viewer import main
from preprocess.files.images import read_image
from runtime.scene.camera import Camera, framing


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_ball(tmp_path_factory.mktemp("viewer") / "ball.seamless", sizes=(8, 4))


@pytest.mark.parametrize("view", VIEW_NAMES)
def test_every_view_becomes_a_picture(ball: Path, tmp_path: Path, view: str) -> None:
    out = tmp_path / "new folder" / "picture.png"
    arguments = [str(ball), "--headless", "--out", str(out), "--size", "80x60", "--view", view]
    assert main([*arguments, "--clip", "bend", "--time", "0.3", "--lod", "1", "--tessellation", "2.5"]) == 0
    picture = read_image(out).texels
    assert picture.shape == (60, 80, 4)
    alpha = picture[..., 3]
    if view in ("lit", "weights", "lod", "wireframe", "seams"):
        assert (alpha == 1).all() and np.ptp(picture[..., :3]) > 0.2
    else:
        assert set(np.unique(alpha)) == {0.0, 1.0} and 0.03 < alpha.mean() < 0.9
    assert list(out.parent.iterdir()) == [out]


def test_the_camera_looks_where_it_is_told(ball: Path, tmp_path: Path) -> None:
    out = tmp_path / "far.png"
    options = [str(ball), "--headless", "--out", str(out), "--size", "64x64", "--view", "mask", "--clip", "0"]
    assert main([*options, "--eye", "0", "1", "20", "--target", "2", "1", "0", "--fovy", "30"]) == 0
    rows, columns = np.nonzero(read_image(out).texels[..., 3])
    assert columns.max() < 32 and abs(rows.mean() - 31.5) < 2  # left of the middle


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--headless"], "--headless needs --out"),
        (["--out", "x.png"], "--out needs --headless"),
        (["--headless", "--out", "x.jpg"], "PNG"),
        (["--headless", "--out", "x.png", "--clip", "dance"], "no clip 'dance'; it has: 0 bend"),
        (["--headless", "--out", "x.png", "--clip", "7"], "no clip 7"),
        (["--headless", "--out", "x.png", "--lod", "9"], "no level of detail 9"),
        (["--headless", "--out", "x.png", "--lod", "fine"], "neither auto nor a level"),
        (["--headless", "--out", "x.png", "--tessellation", "0"], "neither auto, off nor a number from 1 to 64"),
        (["--headless", "--out", "x.png", "--size", "0x5"], "sides must be 1 to"),
        (["--headless", "--out", "x.png", "--size", "big"], "not a size like"),
        (["--headless", "--out", "x.png", "--view", "xray"], "xray"),
        (["--headless", "--out", "x.png", "--fovy", "180"], "between 0 and 180"),
        (["--headless", "--out", "x.png", "--time", "nan"], "not a finite number"),
        (["--headless", "--out", "x.png", "--eye", "0", "1", "0", "--target", "0", "1", "0"], "same point"),
        (["--nonsense"], "nonsense"),
    ],
)
def test_faults_are_one_line_and_status_2(
    ball: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    arguments: list[str], message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main([str(ball), *arguments]) == 2
    error = capfd.readouterr().err
    assert message in error and error.startswith("viewer: ") and error.count("\n") == 1
    assert not list(tmp_path.glob("x.*"))


def test_folders_that_are_none_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "nothing"), "--headless", "--out", str(tmp_path / "x.png")]) == 2
    assert "no such folder" in capfd.readouterr().err


def test_orbiting_keeps_the_distance() -> None:
    orbit = Orbit(Camera((1.0, 2.0, 5.0), (0.0, 1.0, 0.0)))
    assert np.allclose(orbit.camera().eye, (1.0, 2.0, 5.0))
    orbit.turn(300, -90)
    camera = orbit.camera()
    assert np.linalg.norm(np.subtract(camera.eye, camera.target)) == pytest.approx(np.linalg.norm((1, 1, 5)))
    orbit.zoom(1)
    orbit.move(10, 0, 500)
    assert np.linalg.norm(np.subtract(orbit.camera().eye, orbit.camera().target)) < np.linalg.norm((1, 1, 5))


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.5])
@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 2, 1), (0, 1, 0), (0, -1, 0)])
def test_framing_shows_all_of_a_box_and_little_more(aspect: float, direction: tuple[float, float, float]) -> None:
    box = np.array([[-1.0, 0.0, -0.3], [2.0, 1.7, 0.4]])
    matrices = framing(box, aspect, direction=direction).matrices(int(200 * aspect), 200)
    corners = np.array(np.meshgrid(*box.T)).reshape(3, -1).T - matrices.eye
    clip = corners @ matrices.clip_from_world[:, :3].T + matrices.clip_from_world[:, 3]
    place = np.abs(clip[:, :2] / clip[:, 3:])
    assert (clip[:, 3] > 0).all() and 0.75 < place.max() <= 1.0 + 1e-6


def test_small_negative_coordinates_are_numbers() -> None:
    """argparse takes -1e-07 for an option; a character of a few micrometres needs it."""
    parser = Parser()
    add_arguments(parser)
    options = parser.parse_args(["--eye", "-1e-07", "-.5", "2E3", "--target", "-1", "-2.", "-3.5e+1"])
    assert list(options.eye) == [-1e-07, -0.5, 2000] and list(options.target) == [-1, -2, -35]
