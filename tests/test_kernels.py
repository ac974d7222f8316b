"""That a person is told of kernels that compile, exactly when they do."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba import njit
from numba.extending import overload

from preprocess.numerics.compile_progress import COMPILING, compile_quickly, watch_compiling
from preprocess.progress import Progress

MODULE = """
import numba

@numba.njit(cache=True)
def half(x):
    return x / 2

@numba.njit(cache=True)
def quarter(x):
    return half(half(x))
"""
PROGRAM = """
from preprocess.progress import Progress
from kernels_of_a_test import quarter
progress = Progress()
for name in ("first", "second"):
    with progress.stage(name):
        assert quarter(4.0) == 1.0
"""


def test_nothing_is_said_of_kernels_that_are_there() -> None:
    @njit
    def double(x):
        return 2 * x

    double(1)
    said: list[str] = []
    with watch_compiling(lambda: said.append("compiling")) as compiling:
        double(2)
    assert (said, compiling.seconds) == ([], 0.0)


def test_every_kernel_counts_and_is_said_once() -> None:
    @njit
    def inner(x):
        return x + 1

    @njit
    def outer(x):
        return inner(x) * 2

    said: list[str] = []
    with watch_compiling(lambda: said.append("compiling")) as compiling:
        assert outer(1) == 4
        first = compiling.seconds
        assert outer(1.0) == 4.0
    assert said == ["compiling"]
    assert 0.0 < first < compiling.seconds
    outer(1j)
    assert said == ["compiling"], "whoever stopped watching hears nothing"


def test_a_kernel_that_fails_to_compile_leaves_the_watch_in_order() -> None:
    @njit
    def wrong(x):
        return x.nothing

    said: list[str] = []
    with watch_compiling(lambda: said.append("compiling")) as compiling:
        with pytest.raises(Exception, match="nothing"):
            wrong(1.0)
        before = compiling.seconds
        wrong.py_func(type("Thing", (), {"nothing": 0}))
    assert said == ["compiling"] and compiling.seconds == before > 0.0


def test_the_collector_of_cycles_rests_only_while_a_kernel_compiles() -> None:
    seen: list[bool] = []

    def ask(x: int) -> int:
        return x

    @overload(ask)
    def _ask(x):
        seen.append(gc.isenabled())  # while the kernel below is compiled
        return lambda x: x

    @njit
    def kernel(x):
        return ask(x)

    with watch_compiling(lambda: None):
        assert gc.isenabled()
        assert kernel(1) == 1
        assert gc.isenabled()
        gc.disable()
        try:
            kernel(1.0)
            assert not gc.isenabled(), "it was off before"
        finally:
            gc.enable()
    assert seen and not any(seen)


def test_the_first_run_says_so_and_an_update_does(tmp_path: Path) -> None:
    module = tmp_path / "kernels_of_a_test.py"
    module.write_text(MODULE)
    root = Path(__file__).parents[1]
    paths = os.pathsep.join([str(root), str(tmp_path)])
    environment = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run() -> list[str]:
        done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stderr.splitlines()

    first = run()
    assert [COMPILING in line for line in first] == [True, False, False]
    assert COMPILING not in "".join(run())
    module.write_text(MODULE.replace("x / 2", "x * 0.5"))
    assert sum(COMPILING in line for line in run()) == 1


def test_quiet_progress_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    @njit
    def triple(x):
        return 3 * x

    progress = Progress(quiet=True)
    with progress.stage("work"):
        triple(1)
    assert capsys.readouterr() == ("", "")
    assert list(progress.seconds) == ["work"]


def test_a_users_own_choice_of_level_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_OPT", "3")
    compile_quickly()
    assert os.environ["NUMBA_OPT"] == "3"
    monkeypatch.delenv("NUMBA_OPT")
    compile_quickly()
    assert os.environ["NUMBA_OPT"] == "1"
