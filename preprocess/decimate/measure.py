"""How far a level of detail is from the full mesh: distances both ways over dense samples and poses.

The level is taken as it is drawn: its vertices at the position texture's values, skinned like the full mesh. Samples
are the vertices and a low-discrepancy set over the area, so two runs agree to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.decimate.levels import Lod
from preprocess.mesh.closest_point import NearestTree, build_tree
from preprocess.mesh.face_geometry import face_areas, face_normals
from preprocess.mesh.skinning import Skinning, make_skinning
from preprocess.mesh.surface import TexturedSurface

# Samples over the area of each mesh, and how many of its vertices besides; with many poses, in each of them.
NUM_SAMPLES = 8192
NUM_SAMPLES_POSED = 2048
# In other poses than the first, means are those of every so many samples.
POSED_MEAN_STRIDE = 4
# The R2 sequence (Roberts 2018): successive multiples of these, modulo one, cover the square evenly.
_R2 = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class Samples:
    """Points of a mesh: faces (N,) and barycentric weights (N, 3)."""

    faces: NDArray[np.int64]
    weights: Floats

    def points(self, positions: Floats, faces: Ints) -> Floats:
        """Where they are for some positions of the vertices, (N, 3)."""
        result: Floats = np.einsum("nk,nki->ni", self.weights, positions[faces[self.faces]])
        return result


def sample_mesh(positions: Floats, faces: Ints, num_samples: int = NUM_SAMPLES) -> Samples:
    """Points spread evenly over the area, and vertices (all, or every so many).

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int32
    num_samples : int
        Of either kind.
    """
    corners = positions[faces]
    total = np.cumsum(face_areas(corners))
    at = (np.arange(num_samples) + 0.5) / num_samples * total[-1]
    face = np.minimum(np.searchsorted(total, at), len(faces) - 1)
    s, t = (np.arange(1, num_samples + 1) * _R2[0]) % 1.0, (np.arange(1, num_samples + 1) * _R2[1]) % 1.0
    folded = s + t > 1.0
    s, t = np.where(folded, 1.0 - s, s), np.where(folded, 1.0 - t, t)
    first_corner = np.unique(faces.ravel(), return_index=True)[1]
    first_corner = np.sort(first_corner)[:: max(1, len(first_corner) // num_samples)]
    return Samples(
        np.r_[face, first_corner // 3], np.r_[np.stack([1.0 - s - t, s, t], axis=1), np.eye(3)[first_corner % 3]]
    )


def _posed(positions: Floats, matrices: Floats) -> Floats:
    """Positions (V, 3) as they are and in each pose, (1 + P, V, 3)."""
    moved = np.einsum("pvij,vj->pvi", matrices[..., :3], positions) + matrices[..., 3]
    return np.concatenate([positions[None], moved])


@dataclass(frozen=True)
class Reference:
    """The full mesh in every pose, ready to be compared with.

    Attributes
    ----------
    surface : TexturedSurface
    skinning : Skinning
        Poses besides the bind pose.
    posed : (1 + P, V, 3) float64
        The bind pose first.
    trees : tuple of NearestTree, one a pose
    samples : Samples
    num_samples : int
        Over the area.
    """

    surface: TexturedSurface
    skinning: Skinning
    posed: Floats
    trees: tuple[NearestTree, ...]
    samples: Samples
    num_samples: int

    @property
    def extent_m(self) -> float:
        """Longest side of the box around what faces use, in bind pose."""
        return float(np.ptp(self.posed[0][self.surface.faces].reshape(-1, 3), axis=0).max())


def make_reference(
    surface: TexturedSurface, poses: NDArray[np.floating] | None = None, num_samples: int | None = None
) -> Reference:
    """Pose the full mesh and build what distances to it need; see `decimate` for the arguments."""
    if num_samples is None:
        num_samples = NUM_SAMPLES if poses is None else NUM_SAMPLES_POSED
    matrices = np.zeros((0, len(surface.positions), 3, 4)) if poses is None else np.asarray(poses, np.float64)
    posed = _posed(surface.positions, matrices)
    trees = tuple(build_tree(positions[surface.faces]) for positions in posed)
    samples = sample_mesh(surface.positions, surface.faces, num_samples)
    skinning = make_skinning(matrices, surface.faces, surface.uvs[surface.face_uvs])
    return Reference(surface, skinning, posed, trees, samples, num_samples)


@dataclass(frozen=True)
class Distances:
    """Two-sided distances of a level from the full mesh.

    Attributes
    ----------
    largest_m, mean_m : float
        Over all samples and poses, metres; the mean in other poses than the first over every fourth sample.
    normal_rad : float
        Mean angle between normals, radians.
    places : (N, 3) float64
        Where the samples are on the full mesh in bind pose, or what of it is nearest to those of the level.
    each_m : (N,) float64
        The largest distance there over the poses.
    """

    largest_m: float
    mean_m: float
    normal_rad: float
    places: Floats
    each_m: Floats


def measure(reference: Reference, lod: Lod, matrices: Floats | None = None) -> Distances:
    """Compare a level with the full mesh, both ways, in all poses.

    Parameters
    ----------
    reference : Reference
    lod : Lod
    matrices : (P, V, 3, 4) float64 or None
        Those that its vertices are drawn with in the poses, without the bind pose; None takes the surface's own.
    """
    num_samples = reference.num_samples
    posed = _posed(lod.positions, reference.skinning.at(lod.uvs[lod.canonical_uvs]) if matrices is None else matrices)
    samples = sample_mesh(lod.positions, lod.faces, num_samples)
    full, on_full = reference.surface, reference.samples
    means, angles = [], []
    places, to_worst = np.zeros((len(samples.faces), 3)), np.full(len(samples.faces), -1.0)
    from_worst = np.zeros(len(on_full.faces))
    full_face = face = None
    for full_positions, tree, positions in zip(reference.posed, reference.trees, posed, strict=True):
        # Of most samples a face that was nearest in another pose shows that they are not the largest; no mean of those.
        largest = max(float(to_worst.max()), float(from_worst.max()))
        points = samples.points(positions, lod.faces), on_full.points(full_positions, full.faces)
        enough = [np.full(len(part), largest) for part in points]
        area = slice(num_samples)  # samples over the area come first
        if full_face is not None:
            area = slice(0, num_samples, POSED_MEAN_STRIDE)
            enough[0][area] = enough[1][area] = -1.0
        to_full, full_face, weights = tree.query(points[0], full_face, enough[0])
        from_full, face, _ = build_tree(positions[lod.faces]).query(points[1], face, enough[1])
        farther = to_full > to_worst
        nearest = Samples(full_face[farther], weights[farther])
        places[farther], to_worst[farther] = nearest.points(full.positions, full.faces), to_full[farther]
        from_worst = np.maximum(from_worst, from_full)
        means += [to_full[area].mean(), from_full[area].mean()]
        normals = face_normals(positions[lod.faces])
        found, sampled = full.faces[full_face[area]], full.faces[on_full.faces[area]]
        cosines = np.r_[
            np.einsum("ni,ni->n", normals[samples.faces[area]], face_normals(full_positions[found])),
            np.einsum("ni,ni->n", face_normals(full_positions[sampled]), normals[face[area]]),
        ]
        angles.append(np.arccos(np.clip(cosines, -1.0, 1.0)).mean())
    each_m = np.r_[to_worst, from_worst]
    places = np.r_[places, on_full.points(full.positions, full.faces)]
    return Distances(float(each_m.max()), float(np.mean(means)), float(np.mean(angles)), places, each_m)
