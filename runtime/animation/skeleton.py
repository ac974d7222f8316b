"""The hierarchy a character's clips move: nodes by depth, their rest pose, and which of them are joints.

Matrices are float64, row-major, acting on column vectors (``M @ p``); quaternions are (x, y, z, w) as in glTF.
Nodes are sorted by depth, so a level of the tree is one slice and posing is one batched product a level.
Letters in shapes: N nodes, J joints, M nodes with a sheared matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.errors import AssetError
from runtime.validation import describe, is_integer, unknown_name

if TYPE_CHECKING:
    from runtime.gltf.document import Document

# A node's matrix counts as T·R·S when the product gives it back this well, relative to its largest entry.
_SHEAR_TOLERANCE_REL = 1e-6


@dataclass(frozen=True)
class Skeleton:
    """Nodes, parents before children, and the joints among them.

    Attributes
    ----------
    names : tuple of N str, unique
    parents : (N,) int32
        Index of the parent node, -1 for a root. Always smaller than the node's own index.
    translation : (N, 3) float64, metres
    rotation : (N, 4) float64
        Unit quaternions (x, y, z, w).
    scale : (N, 3) float64
    joint_nodes : (J,) int32
        Joint to node. A node may serve several joints (two skins, each with an inverse bind of its own).
    inverse_bind : (J, 4, 4) float64
    root_transform : (4, 4) float64
        Applied above every root.
    document_nodes : (N,) int32
        Index of each node in the file it was read from, -1 for a node made elsewhere.
    matrix_nodes : (M,) int32
        Nodes whose local matrix is not a product of translation, rotation and scale. Clips never move them (glTF).
    matrices : (M, 4, 4) float64
        The local matrices of those.
    morphs : tuple of str, unique
        Names of the morph targets (blend shapes), which clips move as they move nodes.
    morph_weights : tuple of float
        Of each at rest.
    """

    names: tuple[str, ...]
    parents: NDArray[np.int32]
    translation: NDArray[np.float64]
    rotation: NDArray[np.float64]
    scale: NDArray[np.float64]
    joint_nodes: NDArray[np.int32]
    inverse_bind: NDArray[np.float64]
    root_transform: NDArray[np.float64]
    document_nodes: NDArray[np.int32]
    matrix_nodes: NDArray[np.int32]
    matrices: NDArray[np.float64]
    morphs: tuple[str, ...] = ()
    morph_weights: tuple[float, ...] = ()

    @property
    def num_nodes(self) -> int:
        """Number of nodes, N."""
        return len(self.names)

    @property
    def num_joints(self) -> int:
        """Number of joints, J."""
        return len(self.joint_nodes)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Name of the node of every joint."""
        return tuple(self.names[node] for node in self.joint_nodes)

    @cached_property
    def levels(self) -> tuple[slice, ...]:
        """Slices of the nodes at depth 0, 1, 2 …"""
        depths = np.zeros(self.num_nodes, dtype=np.int64)
        for node, parent in enumerate(self.parents):
            if parent >= 0:
                depths[node] = depths[parent] + 1
        starts = np.flatnonzero(np.diff(depths, prepend=-1))
        stops = np.append(starts[1:], self.num_nodes)
        return tuple(slice(int(start), int(stop)) for start, stop in zip(starts, stops))

    @cached_property
    def node_by_name(self) -> dict[str, int]:
        """Index of each node by its name."""
        return {name: node for node, name in enumerate(self.names)}

    def node(self, name: str | int) -> int:
        """Index of a node given by name or by index.

        Raises
        ------
        ValueError
            When there is none of that name or index.
        """
        if isinstance(name, str):
            if name not in self.node_by_name:
                raise unknown_name("joint", name, self.names, "skeleton")
            return self.node_by_name[name]
        if not is_integer(name) or not 0 <= int(name) < self.num_nodes:
            raise ValueError(f"no joint {describe(name)}; the skeleton has {self.num_nodes}, counted from 0")
        return int(name)

    def morph(self, name: str | int) -> int:
        """Index of a morph given by name or by index.

        Raises
        ------
        ValueError
            When there is none of that name or index.
        """
        if isinstance(name, str) and name in self.morphs:
            return self.morphs.index(name)
        if is_integer(name) and 0 <= int(name) < len(self.morphs):
            return int(name)
        raise unknown_name("morph", name, self.morphs, "character")

    def descendants(self, name: str | int) -> NDArray[np.bool_]:
        """Mask of a node and everything below it, (N,) bool."""
        mask = np.zeros(self.num_nodes, dtype=bool)
        mask[self.node(name)] = True
        for node, parent in enumerate(self.parents):
            if parent >= 0 and mask[parent]:
                mask[node] = True
        return mask

    def validate(self) -> None:
        """Assert our own invariants: shapes, order by depth, unit quaternions, finite numbers."""
        num_nodes, num_joints = self.num_nodes, self.num_joints
        assert len(set(self.names)) == num_nodes
        assert len(set(self.morphs)) == len(self.morphs) == len(self.morph_weights)
        assert self.parents.shape == self.document_nodes.shape == (num_nodes,)
        assert (self.parents < np.arange(num_nodes)).all() and (self.parents >= -1).all()
        assert self.translation.shape == self.scale.shape == (num_nodes, 3) and self.rotation.shape == (num_nodes, 4)
        assert self.inverse_bind.shape == (num_joints, 4, 4) and self.root_transform.shape == (4, 4)
        assert self.matrices.shape == (len(self.matrix_nodes), 4, 4)
        assert num_joints == 0 or (0 <= self.joint_nodes.min() and self.joint_nodes.max() < num_nodes)
        assert np.allclose(np.linalg.norm(self.rotation, axis=1), 1.0)
        for array in (self.translation, self.rotation, self.scale, self.inverse_bind, self.root_transform):
            assert np.isfinite(array).all()


def rotation_matrices(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices of unit quaternions: (..., 4) xyzw to (..., 3, 3) float64."""
    x, y, z, w = np.moveaxis(np.asarray(quaternions, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_quaternion(matrix: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) of a (3, 3) rotation matrix.

    The largest of the four components is found first and divided by, so no case loses precision
    (Shepperd 1978, "Quaternion from rotation matrix").
    """
    m = np.asarray(matrix, dtype=np.float64)
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    # Row i holds 4·q_i·(q_x, q_y, q_z, q_w), whichever i is chosen.
    products = np.array(
        [
            [squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [m[0, 1] + m[1, 0], squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[2], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]],
        ]
    )
    quaternion = products[int(np.argmax(squares))]
    return np.asarray(quaternion / np.linalg.norm(quaternion))


def decompose(
    matrix: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], bool]:
    """Split a (4, 4) matrix into translation (3,), rotation (4,) xyzw and scale (3,).

    Returns
    -------
    translation, rotation, scale : the parts; a mirrored matrix gets a negative x scale
    exact : bool
        False when the matrix shears (or is singular) and the product does not give it back.
    """
    m = np.asarray(matrix, dtype=np.float64)
    linear = m[:3, :3]
    scale = np.linalg.norm(linear, axis=0)
    if np.linalg.det(linear) < 0:
        scale[0] = -scale[0]
    if (np.abs(scale) < 1e-30).any():
        return m[:3, 3].copy(), np.array([0.0, 0.0, 0.0, 1.0]), scale, False
    rotation = rotation_quaternion(linear / scale)
    rebuilt = rotation_matrices(rotation) * scale
    exact = bool(np.abs(rebuilt - linear).max() <= _SHEAR_TOLERANCE_REL * np.abs(linear).max())
    exact = exact and bool(np.allclose(m[3], [0, 0, 0, 1]))
    return m[:3, 3].copy(), rotation, scale, exact


def _parents_in_document(nodes: list[dict[str, Any]], where: str) -> NDArray[np.int64]:
    """Parent of every node of the file, -1 for roots."""
    parents = np.full(len(nodes), -1, dtype=np.int64)
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            if not isinstance(child, int) or not 0 <= child < len(nodes):
                raise AssetError(f"{where}: node {index} has child {child}, which does not exist; re-export the file")
            if parents[child] >= 0:
                raise AssetError(f"{where}: node {child} has two parents; re-export the file")
            parents[child] = index
    return parents


def _depths_in_document(parents: NDArray[np.int64], where: str) -> NDArray[np.int64]:
    """Depth of every node of the file; refuses a cycle."""
    depths = np.full(len(parents), -1, dtype=np.int64)
    for start in range(len(parents)):
        chain: list[int] = []
        node = start
        while node >= 0 and depths[node] < 0:
            if len(chain) > len(parents):
                raise AssetError(f"{where}: node {start} is its own ancestor; re-export the file")
            chain.append(node)
            node = int(parents[node])
        depth = -1 if node < 0 else int(depths[node])
        for member in reversed(chain):
            depth += 1
            depths[member] = depth
    return depths


def _moving_nodes(parents: NDArray[np.int64], depths: NDArray[np.int64], joints: Sequence[int]) -> list[int]:
    """Joints, all that is above them and all that hangs below them, by depth, then as in the file."""
    above = np.zeros(len(parents), dtype=bool)
    below = np.zeros(len(parents), dtype=bool)
    below[list(joints)] = True
    for joint in joints:
        node = int(joint)
        while node >= 0 and not above[node]:
            above[node] = True
            node = int(parents[node])
    for node in np.argsort(depths, kind="stable"):
        if parents[node] >= 0 and below[parents[node]]:
            below[node] = True
    kept = np.flatnonzero(above | below)
    return [int(node) for node in kept[np.argsort(depths[kept], kind="stable")]]


def distinct_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names, those that are there already numbered: "arm", "arm (2)", "arm (3)" ..."""
    taken = set[str]()
    numbers: dict[str, int] = {}
    distinct = []
    for base in names:
        name = base
        while name in taken:
            numbers[base] = numbers.get(base, 1) + 1
            name = f"{base} ({numbers[base]})"
        taken.add(name)
        distinct.append(name)
    return tuple(distinct)


def _node_names(nodes: list[dict[str, Any]], kept: Sequence[int]) -> tuple[str, ...]:
    """A name per node: the file's own, "node N" where it has none, numbered where two agree."""
    return distinct_names([str(nodes[index].get("name") or f"node {index}") for index in kept])


def _rest_pose(
    node: dict[str, Any], where: str
) -> tuple[list[float], list[float], list[float], NDArray[np.float64] | None]:
    """Translation, rotation, scale of a node of the file, and its matrix where those cannot say it."""
    if "matrix" in node:
        matrix = np.asarray(node["matrix"], dtype=np.float64)
        if matrix.shape != (16,) or not np.isfinite(matrix).all():
            raise AssetError(f"{where}: its matrix must be 16 finite numbers; re-export the file")
        matrix = matrix.reshape(4, 4).T
        translation, rotation, scale, exact = decompose(matrix)
        return list(translation), list(rotation), list(scale), None if exact else matrix
    parts: list[list[float]] = []
    for key, default in (("translation", [0.0, 0, 0]), ("rotation", [0.0, 0, 0, 1]), ("scale", [1.0, 1, 1])):
        values = np.asarray(node.get(key, default), dtype=np.float64)
        if values.shape != (len(default),) or not np.isfinite(values).all():
            raise AssetError(f"{where}: its {key} must be {len(default)} finite numbers; re-export the file")
        parts.append([float(value) for value in values])
    length = float(np.linalg.norm(parts[1]))
    if length < 1e-12:
        raise AssetError(f"{where}: its rotation is zero; re-export the file")
    return parts[0], [value / length for value in parts[1]], parts[2], None


def read_skeleton(
    document: Document,
    joint_nodes: Sequence[int],
    inverse_bind: ArrayLike,
    root_transform: ArrayLike | None = None,
) -> Skeleton:
    """Read the part of a file's node tree that moves the given joints.

    Parameters
    ----------
    document : Document
    joint_nodes : J node indices of the file
        A node may occur more than once.
    inverse_bind : (J, 4, 4) float
        From the space of the mesh at rest to the space of each joint.
    root_transform : (4, 4) float, optional
        Put above every root; identity by default.

    Returns
    -------
    Skeleton
        The joints, their ancestors (clips may move those), and what hangs below them (sockets to attach objects to).

    Raises
    ------
    AssetError
        When the tree has a cycle or a missing node, or a transform is not finite.
    """
    nodes: list[dict[str, Any]] = document.json.get("nodes", [])
    where = str(getattr(document, "path", None) or "file")
    inverse = np.array(inverse_bind, dtype=np.float64).reshape(len(joint_nodes), 4, 4)
    if not np.isfinite(inverse).all():
        raise AssetError(f"{where}: an inverse bind matrix is not finite; re-export the file")
    for joint in joint_nodes:
        if not 0 <= joint < len(nodes):
            raise AssetError(f"{where}: joint node {joint} does not exist; re-export the file")
    document_parents = _parents_in_document(nodes, where)
    kept = _moving_nodes(document_parents, _depths_in_document(document_parents, where), joint_nodes)
    new_index = {node: index for index, node in enumerate(kept)}
    rests = [_rest_pose(nodes[node], f"{where}: node {node}") for node in kept]
    sheared = [index for index, rest in enumerate(rests) if rest[3] is not None]
    skeleton = Skeleton(
        names=_node_names(nodes, kept),
        parents=np.array([new_index.get(int(document_parents[node]), -1) for node in kept], dtype=np.int32),
        translation=np.array([rest[0] for rest in rests], dtype=np.float64).reshape(-1, 3),
        rotation=np.array([rest[1] for rest in rests], dtype=np.float64).reshape(-1, 4),
        scale=np.array([rest[2] for rest in rests], dtype=np.float64).reshape(-1, 3),
        joint_nodes=np.array([new_index[int(node)] for node in joint_nodes], dtype=np.int32),
        inverse_bind=inverse,
        root_transform=np.eye(4) if root_transform is None else np.array(root_transform, dtype=np.float64),
        document_nodes=np.array(kept, dtype=np.int32),
        matrix_nodes=np.array(sheared, dtype=np.int32),
        matrices=np.array([rests[index][3] for index in sheared], dtype=np.float64).reshape(-1, 4, 4),
    )
    skeleton.validate()
    return skeleton
