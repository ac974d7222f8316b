"""What the windowing examples share besides their scene: arguments, a walk by script for tests, a last picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import moderngl
import numpy as np

from demos.errors import DemoError
from demos.headless import write_png
from demos.options import Parser, picture_size
from demos.walk_scene import WalkScene

BUILT_IN = Path("out/demo")
SCRIPT_STEP_S = 1 / 30


@dataclass(frozen=True)
class EmbedOptions:
    """Arguments of a windowing example.

    Attributes
    ----------
    folder : Path
    size : (int, int)
    frames : int
        Walk by script for so many frames, then close; 0 plays until closed.
    out : Path or None
        Where the last of them is kept.
    window : str
        Window library of moderngl-window.
    """

    folder: Path
    size: tuple[int, int]
    frames: int
    out: Path | None
    window: str


def parse_arguments(program: str, arguments: Sequence[str] | None) -> EmbedOptions:
    """Read the command line.

    Raises
    ------
    DemoError
        When no character was named and none is built yet.
    """
    parser = Parser(program, description="Walk among a crowd.")
    parser.add_argument("folder", nargs="?", type=Path, metavar="DIR", help="a built character (default: the built-in)")
    parser.add_argument("--size", type=picture_size, default=(1280, 720), metavar="WxH", help="pixels (1280x720)")
    parser.add_argument("--frames", type=int, default=0, metavar="N", help="walk by script for N frames, then close")
    parser.add_argument("--out", type=Path, metavar="FILE.png", help="keep the last of those frames")
    parser.add_argument("--window", default="glfw", metavar="NAME", help="window library of moderngl-window (glfw)")
    parsed = parser.parse_args(arguments)
    folder = parsed.folder or next(iter(sorted(BUILT_IN.glob("*.seamless"))), None)
    if folder is None:
        raise DemoError("no built-in character yet: run ./run demo, or name the folder of a built character")
    if parsed.out is not None and parsed.frames < 1:
        raise DemoError("--out needs --frames N")
    return EmbedOptions(folder, parsed.size, max(parsed.frames, 0), parsed.out, parsed.window)


class Scripted:
    """Stands, walks and turns for a number of frames at a fixed step; does nothing when there are none to do."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._done = 0

    def next_step(self, scene: WalkScene, dt_s: float) -> float:
        """Time to advance by: the script's own step while it runs, `dt_s` otherwise."""
        if not self._frames:
            return dt_s
        part = self._done / self._frames
        self._done += 1
        scene.steer(float(part >= 0.2), 0.0 if part < 0.5 else 1.0 if part < 0.75 else -0.5)
        return SCRIPT_STEP_S

    @property
    def finished(self) -> bool:
        """Whether the last frame was just drawn."""
        return bool(self._frames) and self._done >= self._frames


def save_picture(path: Path | None, framebuffer: moderngl.Framebuffer) -> None:
    """Keep what is in a framebuffer, if somewhere is given."""
    if path is None:
        return
    width, height = framebuffer.viewport[2:]
    data = framebuffer.read(viewport=(0, 0, width, height), components=3, alignment=1)
    write_png(path, np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1].copy())
