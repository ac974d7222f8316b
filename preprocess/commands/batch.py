"""`python -m preprocess batch MODEL… -o DIR`: many characters, two at a time by default.

Each is built by its own process, so that one bad file costs nothing but itself.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from preprocess.commands.build_arguments import add_build_arguments
from preprocess.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Models, the folder for all results, and the options of a build."""
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="results go to DIR/STEM.seamless"
    )
    parser.add_argument(
        "-j", "--jobs", type=int, default=min(2, os.cpu_count() or 1), metavar="N", help="builds at a time"
    )
    add_build_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Build all; name those that failed.

    Raises
    ------
    InputError
        If models would share a result, the joblib package is missing, or some models could not be built.
    """
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise InputError('batch needs joblib: pip install "seamskin[batch]"') from None
    stems = [model.stem for model in arguments.models]
    doubled = sorted({stem for stem in stems if stems.count(stem) > 1})
    if doubled:
        raise InputError(f"two models are called {doubled[0]}: their results would be one folder; rename one")
    if arguments.jobs < 1:
        raise InputError(f"--jobs {arguments.jobs}: at least one build runs at a time")
    options = _passed_on(sys.argv)
    outcomes = Parallel(n_jobs=arguments.jobs, prefer="threads")(
        delayed(_build)(model, arguments.output / f"{model.stem}.seamless", options) for model in arguments.models
    )
    failed = [(model, text) for model, (status, text) in zip(arguments.models, outcomes) if status]
    for model, (status, text) in zip(arguments.models, outcomes):
        print(f"{model}: {'built' if status == 0 else text}", file=sys.stderr)
    if failed:
        raise InputError(f"{len(failed)} of {len(arguments.models)} models were not built, see above")
    return 0


def _passed_on(argv: list[str]) -> list[str]:
    """The build's own options among the program's arguments."""
    parser = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
    parser.add_argument("command")
    parser.add_argument("-o", "--output")
    parser.add_argument("-j", "--jobs")
    _, rest = parser.parse_known_args(argv[1:])
    flags = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
    add_build_arguments(flags)
    _, models = flags.parse_known_args(rest)
    return [word for word in rest if word not in models]


def _build(model: Path, destination: Path, options: list[str]) -> tuple[int, str]:
    """Exit status, and the last line the build said."""
    import subprocess

    command = [sys.executable, "-m", "preprocess", "build", str(model), "-o", str(destination), *options]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = done.stderr.strip().splitlines()
    return done.returncode, lines[-1] if lines else f"exit status {done.returncode}"
