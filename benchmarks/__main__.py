"""Run measurements: python -m benchmarks [NAME ...] [--json FILE]."""

from __future__ import annotations

import argparse
import importlib
import json
import pkgutil
import sys
from pathlib import Path

import benchmarks
from demos.extras import needs_packages
from preprocess.kernels import compile_quickly


def subjects() -> list[str]:
    """Names of the measurements: modules of this package with a `run(argv)` that returns rows."""
    return sorted(m.name for m in pkgutil.iter_modules(benchmarks.__path__) if not m.name.startswith("_"))


def main(argv: list[str]) -> int:
    """Run the named measurements, or all, and print their tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, allow_abbrev=False)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of: {', '.join(subjects())} (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all rows as JSON")
    options, extra = parser.parse_known_args(argv)
    unknown = [name for name in options.names if name not in subjects()]
    if unknown:
        parser.error(f"no benchmark is called {unknown[0]!r}: there are {', '.join(subjects())}")
    compile_quickly()
    rows: dict[str, list[dict[str, object]]] = {}
    for name in options.names or subjects():
        print(f"\n== {name}", flush=True)
        with needs_packages(__name__, "benchmarks", "bench"):
            measure = importlib.import_module(f"benchmarks.{name}").run
        rows[name] = measure(extra)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
