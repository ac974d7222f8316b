"""Write the built-in character: python -m demos.creature -o dragon.glb."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from demos.errors import DemoError
from demos.options import Parser, run


def write(arguments: Sequence[str] | None) -> None:
    """Parse arguments and write the file."""
    parser = Parser(prog="python -m demos.creature", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/dragon.glb"), metavar="FILE.glb")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what each step does")
    parsed = parser.parse_args(arguments)
    output: Path = parsed.output
    logging.basicConfig(level=logging.INFO if parsed.verbose else logging.WARNING, format="%(message)s")
    from demos.creature.build import build_creature

    start = time.perf_counter()
    try:
        build_creature(output)
    except OSError as error:
        raise DemoError(f"cannot write {output}: {error.strerror}") from None
    print(f"{output} ({output.stat().st_size / 2**20:.1f} MiB, {time.perf_counter() - start:.1f} s)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.creature`."""
    return run("creature", lambda: write(arguments))


if __name__ == "__main__":
    sys.exit(main())
