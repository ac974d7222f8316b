"""Which places of the source's surface the drawn vertices and faces are.

A folder does not say it, and a measurement that was told could be told wrong: vertices are found by place, of several
in one place (layers that touch, parts that move apart) the one with the like weights; faces by their three corners.
Faces that an atlas divided have no twin, and of several in one place nobody can say which is which: both are left out.
Letters in shapes: V drawn vertices, F drawn faces, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from preprocess.arrays import Floats, Indices
from preprocess.mesh.closest_point import build_tree
from preprocess.verify.drawn import Drawn
from preprocess.verify.source import Source

CANDIDATES = 8  # nearest source vertices among which a drawn one finds its own
WEIGHT_REL = 1e-3  # of the diagonal: what weights that have nothing in common count beside distance
NEAR_REL = 1e-3  # of the diagonal: a vertex further than this from all of the source's is looked for on its faces


@dataclass(frozen=True)
class Match:
    """Where on the source the drawn surface is.

    Attributes
    ----------
    vertices : (V, 3) int64
        Source vertices around each drawn vertex's place; three times the same where it is one of them.
    shares : (V, 3) float64
    faces : (F,) int64
        The source's face that each drawn face is, -1 for none.
    turns : (F,) int64
        Corner k of the drawn face is corner (k + turn) % 3 of the source's.
    unseen_m : float
        Largest distance of a source vertex from the nearest drawn one, metres.
    unseen : int
        That vertex.
    """

    vertices: Indices
    shares: Floats
    faces: Indices
    turns: Indices
    unseen_m: float
    unseen: int

    def source_shares(self, faces: Indices, shares: Floats) -> Floats:
        """Barycentric coordinates on the source's face of points of drawn, matched faces."""
        corner = (np.arange(3) - self.turns[faces][:, None]) % 3
        return np.take_along_axis(shares, corner, axis=1)


def _nearest_vertices(drawn: Drawn, source: Source) -> tuple[Floats, Indices]:
    """Distance to the source's vertex of each drawn one and its number."""
    points = source.mesh.surface.positions
    count = min(CANDIDATES, len(points))
    distances, nearest = (np.asarray(a).reshape(-1, count) for a in cKDTree(points).query(drawn.positions, k=count))
    unlike = np.zeros(nearest.shape)
    near = distances <= distances[:, :1] + WEIGHT_REL * drawn.diagonal_m
    undecided = np.flatnonzero(near.sum(axis=1) > 1)  # weights decide where several are about as near
    for candidate in range(count if len(undecided) else 0):
        own = source.weights(nearest[undecided, candidate])
        unlike[undecided, candidate] = np.abs(own - drawn.weights[undecided]).max(axis=1)
    best = (distances + WEIGHT_REL * drawn.diagonal_m * unlike).argmin(axis=1)[:, None]
    return np.take_along_axis(distances, best, axis=1)[:, 0], np.take_along_axis(nearest, best, axis=1)[:, 0]


def _same_places(positions: Floats) -> Indices:
    """Number of each vertex's place, (V,): those of layers that touch share one."""
    keys = np.ascontiguousarray(positions.astype(np.float32) + np.float32(0.0)).view(np.dtype((np.void, 12))).ravel()
    return np.unique(keys, return_inverse=True)[1].ravel()


def _turned(corners: Indices) -> tuple[NDArray[np.uint64], Indices]:
    """One number for the corners of each face, whichever is first, and the corner that the number starts at."""
    first = corners.argmin(axis=1)
    order = np.take_along_axis(corners, (first[:, None] + np.arange(3)) % 3, axis=1).astype(np.uint64)
    return (order[:, 0] << np.uint64(42)) | (order[:, 1] << np.uint64(21)) | order[:, 2], first


def _match_faces(
    drawn_places: Indices, drawn: Drawn, source_places: Indices, source: Source
) -> tuple[Indices, Indices]:
    """The source's face of each drawn one (-1: none, or one of several) and its turn."""
    wanted, wanted_first = _turned(source_places[source.mesh.surface.faces])
    keys, face_of_key, count = np.unique(wanted, return_index=True, return_counts=True)
    found, first = _turned(drawn_places[drawn.faces])
    at = np.minimum(np.searchsorted(keys, found), len(keys) - 1)
    right = (keys[at] == found) & (count[at] == 1) & (drawn_places[drawn.faces] >= 0).all(axis=1)
    faces = np.where(right, face_of_key[at], -1)
    return faces, np.where(right, (wanted_first[face_of_key[at]] - first) % 3, 0)


def match(drawn: Drawn, source: Source) -> Match:
    """Find the drawn surface on the source.

    Parameters
    ----------
    drawn : Drawn
    source : Source
    """
    points = source.mesh.surface.positions
    distance, nearest = _nearest_vertices(drawn, source)
    vertices, shares = np.repeat(nearest[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(nearest), 1))
    strange = np.flatnonzero(distance > NEAR_REL * drawn.diagonal_m)
    if len(strange):
        off, face, weights = build_tree(source.corners).query(drawn.positions[strange])
        between = off < 0.5 * distance[strange]  # of an edge that was divided
        vertices[strange[between]] = source.mesh.surface.faces[face[between]]
        shares[strange[between]] = weights[between]
    places = _same_places(points)
    of_drawn = places[nearest]
    of_drawn[strange] = places.max(initial=0) + 1 + strange  # no place of the source
    faces, turns = _match_faces(of_drawn, drawn, places, source)
    used = np.unique(source.mesh.surface.faces)
    unseen = np.asarray(cKDTree(drawn.positions).query(points[used])[0])
    return Match(vertices, shares, faces, turns, float(unseen.max()), int(used[unseen.argmax()]))
