"""What measurements take and need, and the one line that says what to do where it is missing."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from runtime.asset.asset import Asset

ROOT = Path(__file__).resolve().parent.parent
ASSETS = ROOT.parent / "shared" / "assets"  # the test characters, where a person has them
BUILT = (ROOT / "out" / "benchmarks", ROOT / "out" / "demo")  # the second is what ./run demo builds
BUILT_HELP = "built characters (default: all in out/benchmarks, else the one of ./run demo)"
TO_BUILD = "build one with ./run demo, or python -m preprocess MODEL -o out/benchmarks/NAME.seamless"


def command_line(name: str, text: str | None) -> argparse.ArgumentParser:
    """The options of one measurement, without any yet; its module's text explains them."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


class MissingInput(Exception):
    """Something that a measurement needs is not there: one line that says what, and what to do."""


def built_characters(chosen: Sequence[Path] | None) -> list[Path]:
    """The folders asked for, or all there are.

    Raises
    ------
    MissingInput
        If one asked for is no built character, or none was asked for and there is none.
    """
    for folder in chosen or ():
        if not (folder / "manifest.json").is_file():
            raise MissingInput(f"no built character in {folder}: python -m preprocess MODEL -o {folder}")
    if chosen:
        return list(chosen)
    for place in BUILT:
        found = sorted(file.parent for file in place.glob("*.seamless/manifest.json"))
        if found:
            return found
    raise MissingInput(f"no built character in out/benchmarks: {TO_BUILD}")


def one_built_character(chosen: Path | None) -> Path:
    """The folder asked for, or `human` of all there are, or the first.

    Raises
    ------
    MissingInput
    """
    found = built_characters(None if chosen is None else [chosen])
    return next((folder for folder in found if folder.name == "human.seamless"), found[0])


def source_files(chosen: Sequence[Path] | None, names: Iterable[str], option: str) -> list[Path]:
    """The files asked for, or those test characters that are there; a line for each that is not.

    Parameters
    ----------
    chosen : files asked for, or nothing
    names : of test characters
    option : str
        What a person gives to name other files: "--models FILE".

    Raises
    ------
    MissingInput
        If a file asked for is not there, or no test character is.
    """
    for path in chosen or ():
        if not path.is_file():
            raise MissingInput(f"no such file: {path}")
    if chosen:
        return list(chosen)
    files = [ASSETS / name for name in names]
    found = [path for path in files if path.is_file()]
    for path in set(files) - set(found) if found else ():
        print(f"({path.name} is not in ../shared/assets: left out)")
    if not found:
        raise MissingInput(f"no test characters in ../shared/assets: name files with {option}")
    return found


def source_of(asset: Asset, sources: Path) -> Path | None:
    """The file a character was built from, among sources or beside what was built; if there is none, a line says so."""
    name = asset.manifest.json["source"]["file"]
    for folder in (sources, asset.path.resolve().parent):
        if (folder / name).is_file():
            result: Path | None = folder / name
            return result
    print(f"({asset.path.name} was built from {name}, which is not in {sources}: give --sources FOLDER)", flush=True)
    return None
