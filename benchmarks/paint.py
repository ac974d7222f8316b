"""Paint beside seams: what closing them costs the base colour, by how closely they are closed.

The base colour as it is baked into the atlas has two values at every point of a seam; nothing that is the same on both
sides can be nearer to both than half of what is between them (`half the jump`). How far the erased texture is from the
middle of the two along the joined seams, in steps of 255: root mean square, and the 99th percentile; and its largest
jump as it is stored. `exact` closes seams to the last digit, `priced` has every jump cost by its square (weight 1e10),
`limited` lets jumps of a fifth of a step be free, as characters are built.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._table import print_table
from preprocess.arrays import Floats
from preprocess.atlas import character_atlas
from preprocess.erase import EraseOptions, erase_mips
from preprocess.fit.textures import JUMP_LIMIT, SEAM_WEIGHT, TextureStage
from preprocess.load import load_character
from preprocess.load.pose_sampling import sample_poses
from preprocess.mesh.texels import sample_bilinear
from preprocess.settings import Settings

MODELS = ("Fox.glb", "human.glb")
POINTS_PER_TEXEL = 4
STORED = "uint8"


def seam_points(lines_uv: Floats, size_px: int) -> Floats:
    """Both places of points along seams, (2, N, 2), evenly spaced; from the seams' ends (S, 2, 2, 2)."""
    length_px = np.linalg.norm(lines_uv[:, :, 1] - lines_uv[:, :, 0], axis=2).max(axis=1) * size_px
    counts = np.ceil(length_px * POINTS_PER_TEXEL).astype(np.int64) + 1
    seam = np.repeat(np.arange(len(lines_uv)), counts)
    share = (np.arange(len(seam)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[seam]
    ends = lines_uv[seam].swapaxes(0, 1)
    result: Floats = ends[:, :, 0] + share[:, None] * (ends[:, :, 1] - ends[:, :, 0])
    return result


def measure(model: Path, size_px: int | None) -> list[dict[str, Any]]:
    """A row for every way to close the seams."""
    character = load_character(model)
    settings = Settings(color_size_px=size_px)
    stage = TextureStage(character, character_atlas(character, settings), sample_poses(character), settings)
    job = next(job for job in stage._materials() if job.name == "base_color")
    surface, seams = job.erased_on or (stage.mesh.surface, stage.seams)
    joined = None if job.erased_on else job.decision.joined
    side = job.baked.shape[0]
    lines = surface.uvs[seams.uv_pairs if joined is None else seams.uv_pairs[joined]]
    places = seam_points(lines, side)
    colors = [sample_bilinear(job.baked[:, :, :3], place) for place in places]
    middle = 0.5 * (colors[0] + colors[1])
    gap = 255 * (colors[0] - middle)
    name = {"character": model.stem, "texture": f"{side}²"}
    rows: list[dict[str, Any]] = [{**name, "closed": "half the jump", "rms": float(np.sqrt((gap**2).mean()))}]
    ways: dict[str, dict[str, float | None]] = {
        "exact": {"seam_weight": None, "jump_limit": None},
        "priced": {"seam_weight": 1e10, "jump_limit": None},
        "limited": {"seam_weight": SEAM_WEIGHT[STORED], "jump_limit": JUMP_LIMIT[STORED]},
    }
    for way, how in ways.items():
        options: EraseOptions = dataclasses.replace(stage.options(joined, STORED), **how)  # type: ignore[arg-type]
        level = erase_mips(job.baked, surface, seams, options, levels=255, smallest=side)[0]
        found = sample_bilinear(level.texels[:, :, :3] / 255.0, places[0])
        off = 255 * np.abs(found - middle)
        rows.append(
            {
                **name,
                "closed": way,
                "rms": float(np.sqrt((off**2).mean())),
                "99 %": float(np.percentile(off, 99)),
                "largest jump as stored": 255 * float(level.stored.max.max()),
            }
        )
    return rows


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print."""
    parser = command_line("paint", __doc__)
    parser.add_argument("--models", type=Path, nargs="+", help="instead of Fox and human")
    parser.add_argument("--color-size", type=int, metavar="N", help="side of the texture (the source's density)")
    options = parser.parse_args(argv)
    rows = []
    for model in source_files(options.models, MODELS, "--models FILE"):
        rows += measure(model, options.color_size)
    print_table(rows)
    return rows
