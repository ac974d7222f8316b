"""What tessellating a level of detail does to its distance from full detail, at rest.

Every level is divided as the shaders divide it, edges into equal parts and faulty triangles left flat, and compared
with the finest level as it is drawn: largest and mean distance, both ways, in thousandths of the character's diagonal.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._inputs import command_line, one_built_character
from benchmarks._table import print_table
from preprocess.decimate.measure import sample_mesh
from preprocess.mesh.closest_point import build_tree
from preprocess.mesh.texels import sample_bilinear
from runtime.asset.asset import Asset, load
from runtime.asset.lod_mesh import LodMesh
from runtime.gpu.patch_validation import divided_patches
from runtime.gpu.patches import corner_uvs

FACTORS = (2, 4, 8)
MOST_TRIANGLES = 300_000
NUM_SAMPLES = 8192


def _grid(segments: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Barycentric coordinates of a divided triangle, (S, 3), and its small triangles, (K, 3)."""
    places = [(i, j) for i in range(segments + 1) for j in range(segments + 1 - i)]
    number = {place: index for index, place in enumerate(places)}
    shares = np.array([(segments - i - j, i, j) for i, j in places]) / segments
    upright = [((i, j), (i + 1, j), (i, j + 1)) for i, j in places if i + j < segments]
    turned = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in places if i + j < segments - 1]
    return shares, np.array([[number[place] for place in small] for small in upright + turned])


def drawn(asset: Asset, mesh: LodMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A level's vertices and faces at rest."""
    texels = asset.textures["position"].levels[0][:, :, :3].astype(np.float64)
    return sample_bilinear(texels, mesh.canonical_uvs.astype(np.float64)), mesh.triangles.astype(np.int32)


def divided(asset: Asset, mesh: LodMesh, segments: int) -> tuple[NDArray[np.float64], NDArray[np.int32], float]:
    """A level's vertices and faces at rest with every edge in so many parts, and the share of faces left flat."""
    texels = asset.textures["position"].levels[0][:, :, :3].astype(np.float64)
    patches = divided_patches(asset, mesh).astype(np.int64)
    whole = patches[:, 3:9:2] == patches[:, 4:9:2]  # edges that stay so
    uvs, canonical = mesh.uvs.astype(np.float64), mesh.canonical_uvs.astype(np.float64)
    shares, small = _grid(segments)
    at_corners = corner_uvs(uvs, canonical, patches)
    places = np.einsum("sk,fki->fsi", shares, uvs[patches[:, :3]])
    edges = [np.flatnonzero(shares[:, (side + 2) % 3] == 0) for side in range(3)]
    for side, on_edge in enumerate(edges):
        ends = shares[on_edge][:, [side, (side + 1) % 3]]
        places[:, on_edge] = np.einsum("sk,fki->fsi", ends, uvs[patches[:, 3 + 2 * side : 5 + 2 * side]])
    for corner in range(3):
        places[:, shares[:, corner] == 1] = at_corners[:, corner, None]
    points = sample_bilinear(texels, places.reshape(-1, 2)).reshape(*places.shape[:2], 3)
    corners = sample_bilinear(texels, at_corners.reshape(-1, 2)).reshape(-1, 3, 3)
    flat = np.einsum("sk,fki->fsi", shares, corners)
    for side, on_edge in enumerate(edges):
        points[:, on_edge] = np.where(whole[:, side, None, None], flat[:, on_edge], points[:, on_edge])
    all_whole = whole.all(axis=1)
    points[all_whole] = flat[all_whole]
    faces = small[None] + np.arange(len(patches))[:, None, None] * len(shares)
    return points.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32), float(all_whole.mean())


def measure_levels(asset: Asset) -> list[dict[str, Any]]:
    """A row per level."""
    low, high = asset.manifest.bind_bounds
    unit = float(np.linalg.norm(high - low)) / 1000
    full, full_faces = drawn(asset, asset.lods[0])
    full_tree, full_samples = build_tree(full[full_faces]), sample_mesh(full, full_faces, NUM_SAMPLES)

    def distances(points: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[float, float]:
        there = full_tree.query(sample_mesh(points, faces, NUM_SAMPLES).points(points, faces))[0]
        back = build_tree(points[faces]).query(full_samples.points(full, full_faces))[0]
        return max(there.max(), back.max()) / unit, max(there.mean(), back.mean()) / unit

    rows = []
    for level, mesh in enumerate(asset.lods[1:], start=1):
        largest, mean = distances(*drawn(asset, mesh))
        row: dict[str, Any] = {"level": level, "faces": len(mesh.triangles), "largest": largest, "mean": mean}
        for factor in FACTORS:
            if len(mesh.triangles) * factor**2 > MOST_TRIANGLES:
                continue
            points, faces, row["flat"] = divided(asset, mesh, factor)
            row[f"largest / {factor}"], row[f"mean / {factor}"] = distances(points, faces)
        rows.append(row)
    return rows


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print."""
    parser = command_line("tessellation", __doc__)
    parser.add_argument("--built", type=Path, help="a built character (default: human's, or the first there is)")
    rows = measure_levels(load(one_built_character(parser.parse_args(argv).built)))
    print_table(rows)
    return rows
