"""Built characters against their sources: how far the finest level's vertices are off, and what it takes in memory.

Every vertex of the finest level is fetched as the GPU fetches it (positions in words, weight cells with their details)
and skinned in 64 bits in moments of all clips, beside the source's own vertex with the source's own weights. Errors are
fractions of the bounding diagonal in percent. Memory is that of geometry, weights and all levels, beside the classic
chain of the same levels: vertex attributes as glTF has them, and packed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks._inputs import ASSETS, BUILT_HELP, built_characters, command_line, source_of
from benchmarks._table import print_table
from benchmarks.draw import CLASSIC_VERTEX_BYTES
from preprocess.arrays import Floats
from preprocess.fit.weight_quadtree import sample_weights
from preprocess.load import Character, load_character
from preprocess.mesh.texels import sample_bilinear
from runtime.animation.pose import rest_pose, sample, skinning_rows
from runtime.asset.asset import Asset, load
from runtime.asset.weight_stack import unpack_weights
from runtime.gpu.textures import prepare
from runtime.gpu.vertex_layout import index_bytes, uv_attributes, vertex_bytes

CANDIDATES = 8  # nearest source vertices among which a vertex finds its own: parts may touch


def fetched_vertices(asset: Asset) -> tuple[Floats, Floats]:
    """Rest positions (V, 3) and dense weights (V, J) of the finest level's surface vertices, as they are drawn."""
    prepared = prepare(asset)
    places = np.unique(asset.lods[0].canonical_uvs, axis=0).astype(np.float64)
    texels = prepared.positions.metres
    stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
    return sample_bilinear(texels, places), sample_weights(stored, asset.weight_details, places)


def match(source: Floats, source_weights: Floats, positions: Floats, weights: Floats) -> NDArray[np.int64]:
    """The drawn vertex of each source vertex: the nearest, and of several in one place the one with its weights.

    The finest level may have vertices of its own besides, where edges were divided to straighten a seam.
    """
    count = min(CANDIDATES, len(positions))
    distance, nearest = (np.asarray(a).reshape(-1, count) for a in cKDTree(positions).query(source, k=count))
    unlike = np.abs(weights[nearest] - source_weights[:, None]).max(axis=2)
    diagonal = np.linalg.norm(np.ptp(source, axis=0))
    best = (distance / diagonal + 1e-3 * unlike).argmin(axis=1)
    return np.asarray(np.take_along_axis(nearest, best[:, None], axis=1)[:, 0], np.int64)


def skin(rows: Floats, weights: Floats, positions: Floats) -> Floats:
    """Linear blend skinning in 64 bits: (J, 3, 4), (V, J), (V, 3) to (V, 3)."""
    blended = (weights @ rows.reshape(len(rows), 12)).reshape(-1, 3, 4)
    result: Floats = np.einsum("vrc,vc->vr", blended[..., :3], positions) + blended[..., 3]
    return result


def measure_errors(asset: Asset, character: Character, moments: int) -> dict[str, Any]:
    """Errors of the finest level at rest and over all clips, percent of the diagonal."""
    mesh = character.mesh
    positions, weights = fetched_vertices(asset)
    dense = mesh.dense_weights(asset.num_joints)
    source = mesh.surface.positions
    own = match(source, dense, positions, weights)
    positions, weights = positions[own], weights[own]
    percent = 100.0 / mesh.surface.diagonal_m
    rest = np.linalg.norm(positions - source, axis=1) * percent
    skeleton = asset.skeleton
    poses = [skinning_rows(skeleton, rest_pose(skeleton))]
    for clip in asset.clips:
        poses.append(skinning_rows(skeleton, sample(clip, skeleton, np.linspace(0.0, clip.duration_s, moments))))
    squares, largest = [], 0.0
    for rows in np.concatenate(poses):
        apart = skin(rows, weights, positions) - skin(rows, dense, source)
        error = np.linalg.norm(apart, axis=1) * percent
        squares.append((error**2).mean())
        largest = max(largest, float(error.max()))
    return {
        "rest rms %": float(np.sqrt((rest**2).mean())),
        "rest max %": float(rest.max()),
        "posed rms %": float(np.sqrt(np.mean(squares))),
        "posed max %": largest,
        "weight max": float(np.abs(weights - dense).max()),
    }


def measure_memory(asset: Asset) -> dict[str, Any]:
    """Bytes by part, and the classic chain's."""
    prepared = prepare(asset)
    indices = sum(len(index_bytes(mesh, mesh.triangles)) for mesh in asset.lods)
    attributes = uv_attributes(asset.lods)
    levels = indices + sum(len(vertex_bytes(mesh, attributes)) for mesh in asset.lods)
    levels += sum(2 * mesh.normal_uvs.size for mesh in asset.lods if mesh.normal_uvs is not None)
    ours = prepared.positions.texels.nbytes + prepared.weight_cells.nbytes + levels
    row: dict[str, Any] = {
        "position": prepared.positions.texels.nbytes,
        "weights": prepared.weight_cells.nbytes,
        "levels": levels,
        "bytes": ours,
    }
    for name, per_vertex in CLASSIC_VERTEX_BYTES.items():
        row[f"classic {name}"] = per_vertex * sum(len(mesh.uvs) for mesh in asset.lods) + indices
    return row


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print; one row per character."""
    parser = command_line("accuracy", __doc__)
    parser.add_argument("--built", type=Path, nargs="+", help=BUILT_HELP)
    parser.add_argument("--sources", type=Path, default=ASSETS, help="folder of the files they were built from")
    parser.add_argument("--moments", type=int, default=9, help="of each clip (9)")
    options = parser.parse_args(argv)
    errors, memory = [], []
    for folder in built_characters(options.built):
        asset = load(folder)
        size = "{}x{}".format(*asset.textures["position"].size)
        name = {"character": asset.name}
        memory.append(
            {**name, "position px": size, "weights px": "{}x{}".format(*asset.weight_size), **measure_memory(asset)}
        )
        source = source_of(asset, options.sources)
        if source is not None:
            errors.append({**name, **measure_errors(asset, load_character(source), options.moments)})
    print_table(errors)
    print()
    print_table(memory)
    return [*errors, *memory]
