"""`--json` and `--watch`: what was made as one line of JSON, and again whenever the file changes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from builders_gltf import bent_bar

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def test_json_is_one_line_on_standard_output(tmp_path: Path) -> None:
    model = bent_bar(tmp_path / "bar.glb")
    command = [sys.executable, "-m", "preprocess", str(model), "-o", str(tmp_path / "bar.seamless"), "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=ENVIRONMENT, check=True)
    told = json.loads(done.stdout)
    manifest = json.loads((tmp_path / "bar.seamless/manifest.json").read_text())
    assert [level["faces"] for level in told["lods"]] == [level["faces"] for level in manifest["lods"]]
    assert told["warnings"] == manifest["warnings"] and set(told["seconds"]) >= {"load", "atlas", "write"}


def test_a_changed_file_is_built_again(tmp_path: Path) -> None:
    model = bent_bar(tmp_path / "bar.glb")
    good, destination = model.read_bytes(), tmp_path / "bar.seamless"
    command = [sys.executable, "-m", "preprocess", str(model), "-o", str(destination), "--watch", "--json"]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        first = json.loads(process.stdout.readline())
        model.write_bytes(good[:40])  # a damaged file is told, and what was built stays
        while "preprocess:" not in (line := process.stderr.readline()):
            assert line, "ended"
        assert (destination / "manifest.json").is_file()
        model.write_bytes(good)
        os.utime(model, (time.time() + 5, time.time() + 5))
        second = json.loads(process.stdout.readline())
        assert first["lods"] == second["lods"]
        process.send_signal(signal.SIGTERM)  # SIGINT is ignored by what a shell starts in the background
        try:
            process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130
    assert (destination / "manifest.json").is_file()
