"""Where the runtime draws points of a source's surface: triangles of the finest level, matched by their corners.

A built character knows nothing of its source's vertices any more. Corners are matched by place and weights; a triangle
of the source whose corners are those of a triangle of the level is that one. The few others, divided to straighten a
seam, are matched by distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks._source_normals import unit
from benchmarks.accuracy import CANDIDATES, fetched_vertices
from preprocess.arrays import Floats
from preprocess.mesh.face_geometry import doubled_area_vectors
from preprocess.mesh.surface import SkinnedMesh
from runtime.asset.asset import Asset

Ints = NDArray[np.integer]
POINTS_AT_ONCE = 32  # beside all triangles
TURN_REL = 1e-2  # of the size: what facing half the other way counts as distance
SAME_REL = 1e-3  # a drawn vertex further than this from every vertex of the source is none of them


@dataclass(frozen=True)
class DrawnPoints:
    """Places of N points of the source on a built character's finest level.

    Attributes
    ----------
    triangles : (N, 3) int64
        The level's vertices around each point.
    shares : (N, 3) float64
        Barycentric coordinates there.
    own : (N,) bool
        Whether the triangle is the source's own; else it is the nearest one.
    """

    triangles: Ints
    shares: Floats
    own: NDArray[np.bool_]


def _classes(places: Floats, weights: Floats, mesh: SkinnedMesh, dense: Floats) -> Ints:
    """Number of the source's place that each drawn vertex stands for, (P,): the nearest, told apart by weights."""
    source = mesh.surface.positions
    count = min(CANDIDATES, len(source))
    distance, nearest = (np.asarray(a).reshape(-1, count) for a in cKDTree(source).query(places, k=count))
    unlike = np.abs(dense[nearest] - weights[:, None]).max(axis=2)
    best = (distance / mesh.surface.diagonal_m + 1e-3 * unlike).argmin(axis=1)
    return np.asarray(np.take_along_axis(nearest, best[:, None], axis=1)[:, 0])


def _turned(corners: Ints) -> tuple[Ints, Ints]:
    """Triangles turned so that the smallest number is first, (F, 3), and by how many corners, (F,)."""
    turns = corners.argmin(axis=1)
    return np.take_along_axis(corners, (turns[:, None] + np.arange(3)) % 3, axis=1), turns


def _places(mesh: SkinnedMesh) -> Ints:
    """Number of each vertex's place, (V,): those split to make the mesh manifold, and layers that touch, share one."""
    rounded = np.round(mesh.surface.positions / mesh.surface.diagonal_m, 7)
    return np.unique(rounded, axis=0, return_inverse=True)[1].ravel()


def single_faces(mesh: SkinnedMesh) -> Ints:
    """Faces that are the only one where they are: of two in one place nobody can say which is seen."""
    _, face, count = np.unique(
        np.sort(_places(mesh)[mesh.surface.faces], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return np.flatnonzero(count[face.ravel()] == 1)


def _normals(triangles: Floats) -> Floats:
    """Normals of triangles (T, 3, 3), not of unit length."""
    normals = doubled_area_vectors(triangles)
    return normals


def _nearest_on_triangles(points: Floats, facing: Floats, triangles: Floats) -> tuple[Ints, Floats]:
    """The nearest of triangles (T, 3, 3) to each point (N, 3), of those that face its way, and where on it."""
    parts = [
        _nearest_of_some(points[i : i + POINTS_AT_ONCE], facing[i : i + POINTS_AT_ONCE], triangles)
        for i in range(0, len(points), POINTS_AT_ONCE)
    ]
    return np.concatenate([best for best, _ in parts]), np.concatenate([shares for _, shares in parts])


def _nearest_of_some(points: Floats, facing: Floats, triangles: Floats) -> tuple[Ints, Floats]:
    """The same for a few points, all triangles at once."""
    edge_b, edge_c = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    offset = points[:, None] - triangles[:, 0]
    bb, bc, cc = (edge_b**2).sum(1), (edge_b * edge_c).sum(1), (edge_c**2).sum(1)
    pb, pc = (offset * edge_b).sum(2), (offset * edge_c).sum(2)
    scale = 1.0 / np.maximum(bb * cc - bc**2, 1e-300)
    b, c = (cc * pb - bc * pc) * scale, (bb * pc - bc * pb) * scale
    shares = np.maximum(np.stack([1.0 - b - c, b, c], axis=2), 0.0)
    shares /= shares.sum(axis=2, keepdims=True)
    apart = np.linalg.norm(np.einsum("ntk,tki->nti", shares, triangles) - points[:, None], axis=2)
    alike = unit(facing) @ unit(_normals(triangles)).T
    # Where surfaces cross, both are near enough, and one faces the point's way.
    turned_away = TURN_REL * np.ptp(triangles.reshape(-1, 3), axis=0).max() * (1.0 - alike)
    best = np.where(alike > 0, apart + turned_away, np.inf).argmin(axis=1)
    return best, shares[np.arange(len(points)), best]


def find_drawn_points(asset: Asset, mesh: SkinnedMesh, faces: Ints, shares: Floats) -> DrawnPoints:
    """Find points of the source's surface on the finest level; only on faces that are the only one in their place.

    Parameters
    ----------
    asset : Asset
    mesh : SkinnedMesh
        The source.
    faces : (N,) int
        Of the source.
    shares : (N, 3) float64
        Barycentric coordinates.
    """
    level = asset.lods[0]
    triangles = level.triangles.astype(np.int64)
    positions, weights = fetched_vertices(asset)
    _, point = np.unique(level.canonical_uvs, axis=0, return_inverse=True)
    point = point.ravel()
    dense, place = mesh.dense_weights(asset.num_joints), _places(mesh)
    classes = _classes(positions, weights, mesh, dense)
    of_place = place[classes]
    apart = np.linalg.norm(positions - mesh.surface.positions[classes], axis=1)
    strange = apart > SAME_REL * mesh.surface.diagonal_m  # in the middle of a divided edge
    of_place[strange] = -1 - np.flatnonzero(strange)
    of_vertex = of_place[point]
    drawn, drawn_turns = _turned(of_vertex[triangles])
    wanted, wanted_turns = _turned(place[mesh.surface.faces])
    lookup = {tuple(corners): number for number, corners in reversed(list(enumerate(drawn.tolist())))}
    match = np.array([lookup.get(tuple(corners), -1) for corners in wanted.tolist()])
    turn = drawn_turns[match] - wanted_turns
    found = match[faces]
    result = np.take_along_axis(shares, (np.arange(3) - turn[faces][:, None]) % 3, axis=1)
    own = found >= 0
    if not own.all():
        corners = mesh.surface.positions[mesh.surface.faces[faces[~own]]]
        places = np.einsum("nk,nki->ni", shares[~own], corners)
        found[~own], result[~own] = _nearest_on_triangles(places, _normals(corners), positions[point[triangles]])
    return DrawnPoints(triangles[found], result, own)
