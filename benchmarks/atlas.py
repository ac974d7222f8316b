"""Atlases side by side: the source's charts kept or packed anew, xatlas' charts, and the base-mesh unwrap.

Seams of all but the unwrap are straightened at the least tolerance of `auto` with which decimation reaches the floor
asked for, or at the largest. `reached` is where decimation really stops with all seams intact; `seams` is the seams'
length in bounding diagonals; `jump` and `error` are of a 512 x 512 position texture: the largest jump across seams
before and after erasure, and the RMS distance of the surface read back at the middle of the faces, all in 1/1000 of
the bounding diagonal. CPU seconds of the atlas alone.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._table import print_table
from preprocess.atlas import build_atlas, default_floor
from preprocess.atlas.measure import measure_coverage, measure_stretch, straight_share
from preprocess.bake.geometry import bake_positions, vertex_values
from preprocess.decimate import decimate_to
from preprocess.erase import LOCAL, EraseOptions, plan_erasure
from preprocess.errors import InputError
from preprocess.load import load_character
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.seams import find_seams
from preprocess.mesh.split_edges import apply_split
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.straighten import straighten

CHARACTERS = ("human.glb", "Fox.glb", "Knight.glb", "robot.glb", "mannequiny.glb")
TOLERANCES_REL = (0.01, 0.02, 0.03, 0.05)
WAYS = ("keep", "repack", "xatlas", "unwrap")
TEXTURE_PX = 512


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure all characters in all ways that they allow."""
    parser = command_line("atlas", __doc__)
    parser.add_argument("--character", type=Path, action="append", help="measure these instead of the test characters")
    parser.add_argument("--way", choices=WAYS, action="append", help="only these ways")
    options = parser.parse_args(argv)
    paths = source_files(options.character, CHARACTERS, "--character FILE")
    rows = []
    for path in paths:
        mesh = load_character(path).mesh
        for way in options.way or WAYS:
            rows.append({"character": path.stem, "faces": mesh.num_faces, "way": way, **_measure(mesh, way)})
    print_table(rows)
    return rows


def _measure(mesh: SkinnedMesh, way: str) -> dict[str, Any]:
    floor = default_floor(mesh.num_faces)
    for tolerance in TOLERANCES_REL:
        started = time.process_time()
        try:
            made = _make(mesh, way, tolerance)
        except InputError as error:
            return {"why not": str(error).partition(": ")[2] or str(error)}
        except ModuleNotFoundError as error:
            return {"why not": f"{error.name} is not installed"}
        seconds = time.process_time() - started
        overlap = find_overlap(made.surface.uvs, made.surface.face_uvs)
        if not overlap.one_to_one:
            return {"why not": f"{overlap.num_pairs} faces overlap, {overlap.num_flat} are flat"}
        reached = len(decimate_to(made.surface, 4).lods[-1].faces)
        if way == "unwrap" or reached <= floor:
            break
    edges = find_edges(made.surface.faces)
    stretch = measure_stretch(made.surface)
    return {
        "charts": label_faces(edges, cut_edges(edges, made.surface.face_uvs))[0],
        "tolerance": "" if way == "unwrap" else tolerance,
        "goal": floor,
        "reached": reached,
        "L2": stretch[0],
        "Linf": stretch[1],
        "coverage %": 100 * measure_coverage(made.surface),
        "seams": find_seams(made.surface).lengths_m.sum() / made.surface.diagonal_m,
        "straight %": 100 * straight_share(made.surface),
        **_measure_positions(made),
        "cpu s": seconds,
    }


def _make(mesh: SkinnedMesh, way: str, tolerance: float) -> SkinnedMesh:
    if way != "xatlas":
        return build_atlas(mesh, mode=way, straighten_rel=tolerance, size_px=TEXTURE_PX).mesh
    mesh = _unwrap_with_xatlas(mesh)
    result = straighten(mesh.surface, tolerance)
    return apply_split(mesh, result.split).with_surface(result.surface)


def _unwrap_with_xatlas(mesh: SkinnedMesh) -> SkinnedMesh:
    """Default charts of xatlas, packed at the same size with the same gutter."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.surface.positions.astype(np.float32), mesh.surface.faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = TEXTURE_PX, 4, True
    atlas.generate(pack_options=packing)
    vertices, face_uvs, uvs = atlas[0]
    assert (vertices[face_uvs] == mesh.surface.faces).all()
    charts = TexturedSurface(
        mesh.surface.positions, mesh.surface.faces, uvs.astype(np.float64), face_uvs.astype(np.int32)
    )
    return mesh.with_surface(charts)


def _measure_positions(mesh: SkinnedMesh) -> dict[str, Any]:
    """What a position texture in this atlas loses."""
    surface = mesh.surface
    scale = 1e3 / surface.diagonal_m
    unit = dataclasses.replace(surface, positions=surface.positions * scale)
    texels = bake_positions(mesh.with_surface(unit), (TEXTURE_PX, TEXTURE_PX))
    options = EraseOptions(weights=dataclasses.replace(LOCAL, samples=1e8), seam_weight=1e8)
    plan = plan_erasure(unit, find_seams(unit), TEXTURE_PX, TEXTURE_PX, options, sample_uvs=unit.uvs)
    before = plan.measure(texels)
    erased = plan.erase(texels, sample_values=vertex_values(mesh, unit.positions)).texels
    after = plan.measure(erased)
    middle = surface.uvs[surface.face_uvs].mean(axis=1)
    truth = unit.positions[unit.faces].mean(axis=1)
    area = np.linalg.norm(
        np.cross(
            surface.positions[surface.faces[:, 1]] - surface.positions[surface.faces[:, 0]],
            surface.positions[surface.faces[:, 2]] - surface.positions[surface.faces[:, 0]],
        ),
        axis=1,
    )
    error_sq = ((sample_bilinear(erased, middle) - truth) ** 2).sum(axis=1)
    return {
        "jump before": float(before.max.max(initial=0.0)),
        "jump after": float(after.max.max(initial=0.0)),
        "error": float(np.sqrt((error_sq * area).sum() / area.sum())),
    }
