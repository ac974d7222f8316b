"""model.glb: skeleton, clips and one skinned mesh per level of detail, as glTF that any viewer opens.

The scene shows the finest level; the others hang on it by MSFT_lod. Materials name the folder's textures by relative
uri. For the runtime every vertex also has `_OWNER_UV`, where its geometry is fetched. `TEXCOORD_1`, where there is one,
is the place of its normal, and of colours that were painted there (docs/format.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from preprocess.arrays import Floats
from preprocess.decimate.levels import Lod
from preprocess.export.lod_vertices import LodMesh, build_lod_mesh
from preprocess.export.materials import describe_textures, plan_draws, uv_set
from preprocess.load.character import Character
from preprocess.mesh.surface import SkinnedMesh
from runtime.animation.clip import WEIGHTS, Clip, Track
from runtime.animation.keyframes import evaluate, stack_tracks
from runtime.animation.skeleton import Skeleton
from runtime.asset.lod_mesh import UV_STEPS

if TYPE_CHECKING:
    from pygltflib import GLTF2

GENERATOR = "seamskin"
CUBIC_PARTS = 8  # that a span of a cubic key track is sampled in, where tracks' keys differ
SCREEN_ROWS = 1080  # of the screen for which MSFT_screencoverage is given
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
COMPONENTS = {np.dtype(np.uint8): 5121, np.dtype(np.uint16): 5123, np.dtype(np.uint32): 5125, np.dtype("<f4"): 5126}
TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class _Buffer:
    """The binary chunk and the accessors into it. Equal arrays for clips are stored once."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self._clip_data = bytearray()
        self._known: dict[tuple[bytes, str], int] = {}

    def view(self, data: bytes | bytearray, target: int | None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.data += data
        self.views.append(view)
        return len(self.views) - 1

    def accessor(self, values: NDArray[Any], target: int | None, bounds: bool = False, normalized: bool = False) -> int:
        """An accessor over a view of its own."""
        spec = self._describe(values, bounds)
        if normalized:
            spec["normalized"] = True
        stored = values.swapaxes(1, 2) if values.ndim == 3 else values
        spec["bufferView"] = self.view(np.ascontiguousarray(stored).tobytes(), target)
        self.accessors.append(spec)
        return len(self.accessors) - 1

    def clip_accessor(self, values: ArrayLike, bounds: bool) -> int:
        """An accessor over the one view that all clips share, which `finish` appends."""
        array = np.ascontiguousarray(values, "<f4")
        spec = self._describe(array, bounds)
        key = (array.tobytes(), f"{spec['type']} {bounds}")
        if key not in self._known:
            spec["byteOffset"] = len(self._clip_data)
            self._clip_data += array.tobytes()
            self.accessors.append(spec)
            self._known[key] = len(self.accessors) - 1
        return self._known[key]

    def sparse_accessor(self, rows: NDArray[np.int64], values: NDArray[np.float32], count: int, bounds: bool) -> int:
        """An accessor of `count` vectors that are zero but in some rows."""
        spec: dict[str, Any] = {"componentType": COMPONENTS[values.dtype], "count": count, "type": "VEC3"}
        if bounds:
            low, high = values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf)
            if len(rows) < count:
                low, high = np.minimum(low, 0), np.maximum(high, 0)
            spec["min"], spec["max"] = low.tolist(), high.tolist()
        if len(rows):
            kind = np.uint16 if count <= 0xFFFF else np.uint32
            numbers = self.view(rows.astype(kind).tobytes(), None)
            spec["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": numbers, "componentType": COMPONENTS[np.dtype(kind)]},
                "values": {"bufferView": self.view(values.tobytes(), None)},
            }
        self.accessors.append(spec)
        return len(self.accessors) - 1

    def finish(self) -> None:
        """Append the clips' view and let their accessors point to it."""
        if self._clip_data:
            view = self.view(self._clip_data, None)
            for index in self._known.values():
                self.accessors[index]["bufferView"] = view

    @staticmethod
    def _describe(values: NDArray[Any], bounds: bool) -> dict[str, Any]:
        spec: dict[str, Any] = {
            "componentType": COMPONENTS[values.dtype],
            "count": len(values),
            "type": TYPES[values.shape[1:]],
        }
        if bounds:
            flat = values.reshape(len(values), -1)
            spec["min"], spec["max"] = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
        return spec


def _describe_nodes(skeleton: Skeleton) -> list[dict[str, Any]]:
    """The skeleton's nodes, at the same indices, with only what differs from rest at the origin."""
    nodes: list[dict[str, Any]] = []
    for index, name in enumerate(skeleton.names):
        node: dict[str, Any] = {"name": name}
        if not np.array_equal(skeleton.translation[index], (0, 0, 0)):
            node["translation"] = skeleton.translation[index].tolist()
        if not np.array_equal(skeleton.rotation[index], (0, 0, 0, 1)):
            node["rotation"] = skeleton.rotation[index].tolist()
        if not np.array_equal(skeleton.scale[index], (1, 1, 1)):
            node["scale"] = skeleton.scale[index].tolist()
        nodes.append(node)
    for index, matrix in zip(skeleton.matrix_nodes, skeleton.matrices):
        for key in ("translation", "rotation", "scale"):
            nodes[index].pop(key, None)
        nodes[index]["matrix"] = matrix.T.reshape(-1).tolist()
    for index, parent in enumerate(skeleton.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(index)
    return nodes


def _free_name(name: str, taken: Sequence[str]) -> str:
    while name in taken:
        name = f"{name}_"
    return name


def _add_skin(
    nodes: list[dict[str, Any]], skeleton: Skeleton, character_name: str, buffer: _Buffer
) -> tuple[dict[str, Any], list[int]]:
    """The skin, and the roots of the scene.

    glTF wants a skin's joints distinct and under one root. A node that is several joints gets children at its own
    place, one a further joint; several roots, and a transform above them, get a node of their own.
    """
    names = [node["name"] for node in nodes]
    roots = [index for index, parent in enumerate(skeleton.parents) if parent < 0]
    if len(roots) > 1 or not np.array_equal(skeleton.root_transform, np.eye(4)):
        root: dict[str, Any] = {"name": _free_name(f"{character_name}_root", names), "children": roots}
        if not np.array_equal(skeleton.root_transform, np.eye(4)):
            root["matrix"] = skeleton.root_transform.T.reshape(-1).tolist()
        nodes.append(root)
        names.append(root["name"])
        roots = [len(nodes) - 1]
    joints: list[int] = []
    for node in skeleton.joint_nodes.tolist():
        if node in joints:
            name = _free_name(f"{skeleton.names[node]} (bind)", names)
            nodes[node].setdefault("children", []).append(len(nodes))
            nodes.append({"name": name})
            names.append(name)
            node = len(nodes) - 1
        joints.append(node)
    matrices = skeleton.inverse_bind.astype("<f4")
    matrices[:, 3] = (0, 0, 0, 1)
    skin = {"name": character_name, "joints": joints, "inverseBindMatrices": buffer.accessor(matrices, None)}
    return skin, roots


def _with_channel(clip: Clip, skeleton: Skeleton) -> Clip:
    """A clip that moves nothing, with a still node: glTF wants a channel, and clips keep their numbers."""
    free = np.setdiff1d(np.arange(skeleton.num_nodes), skeleton.matrix_nodes)
    if clip.tracks or not len(free):
        return clip
    times, node = np.unique([0.0, clip.duration_s]), int(free[0])
    still = Track(node, "scale", "LINEAR", times, np.tile(skeleton.scale[node], (len(times), 1)))
    return replace(clip, tracks=(still,))


def _weight_keys(tracks: Sequence[Track], rest: Sequence[float]) -> tuple[str, NDArray[Any], NDArray[Any]]:
    """Tracks of single morphs as one of all: interpolation, times (K,), values (K, M), or (3 K, M) for CUBICSPLINE.

    Where the tracks' keys differ, they are brought to the times of all; cubic ones are sampled between their keys.
    """
    first = tracks[0]
    alike = all(
        track.interpolation == first.interpolation and np.array_equal(track.times, first.times) for track in tracks
    )
    if alike:
        values = np.zeros((*first.values.shape[:-1], len(rest)))
        (values[:, 1] if values.ndim == 3 else values)[:] = rest
        for track in tracks:
            values[..., track.node] = track.values[..., 0]
        return first.interpolation, first.times, values.reshape(-1, len(rest))
    times = np.unique(np.concatenate([track.times for track in tracks]))
    if any(track.interpolation == "CUBICSPLINE" for track in tracks):
        steps = np.linspace(0.0, 1.0, CUBIC_PARTS, endpoint=False)
        times = np.append((times[:-1, None] + np.diff(times)[:, None] * steps).ravel(), times[-1])
    step = [np.nextafter(track.times[1:].astype("<f4"), 0.0) for track in tracks if track.interpolation == "STEP"]
    times = np.unique(np.concatenate([times.astype("<f4"), *step])).astype(np.float64)
    values = np.tile(np.asarray(rest, np.float64), (len(times), 1))
    for bank, found in evaluate(stack_tracks(tracks), times, np.dtype(np.float64)):
        values[:, bank.nodes] = found[0].T
    return "LINEAR", times, values


def _describe_clip(
    clip: Clip, buffer: _Buffer, level_nodes: Sequence[int], rest: Sequence[float]
) -> dict[str, Any] | None:
    """A clip with its keys as they are; None for one without tracks, which glTF does not allow.

    Morph weights go to the mesh of every level.
    """
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def add(mode: str, times: NDArray[Any], values: NDArray[Any], targets: Sequence[tuple[int, str]]) -> None:
        channels.extend({"sampler": len(samplers), "target": {"node": node, "path": path}} for node, path in targets)
        samplers.append(
            {
                "input": buffer.clip_accessor(times, bounds=True),
                "output": buffer.clip_accessor(values, bounds=False),
                "interpolation": mode,
            }
        )

    for track in clip.tracks:
        if track.path != WEIGHTS:
            values = track.values
            if track.interpolation == "CUBICSPLINE":
                values = values.reshape(-1, values.shape[-1])
            add(track.interpolation, track.times, values, [(int(track.node), track.path)])
    moving = [track for track in clip.tracks if track.path == WEIGHTS]
    if moving:
        mode, times, values = _weight_keys(moving, rest)
        add(mode, times, values.reshape(-1), [(node, WEIGHTS) for node in level_nodes])
    return {"name": clip.name, "samplers": samplers, "channels": channels} if channels else None


def _uv_accessor(uvs: NDArray[np.float32], buffer: _Buffer) -> int:
    """Uvs as 16-bit numbers where these say them exactly."""
    steps = np.rint(np.clip(uvs.astype(np.float64), 0.0, 1.0) * UV_STEPS).astype(np.uint16)
    if np.array_equal((steps / UV_STEPS).astype(np.float32), uvs):
        return buffer.accessor(steps, ARRAY_BUFFER, normalized=True)
    return buffer.accessor(uvs, ARRAY_BUFFER)


def _describe_mesh(
    name: str, level: LodMesh, face_draws: NDArray[np.int64], buffer: _Buffer, second_uvs: bool
) -> dict[str, Any]:
    """A mesh of one primitive a draw range; they share the vertices. Materials may ask all levels for second uvs."""
    attributes = {
        "POSITION": buffer.accessor(level.positions, ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.accessor(level.normals, ARRAY_BUFFER),
        "TEXCOORD_0": _uv_accessor(level.uvs, buffer),
        "_OWNER_UV": _uv_accessor(level.canonical_uvs, buffer),
    }
    if level.tangents is not None:
        attributes["TANGENT"] = buffer.accessor(level.tangents, ARRAY_BUFFER)
    if level.normal_uvs is not None:
        attributes["TEXCOORD_1"] = buffer.accessor(level.normal_uvs, ARRAY_BUFFER, normalized=True)
    elif second_uvs:
        attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"]
    for number in range(level.joints.shape[1] // 4):
        columns = slice(4 * number, 4 * number + 4)
        joints = np.ascontiguousarray(level.joints[:, columns])
        weights = np.ascontiguousarray(level.weights[:, columns])
        attributes[f"JOINTS_{number}"] = buffer.accessor(joints, ARRAY_BUFFER)
        attributes[f"WEIGHTS_{number}"] = buffer.accessor(weights, ARRAY_BUFFER)
    targets = [
        {
            "POSITION": buffer.sparse_accessor(target.vertices, target.shifts, len(level.positions), True),
            "NORMAL": buffer.sparse_accessor(target.vertices, target.turns, len(level.positions), False),
        }
        for target in level.targets
    ]
    index_type = np.uint16 if len(level.positions) < 65535 else np.uint32
    primitives: list[dict[str, Any]] = []
    for draw in np.unique(face_draws).tolist():
        indices = level.faces[face_draws == draw].reshape(-1).astype(index_type)
        primitives.append(
            {"attributes": attributes, "indices": buffer.accessor(indices, ELEMENT_ARRAY_BUFFER), "material": draw}
        )
        if targets:
            primitives[-1]["targets"] = targets
    return {"name": name, "primitives": primitives}


def _drawing_order(
    face_source: NDArray[np.integer], face_draws: NDArray[np.int64], materials: Sequence[Mapping[str, Any]]
) -> NDArray[np.int64]:
    """Order of a level's faces, (F,): as the file has them where they are blended, since the order is seen there.

    Others stay in the order that suits vertex caches.
    """
    is_blended = np.array([material.get("alphaMode") == "BLEND" for material in materials])
    return np.argsort(np.where(is_blended[face_draws], face_source, np.arange(len(face_source))), kind="stable")


def screen_coverage(lods: Sequence[Lod], diagonal_m: float) -> list[float]:
    """Share of the screen's area above which each level is wanted (MSFT_lod's hint), the finest first.

    A level is left once the next one's error is under a pixel of a screen of 1,080 rows; the last is never left.
    Empty where an error was not measured.
    """
    errors = np.array([lod.error_m for lod in lods[1:]])
    if not np.isfinite(errors).all():
        return []
    heights = diagonal_m / (np.maximum(errors, 1e-12) * SCREEN_ROWS)
    shares = np.minimum.accumulate(np.minimum(heights**2, 1.0))
    return [*shares.tolist(), 0.0]


def build_levels(
    character: Character,
    mesh: SkinnedMesh,
    lods: Sequence[Lod],
    influences: int = 4,
    normal_uvs: Sequence[Floats | None] | None = None,
    tangents: Floats | None = None,
) -> list[LodMesh]:
    """The levels as vertex attributes. See `write_model_glb`; `tangents` (F, 3, 4) are of the full mesh's corners."""
    return [
        build_lod_mesh(
            mesh,
            character.skeleton.num_joints,
            lod.surface,
            lod.canonical_uvs,
            lod.face_source,
            influences,
            own_uvs,
            lod.fetch_uvs,
            tangents,
        )
        for lod, own_uvs in zip(lods, normal_uvs or [None] * len(lods))
    ]


def describe_model(
    character: Character,
    mesh: SkinnedMesh,
    lods: Sequence[Lod],
    textures: Mapping[str, Mapping[str, Any]],
    influences: int = 4,
    names: Sequence[str] | None = None,
    normal_uvs: Sequence[Floats | None] | None = None,
    levels: Sequence[LodMesh] | None = None,
) -> tuple[dict[str, Any], bytes]:
    """The glTF of a built character, as JSON and binary chunk. See `write_model_glb`."""
    if influences not in (4, 8):
        raise ValueError(f"influences must be 4 or 8, not {influences}")
    if not lods:
        raise ValueError("a model needs at least one level of detail")
    names = names or [f"{character.name}_LOD{level}" for level in range(len(lods))]
    buffer = _Buffer()
    skeleton = character.skeleton
    nodes = _describe_nodes(skeleton)
    skin, roots = _add_skin(nodes, skeleton, character.name, buffer)

    materials, draw_of_material = plan_draws(character.materials, np.unique(mesh.face_materials), textures)
    meshes: list[dict[str, Any]] = []
    first = len(nodes)
    second_uvs = any(uv_set(entry) for entry in textures.values())
    levels = levels or build_levels(character, mesh, lods, influences, normal_uvs)
    for name, lod, level in zip(names, lods, levels):
        face_draws = draw_of_material[mesh.face_materials[lod.face_source]]
        nodes.append({"name": name, "mesh": len(meshes), "skin": 0})
        order = _drawing_order(lod.face_source, face_draws, materials)
        level = replace(level, faces=level.faces[order])
        meshes.append(_describe_mesh(name, level, face_draws[order], buffer, second_uvs))
        if level.targets:
            meshes[-1]["weights"] = list(skeleton.morph_weights)
            meshes[-1]["extras"] = {"targetNames": list(skeleton.morphs)}
    extensions = {key for material in materials for key in material.get("extensions", {})}
    if len(lods) > 1:
        nodes[first]["extensions"] = {"MSFT_lod": {"ids": list(range(first + 1, len(nodes)))}}
        coverage = screen_coverage(lods, mesh.surface.diagonal_m)
        if coverage:
            nodes[first]["extras"] = {"MSFT_screencoverage": coverage}
        extensions.add("MSFT_lod")
    level_nodes = range(first, len(nodes))
    described = [
        _describe_clip(_with_channel(clip, skeleton), buffer, level_nodes, skeleton.morph_weights)
        for clip in character.clips
    ]
    clips = [spec for spec in described if spec is not None]
    buffer.finish()

    model: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "scene": 0,
        "scenes": [{"name": character.name, "nodes": [*roots, first]}],
        "nodes": nodes,
        "meshes": meshes,
        "skins": [skin],
        "materials": materials,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
        **describe_textures(textures),
    }
    if clips:
        model["animations"] = clips
    if extensions:
        model["extensionsUsed"] = sorted(extensions)
    return model, bytes(buffer.data)


def _as_document(model: dict[str, Any]) -> GLTF2:
    """pygltflib's objects of a description. Its own `from_dict` takes 14 times as long on 76 clips."""
    import pygltflib as gltf

    def primitive(spec: dict[str, Any]) -> gltf.Primitive:
        return gltf.Primitive(**{**spec, "attributes": gltf.Attributes(**spec["attributes"])})

    def accessor(spec: dict[str, Any]) -> gltf.Accessor:
        if "sparse" not in spec:
            return gltf.Accessor(**spec)
        parts = spec["sparse"]
        indices = gltf.AccessorSparseIndices(**parts["indices"])
        values = gltf.AccessorSparseValues(**parts["values"])
        return gltf.Accessor(**{**spec, "sparse": gltf.Sparse(count=parts["count"], indices=indices, values=values)})

    def channel(spec: dict[str, Any]) -> gltf.AnimationChannel:
        return gltf.AnimationChannel(sampler=spec["sampler"], target=gltf.AnimationChannelTarget(**spec["target"]))

    def clip(spec: dict[str, Any]) -> gltf.Animation:
        samplers = [gltf.AnimationSampler(**sampler) for sampler in spec["samplers"]]
        return gltf.Animation(name=spec["name"], samplers=samplers, channels=[channel(c) for c in spec["channels"]])

    def material(spec: dict[str, Any]) -> gltf.Material:
        pbr = dict(spec["pbrMetallicRoughness"])
        for key in ("baseColorTexture", "metallicRoughnessTexture"):
            if key in pbr:
                pbr[key] = gltf.TextureInfo(**pbr[key])
        changed: dict[str, Any] = {"pbrMetallicRoughness": gltf.PbrMetallicRoughness(**pbr)}
        if "emissiveTexture" in spec:
            changed["emissiveTexture"] = gltf.TextureInfo(**spec["emissiveTexture"])
        if "normalTexture" in spec:
            changed["normalTexture"] = gltf.NormalMaterialTexture(**spec["normalTexture"])
        if "occlusionTexture" in spec:
            changed["occlusionTexture"] = gltf.OcclusionTextureInfo(**spec["occlusionTexture"])
        return gltf.Material(**{**spec, **changed})

    return gltf.GLTF2(
        asset=gltf.Asset(**model["asset"]),
        scene=model["scene"],
        scenes=[gltf.Scene(**spec) for spec in model["scenes"]],
        nodes=[gltf.Node(**spec) for spec in model["nodes"]],
        meshes=[
            gltf.Mesh(**{**spec, "primitives": [primitive(one) for one in spec["primitives"]]})
            for spec in model["meshes"]
        ],
        skins=[gltf.Skin(**spec) for spec in model["skins"]],
        materials=[material(spec) for spec in model["materials"]],
        accessors=[accessor(spec) for spec in model["accessors"]],
        bufferViews=[gltf.BufferView(**spec) for spec in model["bufferViews"]],
        buffers=[gltf.Buffer(**spec) for spec in model["buffers"]],
        images=[gltf.Image(**spec) for spec in model.get("images", [])],
        samplers=[gltf.Sampler(**spec) for spec in model.get("samplers", [])],
        textures=[gltf.Texture(**spec) for spec in model.get("textures", [])],
        animations=[clip(spec) for spec in model.get("animations", [])],
        extensionsUsed=model.get("extensionsUsed", []),
    )


def write_model_glb(
    path: Path,
    character: Character,
    mesh: SkinnedMesh,
    lods: Sequence[Lod],
    textures: Mapping[str, Mapping[str, Any]],
    influences: int = 4,
    names: Sequence[str] | None = None,
    normal_uvs: Sequence[Floats | None] | None = None,
    levels: Sequence[LodMesh] | None = None,
) -> None:
    """Write model.glb.

    Parameters
    ----------
    path : Path
        In the folder that holds the textures.
    character : Character
        Gives skeleton, clips and materials.
    mesh : SkinnedMesh
        The full mesh with the atlas as its uvs: normals and weights of the levels are taken from it.
    lods : sequence of Lod
        The finest first. One of them alone makes a file of one level.
    textures : mapping of texture name to its manifest entry
        `file` is the uri; `copied` says that the source's factors are not in it. Only "base_color", "orm", "emissive"
        and "tangent_normal" are referred to.
    influences : 4 or 8
        Joints a vertex. Dropped weight goes to the others.
    names : sequence of str, optional
        Node names of the levels; NAME_LOD0, NAME_LOD1 ... by default.
    normal_uvs : sequence of (F, 3, 2) float64 or None, optional
        Where each level's corners sample the normal texture, if not at its uvs.
    levels : sequence of LodMesh, optional
        What `build_levels` made of the same, where it is at hand.

    Raises
    ------
    ValueError
        If there is no level or `influences` is neither 4 nor 8.
    """
    model, data = describe_model(character, mesh, lods, textures, influences, names, normal_uvs, levels)
    document = _as_document(model)
    document.set_binary_blob(data)
    document.save_binary(str(path))
