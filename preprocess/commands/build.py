"""`python -m preprocess MODEL [-o DIR]`: one character file to one folder."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from preprocess.commands.build_arguments import add_build_arguments, limits_from, settings_from
from preprocess.errors import InputError
from preprocess.files.output_folder import check_destination
from preprocess.progress import Progress
from runtime.errors import AssetError
from runtime.gltf.local_files import check_regular

if TYPE_CHECKING:
    from preprocess.pipeline import BuildResult

LOOK_AGAIN_S = 0.5  # with --watch


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a build."""
    parser.add_argument("model", type=Path, metavar="MODEL", help=".gltf, .glb or .vrm")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="default: MODEL's stem + .seamless")
    add_build_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print what was made as JSON on standard output")
    parser.add_argument("--watch", action="store_true", help="build again whenever the file changes, until interrupted")


def describe(destination: Path, result: BuildResult) -> dict[str, Any]:
    """What `--json` prints of a build."""
    return {
        "output": str(destination),
        "lods": [dataclasses.asdict(level) for level in result.lods],
        "warnings": list(result.warnings),
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.timings.items()},
    }


def _build_once(arguments: argparse.Namespace, destination: Path) -> None:
    from preprocess.pipeline import build  # numba and scipy take a second: the caller's line comes first

    result = build(arguments.model, destination, settings_from(arguments), Progress())
    for warning in result.warnings:
        print(f"  note: {warning}", file=sys.stderr)
    faces = " → ".join(str(level.faces) for level in result.lods)
    print(f"{destination}: {faces} faces, {sum(result.timings.values()):.1f} s", file=sys.stderr, flush=True)
    if arguments.json:
        print(json.dumps(describe(destination, result)), flush=True)


def _state(model: Path) -> dict[Path, tuple[int, int]]:
    """Time and size of the file and, for `.gltf`, of everything beside it: what a change is told by."""
    paths = [model] if model.suffix.lower() != ".gltf" else [path for path in model.parent.rglob("*") if path.is_file()]
    found = {}
    for path in paths:
        try:
            state = path.stat()
        except OSError:  # being replaced just now
            continue
        found[path] = (state.st_mtime_ns, state.st_size)
    return found


def _watch(arguments: argparse.Namespace, destination: Path) -> None:
    """Build at every change, once it has settled; a file that cannot be used is told, and waited for."""
    built: dict[Path, tuple[int, int]] = {}
    while True:
        before = _state(arguments.model)
        time.sleep(LOOK_AGAIN_S)
        if before == built or before != _state(arguments.model) or not before:
            continue
        built = before
        try:
            _build_once(arguments, destination)
        except InputError as error:
            print(f"preprocess: {error}", file=sys.stderr, flush=True)


def run(arguments: argparse.Namespace) -> int:
    """Build, and say where and how far it went.

    Raises
    ------
    InputError
        If the model or the destination is at fault.
    """
    model: Path = arguments.model
    try:
        check_regular(model, limits_from(arguments).file_bytes)
    except AssetError as error:
        raise InputError(error) from None
    destination: Path = arguments.output or Path(f"{model.stem}.seamless")
    check_destination(destination)
    print(f"{model.name} → {destination}", file=sys.stderr, flush=True)
    if arguments.watch:
        _watch(arguments, destination)
    _build_once(arguments, destination)
    return 0
