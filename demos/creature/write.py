"""The dragon as an ordinary binary glTF: one skinned mesh, one material with embedded textures, three clips."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gltf
from numpy.typing import NDArray

from demos.creature.motion import Motion, to_quaternions
from demos.creature.paint import Textures
from demos.creature.skeleton import Joints
from demos.creature.texels import BodyMesh
from preprocess.files.images import Image, write_image

_ARRAY, _ELEMENTS = gltf.ARRAY_BUFFER, gltf.ELEMENT_ARRAY_BUFFER


class _Binary:
    """The file's one buffer, filled piece by piece, and the views and accessors into it."""

    def __init__(self, document: gltf.GLTF2) -> None:
        self._document, self._data = document, bytearray()

    def add_view(self, data: bytes, target: int | None = None) -> int:
        self._data += b"\0" * (-len(self._data) % 4)
        view = gltf.BufferView(buffer=0, byteOffset=len(self._data), byteLength=len(data), target=target)
        self._data += data
        self._document.bufferViews.append(view)
        return len(self._document.bufferViews) - 1

    def add_array(self, values: NDArray[Any], kind: str, target: int | None = None, bounds: bool = False) -> int:
        component = {"float32": gltf.FLOAT, "uint16": gltf.UNSIGNED_SHORT, "uint8": gltf.UNSIGNED_BYTE}[
            values.dtype.name
        ]
        view = self.add_view(np.ascontiguousarray(values).tobytes(), target)
        accessor = gltf.Accessor(bufferView=view, componentType=component, count=len(values), type=kind)
        if bounds:
            table = values.reshape(len(values), -1)
            accessor.min, accessor.max = table.min(axis=0).tolist(), table.max(axis=0).tolist()
        self._document.accessors.append(accessor)
        return len(self._document.accessors) - 1

    def close(self) -> None:
        self._data += b"\0" * (-len(self._data) % 4)
        self._document.buffers = [gltf.Buffer(byteLength=len(self._data))]
        self._document.set_binary_blob(bytes(self._data))


def write_creature(
    path: Path,
    mesh: BodyMesh,
    joints: Joints,
    joint_indices: NDArray[np.uint16],
    joint_weights: NDArray[np.float32],
    textures: Textures,
    clips: tuple[Motion, ...],
) -> None:
    """Write everything into one .glb.

    Parameters
    ----------
    path : Path
    mesh : BodyMesh
    joints : Joints
    joint_indices, joint_weights : (V, 4)
        A row each surface vertex.
    textures : Textures
    clips : tuple of Motion
    """
    document = gltf.GLTF2()
    document.asset = gltf.Asset(version="2.0", generator="seamskin demos.creature")
    binary = _Binary(document)
    _add_skeleton(document, binary, joints)
    _add_material(document, binary, textures)
    _add_mesh(document, binary, mesh, joint_indices, joint_weights)
    for motion in clips:
        _add_clip(document, binary, motion)
    binary.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(b"".join(document.save_to_bytes()))
    partial.replace(path)


def _add_skeleton(document: gltf.GLTF2, binary: _Binary, joints: Joints) -> None:
    """Nodes 0 … J-1 are the joints, node J carries the mesh."""
    offsets = joints.offsets()
    for index, name in enumerate(joints.names):
        children = np.flatnonzero(joints.parents == index).tolist()
        node = gltf.Node(name=name, translation=offsets[index].tolist())
        if children:
            node.children = children
        document.nodes.append(node)
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(joints.names), 1, 1))
    inverse[:, 3, :3] = -joints.positions  # glTF stores columns one after the other
    accessor = binary.add_array(inverse.reshape(-1, 16), gltf.MAT4)
    root = int(np.flatnonzero(joints.parents < 0)[0])
    document.skins.append(
        gltf.Skin(name="dragon", joints=list(range(len(joints.names))), inverseBindMatrices=accessor, skeleton=root)
    )
    document.nodes.append(gltf.Node(name="dragon", mesh=0, skin=0))
    document.scenes.append(gltf.Scene(name="scene", nodes=[root, len(joints.names)]))
    document.scene = 0


def _add_material(document: gltf.GLTF2, binary: _Binary, textures: Textures) -> None:
    document.samplers.append(
        gltf.Sampler(
            magFilter=gltf.LINEAR,
            minFilter=gltf.LINEAR_MIPMAP_LINEAR,
            wrapS=gltf.CLAMP_TO_EDGE,
            wrapT=gltf.CLAMP_TO_EDGE,
        )
    )
    for name, texels in (("base_color", textures.base_color), ("orm", textures.orm), ("normal", textures.normal)):
        view = binary.add_view(_encode_png(texels))
        document.images.append(gltf.Image(name=name, mimeType="image/png", bufferView=view))
        document.textures.append(gltf.Texture(sampler=0, source=len(document.images) - 1))
    document.materials.append(
        gltf.Material(
            name="skin",
            pbrMetallicRoughness=gltf.PbrMetallicRoughness(
                baseColorTexture=gltf.TextureInfo(index=0), metallicRoughnessTexture=gltf.TextureInfo(index=1)
            ),
            occlusionTexture=gltf.OcclusionTextureInfo(index=1),
            normalTexture=gltf.NormalMaterialTexture(index=2),
            alphaMode=gltf.OPAQUE,
            alphaCutoff=None,
        )
    )


def _encode_png(texels: NDArray[np.uint8]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "texels.png"
        write_image(path, Image(texels / 255.0))
        return path.read_bytes()


def _add_mesh(
    document: gltf.GLTF2,
    binary: _Binary,
    mesh: BodyMesh,
    joint_indices: NDArray[np.uint16],
    joint_weights: NDArray[np.float32],
) -> None:
    """One vertex a texture vertex: positions are repeated along the seams."""
    vertex = mesh.uv_to_vertex
    tangents = mesh.tangents.astype(np.float32)
    attributes = gltf.Attributes(
        POSITION=binary.add_array(mesh.points[vertex].astype(np.float32), gltf.VEC3, _ARRAY, bounds=True),
        NORMAL=binary.add_array(_unit(mesh.normals[vertex]), gltf.VEC3, _ARRAY),
        TANGENT=binary.add_array(np.concatenate([_unit(tangents[:, :3]), tangents[:, 3:]], axis=1), gltf.VEC4, _ARRAY),
        TEXCOORD_0=binary.add_array(mesh.uvs.astype(np.float32), gltf.VEC2, _ARRAY),
        JOINTS_0=binary.add_array(joint_indices[vertex].astype(np.uint8), gltf.VEC4, _ARRAY),
        WEIGHTS_0=binary.add_array(joint_weights[vertex], gltf.VEC4, _ARRAY),
    )
    indices = binary.add_array(mesh.face_uvs.reshape(-1).astype(np.uint16), gltf.SCALAR, _ELEMENTS)
    document.meshes.append(
        gltf.Mesh(name="dragon", primitives=[gltf.Primitive(attributes=attributes, indices=indices, material=0)])
    )


def _unit(vectors: NDArray[Any]) -> NDArray[np.float32]:
    wide = vectors.astype(np.float64)
    result: NDArray[np.float32] = (wide / np.linalg.norm(wide, axis=1, keepdims=True)).astype(np.float32)
    return result


def _add_clip(document: gltf.GLTF2, binary: _Binary, motion: Motion) -> None:
    """One channel for every joint that moves, and no others."""
    animation = gltf.Animation(name=motion.name)
    times = (motion.phase * motion.duration_s).astype(np.float32)
    clock = binary.add_array(times, gltf.SCALAR, bounds=True)
    offsets = motion.joints.offsets()
    for joint in range(len(motion.joints.names)):
        tracks: list[tuple[str, NDArray[np.float32], str]] = []
        if np.abs(motion.shifts[joint]).max() > 1e-7:
            moved = offsets[joint] + motion.shifts[joint]
            tracks.append(("translation", moved.astype(np.float32), gltf.VEC3))
        if np.abs(motion.rotations[joint] - np.eye(3)).max() > 1e-6:
            tracks.append(("rotation", to_quaternions(motion.rotations[joint]), gltf.VEC4))
        if np.abs(motion.scales[joint] - 1.0).max() > 1e-7:
            tracks.append(("scale", motion.scales[joint].astype(np.float32), gltf.VEC3))
        for path, values, kind in tracks:
            output = binary.add_array(values, kind)
            sampler = gltf.AnimationSampler(input=clock, output=output, interpolation=gltf.ANIM_LINEAR)
            animation.samplers.append(sampler)
            target = gltf.AnimationChannelTarget(node=joint, path=path)
            animation.channels.append(gltf.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))
    document.animations.append(animation)
