"""Run measurements and print their tables.

One measurement at a time takes options of its own: python -m benchmarks NAME --help lists them.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import pkgutil
import sys
from pathlib import Path
from typing import Any

import benchmarks
from benchmarks._machine import describe_machine
from demos.extras import needs_packages

EXTRA = "bench"


def subjects() -> list[str]:
    """Names of the measurements: modules of this package with a `run(argv)` that returns rows."""
    return sorted(m.name for m in pkgutil.iter_modules(benchmarks.__path__) if not m.name.startswith("_"))


def summary(name: str) -> str:
    """First sentence of a measurement's text, which is not imported for it."""
    source = (Path(benchmarks.__file__).parent / f"{name}.py").read_text(encoding="utf-8")
    text = " ".join((ast.get_docstring(ast.parse(source)) or "").split())
    return text.partition(". ")[0].rstrip(".")


def parse(argv: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Names, where to write, and what is left for one measurement."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        usage="%(prog)s [-h] [NAME ...] [--json FILE]",
        description=__doc__,
        epilog="\n".join(["measurements (default: all):", *(f"  {name:<14}{summary(name)}" for name in subjects())]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all rows as JSON")
    parser.add_argument("-h", "--help", action="store_true", help="show this help, or with a NAME that one's")
    options, rest = parser.parse_known_args(argv)
    first = next((i for i, argument in enumerate(rest) if argument.startswith("-")), len(rest))
    options.names, rest = rest[:first], rest[first:]
    unknown = [name for name in options.names if name not in subjects()]
    if unknown:
        parser.error(f"no benchmark is called {unknown[0]!r}: there are {', '.join(subjects())}")
    if options.help and not options.names:
        parser.print_help()
        raise SystemExit(0)
    if options.help:
        rest.append("--help")
    if rest and len(options.names) != 1:
        parser.error(f"{rest[0]} is an option of one measurement: name that one alone")
    return options, rest


def run(name: str, rest: list[str]) -> list[dict[str, Any]]:
    """One measurement's rows."""
    with needs_packages("__main__", "benchmarks", EXTRA):
        measure = importlib.import_module(f"benchmarks.{name}").run
    rows: list[dict[str, Any]] = measure(rest)
    return rows


def plain(value: Any) -> Any:
    """NumPy's numbers and paths as JSON has them."""
    return value.item() if hasattr(value, "item") else str(value)


def main(argv: list[str]) -> int:
    """Run the named measurements, or all, and print their tables; 2 where one lacks something."""
    options, rest = parse(argv)
    if options.json is not None and not options.json.absolute().parent.is_dir():
        print(f"benchmarks: no folder to write {options.json} in", file=sys.stderr)
        return 2
    with needs_packages("__main__", "benchmarks", EXTRA):
        from benchmarks._inputs import MissingInput
        from preprocess.errors import InputError
        from preprocess.numerics.compile_progress import compile_quickly
        from runtime.errors import AssetError, RenderError
    compile_quickly()
    result: dict[str, Any] = {"machine": describe_machine()}
    if "--help" not in rest:
        print(result["machine"], flush=True)
    status = 0
    for name in options.names or subjects():
        if len(options.names) != 1:
            print(f"\n== {name}", flush=True)
        try:
            result[name] = run(name, rest)
        except (MissingInput, InputError, AssetError, RenderError) as error:
            sys.stdout.flush()
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            result[name], status = [], 2
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=1, default=plain) + "\n")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
