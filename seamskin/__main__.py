"""The command `seamskin`: the offline tools and the demos by one name (`seamskin build human.glb`)."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
import threading
from collections.abc import Sequence

from preprocess.cli import COMMANDS

# Command -> (module with main(arguments), one line of help)
PICTURES = {
    "view": ("demos.viewer", "look at a built character, in a window or as a picture"),
    "crowd": ("demos.crowd", "thousands of it"),
    "compare": ("demos.compare", "before and after, levels of detail side by side"),
}


def print_help() -> None:
    """Every command with its line."""
    print("usage: seamskin COMMAND ...\n")
    for name, (_, description) in {**COMMANDS, **PICTURES}.items():
        print(f"  {name:<12}{description}")
    print("\nseamskin COMMAND -h shows a command's options; seamskin --version the version.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 done, 1 a fault of ours, 2 a bad input or argument.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print_help()
        return 0 if given else 2
    if given[0] in PICTURES:
        return int(importlib.import_module(PICTURES[given[0]][0]).main(given[1:]))
    if given[0] in COMMANDS or given[0] == "--version":
        from preprocess.cli import main as run

        return run(given)
    near = difflib.get_close_matches(given[0], [*COMMANDS, *PICTURES], 1)
    hint = f"did you mean {near[0]}?" if near else "see seamskin -h"
    print(f"seamskin: no command {given[0]!r}: {hint}", file=sys.stderr)
    return 2


def run_and_leave() -> None:
    """Entry of the console script: its status becomes the process's."""
    status = main()
    if threading.active_count() > 1:  # a stage that was stopped has threads that may go on for minutes
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    run_and_leave()
