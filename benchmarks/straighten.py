"""Straightening: how few runs the seams take at each tolerance, what it costs in shape, and the floor it opens.

`floor` is what the chart outlines leave; `reached` is where seam-aware decimation really stops (with --decimate).
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._table import print_table
from preprocess.decimate import decimate_to
from preprocess.load.read_surface import read_surface
from preprocess.straighten import straighten
from preprocess.straighten.warp import find_warp

MESHES = ("human.glb", "Fox.glb", "blub.obj")
TOLERANCES_REL = (0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1)
IMAGE_PX = 1024


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure all meshes at all tolerances; CPU seconds, after one run that compiles."""
    parser = command_line("straighten", __doc__)
    parser.add_argument("--decimate", action="store_true", help="also decimate to the floor")
    parser.add_argument("--mesh", type=Path, action="append", help="measure these instead of the test characters")
    options = parser.parse_args(argv)
    paths = source_files(options.mesh, MESHES, "--mesh FILE")
    rows = []
    for path in paths:
        surface = read_surface(path)
        straighten(surface, 0.02)
        for tolerance in TOLERANCES_REL:
            started = time.process_time()
            result = straighten(surface, tolerance)
            straightened = time.process_time()
            warp = find_warp(result.split.surface, result.surface, IMAGE_PX, IMAGE_PX)
            warp.apply(np.zeros((IMAGE_PX, IMAGE_PX, 3)))
            row: dict[str, Any] = {
                "mesh": path.stem,
                "faces": len(surface.faces),
                "tolerance": tolerance,
                "edges": result.num_edges,
                "runs": result.num_runs,
                "length %": 100.0 * result.collapsible_fraction,
                "split": result.split.num_edges,
                "distortion": result.distortion,
                "floor": result.floor_faces,
                "floor %": 100.0 * result.floor_faces / len(surface.faces),
                "cpu s": straightened - started,
                "warp s": time.process_time() - straightened,
            }
            if options.decimate:
                row["reached"] = decimate_to(result.surface, 4).lods[-1].num_faces
            rows.append(row)
    print_table(rows)
    return rows
