"""Witnesses: points of the full mesh that are followed through the run, to know how far the level strays from them.

A quadric knows how far a vertex is from planes, weighted by area: a small feature goes early, at a large error, and
the largest error is what the runtime selects a level by. A witness knows the point that is drawn at its own uv, in bind
pose and a few others, and how far that is from where it should be. Since the map is one-to-one this holds both ways
(Cohen, Olano and Manocha 1998: the deviation of a parameterised surface bounds the Hausdorff distance).

Along the surface a shift is no error of shape, so it counts by `SLIP` only, but in full where the surface has an edge
or ends: there a shift along one face is a shift away from the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.decimate.topology import HalfEdges
from preprocess.mesh.face_geometry import doubled_area_vectors, unit_vectors
from preprocess.mesh.grouping import connected_faces

# Poses in which witnesses are followed, besides the bind pose: those that stretch the surface most.
MAX_POSES = 6
# Square of the share by which a shift along the surface counts, and how quickly it rises where the surface bends.
SLIP = 0.03
SLIP_PER_BEND = 2.0
SMOOTH_BEND = 0.02
# A mesh with fewer vertices has witnesses on its edges, too.
FEW_VERTICES = 5000

# Columns of a witness: uv, slip, how much its squared departure counts, then position and normal in each pose.
SLIP_COLUMN, WEIGHT_COLUMN, FIRST_POSE, POSE_STRIDE = 2, 3, 4, 6


@dataclass(frozen=True)
class Witnesses:
    """S points, Q poses (the bind pose first), F faces.

    Attributes
    ----------
    points : (S, 4 + 6 Q) float64
        uv, slip, weight, and position and unit normal in each pose.
    following : (S,) int64
        The next witness over the same face, -1 for none.
    faces : (F, 2) int64
        Each face's chart and its first witness, -1 for none.
    """

    points: Floats
    following: NDArray[np.int64]
    faces: NDArray[np.int64]


def choose_poses(posed: Floats, positions: Floats, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which poses stretch the surface most, each next one where those before do not, (at most MAX_POSES,).

    Parameters
    ----------
    posed : (P, V, 3) float64
    positions : (V, 3) float64
        In bind pose.
    faces : (F, 3) int64
    """
    areas = np.linalg.norm(doubled_area_vectors(positions[faces]), axis=1)
    tiny = 1e-9 * float(np.ptp(positions, axis=0).max())
    rest = np.log(_side_lengths(positions, faces) + tiny)
    stretches = [np.abs(np.log(_side_lengths(pose, faces) + tiny) - rest).max(axis=1) for pose in posed]
    chosen: list[int] = []
    known = np.zeros(len(faces))
    for _ in range(min(MAX_POSES, len(posed))):
        gains = [float((np.maximum(stretch - known, 0.0) * areas).sum()) for stretch in stretches]
        best = int(np.argmax(gains))
        if gains[best] <= 0.0:
            break
        chosen.append(best)
        known = np.maximum(known, stretches[best])
    return np.array(chosen, np.int64)


def make_witnesses(half_edges: HalfEdges, uvs: Floats, posed: Floats) -> Witnesses:
    """Put a witness on every vertex and face, and on the edges of a coarse mesh.

    Parameters
    ----------
    half_edges : HalfEdges
    uvs : (W, 2) float64
    posed : (Q, V, 3) float64
        In bind pose, then in the others.
    """
    num_faces = half_edges.num_faces
    tails, wedges = half_edges.tail[: 3 * num_faces], half_edges.wedge[: 3 * num_faces]
    corners, corner_wedges = tails.reshape(-1, 3), wedges.reshape(-1, 3)
    crosses = np.stack([doubled_area_vectors(positions[corners]) for positions in posed])
    sums = np.stack([_sum_at_corners(cross, corners, posed.shape[1]) for cross in crosses])
    vertices, first = np.unique(tails, return_index=True)
    slips = _slips(half_edges, crosses[0], sums[0])
    layers = [_rows(uvs[wedges[first]], slips[vertices], posed[:, vertices], unit_vectors(sums[:, vertices]))]
    over = [first // 3]
    places = [(1 / 3, 1 / 3, 1 / 3)]
    if len(vertices) < FEW_VERTICES:
        places += [(0.5, 0.5, 0.0), (0.0, 0.5, 0.5), (0.5, 0.0, 0.5)]
    for place in places:
        uv = np.einsum("k,fki->fi", place, uvs[corner_wedges])
        points = np.einsum("k,qfki->qfi", place, posed[:, corners])
        layers.append(_rows(uv, np.full(num_faces, SLIP), points, unit_vectors(crosses)))
        over.append(np.arange(num_faces))
    face = np.concatenate(over)
    order = np.argsort(face, kind="stable")
    following = np.full(len(face), -1, np.int64)
    same = face[order[1:]] == face[order[:-1]]
    following[order[:-1][same]] = order[1:][same]
    faces = np.full((num_faces, 2), -1, np.int64)
    faces[:, 0] = connected_faces(corner_wedges, len(half_edges.wedge_source))
    starts = np.r_[True, ~same]
    faces[face[order[starts]], 1] = order[starts]
    return Witnesses(np.concatenate(layers), following, faces)


def no_witnesses(num_faces: int) -> Witnesses:
    """None at all."""
    faces = np.full((num_faces, 2), -1, np.int64)
    return Witnesses(np.zeros((0, FIRST_POSE + POSE_STRIDE)), np.zeros(0, np.int64), faces)


def _side_lengths(positions: Floats, faces: NDArray[np.int64]) -> Floats:
    result: Floats = np.linalg.norm(positions[faces] - positions[np.roll(faces, 1, axis=1)], axis=2)
    return result


def _sum_at_corners(values: Floats, corners: NDArray[np.int64], num_vertices: int) -> Floats:
    """(F, 3) face values summed at the vertices, (V, 3)."""
    sums = [np.bincount(corners.ravel(), np.repeat(value, 3), num_vertices) for value in values.T]
    return np.stack(sums, axis=1)


def _slips(half_edges: HalfEdges, crosses: Floats, sums: Floats) -> Floats:
    """How much a shift along the surface counts at each vertex, (V,): from SLIP where it is flat to 1."""
    num_vertices, num_faces = len(sums), half_edges.num_faces
    corners = half_edges.tail[: 3 * num_faces]
    areas = np.bincount(corners, np.repeat(np.linalg.norm(crosses, axis=1), 3), num_vertices)
    bend = 1.0 - np.linalg.norm(sums, axis=1) / np.where(areas > 0.0, areas, 1.0)
    slips: Floats = np.clip(SLIP + SLIP_PER_BEND * (bend - SMOOTH_BEND), SLIP, 1.0)
    at_holes = half_edges.tail[3 * num_faces :]
    slips[at_holes[(at_holes >= 0) & (at_holes < num_vertices)]] = 1.0
    return slips


def _rows(uvs: Floats, slips: Floats, points: Floats, normals: Floats) -> Floats:
    """Witnesses (N, 4 + 6 Q), all of weight 1, from (N, 2), (N,), (Q, N, 3) and (Q, N, 3)."""
    poses = np.concatenate([points, normals], axis=2).transpose(1, 0, 2).reshape(len(uvs), -1)
    return np.concatenate([uvs, slips[:, None], np.ones((len(uvs), 1)), poses], axis=1)
