"""What a level says of its distance from full detail holds in every moment of every clip, not in a few poses alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from preprocess.decimate.measure import sample_mesh
from preprocess.fit.weight_quadtree import sample_weights
from preprocess.mesh.closest_point import build_tree
from preprocess.mesh.texels import sample_bilinear
from runtime.animation.pose import sample, skinning_rows
from runtime.asset.asset import Asset, load
from runtime.asset.weight_stack import unpack_weights
from runtime.gpu.textures import prepare

NUM_SAMPLES = 2000
MOMENTS = 6  # of each clip: other ones than those that a build asks for, but for the ends
ALLOWED = 1.3  # times the level's error: between two samples there may be a little more


def skinned_levels(asset: Asset) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rest positions (V, 3), weights (V, J) and faces (F, 3) of every level, as drawn."""
    texels = prepare(asset).positions.metres
    stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
    levels = []
    for mesh in asset.lods:
        places, point = np.unique(mesh.canonical_uvs, axis=0, return_inverse=True)
        places = places.astype(np.float64)
        faces = point.ravel()[mesh.triangles.astype(np.int64)].astype(np.int32)
        levels.append((sample_bilinear(texels, places), sample_weights(stored, asset.weight_details, places), faces))
    return levels


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Fox.glb", "robot.glb"])
def test_errors_hold_in_all_clips(name: str, built: Callable[[str], Path]) -> None:
    asset = load(built(name))
    levels = skinned_levels(asset)
    samples = [sample_mesh(positions, faces, NUM_SAMPLES) for positions, _, faces in levels]
    worst = np.zeros(len(levels))
    for clip in asset.clips:
        moments = sample(clip, asset.skeleton, np.linspace(0.0, clip.duration_s, MOMENTS))
        for rows in skinning_rows(asset.skeleton, moments):
            posed = []
            for positions, weights, _ in levels:
                blended = (weights @ rows.reshape(len(rows), 12)).reshape(-1, 3, 4)
                posed.append(np.einsum("vij,vj->vi", blended[:, :, :3], positions) + blended[:, :, 3])
            full = samples[0].points(posed[0], levels[0][2])
            tree = build_tree(posed[0][levels[0][2]])
            for level in range(1, len(levels)):
                faces = levels[level][2]
                there = tree.query(samples[level].points(posed[level], faces))[0].max()
                back = build_tree(posed[level][faces]).query(full)[0].max()
                worst[level] = max(worst[level], there, back)
    errors = np.array([mesh.error_m for mesh in asset.lods])
    assert (worst <= ALLOWED * errors).all(), np.round(worst / errors, 2)
