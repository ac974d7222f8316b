"""Whole builds, without flags: CPU seconds by stage, peak memory and size, beside what else one would do.

Each build runs in a process of its own; its CPU time and peak memory are the system's account of that process. Stages'
seconds are the build's own wall times. Beside it, in another process of the same run, the plain way to a textured
character with levels: an atlas by xatlas, colours resampled into it at the same size, levels of half, a quarter and so
on by meshoptimizer, images and buffers written out. That way has seams, one atlas for all levels, and measures nothing.
"""

from __future__ import annotations

import importlib.util
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._inputs import ASSETS, ROOT, MissingInput, command_line
from benchmarks._table import print_table

PLAIN = """
import sys
from pathlib import Path
import numpy as np
import meshoptimizer, xatlas
from preprocess.bake.materials import bake_materials
from preprocess.files.images import Image, write_image
from preprocess.load import load_character
from preprocess.mesh.raster import cover_atlas
from preprocess.mesh.surface import TexturedSurface

character, folder, side = load_character(Path(sys.argv[1])), Path(sys.argv[2]), int(sys.argv[3])
mesh = character.mesh
surface = mesh.surface
vertices, faces, uvs = xatlas.parametrize(surface.positions.astype(np.float32), surface.faces.astype(np.uint32))
atlas = TexturedSurface(surface.positions, surface.faces, uvs.astype(float), faces.astype(np.int32))
unwrapped = mesh.with_surface(atlas)
baked = bake_materials(character, unwrapped, True, side, lambda w, h: cover_atlas(unwrapped, w, h))
for texture in baked:
    write_image(folder / f"{texture.name}.png", Image(texture.texels, "uint8"))
points = np.ascontiguousarray(surface.positions[vertices], np.float32)
indices = np.ascontiguousarray(faces.ravel(), np.uint32)
np.savez(folder / "level0.npz", points=points, uvs=uvs, indices=indices)
level, target = 1, len(indices) // 2
while target >= 3 * 50:
    kept = np.zeros_like(indices)
    count = meshoptimizer.simplify(kept, indices, points, target_index_count=target // 3 * 3, target_error=1.0)
    np.savez(folder / f"level{level}.npz", indices=kept[:count])
    level, target = level + 1, target // 2
"""


def _measured(command: list[str]) -> dict[str, Any]:
    """CPU seconds and peak MB of a process."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert process.stderr is not None
    said = process.stderr.read().decode(errors="replace").strip()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    row: dict[str, Any] = {"cpu_s": usage.ru_utime + usage.ru_stime, "peak_mb": _megabytes(usage)}
    if process.returncode:
        row["failed"] = said.splitlines()[-1] if said else f"exit status {process.returncode}"
    return row


def _megabytes(usage: resource.struct_rusage) -> float:
    return usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _folder_mb(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def measure(model: Path) -> dict[str, Any]:
    """A row: the build, and the plain way beside it where its packages are installed."""
    with tempfile.TemporaryDirectory() as name:
        built, plain = Path(name) / "built.seamless", Path(name) / "plain"
        row: dict[str, Any] = {"character": model.stem}
        row |= _measured([sys.executable, "-m", "preprocess", str(model), "-o", str(built)])
        side = 1024
        if (built / "manifest.json").is_file():
            manifest = json.loads((built / "manifest.json").read_text(encoding="utf-8"))
            row["MB"] = _folder_mb(built)
            row["faces"], row["charts"] = manifest["lods"][0]["faces"], manifest["atlas"]["charts"]
            row |= {stage: float(seconds) for stage, seconds in manifest["timings"].items()}
            textures = manifest["textures"]
            side = textures["base_color"]["size"][0]
            colors = [entry for name, entry in textures.items() if name not in ("position", "weights")]
            row["jump of 255"] = 255 * max(level["max"] for entry in colors for level in entry["seam"]["stored"])
        if all(importlib.util.find_spec(package) for package in ("xatlas", "meshoptimizer")):
            plain.mkdir()
            found = _measured([sys.executable, "-c", PLAIN, str(model), str(plain), str(side)])
            row |= {f"plain {key}": value for key, value in found.items()}
            row["plain MB"] = _folder_mb(plain)
    return row


def _models(chosen: list[Path] | None) -> list[Path]:
    """The files asked for, or all test characters, or the built-in one."""
    for path in chosen or ():
        if not path.is_file():
            raise MissingInput(f"no such file: {path}")
    if chosen:
        return chosen
    found = sorted([*ASSETS.glob("*.gl[tb]*"), *ASSETS.glob("*/*.gltf")])
    if found:
        return found
    from demos.creature.build import build_creature

    model = ROOT / "out" / "benchmarks" / "creature.glb"
    model.parent.mkdir(parents=True, exist_ok=True)
    build_creature(model)
    return [model]


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print, a line at a time; return the rows."""
    parser = command_line("pipeline", __doc__)
    parser.add_argument("--models", type=Path, nargs="+", help="instead of all in ../shared/assets")
    options = parser.parse_args(argv)
    rows = []
    for model in _models(options.models):
        rows.append(measure(model))
        print_table(rows[-1:])
        sys.stdout.flush()
    print_table(rows)
    return rows
