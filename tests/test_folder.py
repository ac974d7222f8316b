"""A result folder appears whole or not at all."""

from pathlib import Path

import pytest

from preprocess.errors import InputError
from preprocess.folder import check_destination, whole_folder


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
