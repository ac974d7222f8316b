"""Normals: the built texture against the source, at random points of the full mesh (equal chance for equal area).

The source's normal is its corner normals, interpolated; the texture is read at the finest level's normal uvs. Two
numbers: all points, and those further than a texel and a half from every edge of their face. Characters with normal
maps are left out, since these are in the texture too.

Options: --models FILE ... (characters to build the texture of), --points N.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._table import print_table
from preprocess.gltf import load_character
from preprocess.pipeline import _build_atlas, sample_poses
from preprocess.settings import Settings
from preprocess.texels import sample_bilinear
from preprocess.textures.stage import TextureStage

ASSETS = Path("../shared/assets")
MODELS = tuple(ASSETS / f"{name}.glb" for name in ("Fox", "Knight", "robot", "mannequiny"))
INSIDE_PX = 1.5


def edge_distance_px(corners_px: NDArray[np.floating], shares: NDArray[np.floating]) -> NDArray[np.float64]:
    """Distance of points to the nearest edge of their uv triangle: (N, 3, 2) pixels and (N, 3) to (N,)."""
    opposite = np.roll(corners_px, -1, axis=1) - np.roll(corners_px, -2, axis=1)
    first, second = corners_px[:, 1] - corners_px[:, 0], corners_px[:, 2] - corners_px[:, 0]
    doubled = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    heights = doubled[:, None] / np.maximum(np.linalg.norm(opposite, axis=2), 1e-12)
    return np.asarray((heights * shares).min(axis=1), np.float64)


def measure(model: Path, num_points: int) -> dict[str, Any] | None:
    """Angles between texture and source; None for a character with normal maps."""
    character = load_character(model)
    if any(material.normal is not None for material in character.materials):
        return None
    settings = Settings()
    atlas = _build_atlas(character, settings)
    stage = TextureStage(character, atlas, sample_poses(character), settings)
    stored = stage.normal()
    stored_texels = stored.levels[0][:, :, :3]
    full = np.iinfo(stored_texels.dtype).max if stored_texels.dtype.kind == "u" else 1.0
    texels = stored_texels.astype(np.float64) / full * 2 - 1
    mesh, surface = atlas.mesh, atlas.mesh.surface
    corners = surface.positions[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), num_points, p=area / area.sum())
    shares = rng.dirichlet((1, 1, 1), num_points)
    corner_uvs = surface.uvs[surface.face_uvs[face]]
    wanted = np.einsum("ni,nij->nj", shares, mesh.corner_normals[face])
    read_uvs = corner_uvs if stage.normal_uvs is None else stage.normal_uvs.corners[face]
    found = sample_bilinear(texels, np.einsum("ni,nij->nj", shares, read_uvs))
    cosine = (wanted * found).sum(axis=1) / np.maximum(
        np.linalg.norm(wanted, axis=1) * np.linalg.norm(found, axis=1), 1e-12
    )
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    inside = edge_distance_px(corner_uvs * texels.shape[1::-1], shares) > INSIDE_PX
    return {
        "character": character.name,
        "texture": f"{texels.shape[1]}²",
        "rms deg": float(np.sqrt((angle**2).mean())),
        "median deg": float(np.median(angle)),
        "inside faces": float(inside.mean()),
        "rms deg inside": float(np.sqrt((angle[inside] ** 2).mean())) if inside.any() else float("nan"),
        "max deg inside": float(angle[inside].max()) if inside.any() else float("nan"),
    }


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks normals", allow_abbrev=False)
    parser.add_argument("--models", type=Path, nargs="+", default=MODELS)
    parser.add_argument("--points", type=int, default=40_000)
    options, _ = parser.parse_known_args(argv)
    for missing in [model for model in options.models if not model.is_file()]:
        print(f"no such file: {missing}")
    rows = [measure(model, options.points) for model in options.models if model.is_file()]
    measured = [row for row in rows if row is not None]
    print_table(measured)
    return measured
