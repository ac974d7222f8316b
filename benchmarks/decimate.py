"""Decimation: error and speed at equal face counts beside other decimaters, jumps at every level, the n log n curve.

Other decimaters are measured where they are installed: fast-simplification (which ignores uvs) and MeshLab's textured
decimation (pymeshlab). The reference decimater is run where the environment variable SEAM_DECIMATER names its program
(its time includes reading and writing). FLIP is that of pictures against full detail, on the pixels that either covers,
with the character's own texture; each mesh is drawn with smooth normals of its own. All other times are CPU seconds of
the decimation alone, without reading or writing files.
`--curve` runs from 10 thousand to 2 million faces.
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._mesh_pictures import MeshStudio, mean_flip
from benchmarks._table import print_table
from preprocess.decimate import DecimateOptions, Lod, decimate, decimate_to
from preprocess.decimate.chain import NEAR_FLOOR_REL
from preprocess.decimate.measure import make_reference, measure
from preprocess.decimate.state import make_engine
from preprocess.erase import erase, measure_seams
from preprocess.files.images import read_image
from preprocess.files.obj import read_obj, write_obj
from preprocess.load import load_character
from preprocess.load.read_surface import read_surface
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten import straighten
from preprocess.straighten.warp import find_warp

MESHES = ("human.glb", "blub.obj")
RATIOS = (0.5, 0.25, 0.1, 0.05)
CURVE_SIDES = (71, 158, 354, 500, 707, 1000)  # cells along a square; two faces each
TEXTURE_PX = 256
PICTURE_PX = 400
FAR_PICTURE_PX = 128


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


def _reference_decimater(program: str, surface: TexturedSurface, target: int) -> tuple[Lod, float]:
    """The paper's authors' program; a collapse takes one vertex and two faces."""
    num_vertices = len(surface.positions) - (len(surface.faces) - target) // 2
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "source.obj"
        write_obj(source, surface)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [program, str(source), "num-vertices", str(num_vertices)], check=True, capture_output=True, timeout=600
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        results = [path for path in Path(folder).glob("*.obj") if path != source]
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return _as_lod(read_obj(results[0])), spent


OTHERS = (
    ("fast-simplification (no uv)", "fast_simplification", _fast_simplification),
    ("MeshLab with texture", "pymeshlab", _meshlab),
)


def _compare(surface: TexturedSurface, name: str, studio: MeshStudio | None) -> list[dict[str, Any]]:
    """Every decimater at every ratio."""
    methods: dict[str, Callable[[TexturedSurface, int], tuple[Lod, float]]] = {"seamskin": _ours}
    for label, package, method in OTHERS:
        module = _installed(package)
        if module is not None:
            methods[label] = functools.partial(method, module)
        else:
            print(f"({package} is not installed: left out)")
    program = os.environ.get("SEAM_DECIMATER")
    if program:
        methods["reference"] = functools.partial(_reference_decimater, program)
    reference = make_reference(surface)
    full = studio.pictures(surface, PICTURE_PX) if studio else []
    _ours(surface, len(surface.faces) // 2)  # compile
    rows = []
    for ratio in RATIOS:
        target = round(ratio * len(surface.faces))
        for label, decimater in methods.items():
            try:
                lod, spent = decimater(surface, target)
            except subprocess.CalledProcessError as error:
                print(f"({label} failed on {name} to {target} faces with exit status {error.returncode})")
                continue
            has_uvs = len(lod.uvs) > 1
            flip = mean_flip(full, studio.pictures(lod.surface, PICTURE_PX)) if studio and has_uvs else math.nan
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
                    "FLIP": flip,
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


def _relaxed(surface: TexturedSurface, name: str, studio: MeshStudio) -> list[dict[str, Any]]:
    """A relaxed level beside the exact one of as many faces, both drawn where the relaxed one begins to be used."""
    options = DecimateOptions()
    engine = make_engine(surface, options)
    engine.run_to(math.floor(NEAR_FLOOR_REL * engine.predict_floor()))
    exact, reference = engine.copy(), make_reference(surface)
    exact.run_to(1)
    least = exact.num_faces
    rows = []
    for share in (1.0, 1.15):
        exact, relaxed = engine.copy(), engine.copy()
        exact.run_to(math.ceil(share * least))
        before = measure(reference, engine.snapshot())
        relaxed.relax(options.relaxed_px * before.largest_m / engine.metres_per_uv)
        relaxed.run_to(exact.num_faces)
        lods = {"exact": exact.snapshot(), "relaxed": relaxed.snapshot()}
        strayed_m = relaxed.deviation_uv * engine.metres_per_uv
        error_m = max(measure(reference, lods["relaxed"]).largest_m, strayed_m / options.relaxed_px)
        full = studio.pictures(surface, FAR_PICTURE_PX, 1.0 / error_m)
        for kind, lod in lods.items():
            distances = measure(reference, lod)
            rows.append(
                {
                    "mesh": name,
                    "level": kind,
                    "faces": lod.num_faces,
                    "strayed mm": 1e3 * strayed_m if kind == "relaxed" else 0.0,
                    "largest mm": 1e3 * distances.largest_m,
                    "mean mm": 1e3 * distances.mean_m,
                    "seen px tall": studio.extent_m / error_m,
                    "FLIP": mean_flip(full, studio.pictures(lod.surface, FAR_PICTURE_PX, 1.0 / error_m)),
                }
            )
    return rows


def _prepare(path: Path) -> tuple[TexturedSurface, MeshStudio | None]:
    """A mesh with its seams straightened, and a studio with its texture moved along, where it has one."""
    result = straighten(read_surface(path), 0.01)
    beside = path.with_suffix(".png")
    if path.suffix == ".obj":
        image = read_image(beside) if beside.is_file() else None
    else:
        materials = load_character(path).materials
        texture = materials[0].base_color if len(materials) == 1 else None
        image = texture.image if texture else None
    if image is None or _installed("flip_evaluator") is None:
        print(f"({path.name}: no pictures without one texture and flip-evaluator)")
        return result.surface, None
    height, width = image.texels.shape[:2]
    warp = find_warp(result.split.surface, result.surface, width, height)
    return result.surface, MeshStudio(warp.apply(image.texels), result.surface)


def _hills(cells: int) -> TexturedSurface:
    """A square of hills in one chart, two faces per cell."""
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
    parser = command_line("decimate", __doc__)
    parser.add_argument("--curve", action="store_true", help="also time 10 thousand to 2 million faces (minutes)")
    parser.add_argument("--mesh", type=Path, action="append", help="measure these instead of the test characters")
    options = parser.parse_args(argv)
    paths = source_files(options.mesh, MESHES, "--mesh FILE")
    prepared = {path.stem: _prepare(path) for path in paths}
    tables = [
        [row for name, (surface, studio) in prepared.items() for row in _compare(surface, name, studio)],
        [row for name, (surface, studio) in prepared.items() if studio for row in _relaxed(surface, name, studio)],
        [row for name, (surface, _) in prepared.items() for row in _jumps(surface, name)],
    ]
    if options.curve:
        tables.append(_curve())
    for table in tables:
        print_table(table)
        print()
    return [row for table in tables for row in table]
