"""What a build's seam erasure costs: CPU time against the number of charts, and against the texture's size.

A sheet of quads is cut into square charts, shuffled over the atlas and turned, so that every chart meets strangers at
all of its sides: 4 to 2,025 charts at 1024², then 64 charts from 256² to 8192². Texels are waves with noise on them.
The exponent is the slope of log CPU time over log seam texels, by least squares, without the smallest cases.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks._inputs import command_line
from benchmarks._table import print_table

CHARTS = (4, 16, 64, 256, 1024, 2025)
SIDES = (256, 512, 1024, 2048, 4096, 8192)
AT_PX, OF_CHARTS = 1024, 64
GUTTER = 0.12  # of a chart's cell
LEAST_TEXELS = 2000  # below it, what does not grow with the seams is most of the time


def shuffled_sheet(num_charts: int) -> Any:
    """A wavy sheet of about as many square charts, shuffled, four at least."""
    from preprocess.mesh.surface import TexturedSurface

    side = max(round(np.sqrt(num_charts)), 2)
    cells = np.random.default_rng(0).permutation(side * side)
    corner = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    faces, uvs, face_uvs = [], [], []
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0))
    positions = np.stack([x, y, np.sin(x) + np.cos(y)], axis=-1).reshape(-1, 3)
    for chart in range(side * side):
        row, column = divmod(chart, side)
        angle = 0.2 * np.sin(7.0 * chart)
        turn = np.array([(np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))])
        place = np.array(divmod(int(cells[chart]), side))[::-1]
        uvs.append((place + 0.5 + (1 - 2 * GUTTER) * 0.8 * (corner - 0.5) @ turn.T) / side)
        quad = index[row + corner[:, 1], column + corner[:, 0]]
        for triangle in ((0, 1, 2), (0, 2, 3)):
            faces.append(quad[list(triangle)])
            face_uvs.append(4 * chart + np.array(triangle))
    return TexturedSurface(positions, np.array(faces, np.int32), np.concatenate(uvs), np.array(face_uvs, np.int32))


def waves(side: int) -> Any:
    """A texture of smooth waves with noise, (side, side, 3) float32 in [0, 1]."""
    rng = np.random.default_rng(1)
    u = (np.arange(side, dtype=np.float32) + 0.5) / side
    texels = np.empty((side, side, 3), np.float32)
    for channel in range(3):
        texels[..., channel] = 0.5 + 0.3 * np.sin(9 * u + channel) * np.cos(7 * u[:, None])
    return np.clip(texels + rng.normal(0.0, 0.02, texels.shape).astype(np.float32), 0.0, 1.0)


def measure(num_charts: int, side: int) -> dict[str, Any]:
    """A row: CPU seconds of finding the band and of closing the seams, 8-bit, one level."""
    from preprocess.erase.local.band import plan_band
    from preprocess.erase.local.closing import close_seams
    from preprocess.erase.options import EraseOptions
    from preprocess.mesh.seams import find_seams

    surface, texels = shuffled_sheet(num_charts), waves(side)
    seams = find_seams(surface)
    start = time.process_time()
    band = plan_band(surface, seams, side, side, EraseOptions())
    planned = time.process_time()
    closed = close_seams(texels, band, levels=255)
    assert closed is not None
    done = time.process_time()
    return {
        "charts": len(surface.faces) // 2,
        "size": f"{side}²",
        "seam texels": len(band.seam_texels),
        "band": len(band.texels),
        "plan cpu_s": planned - start,
        "close cpu_s": done - planned,
        "us per seam texel": 1e6 * (done - start) / max(len(band.seam_texels), 1),
        "stored jump of 255": 255 * float(closed.stored.max.max(initial=0.0)),
    }


def exponent(rows: list[dict[str, Any]]) -> float:
    """Slope of log CPU time over log seam texels."""
    used = [row for row in rows if row["seam texels"] >= LEAST_TEXELS]
    if len(used) < 2:
        return float("nan")
    texels = np.log([row["seam texels"] for row in used])
    seconds = np.log([row["plan cpu_s"] + row["close cpu_s"] for row in used])
    return float(np.polyfit(texels, seconds, 1)[0])


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print; return the rows."""
    parser = command_line("closing", __doc__)
    parser.add_argument("--most-charts", type=int, default=CHARTS[-1], metavar="N")
    parser.add_argument("--most-texels", type=int, default=SIDES[-1], metavar="SIDE", help="of the largest texture")
    options = parser.parse_args(argv)
    measure(4, 64)  # compiles, or loads, the kernels
    rows: list[dict[str, Any]] = []
    for name, cases in (
        ("charts", [(charts, AT_PX) for charts in CHARTS if charts <= options.most_charts]),
        ("size", [(OF_CHARTS, side) for side in SIDES if side <= options.most_texels]),
    ):
        found = [measure(*case) for case in cases]
        print_table(found)
        print(f"exponent of CPU time over seam texels, by {name}: {exponent(found):.2f}\n", flush=True)
        rows += found
    return rows
