"""`python -m preprocess MODEL [-o DIR]`: one character file to one folder."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from preprocess.commands.build_arguments import add_build_arguments, settings_from
from preprocess.errors import InputError
from preprocess.files.output_folder import check_destination
from preprocess.progress import Progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a build."""
    parser.add_argument("model", type=Path, metavar="MODEL", help=".gltf, .glb or .vrm")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="default: MODEL's stem + .seamless")
    add_build_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Build, and say where and how far it went.

    Raises
    ------
    InputError
        If the model or the destination is at fault.
    """
    model: Path = arguments.model
    if not model.is_file():
        raise InputError(f"{model}: no such file: name a .gltf, .glb or .vrm file")
    destination: Path = arguments.output or Path(f"{model.stem}.seamless")
    check_destination(destination)
    print(f"{model.name} → {destination}", file=sys.stderr, flush=True)
    from preprocess.pipeline import build  # numba and scipy take a second: the line above comes first

    result = build(model, destination, settings_from(arguments), Progress())
    for warning in result.warnings:
        print(f"  note: {warning}", file=sys.stderr)
    faces = " → ".join(str(level.faces) for level in result.lods)
    print(f"{destination}: {faces} faces, {sum(result.timings.values()):.1f} s", file=sys.stderr)
    return 0
