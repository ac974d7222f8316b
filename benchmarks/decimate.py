"""Decimation: error and speed at equal face counts beside other decimaters, jumps at every level, the n log n curve.

Other decimaters are measured where they are installed: fast-simplification (which ignores uvs) and MeshLab's textured
decimation (pymeshlab). All times are CPU seconds of the decimation alone, without reading or writing files.
`--curve` runs from 10 thousand to 2 million faces.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks._table import print_table
from preprocess.decimate import DecimateOptions, Lod, decimate, decimate_to
from preprocess.decimate.measure import make_reference, measure
from preprocess.erase import erase, measure_seams
from preprocess.mesh import TexturedSurface
from preprocess.obj import read_obj, read_surface, write_obj
from preprocess.seams import find_seams
from preprocess.straighten import straighten

ASSETS = Path(__file__).resolve().parent.parent.parent / "shared" / "assets"
MESHES = ("human.glb", "blub.obj")
RATIOS = (0.5, 0.25, 0.1, 0.05)
CURVE_SIDES = (71, 158, 354, 500, 707, 1000)  # cells along a square; two faces each
TEXTURE_PX = 256


def _installed(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _as_lod(surface: TexturedSurface) -> Lod:
    """Somebody else's mesh, for the same measurement."""
    owners = np.zeros(len(surface.positions), np.int32)
    sources = np.zeros(len(surface.faces), np.int32)
    return Lod(surface.uvs, surface.face_uvs, surface.faces, owners, sources, surface.positions)


def _ours(surface: TexturedSurface, target: int) -> tuple[Lod, float]:
    started = time.process_time()
    lod = decimate_to(surface, target).lods[0]
    return lod, time.process_time() - started


def _fast_simplification(module: ModuleType, surface: TexturedSurface, target: int) -> tuple[Lod, float]:
    positions, faces = surface.positions.astype(np.float32), surface.faces.astype(np.int32)
    started = time.process_time()
    points, triangles = module.simplify(positions, faces, target_count=target)
    spent = time.process_time() - started
    triangles = np.asarray(triangles, np.int32)
    return _as_lod(TexturedSurface(np.asarray(points, np.float64), triangles, np.zeros((1, 2)), 0 * triangles)), spent


def _meshlab(module: ModuleType, surface: TexturedSurface, target: int) -> tuple[Lod, float]:
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "source.obj", Path(folder) / "result.obj"
        write_obj(source, surface)
        meshes = module.MeshSet(verbose=False)
        meshes.load_new_mesh(str(source))
        started = time.process_time()
        meshes.meshing_decimation_quadric_edge_collapse_with_texture(targetfacenum=target)
        spent = time.process_time() - started
        meshes.save_current_mesh(str(result))
        return _as_lod(read_obj(result)), spent


OTHERS = (
    ("fast-simplification (no uv)", "fast_simplification", _fast_simplification),
    ("MeshLab with texture", "pymeshlab", _meshlab),
)


def _compare(surface: TexturedSurface, name: str) -> list[dict[str, Any]]:
    """Every decimater at every ratio."""
    methods: dict[str, Callable[[TexturedSurface, int], tuple[Lod, float]]] = {"seamskin": _ours}
    for label, package, method in OTHERS:
        module = _installed(package)
        if module is not None:
            methods[label] = functools.partial(method, module)
        else:
            print(f"({package} is not installed: left out)")
    reference = make_reference(surface)
    _ours(surface, len(surface.faces) // 2)  # compile
    rows = []
    for ratio in RATIOS:
        target = round(ratio * len(surface.faces))
        for label, decimater in methods.items():
            lod, spent = decimater(surface, target)
            distances = measure(reference, lod)
            rows.append(
                {
                    "mesh": name,
                    "method": label,
                    "target": target,
                    "faces": lod.num_faces,
                    "mean mm": 1e3 * distances.mean_m,
                    "largest mm": 1e3 * distances.largest_m,
                    "normal deg": math.degrees(distances.normal_rad),
                    "cpu s": spent,
                    "faces/s": len(surface.faces) / max(spent, 1e-9),
                }
            )
    return rows


def _jumps(surface: TexturedSurface, name: str) -> list[dict[str, Any]]:
    """Jump of an erased texture across the seams of every level, at the seams' own mean over their length."""
    rows, columns = np.mgrid[0:TEXTURE_PX, 0:TEXTURE_PX]
    texels = 0.5 + 0.4 * np.stack([np.sin(0.11 * columns + 0.07 * rows), np.cos(0.05 * rows)], axis=2)
    erased = erase(texels, surface, find_seams(surface)).texels
    started = time.process_time()
    chain = decimate(surface, DecimateOptions(texture_px=TEXTURE_PX))
    spent = time.process_time() - started
    rows_out = []
    for level, lod in enumerate(chain.lods):
        jump = measure_seams(erased, lod.surface, find_seams(lod.surface))
        rows_out.append(
            {
                "mesh": name,
                "level": level,
                "faces": lod.num_faces,
                "% of full": 100.0 * lod.num_faces / len(surface.faces),
                "exact": lod.exact,
                "bound px": lod.uv_bound_px,
                "jump rms": float(np.max(jump.rms)),
                "jump max": float(np.max(jump.max)),
                "error mm": 1e3 * lod.error_m,
                "mean mm": 1e3 * lod.mean_error_m,
                "chain cpu s": spent,
            }
        )
    return rows_out


def _hills(cells: int) -> TexturedSurface:
    """A square of hills in one chart, two faces a cell."""
    side = np.linspace(0.0, 1.0, cells + 1)
    x, y = (values.ravel() for values in np.meshgrid(side, side))
    height = 0.05 * np.sin(9.0 * x) * np.cos(7.0 * y) + 0.01 * np.sin(40.0 * x + 25.0 * y)
    i, j = (values.ravel() for values in np.meshgrid(np.arange(cells), np.arange(cells)))
    a = j * (cells + 1) + i
    b, c, d = a + 1, a + cells + 2, a + cells + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return TexturedSurface(np.stack([x, y, height], axis=1), faces, np.stack([x, y], axis=1), faces)


def _curve() -> list[dict[str, Any]]:
    """Time to a tenth of the faces; the last column is flat where the time is n log n."""
    rows = []
    _ours(_hills(20), 80)
    for cells in CURVE_SIDES:
        surface = _hills(cells)
        count = len(surface.faces)
        _, spent = _ours(surface, count // 10)
        rows.append(
            {
                "faces": count,
                "to": count // 10,
                "cpu s": spent,
                "faces/s": count / spent,
                "ns / (n log2 n)": 1e9 * spent / (count * math.log2(count)),
            }
        )
    return rows


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Compare, measure jumps at every level, and time the curve; see the module's text."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks decimate", allow_abbrev=False)
    parser.add_argument("--curve", action="store_true", help="also time 10 thousand to 2 million faces (minutes)")
    parser.add_argument("--mesh", type=Path, action="append", help="measure these instead of the test characters")
    options = parser.parse_args(argv)
    paths = options.mesh or [ASSETS / name for name in MESHES if (ASSETS / name).is_file()]
    surfaces = {path.stem: straighten(read_surface(path), 0.01).surface for path in paths}
    tables = [
        [row for name, surface in surfaces.items() for row in _compare(surface, name)],
        [row for name, surface in surfaces.items() for row in _jumps(surface, name)],
    ]
    if options.curve:
        tables.append(_curve())
    for table in tables:
        print_table(table)
        print()
    return [row for table in tables for row in table]
