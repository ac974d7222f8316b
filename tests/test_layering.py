"""Dependencies run one way: preprocess reads a few rooms of the runtime, the runtime reads nothing of preprocess."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CROSSING = {
    f"runtime.{room}"
    for room in (
        "asset",
        "gltf",
        "skeleton",
        "clip",
        "keys",
        "pose",
        "bounds",
        "png",
        "errors",
        "lods",
        "position_words",
        "touched_cells",
        "weight_details",
    )
}


def imported_modules(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return names


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", files("runtime"), ids=lambda p: str(p.relative_to(ROOT)))
def test_runtime_stands_alone(path: Path) -> None:
    roots = {name.split(".")[0] for name in imported_modules(path)}
    assert not roots & {"preprocess", "demos", "benchmarks", "scipy", "numba", "glfw", "trimesh", "pygltflib"}


@pytest.mark.parametrize("path", files("preprocess"), ids=lambda p: str(p.relative_to(ROOT)))
def test_preprocess_reads_few_rooms_of_the_runtime(path: Path) -> None:
    names = imported_modules(path)
    assert not {n for n in names if n.split(".")[0] == "runtime"} - CROSSING
    assert not {n.split(".")[0] for n in names} & {"demos", "benchmarks", "moderngl", "glfw"}


def test_importing_the_runtime_is_light() -> None:
    code = "import sys, runtime; print(sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for heavy in ("preprocess", "scipy", "numba", "OpenImageIO", "glfw"):
        assert f"'{heavy}'" not in loaded


def test_only_texels_knows_the_half_texel() -> None:
    """No other Python file of the pipeline writes the half-texel rule: they call preprocess.texels."""
    found = [
        str(path.relative_to(ROOT))
        for path in files("preprocess")
        if path.name not in ("texels.py", "resample.py") and "- 0.5) /" in path.read_text()
    ]
    assert not found
