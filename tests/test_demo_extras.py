"""A runtime-only installation: what a program lacks is one line that says what to install."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from demos.extras import missing_package, needs_packages

ROOT = Path(__file__).resolve().parent.parent
# Importing any of these fails as it does where they are not installed.
HIDE = """
import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
sys.argv = ["program", *{arguments!r}]
runpy.run_module({module!r}, run_name="__main__", alter_sys=True)
"""
EXTRAS = ("scipy", "numba", "pygltflib", "rich", "glfw", "pygame", "moderngl_window", "skimage", "PIL")


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("demos.viewer", ["ball.seamless"]),
        ("demos.crowd", ["ball.seamless"]),
        ("demos.compare", []),
        ("demos.embed_glfw", []),
        ("demos.embed_pygame", []),
        ("demos.embed_moderngl_window", []),
        ("demos.gallery", ["--force"]),
        ("demos.creature", []),
        ("benchmarks", ["accuracy"]),
        ("preprocess", ["check", "ball.seamless"]),
    ],
)
def test_a_missing_package_is_one_line_that_names_the_extra(tmp_path: Path, module: str, arguments: list[str]) -> None:
    code = HIDE.format(hidden=EXTRAS, arguments=arguments, module=module)
    command = [sys.executable, "-c", code]
    environment = {"PYTHONPATH": str(ROOT), "PATH": ""}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].split(":")[0] in (module.rpartition(".")[2], "demo"), done.stderr
    assert 'pip install "seamskin[' in lines[0]


def test_only_other_peoples_packages_are_told_and_only_by_programs() -> None:
    ours = ModuleNotFoundError("No module named 'runtime.nothing'", name="runtime.nothing")
    assert missing_package(ours) is None and missing_package(ImportError("cannot import name")) is None
    theirs = ModuleNotFoundError("No module named 'scipy'", name="scipy.spatial")
    assert missing_package(theirs) == 'scipy is not installed: pip install "seamskin[demos]"'
    with pytest.raises(ModuleNotFoundError), needs_packages("demos.compare", "compare"):
        raise theirs
    with pytest.raises(SystemExit) as ended, needs_packages("__main__", "compare"):
        raise theirs
    assert ended.value.code == 2
    with pytest.raises(ZeroDivisionError), needs_packages("__main__", "compare"):
        raise ZeroDivisionError
