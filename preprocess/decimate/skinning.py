"""Skinning matrices anywhere on the surface: those of its vertices, blended over the uv triangle there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.decimate.nearest import NearestTree, build_tree
from preprocess.mesh import Floats


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
        return np.einsum("nk,pnkij->pnij", weights, self.matrices[:, self.corners[faces]])


def uv_tree(corner_uvs: Floats) -> NearestTree:
    """Faces as triangles of the atlas, from their corners (F, 3, 2)."""
    flat = np.zeros((*corner_uvs.shape[:2], 3))
    flat[..., :2] = corner_uvs
    return build_tree(flat)


def locate_uvs(tree: NearestTree, uvs: Floats) -> tuple[NDArray[np.int64], Floats]:
    """The face at each place of the atlas (N, 2), or nearest to it: faces (N,), barycentric coordinates (N, 3)."""
    _, faces, weights = tree.query(np.c_[uvs, np.zeros(len(uvs))])
    return faces, weights


def make_skinning(matrices: Floats, corners: NDArray[np.integer], corner_uvs: Floats) -> Skinning:
    """Prepare to ask for matrices.

    Parameters
    ----------
    matrices : (P, V, 3, 4) float64
    corners : (F, 3) int
    corner_uvs : (F, 3, 2) float64
    """
    return Skinning(matrices, corners, uv_tree(corner_uvs))
