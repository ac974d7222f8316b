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
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from preprocess.errors import InputError
from preprocess.folder import stops_as_interrupts
from preprocess.kernels import compile_quickly
from preprocess.settings import Settings

# Command -> (module with add_arguments(parser) and run(arguments), one line of help)
COMMANDS = {
    "build": ("preprocess.build_command", "build a character: .gltf, .glb or .vrm"),
    "erase": ("preprocess.erase.command", "erase the seams of images on a mesh"),
    "straighten": ("preprocess.straighten.command", "straighten the seams of a mesh and warp its images"),
    "decimate": ("preprocess.decimate.command", "simplify a mesh and keep its seams exact"),
    "batch": ("preprocess.batch_command", "build many characters"),
    "check": ("preprocess.check", "measure a built character again, from its files alone"),
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
EXTRA = ("scipy", "numba", "pygltflib", "rich")  # what `pip install seamskin` alone leaves out
USAGE = "python -m preprocess MODEL [-o DIR] [options]   or   python -m preprocess COMMAND ... (see -h)"


class _Parser(argparse.ArgumentParser):
    """An argument parser whose refusals are one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}: see {self.prog} -h")


def size(text: str) -> int | None:
    """A texture's side in texels, or None for "auto"."""
    if text == "auto":
        return None
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 8 <= value <= 8192:
        raise argparse.ArgumentTypeError(f"a size is auto or 8 to 8192 texels, not {text!r}")
    return value


def tolerance(text: str) -> float | None:
    """A straightening tolerance, or None for "off"."""
    if text == "off":
        return None
    return _fraction(text, "a tolerance is off or a fraction between 0 and 0.5")


def border(text: str) -> float | None:
    """A painted border's threshold, or None for "off"."""
    if text == "off":
        return None
    return _fraction(text, "a threshold is off or a fraction between 0 and 1")


def ratios(text: str) -> tuple[float, ...] | None:
    """Ratios of the levels of detail, or None for "auto"."""
    if text == "auto":
        return None
    values = tuple(
        _fraction(part, "ratios are auto or fractions between 0 and 1 such as 0.5,0.25") for part in text.split(",")
    )
    if any(b >= a for a, b in zip((1.0, *values), values)):
        raise argparse.ArgumentTypeError(f"ratios must fall from below 1, not {text!r}")
    return values


def fraction(text: str) -> float:
    """A fraction between 0 and 1."""
    return _fraction(text, "a fraction between 0 and 1 is needed")


def _fraction(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"{what}, not {text!r}")
    return value


def add_build_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a build, shared by `build` and `batch`."""
    default = Settings()
    parser.add_argument("--atlas", choices=["auto", "keep", "repack", "unwrap"], default=default.atlas)
    parser.add_argument(
        "--straighten",
        type=tolerance,
        default=default.straighten_rel,
        metavar="TOL|off",
        help="how far seams may move, a fraction of a chart's box (default 0.01)",
    )
    parser.add_argument("--seams", choices=["local", "global"], default=default.seams)
    for name in ("geometry", "weight", "color"):
        parser.add_argument(f"--{name}-size", type=size, default=None, metavar="auto|N", help="texels a side")
    parser.add_argument(
        "--lods", type=ratios, default=None, metavar="auto|R,R,…", help="levels below the full mesh, as fractions of it"
    )
    parser.add_argument(
        "--floor",
        type=fraction,
        default=default.floor_rel,
        metavar="R",
        help="fraction of the faces the coarsest exact level must reach (default 0.03)",
    )
    parser.add_argument("--exact", action="store_true", help="leave out levels with relaxed seams")
    parser.add_argument(
        "--influences", type=int, choices=[4, 8], default=default.influences, help="joints a vertex in model.glb"
    )
    parser.add_argument(
        "--separate-lods", action="store_true", help="also write every level of detail as a file of its own"
    )
    parser.add_argument(
        "--keep-borders",
        type=border,
        default=default.keep_borders,
        metavar="T|off",
        help="leave colour seams whose sides differ by more than T of the range: painted borders (default 0.15)",
    )
    parser.add_argument("--report", action="store_true", help="write report.html")
    parser.add_argument("-v", "--verbose", action="store_true", help="log what each stage does")


def settings_from(arguments: argparse.Namespace) -> Settings:
    """Parsed arguments as settings."""
    return Settings(
        atlas=arguments.atlas,
        straighten_rel=arguments.straighten,
        seams=arguments.seams,
        geometry_size_px=arguments.geometry_size,
        weight_size_px=arguments.weight_size,
        color_size_px=arguments.color_size,
        lod_ratios=arguments.lods,
        floor_rel=arguments.floor,
        exact=arguments.exact,
        influences=arguments.influences,
        separate_lods=arguments.separate_lods,
        keep_borders=arguments.keep_borders,
        report=arguments.report,
    )


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
        with stops_as_interrupts():
            status = _run(list(arguments))
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read our lines has seen enough: `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except InputError as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        print("preprocess: interrupted; nothing was written", file=sys.stderr)
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
