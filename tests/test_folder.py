"""A result folder appears whole or not at all."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from preprocess.errors import InputError
from preprocess.files.output_folder import atomic_folder, check_destination, check_not_input, describe_contents


def fill(folder: Path, text: str) -> None:
    """A result of ours that holds a text."""
    (folder / "mips").mkdir()
    (folder / "mips/text.txt").write_text(text)
    (folder / "manifest.json").write_text(json.dumps(describe_contents(folder)))


def text_of(folder: Path) -> str:
    return (folder / "mips/text.txt").read_text()


def test_new_and_replaced(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "fox.seamless"
    for text in ("one", "two"):
        check_destination(target)
        with atomic_folder(target) as folder:
            fill(folder, text)
        assert text_of(target) == text
        assert [p.name for p in target.parent.iterdir()] == ["fox.seamless"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failed_build_leaves_the_previous_result(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as folder:
        fill(folder, "one")
    with pytest.raises(error), atomic_folder(target) as folder:
        fill(folder, "two")
        raise error
    assert text_of(target) == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["fox.seamless"]


def test_other_files_are_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="name another folder"):
        check_destination(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        check_destination(tmp_path / "thesis.tex")


def refused(destination: Path, *words: str) -> None:
    """One line before any work, and the same from the folder itself."""
    for attempt in (lambda: check_destination(destination), lambda: atomic_folder(destination).__enter__()):
        with pytest.raises(InputError) as refusal:
            attempt()
        assert "\n" not in str(refusal.value) and all(word in str(refusal.value) for word in words)


@pytest.mark.parametrize(
    "manifest",
    [
        '{"name": "a web page", "start_url": "/"}',
        '{"manifest_version": 3, "files": {}}',
        '{"dependencies": {}}',
        '{"generator": "seamskin"}',
        '{"generator": "other", "files": {}}',
        "[]",
        "not even JSON",
    ],
)
def test_a_folder_with_somebody_elses_manifest_is_not_ours(tmp_path: Path, manifest: str) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site/manifest.json").write_text(manifest)
    refused(tmp_path / "site", "holds other files and no built character")
    assert (tmp_path / "site/manifest.json").read_text() == manifest


@pytest.mark.parametrize("name", ["notes.txt", "mips/notes.txt", "mine/notes.txt", "mips/text.txt.bak"])
def test_a_users_own_file_in_a_result_stops_the_next(tmp_path: Path, name: str) -> None:
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as folder:
        fill(folder, "one")
    (target / name).parent.mkdir(exist_ok=True)
    (target / name).write_text("years of work")
    refused(target, Path(name).parts[0], "none of the files that seamskin wrote there")
    (target / name).unlink()
    (target / ".DS_Store").write_text("nobody's work")
    (target / "report.html").write_text("ours, written after the manifest")
    if name.startswith("mine"):
        (target / "mine").rmdir()
    check_destination(target)


def test_a_users_file_that_comes_while_a_build_runs_is_safe_too(tmp_path: Path) -> None:
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as folder:
        fill(folder, "one")
    with pytest.raises(InputError, match=r"notes\.txt"), atomic_folder(target) as folder:
        fill(folder, "two")
        (target / "notes.txt").write_text("years of work")
    assert text_of(target) == "one" and [path.name for path in tmp_path.iterdir()] == ["fox.seamless"]


def test_links_and_the_folder_one_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as folder:
        fill(folder, "one")
    (tmp_path / "link").symlink_to(target)
    refused(tmp_path / "link", "is a link")
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    refused(tmp_path / "dangling", "is a link")
    (target / "inner").symlink_to(tmp_path)
    refused(target, "inner")
    (target / "inner").unlink()
    monkeypatch.chdir(target)
    for name in (".", "..", "mips/..", "", "/"):
        refused(Path(name), "the folder that you are in")
    refused(target / "mips/text.txt/deeper", "is a file")
    refused(target / "mips/text.txt", "is a file")


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path[:0] = [{root!r}, {tests!r}]
from test_folder import fill
from preprocess.files import output_folder
target = Path({target!r})
if {swapping}:
    rename = Path.rename
    def die(path, to):
        if ".partial-" in path.name:
            os.kill(os.getpid(), signal.SIGKILL)
        return rename(path, to)
    Path.rename = die
with output_folder.atomic_folder(target) as folder:
    fill(folder, "two")
    if not {swapping}:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("swapping", [False, True])
def test_what_a_killed_build_left_is_swept_by_the_next(tmp_path: Path, swapping: bool) -> None:
    """Also between moving the old result away and the new one in: then the old one is put back."""
    if not hasattr(signal, "SIGKILL"):
        pytest.skip("no SIGKILL here")
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as folder:
        fill(folder, "one")
    here = Path(__file__).resolve().parent
    code = KILLED.format(root=str(here.parent), tests=str(here), target=str(target), swapping=swapping)
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    assert any(path.name.startswith(".fox.seamless.partial-") for path in tmp_path.iterdir())
    with pytest.raises(ValueError, match="stop"), atomic_folder(target):
        raise ValueError("stop")
    assert [path.name for path in tmp_path.iterdir()] == ["fox.seamless"] and text_of(target) == "one"


def test_a_build_that_still_runs_is_not_swept(tmp_path: Path) -> None:
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as running:
        fill(running, "one")
        with atomic_folder(target) as second:
            fill(second, "two")
        assert running.is_dir() and text_of(target) == "two"
    assert text_of(target) == "one" and [path.name for path in tmp_path.iterdir()] == ["fox.seamless"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_failed_swap_leaves_the_previous_result(
    tmp_path: Path, error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The moment between moving the old result away and the new one in."""
    target = tmp_path / "fox.seamless"
    with atomic_folder(target) as folder:
        fill(folder, "one")
    rename = Path.rename

    def fail(path: Path, to: Path) -> Path:
        if ".partial-" in path.name:
            raise error
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(error), atomic_folder(target) as folder:
        fill(folder, "two")
    assert text_of(target) == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["fox.seamless"]


def test_a_failed_build_leaves_no_folders_above(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match="bad"), atomic_folder(tmp_path / "there" / "deep" / "deeper" / "a.seamless"):
        raise ValueError("bad")
    assert [p.name for p in tmp_path.rglob("*")] == ["there"]


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_polite_kill_or_a_closed_terminal_cleans_up(tmp_path: Path, name: str) -> None:
    number = getattr(signal, name, None)
    if number is None:
        pytest.skip(f"no {name} here")
    before = signal.signal(number, signal.SIG_DFL)  # whatever started the tests may ignore it: nohup
    try:
        with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "new" / "a"):
            signal.raise_signal(number)
        assert not list(tmp_path.iterdir())
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_ignored_signals_stay_ignored(tmp_path: Path) -> None:
    """nohup: a build goes on when its terminal closes."""
    if not hasattr(signal, "SIGHUP"):
        pytest.skip("no SIGHUP here")
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with atomic_folder(tmp_path / "a") as folder:
            signal.raise_signal(signal.SIGHUP)
            fill(folder, "one")
        assert text_of(tmp_path / "a") == "one"
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_input_is_never_the_output(tmp_path: Path) -> None:
    source, other = tmp_path / "a.png", tmp_path / "b.png"
    source.write_bytes(b"1")
    check_not_input(other, [source])
    other.write_bytes(b"2")
    check_not_input(other, [source, tmp_path / "missing.png"])
    with pytest.raises(InputError, match="is the input itself: name another place"):
        check_not_input(tmp_path / "." / "a.png", [other, source])
    link = tmp_path / "link.png"
    link.symlink_to(source)
    with pytest.raises(InputError, match="is the input itself"):
        check_not_input(link, [source])
