"""Bind pose: where each part of a file stands in object space, and the one joint list that moves all of them.

Object space is the scene's space. A skin draws a vertex p at the weighted sum of G(j) I(j) p: the joint's global
transform times its inverse bind matrix. In bind pose all those products are one matrix B, so the mesh stands at B p.
glTF says nothing about B: the rest transforms of the nodes may show another pose. B is taken, in this order, to agree
with a skin placed before it that has the same joints, or as the placement of the mesh's node, of the node above the
joints or of one joint, whichever matches the drawn rest pose. Any choice is exact: joint j of the result is the pair
(node, I(j) B^-1), which moves B p as the file moves p. A pair that two skins share is one joint.

A rigid part hangs on its node with weight one; it stands where its nearest ancestor joint carries it in bind pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats

# Two inverse bind matrices that differ less than this, relative to their linear part (and, for the translation, to
# the character's size), are one joint: float32 files repeat matrices with errors of about 6e-8.
SAME_JOINT_REL = 2e-7
# A canonical placement (mesh node, parent of the joints) may miss the rest pose by this factor more than the best.
CANONICAL_SLACK = 4.0
# Squared relative distance from the rest pose that counts as none (1e-5 of the part's size).
MATCH_REL_SQ = 1e-10
SINGULAR_REL = 1e-12
MOST_CANDIDATES = 64  # joints whose drawn placement may be that of the mesh: those that hold most of it


def is_invertible(matrix: Floats) -> bool:
    """Whether a (4, 4) affine matrix is finite and keeps volume, relative to its own scale."""
    linear = matrix[:3, :3]
    size = float(np.abs(linear).max(initial=0.0))
    return bool(np.isfinite(matrix).all() and size > 0 and abs(np.linalg.det(linear / size)) > SINGULAR_REL)


class JointList:
    """The growing list of joints: pairs of a node and an inverse bind matrix, each pair once."""

    def __init__(self) -> None:
        self.nodes: list[int] = []
        self.inverse_binds: list[Floats] = []
        self._by_node: dict[int, list[int]] = {}

    def add(self, node: int, inverse_bind: Floats, size_m: float) -> int:
        """Index of the joint, new or found. `size_m` is the character's, for comparing translations."""
        scale = np.abs(inverse_bind[:3, :3]).max()
        tolerance = np.full((4, 4), SAME_JOINT_REL * scale)
        tolerance[:3, 3] *= max(size_m, 1e-30)
        known = self._by_node.get(node, [])
        if known:
            others = np.stack([self.inverse_binds[index] for index in known])
            same = np.logical_and.reduce(np.abs(others - inverse_bind) <= tolerance, axis=(1, 2))
            if same.any():
                return known[int(same.argmax())]
        self.nodes.append(node)
        self.inverse_binds.append(inverse_bind)
        self._by_node.setdefault(node, []).append(len(self.nodes) - 1)
        return len(self.nodes) - 1


def moments_of(positions: Floats, joints: NDArray[np.int64], weights: Floats, num_joints: int) -> Floats:
    """Weighted second moments of the points that each joint moves: what the distance between two placements needs.

    Parameters
    ----------
    positions : (N, 3) float64
    joints : (N, K) int64
    weights : (N, K) float64
    num_joints : int

    Returns
    -------
    (J, 4, 4) float64
        Sums of w p p^T over homogeneous points; the last entry of each is the joint's mass.
    """
    homogeneous = np.concatenate([positions, np.ones((len(positions), 1))], axis=1)
    outer = np.einsum("ni,nj->nij", homogeneous, homogeneous).reshape(-1, 16)
    total = np.zeros((num_joints, 16))
    for k in range(joints.shape[1]):  # a handful of influences
        for component in range(16):
            total[:, component] += np.bincount(joints[:, k], weights[:, k] * outer[:, component], minlength=num_joints)
    return total.reshape(-1, 4, 4)


def _mismatch(placement: Floats, drawn: Floats, moments: Floats) -> float:
    """Sum over points and joints of the weighted squared distance between `placement` p and the drawn rest pose."""
    difference = (drawn - placement)[:, :3]
    return float(np.einsum("jrc,jcd,jrd->", difference, moments, difference))


def place_skin(
    drawn: Floats,
    moments: Floats,
    canonical: list[Floats],
    known: dict[int, Floats],
    nodes: list[int],
    inverse: Floats,
) -> Floats:
    """The matrix B that stands a skin's mesh in object space.

    Parameters
    ----------
    drawn : (J, 4, 4) float64
        G(j) I(j) with the nodes' rest transforms.
    moments : (J, 4, 4) float64
        Of the skin's meshes (`moments_of`).
    canonical : list of (4, 4)
        Preferred placements, the best first.
    known : dict of node -> (4, 4)
        Bind-pose globals of joints placed before.
    nodes : list of J int
    inverse : (J, 4, 4) float64
        The skin's own inverse bind matrices I(j).

    Returns
    -------
    (4, 4) float64, invertible
    """
    masses = moments[:, 3, 3]
    by_mass = np.argsort(-masses, kind="stable")
    for j in by_mass:
        if masses[j] > 0 and nodes[j] in known:
            placement: Floats = known[nodes[j]] @ inverse[j]
            if is_invertible(placement):
                return placement
    candidates = [matrix for matrix in canonical if is_invertible(matrix)]
    num_canonical = len(candidates)
    candidates += [drawn[j] for j in by_mass[:MOST_CANDIDATES] if masses[j] > 0 and is_invertible(drawn[j])]
    if not candidates:
        return np.eye(4)
    misses = [_mismatch(candidate, drawn, moments) for candidate in candidates]
    size_sq = np.einsum("jrc,jcd,jrd->", drawn[:, :3], moments, drawn[:, :3])
    limit = CANONICAL_SLACK * min(misses) + MATCH_REL_SQ * size_sq
    for index in range(num_canonical):
        if misses[index] <= limit:
            return candidates[index]
    return candidates[int(np.argmin(misses))]


def place_rigid(node: int, parents: NDArray[np.int64], rest: Floats, known: dict[int, Floats]) -> Floats:
    """Where a rigid part's node stands in bind pose: carried by its nearest ancestor that is a joint.

    Parameters
    ----------
    node : int
    parents : (N,) int
        -1 for roots.
    rest : (N, 4, 4) float64
        Rest globals.
    known : dict of node -> (4, 4)
        Bind-pose globals of joints.

    Returns
    -------
    (4, 4) float64, invertible
    """
    ancestor = node
    while ancestor >= 0:
        if ancestor in known and is_invertible(rest[ancestor]):
            placement: Floats = known[ancestor] @ np.linalg.inv(rest[ancestor]) @ rest[node]
            if is_invertible(placement):
                return placement
        ancestor = int(parents[ancestor])
    return rest[node] if is_invertible(rest[node]) else np.eye(4)
