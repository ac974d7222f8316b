"""Arguments to settings; an input error to one line and exit status 2.

Heavy modules are imported only once their command is known, so that help and refusals come at once.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import io
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from preprocess.errors import InputError
from preprocess.files.output_folder import stops_as_interrupts
from preprocess.numerics.compile_progress import compile_quickly

# Command -> (module with add_arguments(parser) and run(arguments), one line of help)
COMMANDS = {
    "build": ("preprocess.commands.build", "build a character: .gltf, .glb or .vrm"),
    "info": ("preprocess.commands.info", "what a character file holds, and what will become of it"),
    "erase": ("preprocess.commands.erase", "erase the seams of images on a mesh"),
    "straighten": ("preprocess.commands.straighten", "straighten the seams of a mesh and warp its images"),
    "decimate": ("preprocess.commands.decimate", "simplify a mesh and keep its seams exact"),
    "batch": ("preprocess.commands.batch", "build many characters"),
    "check": ("preprocess.commands.check", "measure a built character again, from its files alone"),
}
# Errors of the operating system that no file and no program is to blame for -> what to do.
SURROUNDINGS = {
    errno.ENOSPC: "make room, or name a folder on another disk with -o",
    errno.EDQUOT: "make room, or name a folder on another disk with -o",
    errno.EROFS: "name another folder with -o",
    errno.EACCES: "change its permissions, or name another folder with -o",
    errno.EPERM: "change its permissions, or name another folder with -o",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "allow more open files (ulimit -n)",
}
EXTRA = ("scipy", "numba", "pygltflib", "rich", "mapbox_earcut")  # what `pip install seamskin` alone leaves out
USAGE = "python -m preprocess MODEL [-o DIR] [options]   or   python -m preprocess COMMAND ... (see -h)"


class _Parser(argparse.ArgumentParser):
    """An argument parser whose refusals are one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}: see {self.prog} -h")


def main(arguments: Sequence[str]) -> int:
    """Run the command line.

    Returns
    -------
    int
        0 done, 1 a fault of ours (with a traceback), 2 a bad input or argument (one line on stderr).
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a console that lacks an arrow shows a question mark instead
            stream.reconfigure(errors="replace")
    compile_quickly()
    try:
        # NumPy's warnings are of values that a stage deals with: the lines here are ours.
        with warnings.catch_warnings(action="ignore"), stops_as_interrupts():
            status = _run(list(arguments))
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read our lines has seen enough: `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except InputError as error:
        return _refuse(str(error))
    except KeyboardInterrupt as interrupt:  # a command that has written something says what
        print(f"preprocess: interrupted; {str(interrupt) or 'nothing was written'}", file=sys.stderr)
        return 130
    except Exception as error:
        surroundings = _name_surroundings(error)
        if surroundings:
            return _refuse(surroundings)
        traceback.print_exc()
        print("preprocess: this is a fault of seamskin, not of your file; please report it", file=sys.stderr)
        return 1


def _refuse(text: str) -> int:
    print(f"preprocess: {' '.join(text.split())}", file=sys.stderr)
    return 2


def _name_surroundings(error: Exception) -> str | None:
    """What the machine lacks, where that and no fault of the program stopped it; else None."""
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRA:
        return f'the offline tools need {error.name}: pip install "seamskin[preprocess]"'
    if isinstance(error, MemoryError):
        return "not enough memory: choose smaller sizes, or build on a larger machine"
    if isinstance(error, OSError) and error.errno in SURROUNDINGS:
        name = f"{Path(error.filename).name}: " if isinstance(error.filename, str) else ""
        return f"{name}{error.strerror}: {SURROUNDINGS[error.errno]}"
    return None


def _run(arguments: list[str]) -> int:
    name = "build"
    if arguments and arguments[0] in COMMANDS:
        name = arguments.pop(0)
    elif not arguments:
        raise InputError("no model: " + USAGE)
    elif arguments[0] in ("-h", "--help"):
        _print_help()
        return 0
    elif arguments[0] == "--version":
        print(f"seamskin {version('seamskin')}")
        return 0
    module: Any = importlib.import_module(COMMANDS[name][0])
    prog = "python -m preprocess" + ("" if name == "build" else f" {name}")
    parser = _Parser(prog=prog, description=COMMANDS[name][1], allow_abbrev=False)
    module.add_arguments(parser)
    parsed = parser.parse_args(arguments)
    if getattr(parsed, "verbose", False):
        logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
    status = module.run(parsed)
    return int(status or 0)


def _print_help() -> None:
    print(f"usage: {USAGE}\n")
    for name, (_, description) in COMMANDS.items():
        print(f"  {name:<12}{description}")
    print("\nbuild is the default: a first argument that is no command is a model.")
    print("python -m preprocess COMMAND -h shows a command's options.")
