"""Docstrings name the parameters and fields that exist, all of them, in their order; private ones' too."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("runtime", "preprocess", "benchmarks", "demos")
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
ENTRY = re.compile(r"^(\*{0,2}[A-Za-z_]\w*(?:, ?\*{0,2}[A-Za-z_]\w*)*)(?: ?:.*)?$")
Function = ast.FunctionDef | ast.AsyncFunctionDef


def section(docstring: str, title: str) -> list[str]:
    """Names of a section's entries, in order; the docstring is dedented."""
    found = re.search(rf"^{title}\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", docstring, re.DOTALL | re.MULTILINE)
    if not found:
        return []
    names: list[str] = []
    for line in found[1].splitlines():
        if not line or line[0].isspace():
            continue
        entry = ENTRY.match(line)
        assert entry, f"not an entry `name : type` of {title}: {line!r}"
        names += [name.strip().lstrip("*") for name in entry[1].split(",")]
    return names


def parameters(function: Function) -> list[str]:
    """Names of a function's parameters, but for self and cls."""
    spec = function.args
    every = [*spec.posonlyargs, *spec.args, spec.vararg, *spec.kwonlyargs, spec.kwarg]
    names = [arg.arg for arg in every if arg]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def own_fields(node: ast.ClassDef) -> set[str]:
    """Annotated and assigned names of a class, its properties, and what its methods assign to self."""
    names: set[str] = set()
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
            names.add(item.target.id)
        elif isinstance(item, ast.Assign):
            names |= {target.id for target in item.targets if isinstance(target, ast.Name)}
        elif isinstance(item, Function):
            if any("property" in ast.unparse(decorator) for decorator in item.decorator_list):
                names.add(item.name)
            for inner in ast.walk(item):
                if isinstance(inner, ast.Attribute) and isinstance(inner.ctx, ast.Store):
                    names |= {inner.attr} if ast.unparse(inner.value) == "self" else set()
    return names


def all_classes() -> dict[str, list[ast.ClassDef]]:
    """Classes of all packages by name."""
    classes: dict[str, list[ast.ClassDef]] = {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, []).append(node)
    return classes


CLASSES = all_classes()


def fields(node: ast.ClassDef) -> set[str]:
    """Fields of a class and of the classes of ours that it derives from."""
    names = own_fields(node)
    for base in node.bases:
        name = ast.unparse(base).split(".")[-1]
        for parent in CLASSES.get(name, []) if name != node.name else []:
            names |= fields(parent)
    return names


def faults(tree: ast.AST) -> Iterator[str]:
    """What the docstrings of a file get wrong, one line each."""
    for node in ast.walk(tree):
        if not isinstance(node, Function | ast.ClassDef):
            continue
        docstring = ast.get_docstring(node)
        if not docstring:
            continue
        if isinstance(node, ast.ClassDef):
            makers = [item for item in node.body if isinstance(item, Function) and item.name == "__init__"]
            real = fields(node)
            taken = set(parameters(makers[0])) if makers else real
            named = [item.target for item in node.body if isinstance(item, ast.AnnAssign)]
            public = [t.id for t in named if isinstance(t, ast.Name) and not t.id.startswith("_")]
            listed = {"Attributes": (real, public), "Parameters": (taken, parameters(makers[0]) if makers else public)}
        else:
            listed = {"Parameters": (set(parameters(node)), parameters(node))}
        for title, (existing, wanted) in listed.items():
            names = section(docstring, title)
            where = f"line {node.lineno}: {title} of {node.name}"
            for name in names:
                if name not in existing:
                    yield f"{where}: there is no {name!r}"
            if names and not set(wanted) <= set(names):
                yield f"{where}: {sorted(set(wanted) - set(names))} is not there"
            elif names and [name for name in names if name in wanted] != wanted:
                yield f"{where}: not once each in the order of the code"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_docstrings_name_what_exists(path: Path) -> None:
    assert not list(faults(ast.parse(path.read_text(encoding="utf-8"))))


DRIFTED = '''
class Box:
    """A box.

    Attributes
    ----------
    low, high : (3,) float
    colour : str
    """

    low: object

    def __init__(self) -> None:
        self.high = 1

def grow(box, *more, by=1):
    """Grow it.

    Parameters
    ----------
    box : Box
    amount : float
        By how much, for instance: a metre.
    *more : Box

    Returns
    -------
    nothing : None
    """

def shrink(box, by):
    """Shrink it.

    Parameters
    ----------
    by : float
    """

def turn(box, by):
    """Turn it.

    Parameters
    ----------
    by : float
    box : Box
    """
'''


def test_a_drifted_docstring_is_found() -> None:
    found = list(faults(ast.parse(DRIFTED)))
    assert [line.split(": ", 1)[1] for line in found] == [
        "Attributes of Box: there is no 'colour'",
        "Parameters of grow: there is no 'amount'",
        "Parameters of grow: ['by'] is not there",
        "Parameters of shrink: ['box'] is not there",
        "Parameters of turn: not once each in the order of the code",
    ]
