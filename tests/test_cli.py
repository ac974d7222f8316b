"""The command line from outside: results whole or not at all, refusals in one line with status 2."""

from __future__ import annotations

import errno
import itertools
import json
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from builders_gltf import bent_bar
from conftest import ROOT, asset

from preprocess import cli
from runtime.asset.manifest import SCHEMA
from runtime.gltf.document import read_document


def preprocess(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "preprocess", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """Status 2, and a last line that says the words; no traceback."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("preprocess: ")
    for word in words:
        assert word in last


def write_glb(path: Path, document: dict[str, object]) -> Path:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(
        struct.pack("<III", 0x46546C67, 2, 20 + len(text)) + struct.pack("<II", len(text), 0x4E4F534A) + text
    )
    return path


def test_help_is_quick_and_names_every_command() -> None:
    done = preprocess("--help")
    assert done.returncode == 0
    for name in ("build", "erase", "straighten", "decimate", "batch", "check"):
        assert name in done.stdout


@pytest.mark.parametrize("command", ["build", "erase", "straighten", "decimate", "batch", "check"])
def test_every_command_explains_itself(command: str) -> None:
    done = preprocess(command, "--help")
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--lods", "0.5,0.7"], ["ratios must fall"]),
        (["--geometry-size", "5"], ["8 to 8192"]),
        (["--straighten", "2"], ["tolerance"]),
        (["--atlas", "magic"], ["invalid choice"]),
        (["--frobnicate"], ["unrecognized"]),
    ],
)
def test_bad_arguments(tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    refused(preprocess("x.glb", "-o", tmp_path / "out", *arguments), *words)
    assert not (tmp_path / "out").exists()


def test_bad_files_write_nothing(tmp_path: Path) -> None:
    refused(preprocess(tmp_path / "missing.glb", "-o", tmp_path / "out"), "no such file")
    text = tmp_path / "text.glb"
    text.write_text("this is no model")
    refused(preprocess(text, "-o", tmp_path / "out"), "text.glb")
    empty = write_glb(tmp_path / "empty.glb", {"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], "scene": 0})
    refused(preprocess(empty, "-o", tmp_path / "out"), "empty.glb", "mesh")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.glb", "text.glb"]


def test_other_peoples_folders_are_safe(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    refused(preprocess(asset("Fox.glb"), "-o", tmp_path), "other files")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_one_file_a_level(tmp_path: Path) -> None:
    """Each file holds its level alone with the whole skeleton and all clips, and finds the folder's textures."""
    bar = bent_bar(tmp_path / "bar.glb")
    done = preprocess(bar, "-o", tmp_path / "out", "--lods", "0.5", "--separate-lods", "--color-size", "32")
    assert done.returncode == 0, done.stderr
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["model_files"] == [f"model_LOD{i}.glb" for i in range(len(manifest["lods"]))]
    assert [level["faces"] for level in manifest["lods"]] == [32, 16]  # the full mesh needs not be asked for
    together = read_document(tmp_path / "out" / "model.glb")
    for file, level in zip(manifest["model_files"], manifest["lods"]):
        alone = read_document(tmp_path / "out" / file)
        assert [node["name"] for node in alone.items("nodes") if "mesh" in node] == [level["node"]]
        (primitive,) = alone.items("meshes")[0]["primitives"]
        assert len(alone.accessor(primitive["indices"])) == 3 * level["faces"]
        assert len(alone.items("skins")[0]["joints"]) == len(manifest["joints"])
        clips = [[clip["name"] for clip in document.items("animations")] for document in (alone, together)]
        assert clips[0] == clips[1] == ["bend"]
        assert all((tmp_path / "out" / image["uri"]).is_file() for image in alone.items("images"))


def test_levels_below_the_floor_are_missed_aloud(tmp_path: Path) -> None:
    """Two triangles with four corners are all that a flat bar's outline allows."""
    done = preprocess(
        bent_bar(tmp_path / "bar.glb"), "-o", tmp_path / "out", "--lods", "0.5,0.03", "--color-size", "32"
    )
    assert done.returncode == 0, done.stderr
    warnings = json.loads((tmp_path / "out" / "manifest.json").read_text())["warnings"]
    assert any("levels end at 2 faces, not 1" in warning for warning in warnings)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Fox.glb", "human.glb", "Knight.glb", "robot.glb", "mannequiny.glb"])
def test_a_built_character_measures_as_it_claims(name: str, built: Callable[[str], Path]) -> None:
    folder = built(name)
    done = preprocess("check", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["schema"] == SCHEMA
    assert manifest["atlas"]["overlap"] == 0
    floor = manifest["atlas"]["exact_floor_faces"]  # None where the chain ends above it because the error is too large
    exact = min(lod["faces"] for lod in manifest["lods"] if lod["exact"])
    assert floor is None or 0 < floor <= exact  # a report, no condition: below it relaxed levels carry on
    errors = [lod["error_m"] for lod in manifest["lods"]]
    assert all(a <= b for a, b in itertools.pairwise(errors))
    for texture in manifest["textures"].values():
        stored = texture["seam"]["stored"]
        assert len(stored) == texture["mips"]
        if texture["format"] == "uint8" and texture["mips"] > 1:
            assert max(level["max"] for level in stored) <= 0.5 / 255 + 1e-9
    assert (folder / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_check_refuses_a_changed_folder(built: Callable[[str], Path], tmp_path: Path) -> None:
    import shutil

    import numpy as np

    from preprocess.files.images import Image, read_image, write_image
    from preprocess.files.output_folder import hash_file

    folder = tmp_path / "Fox.seamless"
    shutil.copytree(built("Fox.glb"), folder)
    image = read_image(folder / "base_color.png")
    noise = np.random.default_rng(1).uniform(-0.2, 0.2, image.texels.shape)
    write_image(folder / "base_color.png", Image(np.clip(image.texels + noise, 0, 1), "uint8"))
    refused(preprocess("check", folder), "not sound: base_color.png was changed")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["base_color.png"] = hash_file(folder / "base_color.png")  # the measures alone tell too
    (folder / "manifest.json").write_text(json.dumps(manifest))
    refused(preprocess("check", folder), "not sound: base_color level 0: seams jump by")


@pytest.mark.slow
def test_batch_builds_all_and_names_the_bad_one(tmp_path: Path) -> None:
    bad = tmp_path / "bad.glb"
    bad.write_text("no")
    options = ["--color-size", "64", "--lods", "0.6"]
    done = preprocess("batch", asset("Fox.glb"), bad, "-o", tmp_path / "out", "-j", "2", *options)
    refused(done, "1 of 2")
    assert (tmp_path / "out" / "Fox.seamless" / "manifest.json").is_file()
    assert not (tmp_path / "out" / "bad.seamless").exists()


def test_limits_are_options(tmp_path: Path) -> None:
    bar = bent_bar(tmp_path / "bar.glb")
    refused(preprocess(bar, "-o", tmp_path / "out", "--limit", "triangles=10"), "more than 10 triangles")
    refused(preprocess(bar, "-o", tmp_path / "out", "--limit", "file_bytes=9"), "more than 9")
    refused(preprocess(bar, "-o", tmp_path / "out", "--limit", "magic=9"), "NAME=VALUE with one of number")


def test_a_pipe_is_told_from_a_missing_file(tmp_path: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("no named pipes here")
    os.mkfifo(tmp_path / "bar.glb")
    refused(preprocess(tmp_path / "bar.glb", "-o", tmp_path / "out"), "it is a pipe: save its content as a file")
    refused(preprocess(tmp_path, "-o", tmp_path / "out"), "it is a folder")


@pytest.mark.slow
def test_a_batch_that_is_stopped_ends_its_builds_and_says_what_is_there(tmp_path: Path) -> None:
    """SIGTERM while one of two builds runs: no process goes on, no partial folder stays, nothing is claimed wrongly."""
    models = [bent_bar(tmp_path / f"{name}.glb") for name in ("a", "b")]
    out = tmp_path / "out"
    command = [sys.executable, "-m", "preprocess", "batch", *map(str, models), "-o", str(out), "-j", "1"]
    batch = subprocess.Popen([*command, "--lods", "0.6"], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    while not list(out.glob(".a.seamless.partial-*")):
        assert batch.poll() is None
        time.sleep(0.01)
    batch.terminate()
    _, said = batch.communicate(timeout=60)
    assert batch.returncode == 130
    whole = sorted(path.name for path in out.iterdir()) if out.exists() else []
    assert whole in ([], ["a.seamless"])
    assert said.splitlines()[-1] == f"preprocess: interrupted; {len(whole)} of 2 models were built and are whole"


def full_disk(folder: Path) -> OSError:
    return OSError(errno.ENOSPC, "No space left on device", str(folder / "model.glb"))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (full_disk(Path("somewhere")), ["model.glb: No space left on device: make room"]),
        (MemoryError(), ["not enough memory"]),
        (ModuleNotFoundError("No module named 'numba'", name="numba"), ['pip install "seamskin[preprocess]"']),
        (PermissionError(errno.EACCES, "Permission denied"), ["Permission denied", "permissions"]),
    ],
)
def test_what_the_machine_lacks_is_no_fault_of_the_program(
    error: Exception, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(arguments: list[str]) -> int:
        raise error

    monkeypatch.setattr(cli, "_run", fail)
    assert cli.main(["x.glb"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for word in words:
        assert word in said


def test_a_fault_of_ours_is_told_from_a_bad_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(arguments: list[str]) -> int:
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "_run", fail)
    assert cli.main(["x.glb"]) == 1
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_no_arguments_and_the_version() -> None:
    refused(preprocess(), "no model")
    done = preprocess("--version")
    assert done.returncode == 0 and done.stdout.startswith("seamskin ")
