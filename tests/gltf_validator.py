"""The Khronos glTF validator: run wherever node is, brought by npm the first time."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PACKAGE = "gltf-validator@2.0.0-dev.3.10"
PLACE = Path(sys.prefix) / "share" / "seamskin-node"  # in the virtual environment that runs the tests
VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs'), path = require('path');
const file = process.argv[1];
const read = (uri) => fs.promises.readFile(path.join(path.dirname(file), decodeURIComponent(uri)));
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {maxIssues: 50,
  externalResourceFunction: (uri) => read(uri).then((data) => new Uint8Array(data))})
  .then((report) => console.log(JSON.stringify(report.issues)));
"""


def _run(path: Path) -> subprocess.CompletedProcess[str]:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed: the Khronos validator cannot run")
    places = [str(PLACE / "node_modules"), *filter(None, [os.environ.get("NODE_PATH")])]
    environment = os.environ | {"NODE_PATH": os.pathsep.join(places)}
    command = [node, "-e", VALIDATE, str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment)


def issues(path: Path) -> dict[str, Any]:
    """What the validator says of a file; a skip without node, or where npm cannot bring it (no network)."""
    done = _run(path)
    if "Cannot find module 'gltf-validator'" in done.stderr:
        npm = shutil.which("npm")
        command = [str(npm), "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(PLACE), PACKAGE]
        if npm is None or subprocess.run(command, capture_output=True, timeout=180, check=False).returncode:
            pytest.skip("npm cannot bring gltf-validator (npm i gltf-validator, NODE_PATH): validator not run")
        done = _run(path)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found
