"""The program of measurements: names, options, what is missing, and the rows it writes."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest
from builders_erase import make_cube

from benchmarks import _inputs, crowd
from benchmarks.__main__ import main, subjects, summary
from preprocess.files.obj import write_obj

MAKE_THEIR_INPUT = {"closing", "pipeline"}  # measurements that run without any file at hand


def lines_of(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.strip().splitlines()


@pytest.mark.parametrize("name", subjects())
def test_every_measurement_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"benchmarks.{name}").run(["--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert f"python -m benchmarks {name}" in told and summary(name) in " ".join(told.split())


def test_help_lists_the_measurements(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    told = capsys.readouterr().out
    assert ended.value.code == 0 and all(f"  {name} " in told for name in subjects()) and "--json FILE" in told


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nothing"], "no benchmark is called 'nothing'"),
        (["straighten", "--nothing"], "unrecognized arguments: --nothing"),
        (["straighten", "atlas", "--mesh", "a.obj"], "--mesh is an option of one measurement"),
        (["--mesh", "a.obj"], "--mesh is an option of one measurement"),
    ],
)
def test_wrong_arguments_are_told(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2 and said in lines_of(capsys)[-1]


@pytest.mark.parametrize("name", sorted({*subjects()} - MAKE_THEIR_INPUT))
def test_on_a_fresh_clone_each_says_what_to_do(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither test characters nor anything built: one line, status 2, and the rows of the others are not lost."""
    monkeypatch.setattr(_inputs, "ASSETS", tmp_path / "assets")
    monkeypatch.setattr(_inputs, "BUILT", (tmp_path / "out", tmp_path / "demo"))
    monkeypatch.setattr(crowd, "SOURCE", tmp_path / "assets" / "human.glb")
    assert main([name, "--json", str(tmp_path / "rows.json")]) == 2
    (line,) = lines_of(capsys)
    assert line.startswith(f"{name}: no ") and ("./run demo" in line or "FILE" in line)
    assert json.loads((tmp_path / "rows.json").read_text())[name] == []


@pytest.mark.parametrize("name", ["accuracy", "cracks", "draw", "normals", "tessellation"])
def test_a_folder_that_is_no_character_is_named(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--built", str(tmp_path)]) == 2
    (line,) = lines_of(capsys)
    assert f"no built character in {tmp_path}: python -m preprocess MODEL -o {tmp_path}" in line


def test_a_file_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, option in (("atlas", "--character"), ("decimate", "--mesh"), ("levels", "--models"), ("erase", "--mesh")):
        assert main([name, option, str(tmp_path / "none.glb")]) == 2
        assert lines_of(capsys) == [f"{name}: no such file: {tmp_path / 'none.glb'}"]


def test_rows_are_written_with_the_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_obj(tmp_path / "cube.obj", make_cube())
    measured, file = ["straighten", "--mesh", str(tmp_path / "cube.obj")], tmp_path / "rows.json"
    assert main([*measured, "--json", str(file)]) == 0
    rows, told = json.loads(file.read_text()), capsys.readouterr().out.splitlines()
    assert told[0] == rows["machine"] and "Python" in told[0]
    assert len(rows["straighten"]) == len(told) - 2  # the machine and the table's head
    assert {row["faces"] for row in rows["straighten"]} == {12}
    assert main(["--json", str(file), *measured]) == 0
    assert len(json.loads(file.read_text())["straighten"]) == len(rows["straighten"])


def test_a_place_that_cannot_be_written_is_told_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["straighten", "--json", str(tmp_path / "none" / "rows.json")]) == 2
    assert lines_of(capsys) == [f"benchmarks: no folder to write {tmp_path / 'none' / 'rows.json'} in"]


def test_what_is_built_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a person built for it comes before the character of the demo; `human` before others."""
    mine, demo = tmp_path / "mine", tmp_path / "demo"
    monkeypatch.setattr(_inputs, "BUILT", (mine, demo))
    for folder in (demo / "creature.seamless", mine / "human.seamless", mine / "Fox.seamless"):
        folder.mkdir(parents=True)
    (demo / "creature.seamless" / "manifest.json").touch()
    assert _inputs.built_characters(None) == [demo / "creature.seamless"]
    for name in ("Fox", "human"):
        (mine / f"{name}.seamless" / "manifest.json").touch()
    assert _inputs.built_characters(None) == [mine / "Fox.seamless", mine / "human.seamless"]
    assert _inputs.one_built_character(None) == mine / "human.seamless"
    assert _inputs.one_built_character(demo / "creature.seamless") == demo / "creature.seamless"
