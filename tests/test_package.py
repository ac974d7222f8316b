"""What `pip install seamskin` brings: the wheel's contents, the name `seamskin`, its console command."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import runtime
import seamskin
from seamskin.__main__ import PICTURES, main

ROOT = Path(__file__).resolve().parent.parent
IN_WHEEL = ("runtime", "preprocess", "demos", "seamskin")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which the wheel of this checkout was unpacked, as pip does it."""
    pytest.importorskip("setuptools", "77", reason="building a wheel takes setuptools 77")
    tree = tmp_path_factory.mktemp("tree")
    for name in (*IN_WHEEL, "shaders", "benchmarks"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree / name)
    code = "from setuptools import build_meta; print(build_meta.build_wheel('dist'))"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], cwd=tree, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    target = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(tree / "dist" / done.stdout.splitlines()[-1]) as wheel:
        wheel.extractall(target)
    return target


def run_there(target: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python in an empty folder with the installed files before anything else."""
    environment = {"PYTHONPATH": str(target), "PATH": "", "HOME": str(target)}
    (target / "elsewhere").mkdir(exist_ok=True)
    return subprocess.run(
        [sys.executable, *arguments], cwd=target / "elsewhere", capture_output=True, text=True, env=environment
    )


def test_the_wheel_holds_the_packages_and_every_file_of_theirs(installed: Path) -> None:
    tops = {path.name for path in installed.iterdir() if path.is_dir() and path.suffix != ".dist-info"}
    assert tops - {"elsewhere"} == set(IN_WHEEL)
    suffixes = (".py", ".typed", ".html", ".ttf")
    for name in IN_WHEEL:
        wanted = {p.relative_to(ROOT) for p in (ROOT / name).rglob("*") if p.suffix in suffixes or p.name == "py.typed"}
        assert wanted <= {p.relative_to(installed) for p in (installed / name).rglob("*")}
    for shader in (ROOT / "shaders").rglob("*.*"):
        if "__pycache__" not in shader.parts:
            assert (installed / "runtime" / "shaders" / shader.relative_to(ROOT / "shaders")).is_file(), shader


def test_installed_it_works_by_its_own_name(installed: Path) -> None:
    code = (
        "import seamskin, runtime; from pathlib import Path\n"
        "assert seamskin.load is runtime.load and seamskin.Model is runtime.Model\n"
        "from runtime.gpu.programs import assemble\n"
        "assert 'read_surface' in assemble('lit.frag', 330).text\n"
        "print(seamskin.__version__, Path(runtime.__file__).parent)"
    )
    done = run_there(installed, "-c", code)
    version, folder = done.stdout.split()
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert done.returncode == 0 and version == declared and Path(folder) == installed / "runtime", done.stderr


def test_installed_it_has_a_command(installed: Path) -> None:
    (entry,) = installed.glob("*.dist-info/entry_points.txt")
    assert "seamskin = seamskin.__main__:run_and_leave" in entry.read_text()
    done = run_there(installed, "-m", "seamskin", "--help")
    assert done.returncode == 0, done.stderr
    for name in ("build", "erase", "straighten", "decimate", "batch", "check", "view", "crowd", "compare"):
        assert f"\n  {name} " in done.stdout
    refused = run_there(installed, "-m", "seamskin", "check", "nowhere")
    assert refused.returncode == 2 and len(refused.stderr.splitlines()) == 1


def test_seamskin_is_the_runtime_by_another_name() -> None:
    assert set(seamskin.__all__) == {*runtime.__all__, "__version__"} <= set(dir(seamskin))
    for name in runtime.__all__:
        assert getattr(seamskin, name) is getattr(runtime, name)
    with pytest.raises(AttributeError, match="seamskin"):
        _ = seamskin.nothing


@pytest.mark.parametrize("arguments", [["biuld", "x.glb"], ["nonsense"], []])
def test_an_unknown_command_is_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert ("did you mean build?" in said.err) == (arguments[:1] == ["biuld"])
    assert len(said.err.splitlines()) == bool(arguments)


@pytest.mark.parametrize("name", sorted(PICTURES))
def test_a_picture_command_is_a_demo(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--headless", "--out", "picture.png", "nowhere.seamless"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


DISTRIBUTIONS = {"OpenGL": "pyopengl", "PIL": "pillow", "skimage": "scikit-image", "llvmlite": "numba"}
# A window library that a person may choose besides ours, and the reference program of a benchmark.
NOT_OURS_TO_INSTALL = {"PySide6", "seam_erasure", "meshoptimizer"}
ONLY_IF_THERE = {"runtime": {"meshopt"}}  # compressed files alone need it, and say so


def declared(*extras: str) -> set[str]:
    """Distributions that the package with some extras brings, extras within extras included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted, found = list(project["dependencies"]), set()
    for extra in extras:
        wanted += project["optional-dependencies"][extra]
    for line in wanted:
        name = re.match(r"[\w.-]+", line)
        assert name is not None
        if name[0] == "seamskin":
            inner = re.search(r"\[(.*?)\]", line)
            assert inner is not None
            found |= declared(*inner[1].split(","))
        found.add(name[0].lower().replace("_", "-"))
    return found


@pytest.mark.parametrize(
    "folder,extras",
    [("runtime", ()), ("preprocess", ("preprocess",)), ("demos", ("demos",)), ("benchmarks", ("bench",)),
     ("tests", ("dev", "bench"))],
)  # fmt: skip
def test_every_package_that_is_imported_is_declared(folder: str, extras: tuple[str, ...]) -> None:
    """What lies in a developer's environment by chance hides what a new one lacks."""
    ours = {"tests", "runtime", "preprocess", "demos", "benchmarks", "seamskin"}
    ours |= {path.stem for path in (ROOT / "tests").glob("*.py")}
    names = {"numba", "pytest"} if folder == "tests" else set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.split(".")[0])
    foreign = names - ours - set(sys.stdlib_module_names) - NOT_OURS_TO_INSTALL - ONLY_IF_THERE.get(folder, set())
    lacking = {
        name for name in foreign if DISTRIBUTIONS.get(name, name).lower().replace("_", "-") not in declared(*extras)
    }
    assert not lacking
