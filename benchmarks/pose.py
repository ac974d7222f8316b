"""Posing: milliseconds of processor time until skinning matrices of many actors are there, each at its own moment.

Every joint turns, so that the figure holds for any clip.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._table import print_table
from runtime.animation.clip import Clip, Track, read_clips
from runtime.animation.pose import sample, skinning_rows
from runtime.animation.skeleton import read_skeleton
from runtime.gltf.document import read_document

CHARACTERS = ("human.glb", "Fox.glb")
ROUNDS = 9


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure each character; the quickest of a few rounds."""
    parser = command_line("pose", __doc__)
    parser.add_argument("--actors", type=int, default=1000, metavar="N")
    parser.add_argument("--model", type=Path, action="append", help="measure these instead of the test characters")
    options = parser.parse_args(argv)
    rows = []
    for path in source_files(options.model, CHARACTERS, "--model FILE"):
        document = read_document(path)
        skin = document.item("skins", 0)
        skeleton = read_skeleton(document, skin["joints"], document.accessor(skin["inverseBindMatrices"]))
        walk = next(clip for clip in read_clips(document, skeleton) if clip.tracks)
        turn = next(track for track in walk.tracks if track.path == "rotation")
        tracks = tuple(
            Track(node, turn.path, turn.interpolation, turn.times, turn.values) for node in range(skeleton.num_nodes)
        )
        clip = Clip("all", walk.duration_s, tracks)
        times = np.linspace(0, 9, options.actors)
        spent = []
        for _ in range(ROUNDS):
            started = time.process_time()
            skinning_rows(skeleton, sample(clip, skeleton, times, loop=True, dtype=np.float32))
            spent.append(time.process_time() - started)
        rows.append(
            {
                "character": path.stem,
                "joints": skeleton.num_joints,
                "actors": options.actors,
                "ms": 1e3 * min(spent),
            }
        )
    print_table(rows)
    return rows
