"""Command-line arguments that every demo shares: what to draw, from where, at which level; window or picture."""

from __future__ import annotations

import argparse
import io
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from demos.errors import DemoError
from demos.extras import missing_package
from demos.model_cache import built_folder
from runtime.errors import AssetError, RenderError

VIEW_NAMES = ("lit", "base_color", "normal", "position", "weights", "lod", "wireframe", "seams", "mask")
MAX_SIDE_PX = 16384


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and for which -1e-6 is a number and no option."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage."""
        raise DemoError(f"{message} (see --help)")


@dataclass(frozen=True)
class Options:
    """What every demo is told.

    Attributes
    ----------
    folder : Path or None
        Built character; None: the demo's own choice.
    headless, out, size : bool, Path or None, (int, int)
    clip : str, int or None
        Name or number; None: rest pose in pictures, the first clip in windows.
    time_s : float
    lod : "auto" or int
    tessellation : "auto", "off" or float
    eye, target : three floats or None
    fovy_deg : float
    view : str
    backdrop : bool
        Whether lit pictures have a ground and a sky.
    panel : bool
        Whether windows have a panel, where the demo has one.
    """

    folder: Path | None
    headless: bool
    out: Path | None
    size: tuple[int, int]
    clip: str | int | None
    time_s: float
    lod: str | int
    tessellation: str | float
    eye: tuple[float, float, float] | None
    target: tuple[float, float, float] | None
    fovy_deg: float
    view: str
    backdrop: bool
    panel: bool = True


def picture_size(text: str) -> tuple[int, int]:
    """Width and height from WxH."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 1024x1024")
    width, height = int(parts[0]), int(parts[1])
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise argparse.ArgumentTypeError(f"{text!r}: sides must be 1 to {MAX_SIDE_PX} pixels")
    return width, height


def level(text: str) -> str | int:
    """`auto` or the number of a level of detail."""
    if text == "auto":
        return text
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is neither auto nor a level of detail, 0 being the finest")
    return int(text)


def tessellation(text: str) -> str | float:
    """`auto`, `off` or how often every edge is divided."""
    if text in ("auto", "off"):
        return text
    value = finite(text)
    if not 1.0 <= value <= 64.0:
        raise argparse.ArgumentTypeError(f"{text!r} is neither auto, off nor a number from 1 to 64")
    return value


def finite(text: str) -> float:
    """A number that is neither infinite nor NaN."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def field_of_view(text: str) -> float:
    """Degrees between 0 and 180."""
    value = finite(text)
    if not 0.0 < value < 180.0:
        raise argparse.ArgumentTypeError(f"{text!r}: the field of view lies between 0 and 180 degrees")
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments that all demos have."""
    parser.add_argument(
        "folder",
        nargs="?",
        type=Path,
        metavar="DIR|MODEL",
        help="a built character, or a .glb, .gltf or .vrm file, which is built once (default: the built-in character)",
    )
    parser.add_argument("--headless", action="store_true", help="draw one picture without a window")
    parser.add_argument("--out", type=Path, metavar="FILE.png", help="where the picture goes (with --headless)")
    parser.add_argument("--size", type=picture_size, default=(1024, 1024), metavar="WxH", help="pixels (1024x1024)")
    parser.add_argument("--clip", metavar="NAME|INDEX", help="what to play")
    parser.add_argument("--time", type=finite, default=0.0, metavar="S", help="moment of the clip, seconds (0)")
    parser.add_argument(
        "--lod", type=level, default="auto", metavar="auto|N", help="level of detail, 0 the finest (auto)"
    )
    parser.add_argument("--tessellation", type=tessellation, metavar="auto|off|N",
                        help="divide triangles on the GPU (auto; off where --lod names a level)")  # fmt: skip
    parser.add_argument("--eye", type=finite, nargs=3, metavar=("X", "Y", "Z"), help="where the camera stands, metres")
    parser.add_argument("--target", type=finite, nargs=3, metavar=("X", "Y", "Z"), help="what it looks at, metres")
    parser.add_argument("--fovy", type=field_of_view, default=35.0, metavar="DEG", help="vertical field of view (35)")
    parser.add_argument(
        "--view", choices=VIEW_NAMES, default="lit", metavar="VIEW", help=", ".join(VIEW_NAMES) + " (lit)"
    )
    parser.add_argument("--no-backdrop", action="store_true", help="transparent background in lit pictures")
    parser.add_argument("--no-panel", action="store_true", help="a window without its panel")


def options_of(arguments: argparse.Namespace) -> Options:
    """Parsed arguments as options, checked against each other.

    Raises
    ------
    DemoError
    """
    if arguments.headless and arguments.out is None:
        raise DemoError("--headless needs --out FILE.png")
    if arguments.out is not None and not arguments.headless:
        raise DemoError("--out needs --headless")
    chosen = arguments.tessellation
    if chosen is None:
        chosen = "auto" if arguments.lod == "auto" else "off"
    clip = arguments.clip
    return Options(
        folder=None if arguments.folder is None else built_folder(arguments.folder),
        headless=arguments.headless,
        out=arguments.out,
        size=arguments.size,
        clip=int(clip) if clip is not None and clip.isdigit() else clip,
        time_s=arguments.time,
        lod=arguments.lod,
        tessellation=chosen,
        eye=tuple(arguments.eye) if arguments.eye else None,
        target=tuple(arguments.target) if arguments.target else None,
        fovy_deg=arguments.fovy,
        view=arguments.view,
        backdrop=not arguments.no_backdrop,
        panel=not arguments.no_panel,
    )


def run(program: str, work: Callable[[], None]) -> int:
    """Call a demo's work: exit status 0, or 2 with one line where input or machine are at fault."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a console that lacks an arrow shows a question mark instead
            stream.reconfigure(errors="replace")
    try:
        work()
    except (DemoError, AssetError, RenderError) as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        told = missing_package(error)
        if told is None:
            raise
        print(f"{program}: {told}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def parse(parser: Parser, arguments: Sequence[str] | None) -> tuple[argparse.Namespace, Options]:
    """Parse a command line that has at least the shared arguments."""
    parsed = parser.parse_args(arguments)
    return parsed, options_of(parsed)
