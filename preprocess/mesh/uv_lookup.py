"""Faces found by their place in the atlas: a tree of boxes over the triangles of the parameter mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.mesh.closest_point import NearestTree, build_tree


def uv_tree(corner_uvs: Floats) -> NearestTree:
    """Faces as triangles of the atlas, from their corners (F, 3, 2)."""
    flat = np.zeros((*corner_uvs.shape[:2], 3))
    flat[..., :2] = corner_uvs
    return build_tree(flat)


def locate_uvs(tree: NearestTree, uvs: Floats) -> tuple[NDArray[np.int64], Floats]:
    """The face at each place of the atlas (N, 2), or nearest to it: faces (N,), barycentric coordinates (N, 3)."""
    _, faces, weights = tree.query(np.c_[uvs, np.zeros(len(uvs))])
    return faces, weights
