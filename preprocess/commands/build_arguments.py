"""The options of a build on the command line, shared by `build` and `batch`, and the settings they make."""

from __future__ import annotations

import argparse
import dataclasses

from preprocess.settings import Settings
from runtime.gltf.limits import LIMITS, Limits

LIMIT_NAMES = tuple(field.name for field in dataclasses.fields(Limits))


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


def limit(text: str) -> tuple[str, float]:
    """One of the limits and its value, from NAME=VALUE."""
    name, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if name not in LIMIT_NAMES or not 0 < value < 1e300:
        raise argparse.ArgumentTypeError(f"NAME=VALUE with one of {', '.join(LIMIT_NAMES)}, not {text[:80]!r}")
    return name, value


def add_limit_argument(parser: argparse.ArgumentParser) -> None:
    """The option for what a file may say or ask for."""
    parser.add_argument(
        "--limit",
        type=limit,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="most that the file may say or ask for: " + ", ".join(LIMIT_NAMES),
    )


def limits_from(arguments: argparse.Namespace) -> Limits:
    """The limits with those that were given."""
    kinds = {name: type(value) for name, value in dataclasses.asdict(LIMITS).items()}
    return dataclasses.replace(LIMITS, **{name: kinds[name](value) for name, value in arguments.limit})


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
        help="fraction of the faces the coarsest exact level should reach, a wish (default 0.03)",
    )
    parser.add_argument("--exact", action="store_true", help="leave out levels with relaxed seams")
    parser.add_argument(
        "--influences", type=int, choices=[4, 8], default=default.influences, help="joints a vertex in model.glb"
    )
    parser.add_argument(
        "--separate-lods", action="store_true", help="also write every level of detail as a file of its own"
    )
    parser.add_argument(
        "--ktx2", action="store_true", help="also write textures with their mip levels as KTX2, for other engines"
    )
    parser.add_argument(
        "--keep-borders",
        type=border,
        default=default.keep_borders,
        metavar="T|off",
        help="leave colour seams whose sides differ by more than T of the range: painted borders (default 0.15)",
    )
    parser.add_argument("--report", action="store_true", help="write report.html")
    add_limit_argument(parser)
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
        ktx2=arguments.ktx2,
        keep_borders=arguments.keep_borders,
        report=arguments.report,
        limits=limits_from(arguments),
    )
