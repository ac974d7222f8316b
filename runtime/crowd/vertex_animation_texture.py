"""Where the vertices of a coarse level stand in every baked pose, ready-made: two small fetches, not twenty-four.

A coarse level has few vertices, so that all its poses fit into a small texture: a vertex along x, a pose a row, a place
in 32 bits. All joints take part, however many a vertex has. Vertices that are the same point share a place.
Letters in shapes: V vertices, P different places, R rows, J joints, K joints a vertex.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

BITS = (11, 11, 10)  # of x, y and z
# A level is placed if rounding moves nothing by more than this part of its own error.
ROUNDING_REL = 0.1


@dataclass(frozen=True)
class VertexAnimation:
    """VertexAnimation of a level's vertices in every baked pose.

    Attributes
    ----------
    texels : (R, P) uint32
        x, y and z from the lowest bit up (`BITS`).
    column_of_vertex : (V,) uint16
    scale, offset : (3,) float64
        Metres are whole numbers times scale plus offset.
    """

    texels: NDArray[np.uint32]
    column_of_vertex: NDArray[np.uint16]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]

    @property
    def rounding_m(self) -> float:
        """How far rounding moves a place at most, metres."""
        return float(np.linalg.norm(self.scale)) / 2


def _different(positions: Floats, joints: NDArray[Any], weights: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """One vertex of each place (P,), and the place of each vertex (V,)."""
    parts = (positions.astype("<f4"), joints.astype("<i4"), weights.astype("<f4"))
    rows = np.concatenate([np.ascontiguousarray(part).view(np.uint32) for part in parts], axis=1)
    _, chosen, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return chosen, place.ravel()


def bake_vertex_animation(
    matrices: NDArray[np.float32], positions: Floats, joints: NDArray[Any], weights: Floats
) -> VertexAnimation:
    """Skin the vertices of a level in every baked pose.

    Parameters
    ----------
    matrices : (R, J, 3, 4) float32
        Skinning matrices.
    positions : (V, 3) float, at rest, metres
    joints : (V, K) int
    weights : (V, K) float

    Raises
    ------
    ValueError
        When there are more places than 16 bits can number.
    """
    chosen, column_of_vertex = _different(positions, joints, weights)
    if len(chosen) > 0xFFFF:
        raise ValueError(f"{len(chosen)} places are more than 16 bits can number")
    num_rows, num_joints = matrices.shape[:2]
    shares = np.zeros((len(chosen), num_joints), np.float32)
    for slot in range(joints.shape[1]):
        np.add.at(shares, (np.arange(len(chosen)), joints[chosen, slot]), weights[chosen, slot])
    points = np.concatenate([positions[chosen], np.ones((len(chosen), 1))], axis=1).astype(np.float32)
    spread = (shares[:, :, None] * points[:, None, :]).reshape(len(chosen), 4 * num_joints)
    flat = matrices.transpose(0, 2, 1, 3).reshape(3 * num_rows, 4 * num_joints)
    places = (flat @ spread.T).reshape(num_rows, 3, len(chosen))
    low, high = places.min(axis=(0, 2)).astype(np.float64), places.max(axis=(0, 2)).astype(np.float64)
    scale = np.maximum(high - low, 1e-9) / (2.0 ** np.array(BITS) - 1)
    whole = np.rint((places - low[:, None]) / scale[:, None]).astype(np.uint32)
    texels = whole[:, 0] | whole[:, 1] << BITS[0] | whole[:, 2] << (BITS[0] + BITS[1])
    return VertexAnimation(np.ascontiguousarray(texels), column_of_vertex.astype(np.uint16), scale, low)
