"""The parts of a file's default scene, placed in bind pose and moved by one joint list.

See binding.py for what bind pose means. A part is one primitive of one node; its vertices are the file's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.errors import InputError
from preprocess.load.binding import JointList, moments_of, place_rigid, place_skin
from preprocess.load.primitives import Primitive, Target, check_positions, read_primitive
from runtime.animation.pose import global_transforms, rest_pose
from runtime.animation.skeleton import read_skeleton
from runtime.gltf.document import Document
from runtime.gltf.morph_names import default_weights, morph_names

ZERO_SCALE = 1e-6  # rest scales below this hide a part; it is placed as if they were one


@dataclass(frozen=True)
class Part:
    """One primitive in object space. N vertices, F faces, L texture coordinate sets, K influences.

    Attributes
    ----------
    source : Primitive
        As in the file.
    node : int
        The mesh's node in the file.
    skin : int or None
    positions, normals : (N, 3) float64
        In object space.
    tangents : (N, 4) float64 or None
        In object space, handedness last.
    joints : (N, K) int64
        Into the character's joint list.
    weights : (N, K) float64
        Rows sum to one.
    faces : (F, 3) int64
        Turned over where the placement mirrors.
    targets : tuple of Target
        In object space.
    morph_names : tuple of str
        Of each target: parts may share a morph.
    """

    source: Primitive
    node: int
    skin: int | None
    positions: Floats
    normals: Floats
    tangents: Floats | None
    joints: NDArray[np.int64]
    weights: Floats
    faces: NDArray[np.int64]
    targets: tuple[Target, ...] = ()
    morph_names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Scene:
    """All parts and the joint list they point into.

    Attributes
    ----------
    parts : tuple of Part
    joint_nodes : (J,) int64, node indices of the file
    inverse_bind : (J, 4, 4) float64
    morphs : dict of name to weight at rest
    warnings : tuple of str
    """

    parts: tuple[Part, ...]
    joint_nodes: NDArray[np.int64]
    inverse_bind: Floats
    morphs: dict[str, float]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Instance:
    """A primitive as some node shows it, before it is placed."""

    node: int
    skin: int | None
    primitive: Primitive
    where: str


@dataclass(frozen=True)
class _Skin:
    nodes: list[int]
    inverse: Floats


def _choose_scene(document: Document, warnings: list[str]) -> list[int]:
    """Roots of the default scene, or of the first with a mesh where that one shows none."""
    scenes, nodes = document.items("scenes"), document.items("nodes")
    shown: dict[int, bool] = {}  # whether a root shows a mesh: scenes may share roots

    def shows_mesh(root: int) -> bool:
        if root not in shown:
            shown[root] = any("mesh" in document.item("nodes", node) for node in _nodes_below(document, [root]))
        return shown[root]

    if not scenes:
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]
    default = document.json.get("scene", 0)
    candidates = [document.item("scenes", default), *scenes]
    for number, scene in enumerate(candidates):
        roots: list[int] = scene.get("nodes", [])
        if any(map(shows_mesh, roots)):
            if number:
                warnings.append(f"scene {default} shows no mesh: scene {number - 1} is built instead")
            return roots
    return []


def _nodes_below(document: Document, roots: list[int]) -> Iterator[int]:
    """Roots and all nodes below them once, parents first, children in the file's order."""
    stack = list(reversed(roots))
    seen: set[int] = set()
    while stack:
        index = stack.pop()
        if index in seen:
            continue
        seen.add(index)
        yield index
        stack.extend(reversed(document.item("nodes", index).get("children", [])))


def _read_skin(document: Document, index: int) -> _Skin:
    spec = document.item("skins", index)
    nodes = spec.get("joints", [])
    where = f"{document.path.name}: skin {index}"
    if not nodes:
        raise InputError(f"{where} has no joints: export the file again")
    for node in nodes:
        document.item("nodes", node)
    inverse = np.tile(np.eye(4), (len(nodes), 1, 1))
    if "inverseBindMatrices" in spec:
        matrices = document.accessor(spec["inverseBindMatrices"]).astype(np.float64)
        if matrices.shape[1:] != (4, 4) or len(matrices) < len(nodes):
            raise InputError(f"{where} has {len(matrices)} inverse bind matrices for {len(nodes)} joints: export again")
        inverse = matrices[: len(nodes)]
        inverse[:, 3] = (0, 0, 0, 1)
        if not (np.abs(inverse) <= document.limits.number).all():
            raise InputError(f"{where} has inverse bind matrices that are not finite or far out of range: export again")
    return _Skin(list(nodes), inverse)


def _read_instances(document: Document, warnings: list[str]) -> list[_Instance]:
    """Every primitive of every mesh node of the scene, each mesh decoded once; of levels of detail, the first alone."""
    meshes: dict[int, list[tuple[Primitive, str]]] = {}
    instances: list[_Instance] = []
    roots = _choose_scene(document, warnings)
    lower = _lower_levels(document, roots)
    hidden, num_faces = 0, 0
    for node in _nodes_below(document, roots):
        spec = document.item("nodes", node)
        if node in lower:
            hidden += "mesh" in spec
            continue
        if "EXT_mesh_gpu_instancing" in spec.get("extensions", {}):
            raise InputError(
                f"{document.path.name}: node {node} is instanced: export its copies as meshes of their own"
            )
        if "mesh" not in spec:
            continue
        mesh = spec["mesh"]
        if mesh not in meshes:
            meshes[mesh] = _read_mesh(document, mesh, warnings)
        skin = spec.get("skin")
        instances += [_Instance(node, skin, primitive, where) for primitive, where in meshes[mesh]]
        num_faces += sum(len(primitive.faces) for primitive, _ in meshes[mesh])
        if num_faces > document.limits.triangles:
            raise InputError(
                f"{document.path.name} has more than {document.limits.triangles} triangles, counting each copy of a "
                "mesh: simplify it, or raise --limit triangles=N"
            )
    if hidden:
        warnings.append(f"{hidden} meshes left out: lower levels of detail (MSFT_lod) of others in the scene")
    return instances


def _lower_levels(document: Document, roots: list[int]) -> set[int]:
    """Nodes that are lower levels of detail of others in the scene (MSFT_lod), with all below them."""
    levels: list[int] = []
    for node in _nodes_below(document, roots):
        level_ids = document.item("nodes", node).get("extensions", {}).get("MSFT_lod", {}).get("ids", [])
        levels += [level for level in level_ids if level != node]
    return set(_nodes_below(document, levels))


def _read_mesh(document: Document, index: Any, warnings: list[str]) -> list[tuple[Primitive, str]]:
    mesh = document.item("meshes", index)
    name = str(mesh.get("name") or f"mesh {index}")
    found = []
    for number, spec in enumerate(mesh.get("primitives", [])):
        where = f"{document.path.name}: {name}, primitive {number}"
        primitive, notes = read_primitive(document, spec, where)
        warnings += [note.removeprefix(f"{document.path.name}: ") for note in notes]
        if primitive is not None:
            found.append((primitive, where))
    return found


def _is_skinned(instance: _Instance) -> bool:
    return instance.skin is not None and instance.primitive.joints is not None


def _clean_weights(instance: _Instance, num_joints: int, warnings: list[str]) -> tuple[NDArray[np.int64], Floats]:
    """Joints of the skin and weights that sum to one; the damage is counted."""
    joints, weights = instance.primitive.joints, instance.primitive.weights
    assert joints is not None and weights is not None
    place = instance.where.partition(": ")[2]
    broken = ~np.isfinite(weights) | (weights < 0)
    if broken.any():
        warnings.append(f"{place}: {int(broken.sum())} weights are negative or not finite: set to 0")
        weights = np.where(broken, 0.0, weights)
    outside = (joints >= num_joints) | (joints < 0)
    if (outside & (weights > 0)).any():
        raise InputError(
            f"{instance.where}: joint {int(joints[outside & (weights > 0)].max())} is outside its skin's "
            f"{num_joints} joints: export the file again"
        )
    joints = np.where(outside, 0, joints)
    sums = weights.sum(axis=1)
    empty = sums <= 0
    if empty.any():
        warnings.append(f"{place}: {int(empty.sum())} vertices have no weight: hung on the skin's first joint")
        joints, weights = joints.copy(), weights.copy()
        joints[empty, 0], weights[empty, 0] = 0, 1.0
        sums = weights.sum(axis=1)
    uneven = int((np.abs(sums - 1) > 0.02).sum())  # four 8-bit weights may miss one by 4 / 255
    if uneven:
        warnings.append(f"{place}: weights of {uneven} vertices do not sum to one: normalised")
    return joints, weights / sums[:, None]


def _place_target(target: Target, normals: Floats | None, linear: Floats) -> Target:
    """A target in object space: shifts by the placement's linear part, turns by its inverse transpose.

    Normals are made unit there: what is added to them shrinks by as much.
    """
    turns = target.turns @ np.linalg.inv(linear)
    if normals is not None:
        turns /= np.linalg.norm(normals[target.vertices] @ np.linalg.inv(linear), axis=1, keepdims=True)
    return Target(target.vertices, target.shifts @ linear.T, np.nan_to_num(turns))


def _place(
    instance: _Instance,
    placement: Floats,
    joints: NDArray[np.int64],
    weights: Floats,
    most: float,
    morph_names: tuple[str, ...],
) -> Part:
    """A part in object space: positions by the placement, normals by its inverse transpose."""
    primitive = instance.primitive
    identity = bool((placement == np.eye(4)).all())
    linear, shift = placement[:3, :3], placement[:3, 3]
    mirrored = np.linalg.det(linear) < 0
    positions = primitive.positions if identity else primitive.positions @ linear.T + shift
    check_positions(positions, most, instance.where)
    normals = primitive.normals if primitive.normals is not None else np.full_like(positions, np.nan)
    tangents = primitive.tangents
    if not identity:
        normals = normals @ np.linalg.inv(linear)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        if tangents is not None:
            directions = tangents[:, :3] @ linear.T
            lengths = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
            tangents = np.concatenate([directions / lengths, tangents[:, 3:] * (-1 if mirrored else 1)], axis=1)
    return Part(
        source=primitive,
        node=instance.node,
        skin=instance.skin if _is_skinned(instance) else None,
        positions=positions,
        normals=normals,
        tangents=tangents,
        joints=joints,
        weights=weights,
        faces=primitive.faces[:, [0, 2, 1]] if mirrored else primitive.faces,
        targets=tuple(_place_target(target, primitive.normals, linear) for target in primitive.targets),
        morph_names=morph_names[: len(primitive.targets)],
    )


class _Binder:
    """Places skins and rigid parts and collects the joint list."""

    def __init__(self, document: Document) -> None:
        self.size_m = 1.0
        num_nodes = len(document.items("nodes"))
        tree = read_skeleton(document, list(range(num_nodes)), np.tile(np.eye(4), (num_nodes, 1, 1)))
        shown = dataclasses.replace(tree, scale=np.where(np.abs(tree.scale) < ZERO_SCALE, 1.0, tree.scale))
        self.rest = np.empty((num_nodes, 4, 4))
        with np.errstate(over="ignore", invalid="ignore"):  # scales may multiply beyond all numbers down a tree
            self.rest[tree.document_nodes] = global_transforms(shown, rest_pose(shown))[0]
        self.parents = np.full(num_nodes, -1, np.int64)
        has_parent = tree.parents >= 0
        self.parents[tree.document_nodes[has_parent]] = tree.document_nodes[tree.parents[has_parent]]
        self.joints = JointList()
        self.known: dict[int, Floats] = {}  # bind-pose globals of joints
        self.order = np.empty(num_nodes, np.int64)  # parents before children
        self.order[tree.document_nodes] = np.arange(num_nodes)
        self.most_joints, self.where = document.limits.joints, document.path.name

    def _add_joint(self, node: int, inverse_bind: Floats) -> int:
        index = self.joints.add(node, inverse_bind, self.size_m)
        if len(self.joints.nodes) > self.most_joints:
            raise InputError(
                f"{self.where} has more than {self.most_joints} joints: remove some, or raise --limit joints=N"
            )
        return index

    def add_skin(self, skin: _Skin, mesh_node: int, moments: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Placement of a skin's meshes and the joint of each of its joints."""
        top = int(self.parents[min(skin.nodes, key=lambda node: self.order[node])])
        above = self.rest[top] if top >= 0 else np.eye(4)
        placement = place_skin(
            drawn=self.rest[skin.nodes] @ skin.inverse,
            moments=moments,
            canonical=[self.rest[mesh_node], above, np.eye(4)],
            known=self.known,
            nodes=skin.nodes,
            inverse=skin.inverse,
        )
        inverse = skin.inverse if (placement == np.eye(4)).all() else skin.inverse @ np.linalg.inv(placement)
        indices = [self._add_joint(node, matrix) for node, matrix in zip(skin.nodes, inverse)]
        for node, matrix in zip(skin.nodes, inverse):
            if node not in self.known and abs(np.linalg.det(matrix[:3, :3])) > 0:
                self.known[node] = np.linalg.inv(matrix)
        return placement, np.array(indices, np.int64)

    def add_rigid(self, node: int) -> tuple[Floats, int]:
        """Placement of a rigid part and its joint."""
        placement = place_rigid(node, self.parents, self.rest, self.known)
        inverse = np.linalg.inv(placement).astype(np.float64)
        return placement, self._add_joint(node, inverse)


def _rest_weights(
    document: Document, instances: list[_Instance], names: dict[int, tuple[str, ...]]
) -> dict[str, float]:
    """The scene's morphs, in the order in which they come, with their weights at rest."""
    found: dict[str, float] = {}
    for node in dict.fromkeys(instance.node for instance in instances):
        if node in names:
            for name, weight in zip(names[node], default_weights(document, document.item("nodes", node))):
                found.setdefault(name, weight)
    return found


def read_scene(document: Document) -> Scene:
    """Read, bind and place everything with a mesh in the default scene.

    Joints come in the order of the skins, then of the rigid parts; those that move something before all others.

    Raises
    ------
    InputError, AssetError
        If a mesh, skin or node is malformed.
    """
    warnings: list[str] = []
    binder = _Binder(document)  # first: it refuses a tree with a cycle
    instances = _read_instances(document, warnings)
    if not instances:
        raise InputError(
            f"{document.path.name} has no mesh with triangles in its scene: export the character's meshes with it"
        )
    binder.size_m = max(float(np.nanmax(np.abs(instance.primitive.positions))) for instance in instances)

    names = morph_names(document)
    skinned: dict[int, list[tuple[_Instance, NDArray[np.int64], Floats]]] = {}
    skins: dict[int, _Skin] = {}
    for instance in instances:
        if _is_skinned(instance):
            assert instance.skin is not None
            if instance.skin not in skins:
                skins[instance.skin] = _read_skin(document, instance.skin)
            joints, weights = _clean_weights(instance, len(skins[instance.skin].nodes), warnings)
            skinned.setdefault(instance.skin, []).append((instance, joints, weights))
    placed: dict[int, Part] = {}
    for index, members in skinned.items():
        skin = skins[index]
        total = np.zeros((len(skin.nodes), 4, 4))
        for instance, joints, weights in members:
            total += moments_of(instance.primitive.positions, joints, weights, len(skin.nodes))
        placement, to_joint = binder.add_skin(skin, members[0][0].node, total)
        for instance, joints, weights in members:
            names_here = names.get(instance.node, ())
            placed[id(instance)] = _place(
                instance, placement, to_joint[joints], weights, document.limits.number, names_here
            )
    for instance in instances:
        if id(instance) not in placed:
            placement, joint = binder.add_rigid(instance.node)
            count = len(instance.primitive.positions)
            placed[id(instance)] = _place(
                instance,
                placement,
                np.full((count, 1), joint, np.int64),
                np.ones((count, 1)),
                document.limits.number,
                names.get(instance.node, ()),
            )
    parts, order = _moving_first([placed[id(instance)] for instance in instances], len(binder.joints.nodes))
    return Scene(
        parts=parts,
        joint_nodes=np.array(binder.joints.nodes, np.int64)[order],
        inverse_bind=np.stack(binder.joints.inverse_binds)[order],
        morphs=_rest_weights(document, instances, names),
        warnings=tuple(warnings),
    )


def _moving_first(parts: list[Part], num_joints: int) -> tuple[tuple[Part, ...], NDArray[np.int64]]:
    """Parts whose joints are numbered anew, those that move something first, and the old number of each joint.

    What later stages hold for each joint at each point is then bounded by the mesh: skins may list thousands of others.
    """
    moves = np.zeros(num_joints, bool)
    for part in parts:
        moves[part.joints[part.weights > 0]] = True
    order = np.r_[np.flatnonzero(moves), np.flatnonzero(~moves)]
    number = np.empty(num_joints, np.int64)
    number[order] = np.arange(num_joints)
    return tuple(dataclasses.replace(part, joints=number[part.joints]) for part in parts), order
