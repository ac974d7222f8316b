"""Which moments of the clips stand for all: poses in which the surface bends most, and differently.

Levels of detail are costed and measured in a few poses, textures judged in them. What a coarse level loses when a
character moves is where neighbouring points move unlike each other. So an edge's *bend* in a pose is the difference
between what its two ends' blended matrices do to directions and to its middle: nothing where all moves as one. Poses
are taken one by one, each the one whose bends are furthest from those of the poses taken before, edge by edge (farthest
points; Gonzalez 1985).
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.load import Character
from preprocess.mesh.surface import SkinnedMesh
from runtime.animation.pose import rest_pose, sample, skinning_matrices

MAX_POSES, MOST_OF_SMALL = 8, 16  # besides the rest pose; more where faces are few, and measuring costs little
POSED_FACES = 40_000  # faces times poses up to which there are more than `MAX_POSES`
MOMENTS_A_CLIP = 9  # that are asked for, ends included
MAX_MOMENTS = 512  # of all clips together
NUM_EDGES = 1024  # that stand for all
LEAST_BEND = 1e-4  # of all edges alike: below it a pose says nothing new


def _moments(character: Character) -> Floats:
    """Skinning matrices in moments of all clips, (M, J, 4, 4)."""
    skeleton, clips = character.skeleton, character.clips
    count = max(2, min(MOMENTS_A_CLIP, MAX_MOMENTS // max(len(clips), 1)))
    if len(clips) * count > MAX_MOMENTS:
        clips = tuple(clips[i] for i in np.linspace(0, len(clips) - 1, MAX_MOMENTS // count).astype(int))
    poses = [
        skinning_matrices(skeleton, sample(clip, skeleton, np.linspace(0.0, clip.duration_s, count))) for clip in clips
    ]
    return np.concatenate(poses) if poses else np.zeros((0, skeleton.num_joints, 4, 4))


def _edges(mesh: SkinnedMesh) -> tuple[Floats, Floats, Floats]:
    """Of some edges: differences of their ends' weights, (E, J), middles over lengths, (E, 4), what they count, (E,).

    A bend moves an edge's end by its length. The fourth power of that lets large bends of few edges count.
    """
    faces = mesh.surface.faces
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = ends[:: -(-len(ends) // NUM_EDGES)]
    dense = mesh.dense_weights(mesh.num_moving_joints)
    first, second = mesh.surface.positions[ends[:, 0]], mesh.surface.positions[ends[:, 1]]
    length = np.maximum(np.linalg.norm(first - second, axis=1), 1e-6 * mesh.surface.diagonal_m)
    middles = np.concatenate([0.5 * (first + second), np.ones((len(ends), 1))], axis=1) / length[:, None]
    return dense[ends[:, 0]] - dense[ends[:, 1]], middles, length**4


def choose_poses(
    matrices: Floats, weight_differences: Floats, middles: Floats, counts: Floats, most: int = MAX_POSES
) -> list[int]:
    """Poses whose bends differ most, in the order they are taken.

    Parameters
    ----------
    matrices : (M, J, 4, 4) float64
    weight_differences : (E, J) float64
        Between the two ends of edges.
    middles : (E, 4) float64
        Homogeneous, of edges, over their lengths.
    counts : (E,) float64
        What the fourth power of each edge's bend counts.
    most : int

    Returns
    -------
    list of int
        Fewer than `most` where the others bend like these.
    """
    num_joints = weight_differences.shape[1]
    rows = matrices[:, :num_joints, :3].reshape(len(matrices), num_joints, 12)
    change = np.einsum("ej,mjk->mek", weight_differences, rows).reshape(len(matrices), len(counts), 3, 4)
    moved = np.einsum("merc,ec->mer", change, middles)
    bends = np.concatenate([change[..., :3].reshape(len(matrices), len(counts), 9), moved], axis=2)
    apart_sq = np.einsum("mek,mek->me", bends, bends)  # from rest, where nothing bends
    enough = LEAST_BEND**4 * float(counts.sum())
    chosen: list[int] = []
    while len(chosen) < most:
        gains = apart_sq**2 @ counts
        best = int(gains.argmax()) if len(gains) else 0
        if not len(gains) or gains[best] <= enough:
            break
        chosen.append(best)
        between = bends - bends[best]
        apart_sq = np.minimum(apart_sq, np.einsum("mek,mek->me", between, between))
    return chosen


def sample_poses(character: Character) -> Floats:
    """Skinning matrices of the rest pose and of the moments of the clips that differ most, (P, J, 4, 4) float64.

    Of the joints that move something: the mesh's `num_moving_joints`.
    """
    moving = character.mesh.num_moving_joints
    moments = _moments(character)[:, :moving]
    most = min(max(MAX_POSES, POSED_FACES // character.mesh.num_faces), MOST_OF_SMALL)
    chosen = sorted(choose_poses(moments, *_edges(character.mesh), most))
    rest = skinning_matrices(character.skeleton, rest_pose(character.skeleton))
    return np.concatenate([rest[:, :moving], moments[chosen]])
