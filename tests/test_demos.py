"""The gallery's steps and page, pictures set side by side, the comparison of before and after."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from demos import compare, gallery
from demos.before import find_source
from demos.errors import DemoError
from demos.gallery import PICTURES, Step, plan, run_steps, write_page
from demos.pictures import PAPER, label, side_by_side
from runtime.asset.asset import load
from tests.builders_asset import build_ball


def make_step(path: Path, made: list[str], name: str, after: list[Step] | None = None) -> Step:
    def make() -> None:
        made.append(name)
        path.write_text(name)

    return Step(name, (path,), ("demos/errors.py",), make, after or [])


def test_steps_are_made_once_and_again_when_their_results_are_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[str] = []
    first = make_step(tmp_path / "a", made, "first")
    second = make_step(tmp_path / "b", made, "second", [first])
    run_steps([first, second], tmp_path, force=False)
    run_steps([first, second], tmp_path, force=False)
    assert made == ["first", "second"]
    assert "up to date" in capsys.readouterr().out
    (tmp_path / "b").unlink()
    run_steps([first, second], tmp_path, force=False)
    assert made == ["first", "second", "second"]
    run_steps([first, second], tmp_path, force=True)
    assert made[3:] == ["first", "second"]
    (tmp_path / gallery.STAMPS).write_text("{cut short")
    run_steps([first, second], tmp_path, force=False)
    assert made[5:] == ["first", "second"]


def test_a_step_depends_on_its_sources_and_on_earlier_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "ROOT", tmp_path)
    source = tmp_path / "demos" / "errors.py"
    source.parent.mkdir()
    source.write_text("one")
    first = make_step(tmp_path / "a", [], "first")
    second = make_step(tmp_path / "b", [], "second", [first])
    before = first.stamp(), second.stamp()
    source.write_text("two")
    after = first.stamp(), second.stamp()
    assert before[0] != after[0] and before[1] != after[1] and after[0] != after[1]


def test_a_step_that_fails_is_tried_again(tmp_path: Path) -> None:
    def fail() -> None:
        raise DemoError("no")

    step = Step("fails", (tmp_path / "a",), (), fail)
    for _ in range(2):
        with pytest.raises(DemoError):
            run_steps([step], tmp_path, force=False)


def test_the_plan_names_every_picture_of_the_page(tmp_path: Path) -> None:
    creature, pipeline, pictures = plan(tmp_path)
    assert creature.results[0].suffix == ".glb" and pipeline.results[0].name == "manifest.json"
    assert {path.name for path in pictures.results} == {"index.html", *(file for file, _, _ in PICTURES)}
    assert pictures.after == [pipeline] and pipeline.after == [creature]


def test_the_page_shows_all_pictures_and_the_figures(tmp_path: Path) -> None:
    seam = {"before": {"rms": 0.25, "max": 0.5}, "after": {"rms": 0, "max": 0}, "stored": [{"rms": 1e-3, "max": 2e-3}]}
    manifest = {
        "lods": [{"faces": 1234}, {"faces": 56}],
        "joints": ["a", "b"],
        "atlas": {"charts": 7, "mode": "<keep>"},
        "textures": {"base_color": {"size": [64, 32], "format": "uint8", "seam": seam}},
    }
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    write_page(tmp_path, tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert all(f'src="{file}"' in page for file, _, _ in PICTURES)
    assert "1,234" in page and "64 × 32" in page and "2.50e-01" in page and "&lt;keep&gt;" in page


def test_a_bad_folder_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert gallery.main(["--out", str(tmp_path / "file" / "folder")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_pictures_stand_in_rows_on_paper() -> None:
    red, blue = np.zeros((10, 20, 3), np.uint8), np.zeros((10, 6, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    sheet = side_by_side([[red, red], [blue]], gap_px=4)
    assert sheet.shape == (24, 44, 3)
    assert (sheet[:10, :20] == red).all() and (sheet[:10, 24:] == red).all() and (sheet[10:14] == PAPER).all()
    assert (sheet[14:, 19:25] == blue).all() and (sheet[14:, :19] == PAPER).all()


def test_a_label_is_written_in_the_lower_left_corner() -> None:
    picture = np.full((60, 200, 3), 255, np.uint8)
    written = label(picture, "1,234 faces", size_px=16)
    changed = np.argwhere((written != picture).any(axis=2))
    assert len(changed) > 50 and changed[:, 0].min() > 25 and changed[:, 1].max() < 150
    assert (picture == 255).all()


def test_comparison_without_a_source_shows_the_levels(tmp_path: Path) -> None:
    folder = tmp_path / "ball.seamless"
    build_ball(folder)
    asset = load(folder)
    assert find_source(asset) is None
    picture = tmp_path / "sheet.png"
    assert compare.main([str(folder), "--headless", "--out", str(picture), "--size", "400x300"]) == 0
    from preprocess.files.images import read_image

    texels = read_image(picture).texels
    assert texels.shape[1] <= 400 and texels.shape[0] <= 310
    assert texels.std() > 0.05


@pytest.mark.parametrize(
    "arguments",
    [
        ["--headless", "--out", "x.png", "--seam", "-1"],
        ["--headless", "--out", "x.png", "--source", "missing.glb"],
        ["--headless"],
        ["--lod", "coarse"],
    ],
)
def test_comparison_refuses_in_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main(["somewhere", *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1
