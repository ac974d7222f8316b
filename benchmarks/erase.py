"""Seam erasure: time, memory and jump of our integer path, beside the paper's authors' program where it is there.

Every measurement runs in a process of its own, so that peak memory is its own: the whole process, its libraries
included, and what erasure added to a process that had imported them. Times are of reading nothing and writing nothing:
plan and solve, from texels to stored texels. The reference (zfergus/seam-erasure) runs where it can be imported or the
environment variable SEAM_ERASURE names a checkout; SEAM_ERASURE_PYTHON may name the Python that has its dependencies.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._inputs import ASSETS, MissingInput, command_line, source_files
from benchmarks._table import print_table

CURVE = (256, 512, 1024, 2048, 4096, 8192)

# ru_maxrss would count the parent's memory at the fork too.
PEAK = """
def max_resident_mb():
    try:
        lines = open("/proc/self/status").read().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except OSError:
        import resource
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
"""

OURS = """
import json, sys, time
import numpy as np
from preprocess.erase import plan_erasure
from preprocess.files.obj import read_obj
from preprocess.mesh.seams import find_seams

mesh, image, channels, output = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4]
surface = read_obj(__import__("pathlib").Path(mesh))
seams = find_seams(surface)
tiny = np.zeros((16, 16, 1), np.uint8)  # imports what is imported when it is used
plan_erasure(surface, seams, 16, 16).erase_stored(tiny)
texels = np.load(image)
if channels:
    texels = np.ascontiguousarray(np.tile(texels, (1, 1, -(-channels // texels.shape[2])))[:, :, :channels])
start_mb, wall, cpu = max_resident_mb(), time.perf_counter(), time.process_time()
plan = plan_erasure(surface, seams, texels.shape[1], texels.shape[0])
erased = plan.erase_stored(texels)
row = {"s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu, "peak_mb": max_resident_mb(),
       "added_mb": max_resident_mb() - start_mb, "unknowns": len(plan.grid.free),
       "D_before": float(erased.before.max()), "D_after": float(erased.after.max())}
np.save(output, erased.texels)
print(json.dumps(row))
"""

REFERENCE = """
import json, os, sys, time
import numpy as np
checkout = os.environ.get("SEAM_ERASURE")
if checkout:
    sys.path.insert(0, checkout)
from seam_erasure import obj_reader, seam_erasure

mesh, image, output = sys.argv[1], sys.argv[2], sys.argv[4]
mesh = obj_reader.quads_to_triangles(obj_reader.load_obj(mesh))
texels = np.load(image)[::-1] / 255.0  # its v runs up
start_mb, wall, cpu = max_resident_mb(), time.perf_counter(), time.process_time()
solved = seam_erasure.erase_seam(mesh, texels).reshape(texels.shape)[::-1]
row = {"s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu,
       "peak_mb": max_resident_mb(), "added_mb": max_resident_mb() - start_mb}
np.save(output, np.rint(np.clip(solved, 0, 1) * 255).astype(np.uint8))
np.save(output + ".solved.npy", solved)
print(json.dumps(row), flush=True)
os._exit(0)
"""


def has_reference() -> bool:
    """Whether the authors' program can be run."""
    return "SEAM_ERASURE" in os.environ or importlib.util.find_spec("seam_erasure") is not None


def _run(program: str, *arguments: Any, python: str = sys.executable) -> dict[str, Any]:
    done = subprocess.run(
        [python, "-c", PEAK + program, *map(str, arguments)], capture_output=True, text=True, check=True, timeout=3600
    )
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _measure(name: str, mesh: Path, texels: Any, folder: Path, channels: int, reference: bool) -> dict[str, Any]:
    """One row of the table."""
    import numpy as np

    from preprocess.erase import measure_seams
    from preprocess.files.obj import read_obj
    from preprocess.mesh.seams import find_seams

    image, output, theirs = folder / "image.npy", folder / "ours.npy", folder / "theirs.npy"
    np.save(image, texels)
    ours = _run(OURS, mesh, image, channels, output)
    row: dict[str, Any] = {
        "input": name,
        "size": f"{texels.shape[1]}²",
        "channels": channels or texels.shape[2],
        **ours,
    }
    surface = read_obj(mesh)
    seams = find_seams(surface)
    before, stored = (measure_seams(t, surface, seams) for t in (texels, np.load(output)))
    row |= {"rms_before": _rms(before), "max_before": float(before.max.max())}
    row |= {"rms": _rms(stored), "max": float(stored.max.max())}
    if reference:
        other = _run(
            REFERENCE, mesh, image, channels, theirs, python=os.environ.get("SEAM_ERASURE_PYTHON", sys.executable)
        )
        measured = measure_seams(np.load(theirs), surface, seams)
        solved = measure_seams(np.load(f"{theirs}.solved.npy"), surface, seams)
        row |= {f"ref_{key}": value for key, value in other.items()}
        row |= {"ref_D_after": float(solved.total.max()), "ref_rms": _rms(measured)}
        row |= {"ref_max": float(measured.max.max()), "times_faster": other["cpu_s"] / ours["cpu_s"]}
        row |= {"memory_ratio": other["peak_mb"] / ours["peak_mb"]}
        row |= {"added_memory_ratio": other["added_mb"] / max(ours["added_mb"], 1.0)}
    return row


def _rms(measure: Any) -> float:
    return float((measure.total.mean()) ** 0.5)


def _resize(texels: Any, side: int) -> Any:
    """Box filter down or repeat up to a side that divides or is divided by the image's."""
    import numpy as np

    height, width, channels = texels.shape
    if side >= width:
        return np.repeat(np.repeat(texels, side // height, axis=0), side // width, axis=1)
    k = width // side
    return np.rint(texels.reshape(side, k, side, k, channels).mean(axis=(1, 3))).astype(np.uint8)


def _inputs(options: argparse.Namespace, folder: Path) -> list[tuple[str, Path, Any]]:
    """Name, OBJ file and texels of every input."""
    from preprocess.files.images import read_image
    from preprocess.files.obj import write_obj
    from preprocess.load.read_surface import read_surface

    chosen = None if options.mesh is None else [options.mesh]
    inputs = []
    for mesh in source_files(chosen, ("blub.obj", "Fox.glb"), "--mesh FILE --image FILE"):
        name, image = mesh.stem, options.image
        if image is None and mesh.suffix == ".obj":
            image = ASSETS / "blub.png" if chosen is None else mesh.with_suffix(".png")
        if image is not None and not image.is_file():
            raise MissingInput(f"no image of {mesh.name}: give --image FILE")
        write_obj(folder / f"{name}.obj", read_surface(mesh))
        if image is None:
            from preprocess.load import load_character

            texture = load_character(mesh).materials[0].base_color
            if texture is None:
                raise MissingInput(f"{mesh.name} has no base colour texture: give --image FILE")
            texels = (texture.image.texels[..., :3] * 255).round().astype("uint8")
        else:
            texels = read_image(image, native=True).texels
        inputs.append((name, folder / f"{name}.obj", texels))
    return inputs


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print; return the rows."""
    parser = command_line("erase", __doc__)
    parser.add_argument("--mesh", type=Path, help="measure this one instead of blub and Fox")
    parser.add_argument("--image", type=Path, help="its texture (default: the file's own, or the PNG beside it)")
    parser.add_argument("--curve", action="store_true", help="256² to 8192² of the first input")
    parser.add_argument("--channels", action="store_true", help="64 channels at 1024²")
    options = parser.parse_args(argv)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        inputs = _inputs(options, folder)
        for what, mesh, texels in inputs:
            rows.append(_measure(what, mesh, texels, folder, 0, has_reference()))
            print_table(rows[-1:])
        if inputs and options.channels:
            what, mesh, texels = inputs[0]
            rows.append(_measure(what, mesh, _resize(texels, 1024), folder, 64, False))
        if inputs and options.curve:
            what, mesh, texels = inputs[0]
            for side in CURVE:
                rows.append(_measure(what, mesh, _resize(texels, side), folder, 0, False))
    print_table(rows)
    return rows


def main() -> None:
    """Run with the process's own arguments."""
    run(sys.argv[1:])
