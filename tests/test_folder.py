"""A result folder appears whole or not at all."""

import signal
import threading
import time
from pathlib import Path

import pytest

from preprocess.errors import InputError
from preprocess.files.output_folder import check_destination, check_not_input, whole_folder


def fill(folder: Path, text: str) -> None:
    (folder / "manifest.json").write_text(text)


def test_new_and_replaced(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "fox.seamless"
    for text in ("one", "two"):
        check_destination(target)
        with whole_folder(target) as folder:
            fill(folder, text)
        assert (target / "manifest.json").read_text() == text
        assert [p.name for p in target.parent.iterdir()] == ["fox.seamless"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failed_build_leaves_the_previous_result(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "fox.seamless"
    with whole_folder(target) as folder:
        fill(folder, "one")
    with pytest.raises(error), whole_folder(target) as folder:
        fill(folder, "two")
        raise error
    assert (target / "manifest.json").read_text() == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["fox.seamless"]


def test_other_files_are_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="name another folder"):
        check_destination(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        check_destination(tmp_path / "thesis.tex")


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_failed_swap_leaves_the_previous_result(
    tmp_path: Path, error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The moment between moving the old result away and the new one in."""
    target = tmp_path / "fox.seamless"
    with whole_folder(target) as folder:
        fill(folder, "one")
    rename = Path.rename

    def fail(path: Path, to: Path) -> Path:
        if ".partial-" in path.name:
            raise error
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(error), whole_folder(target) as folder:
        fill(folder, "two")
    assert (target / "manifest.json").read_text() == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["fox.seamless"]


def test_a_failed_build_leaves_no_folders_above(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match="bad"), whole_folder(tmp_path / "there" / "deep" / "deeper" / "a.seamless"):
        raise ValueError("bad")
    assert [p.name for p in tmp_path.rglob("*")] == ["there"]


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_polite_kill_or_a_closed_terminal_cleans_up(tmp_path: Path, name: str) -> None:
    number = getattr(signal, name, None)
    if number is None:
        pytest.skip(f"no {name} here")
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / "new" / "a"):
        signal.raise_signal(number)
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(number) == before


def test_ignored_signals_stay_ignored(tmp_path: Path) -> None:
    """nohup: a build goes on when its terminal closes."""
    if not hasattr(signal, "SIGHUP"):
        pytest.skip("no SIGHUP here")
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with whole_folder(tmp_path / "a") as folder:
            signal.raise_signal(signal.SIGHUP)
            (folder / "manifest.json").write_text("{}")
        assert (tmp_path / "a" / "manifest.json").is_file()
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


def test_an_interrupt_does_not_wait_for_other_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """A factorisation of a large system takes minutes and cannot be stopped from outside."""
    from preprocess.fit.textures import TextureStage

    release = threading.Event()

    def interrupt(self: TextureStage) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(TextureStage, "position", lambda self: release.wait(30))
    monkeypatch.setattr(TextureStage, "weights", lambda self: None)
    monkeypatch.setattr(TextureStage, "_normal", interrupt)
    start = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            object.__new__(TextureStage).build()
        assert time.monotonic() - start < 10
    finally:
        release.set()
