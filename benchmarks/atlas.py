"""Atlases side by side: what a build takes, all charts made anew, and xatlas' charts.

All is measured on uvs as stored, at the size of the largest texture. `kept %`: of the surface, in charts of the
source. `stretch`: longer against shorter axis, for 99.9 % of the surface. `sparse` and `stretched`: faces of a pixel or
more, where the character is 1024 pixels large, with under a quarter of the median texels per metre or stretched more
than 4 : 1. `thin`: faces narrower than a texel. `seams`: their length in bounding diagonals. `reached`: faces at which
decimation stops with all seams intact. CPU seconds of the atlas alone, textures looked at included.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._table import print_table
from preprocess.atlas import character_atlas
from preprocess.atlas.chart_scales import NORMAL_SIZE_PX
from preprocess.atlas.measure import measure_coverage, measure_stretch, measure_texels
from preprocess.decimate import decimate_to
from preprocess.load import Character, load_character
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import snap_canonical_uvs
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.settings import Settings

CHARACTERS = (
    *("Fox.glb", "lumberjack.glb", "cat.glb", "phoenix_bird.glb", "robot.glb", "Knight.glb", "mannequiny.glb"),
    *("human.glb", "BrainStem.glb", "MorphStressTest.gltf", "AnimatedMorphCube/AnimatedMorphCube.gltf"),
)
WAYS = ("auto", "unwrap", "xatlas")


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure all characters in all ways."""
    parser = command_line("atlas", __doc__)
    parser.add_argument("--character", type=Path, action="append", help="measure these instead of the test characters")
    parser.add_argument("--way", choices=WAYS, action="append", help="only these ways")
    options = parser.parse_args(argv)
    paths = source_files(options.character, CHARACTERS, "--character FILE")
    rows = []
    for path in paths:
        character = load_character(path)
        for way in options.way or WAYS:
            rows.append({"character": path.stem, "faces": character.mesh.num_faces, **_measure(character, way)})
    print_table(rows)
    return rows


def _measure(character: Character, way: str) -> dict[str, Any]:
    try:
        surface, size_px, kept, mode, seconds = _make(character, way)
    except ModuleNotFoundError as error:
        return {"way": way, "why not": f"{error.name} is not installed"}
    stored = dataclasses.replace(surface, uvs=snap_canonical_uvs(surface.uvs))
    edges = find_edges(surface.faces)
    overlap = find_overlap(stored.uvs, stored.face_uvs)
    texels = measure_texels(stored, size_px)
    return {
        "way": mode,
        "kept %": 100.0 * kept,
        "charts": label_faces(edges, cut_edges(edges, surface.face_uvs))[0],
        "overlap": overlap.num_pairs + overlap.num_flat,
        "L2": measure_stretch(stored)[0],
        "stretch": texels["stretch"][-1],
        "sparse": texels["sparse_faces"],
        "stretched": texels["stretched_faces"],
        "thin": texels["thin_faces"],
        "side": size_px,
        "coverage %": 100.0 * measure_coverage(stored),
        "seams": find_seams(surface).lengths_m.sum() / surface.diagonal_m,
        "reached": len(decimate_to(surface, 4).lods[-1].faces),
        "cpu s": seconds,
    }


def _make(character: Character, way: str) -> tuple[TexturedSurface, int, float, str, float]:
    """The surface in its atlas, the largest texture's side, the share kept, what was done, and CPU seconds."""
    start = time.process_time()
    if way == "xatlas":
        surface = _unwrap_with_xatlas(character.mesh.surface)
        return surface, NORMAL_SIZE_PX, 0.0, "xatlas", time.process_time() - start
    atlas = character_atlas(character, dataclasses.replace(Settings(), atlas=way))  # type: ignore[arg-type]
    mode = atlas.mode if way == "auto" else "all anew"
    return atlas.mesh.surface, atlas.texels["size_px"], atlas.kept_share, mode, time.process_time() - start


def _unwrap_with_xatlas(surface: TexturedSurface) -> TexturedSurface:
    """Default charts of xatlas, packed with the same gutter, its rectangle fitted into the square."""
    import xatlas

    atlas = xatlas.Atlas()
    # It takes faces of less than a ten-millionth for flat, in whatever unit: a thousand units a character are enough.
    scale = 1000.0 / np.ptp(surface.positions, axis=0).max()
    atlas.add_mesh((scale * surface.positions).astype(np.float32), surface.faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = 1024, 8, True
    atlas.generate(pack_options=packing)
    vertices, face_uvs, uvs = atlas[0]
    assert (vertices[face_uvs] == surface.faces).all()
    uvs = uvs.astype(np.float64) * (atlas.width, atlas.height) / max(atlas.width, atlas.height)
    return TexturedSurface(surface.positions, surface.faces, uvs, face_uvs.astype(np.int32))
