"""Write the built-in character: python -m demos.creature -o dragon.glb."""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path

from demos.creature.build import build_creature


def main() -> None:
    """Parse arguments and write the file."""
    parser = argparse.ArgumentParser(prog="python -m demos.creature", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/dragon.glb"), metavar="FILE.glb")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what each step does")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO if arguments.verbose else logging.WARNING, format="%(message)s")
    start = time.perf_counter()
    build_creature(arguments.output)
    print(
        f"{arguments.output} ({arguments.output.stat().st_size / 2**20:.1f} MiB, {time.perf_counter() - start:.1f} s)"
    )


if __name__ == "__main__":
    main()
