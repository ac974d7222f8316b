"""`--json`: what was made, as one line of JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
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
