"""Skinning matrices anywhere on the surface: those of its vertices, blended over the uv triangle there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.mesh.closest_point import NearestTree
from preprocess.mesh.uv_lookup import locate_uvs, uv_tree


@dataclass(frozen=True)
class Skinning:
    """A surface in P poses.

    Attributes
    ----------
    matrices : (P, V, 3, 4) float64
        Of its vertices.
    corners : (F, 3) int
        The vertices of its faces.
    tree : NearestTree
        Its faces in uv.
    """

    matrices: Floats
    corners: NDArray[np.integer]
    tree: NearestTree

    def at(self, uvs: Floats) -> Floats:
        """Matrices at uv points (N, 2): (P, N, 3, 4) float64."""
        if not len(self.matrices):
            return np.zeros((0, len(uvs), 3, 4))
        faces, weights = locate_uvs(self.tree, uvs)
        result: Floats = np.einsum("nk,pnkij->pnij", weights, self.matrices[:, self.corners[faces]])
        return result


def make_skinning(matrices: Floats, corners: NDArray[np.integer], corner_uvs: Floats) -> Skinning:
    """Prepare to ask for matrices.

    Parameters
    ----------
    matrices : (P, V, 3, 4) float64
    corners : (F, 3) int
    corner_uvs : (F, 3, 2) float64
    """
    return Skinning(matrices, corners, uv_tree(corner_uvs))
