"""Data flows one way: folders in the order of the data, and a few doors between the offline tools and the runtime."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MOST_FILES = 18  # in one folder
# Each room may import from itself and from rooms before it; imports in functions and for types alone count too.
RUNTIME = ("errors", "validation", "gltf", "animation", "asset", "scene", "gpu", "render", "crowd", "picking")
PREPROCESS = (
    *("errors", "arrays", "settings", "numerics", "progress", "mesh", "files", "load", "straighten", "decimate"),
    *("atlas", "bake", "erase", "fit", "export", "verify", "pipeline", "api", "commands", "cli", "__main__"),
)
ROOMS = {"runtime": RUNTIME, "preprocess": PREPROCESS}
# What the offline tools may use of the runtime: files as they are, poses, and the codecs of a built folder.
DOORS = {"errors", "gltf", "animation", "asset"}


def imported_modules(path: Path) -> set[str]:
    """Modules that a file imports anywhere, and for `from package import name` also `package.name`."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def room_of(path: Path) -> str:
    """The folder of a file within its package, or the file's own name at the top."""
    first = path.relative_to(ROOT).parts[1]
    return first.removesuffix(".py")


@pytest.mark.parametrize("package", ["runtime", "preprocess"])
def test_rooms_read_only_what_comes_before_them(package: str) -> None:
    order = ROOMS[package]
    for path in files(package):
        if path == ROOT / package / "__init__.py":
            continue
        at = order.index(room_of(path))  # a room that the table does not know is an error
        for name in imported_modules(path):
            parts = name.split(".")
            if parts[0] == package and len(parts) > 1 and parts[1] in order:
                assert order.index(parts[1]) <= at, f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize("folder", ["runtime", "preprocess"])
def test_no_folder_is_crowded(folder: str) -> None:
    for directory in [ROOT / folder, *(p for p in (ROOT / folder).rglob("*") if p.is_dir())]:
        assert len([p for p in directory.glob("*.py") if p.name != "__init__.py"]) <= MOST_FILES, directory


@pytest.mark.parametrize("path", files("runtime"), ids=lambda p: str(p.relative_to(ROOT)))
def test_runtime_stands_alone(path: Path) -> None:
    roots = {name.split(".")[0] for name in imported_modules(path)}
    assert not roots & {"preprocess", "demos", "benchmarks", "scipy", "numba", "glfw", "trimesh", "pygltflib"}


@pytest.mark.parametrize("path", files("preprocess"), ids=lambda p: str(p.relative_to(ROOT)))
def test_preprocess_uses_the_runtime_through_few_doors(path: Path) -> None:
    names = imported_modules(path)
    assert not {n.split(".")[1] for n in names if n.startswith("runtime.")} - DOORS and "runtime" not in names
    assert not {n.split(".")[0] for n in names} & {"demos", "benchmarks", "moderngl", "glfw"}


def test_importing_the_runtime_is_light() -> None:
    code = "import sys, runtime; print(sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for heavy in ("preprocess", "scipy", "numba", "OpenImageIO", "glfw"):
        assert f"'{heavy}'" not in loaded


def test_only_texels_knows_the_half_texel() -> None:
    """No other Python file of the pipeline writes the half-texel rule: they call preprocess.mesh.texels."""
    found = [
        str(path.relative_to(ROOT))
        for path in files("preprocess")
        if path.name not in ("texels.py", "resample.py") and "- 0.5) /" in path.read_text()
    ]
    assert not found


@pytest.mark.parametrize("package", ["runtime", "preprocess"])
def test_the_architecture_page_shows_the_order_of_the_rooms(package: str) -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    (row,) = (line for line in page.splitlines() if line.startswith(f"{package}   "))
    shown = row.removeprefix(package).partition(" on ")[0].replace(" ", "").split(">")
    rooms = [room for room in ROOMS[package] if room in shown]
    assert shown == rooms and len(shown) >= 7
    for room in (ROOT / package).iterdir():
        if (room / "__init__.py").is_file():
            assert f"| `{room.name}/` |" in page, room
