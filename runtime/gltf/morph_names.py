"""Names of a file's morph targets (blend shapes): several meshes with a target of one name are one morph.

glTF keeps names in a mesh's `extras.targetNames`, by convention. Targets without a name, or whose name their mesh has
given already, are named after their mesh and their number. Two nodes whose targets share a name and yet say different
things (another default, other keys in a clip) are two morphs: the later one is called "NAME (NODE)".
Source: Khronos Group, glTF 2.0 Specification, sections 3.7.2.2 and 5.24.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from runtime.gltf.document import Document

MAX_TARGETS = 1024  # of one mesh: avatars have up to 80, scanned faces some 250


def num_targets(mesh: dict[str, Any]) -> int:
    """Morph targets of a mesh: as many as the primitive with the most has."""
    return max((len(primitive.get("targets", [])) for primitive in mesh.get("primitives", [])), default=0)


def default_weights(document: Document, node: dict[str, Any]) -> list[float]:
    """Weights of the targets of a node's mesh at rest: the node's own, else the mesh's, else none."""
    mesh = document.item("meshes", node["mesh"])
    given = node.get("weights", mesh.get("weights", []))
    count = num_targets(mesh)
    return [float(weight) for weight in [*given, *[0.0] * count][:count]]


def _own_names(mesh: dict[str, Any], index: int) -> list[str]:
    """A name for each target of a mesh, each another."""
    extras = mesh.get("extras")
    given = extras.get("targetNames") if isinstance(extras, dict) else None
    listed = given if isinstance(given, list) else []
    base = str(mesh.get("name") or f"mesh {index}")
    names: list[str] = []
    for number in range(num_targets(mesh)):
        name = listed[number] if number < len(listed) else None
        if not isinstance(name, str) or not name or name in names:
            name = f"{base}.{number}"
        while name in names:
            name += "_"
        names.append(name)
    return names


class _Sayings:
    """What a file says about the targets of its nodes: defaults, and keys of every clip."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._channels: dict[int, dict[int, tuple[Any, ...]]] = {}  # by node, then clip
        for clip, animation in enumerate(document.items("animations")):
            samplers = animation.get("samplers", [])
            for channel in animation.get("channels", []):
                target, sampler = channel.get("target", {}), channel.get("sampler", -1)
                if target.get("path") == "weights" and "node" in target and 0 <= sampler < len(samplers):
                    one = samplers[sampler]
                    key = (one.get("input"), one.get("output"), one.get("interpolation", "LINEAR"))
                    self._channels.setdefault(target["node"], {}).setdefault(clip, key)

    def _keys(self, key: tuple[Any, ...], number: int, count: int) -> bytes:
        times, values = (self._document.accessor(index) for index in key[:2])
        flat = values.reshape(-1)
        own = flat.reshape(-1, count)[:, number] if count and flat.size % count == 0 else flat
        parts = np.asarray(times, np.float32).tobytes(), np.asarray(own, np.float32).tobytes(), str(key[2]).encode()
        return b"".join(parts)

    def differ(self, one: tuple[int, int], other: tuple[int, int]) -> bool:
        """Whether two targets, each a node and a number, are told to do different things."""
        nodes = self._document.items("nodes")
        defaults = [default_weights(self._document, nodes[node]) for node, _ in (one, other)]
        if defaults[0][one[1]] != defaults[1][other[1]]:
            return True
        of_one, of_other = self._channels.get(one[0], {}), self._channels.get(other[0], {})
        for clip in of_one.keys() & of_other.keys():
            if of_one[clip] == of_other[clip] and one[1] == other[1]:
                continue
            keys = [
                self._keys(of[clip], number, len(weights))
                for of, number, weights in ((of_one, one[1], defaults[0]), (of_other, other[1], defaults[1]))
            ]
            if keys[0] != keys[1]:
                return True
        return False


def morph_names(document: Document) -> dict[int, tuple[str, ...]]:
    """The morph that each target of a node's mesh is, by node; nodes without targets are left out.

    Raises
    ------
    AssetError
        If a node's mesh does not exist, or keys are malformed.
    """
    own = {
        number: _own_names(document.item("meshes", node["mesh"]), node["mesh"])
        for number, node in enumerate(document.items("nodes"))
        if "mesh" in node and num_targets(document.item("meshes", node["mesh"]))
    }
    sayings = _Sayings(document) if len(own) > 1 else None
    first: dict[str, tuple[int, int]] = {}
    result: dict[int, tuple[str, ...]] = {}
    for node, names in own.items():
        final = []
        for number, name in enumerate(names):
            known = first.setdefault(name, (node, number))
            if sayings is not None and known[0] != node and sayings.differ(known, (node, number)):
                name = f"{name} ({document.items('nodes')[node].get('name') or f'node {node}'})"
                first.setdefault(name, (node, number))
            final.append(name)
        result[node] = tuple(final)
    return result
