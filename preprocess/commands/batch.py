"""`python -m preprocess batch MODEL… -o DIR`: many characters, two at a time by default.

Each is built by its own process, so that one bad file costs nothing but itself. When the batch is stopped it stops
those processes, waits until they have cleaned up, and says what was built and what was not.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from preprocess.commands.build_arguments import add_build_arguments
from preprocess.errors import InputError

PATIENCE_S = 20.0  # for a build that was asked to stop: its threads finish what they are at


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
        If models would share a result, or some models could not be built.
    KeyboardInterrupt
        When stopped, with what was built until then.
    """
    models: list[Path] = arguments.models
    stems = [model.stem for model in models]
    doubled = sorted({stem for stem in stems if stems.count(stem) > 1})
    if doubled:
        raise InputError(f"two models are called {doubled[0]}: their results would be one folder; rename one")
    if arguments.jobs < 1:
        raise InputError(f"--jobs {arguments.jobs}: at least one build runs at a time")
    builds = _Builds(_passed_on(sys.argv))
    pool = ThreadPoolExecutor(arguments.jobs)
    try:
        running = [pool.submit(builds.build, model, arguments.output / f"{model.stem}.seamless") for model in models]
        outcomes = [one.result() for one in running]
    except KeyboardInterrupt:
        builds.stop()
        pool.shutdown(cancel_futures=True)
        built = [one.result()[0] == 0 for one in running if one.done() and not one.cancelled()]
        raise KeyboardInterrupt(f"{sum(built)} of {len(models)} models were built and are whole") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    for model, (status, text) in zip(models, outcomes):
        print(f"{model}: {'built' if status == 0 else text}", file=sys.stderr)
    failed = sum(status != 0 for status, _ in outcomes)
    if failed:
        raise InputError(f"{failed} of {len(models)} models were not built, see above")
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


class _Builds:
    """Builds in processes of their own, which can be stopped together."""

    def __init__(self, options: list[str]) -> None:
        self._options = options
        self._running: set[subprocess.Popen[str]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def build(self, model: Path, destination: Path) -> tuple[int, str]:
        """Exit status, and the last line the build said."""
        command = [sys.executable, "-m", "preprocess", "build", str(model), "-o", str(destination), *self._options]
        with self._lock:
            if self._stopped:
                return 1, "not begun"
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            self._running.add(process)
        _, said = process.communicate()
        with self._lock:
            self._running.discard(process)
        lines = said.strip().splitlines()
        return process.returncode, lines[-1] if lines else f"exit status {process.returncode}"

    def stop(self) -> None:
        """Ask all builds to stop as Ctrl-C does, and wait; one that does not is killed."""
        with self._lock:
            self._stopped = True
            running = list(self._running)
        for process in running:
            process.terminate()
        for process in running:
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
