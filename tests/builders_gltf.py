"""Small glTF files for tests, written from arrays: no binary assets."""

from __future__ import annotations

import base64
import json
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from preprocess.files.images import Image, write_image

COMPONENTS = {
    np.dtype(np.int8): 5120,
    np.dtype(np.uint8): 5121,
    np.dtype(np.int16): 5122,
    np.dtype(np.uint16): 5123,
    np.dtype(np.uint32): 5125,
    np.dtype(np.float32): 5126,
}
TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (3, 3): "MAT3", (4, 4): "MAT4"}


class GltfBuilder:
    """Collects a glTF file's JSON and bytes. Every `add` returns the new index."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.data = bytearray()

    def add(self, kind: str, **spec: Any) -> int:
        self.json.setdefault(kind, []).append(spec)
        return len(self.json[kind]) - 1

    def view(self, data: bytes, **spec: Any) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data), **spec)

    def accessor(self, values: ArrayLike, dtype: Any = np.float32, **spec: Any) -> int:
        """An accessor of its own buffer view. Matrices are given as [row, column]."""
        array = np.ascontiguousarray(values, dtype)
        stored = array.swapaxes(1, 2) if array.ndim == 3 else array
        if array.ndim == 2 and array.dtype.itemsize * array.shape[1] % 4:  # vertex attributes keep 4-byte strides
            width = -(-array.dtype.itemsize * array.shape[1] // 4) * 4
            padded = np.zeros((len(array), width), np.uint8)
            padded[:, : array.dtype.itemsize * array.shape[1]] = array.view(np.uint8).reshape(len(array), -1)
            view = self.view(padded.tobytes(), byteStride=width)
        else:
            view = self.view(stored.tobytes())
        return self.add(
            "accessors",
            bufferView=view,
            componentType=COMPONENTS[array.dtype],
            count=len(array),
            type=TYPES[array.shape[1:]],
            **spec,
        )

    def primitive(
        self, positions: ArrayLike, faces: ArrayLike | None = None, mode: int | None = None, **attributes: ArrayLike
    ) -> dict[str, Any]:
        """A primitive; attributes by their glTF names. JOINTS are written as bytes, the rest as floats."""
        position = np.asarray(positions, np.float32)
        low, high = position.min(axis=0).tolist(), position.max(axis=0).tolist()
        spec: dict[str, Any] = {"attributes": {"POSITION": self.accessor(position, min=low, max=high)}}
        for name, values in attributes.items():
            dtype = np.uint8 if name.startswith("JOINTS") else np.float32
            spec["attributes"][name] = self.accessor(values, dtype)
        if faces is not None:
            spec["indices"] = self.accessor(np.asarray(faces).reshape(-1), np.uint16)
        if mode is not None:
            spec["mode"] = mode
        return spec

    def mesh(self, *primitives: dict[str, Any], **spec: Any) -> int:
        return self.add("meshes", primitives=list(primitives), **spec)

    def node(self, parent: int | None = None, **spec: Any) -> int:
        """A node under a parent, or a root of the scene."""
        index = self.add("nodes", **spec)
        if parent is None:
            self.json["scenes"][0]["nodes"].append(index)
        else:
            self.json["nodes"][parent].setdefault("children", []).append(index)
        return index

    def skin(self, joints: list[int], inverse_bind: ArrayLike | None = None) -> int:
        spec: dict[str, Any] = {"joints": joints}
        if inverse_bind is not None:
            spec["inverseBindMatrices"] = self.accessor(np.asarray(inverse_bind, np.float32))
        return self.add("skins", **spec)

    def clip(self, name: str, *tracks: tuple[int, str, str, ArrayLike, ArrayLike]) -> int:
        """A clip of (node, path, interpolation, times, values)."""
        samplers, channels = [], []
        for number, (node, path, interpolation, times, values) in enumerate(tracks):
            keys = np.asarray(times, np.float32)
            source = self.accessor(keys, min=[float(keys.min())], max=[float(keys.max())])
            samplers.append({"input": source, "output": self.accessor(values), "interpolation": interpolation})
            channels.append({"sampler": number, "target": {"node": node, "path": path}})
        return self.add("animations", name=name, samplers=samplers, channels=channels)

    def texture(self, texels: NDArray[np.uint8], **sampler: Any) -> int:
        """A texture of an embedded PNG of texels (H, W, 3 or 4)."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.png"
            write_image(path, Image(np.asarray(texels, np.float32) / 255))
            data = path.read_bytes()
        image = self.add("images", bufferView=self.view(data), mimeType="image/png")
        spec: dict[str, Any] = {"source": image}
        if sampler:
            spec["sampler"] = self.add("samplers", **sampler)
        return self.add("textures", **spec)

    def glb(self) -> bytes:
        """The bytes of a GLB file."""
        binary = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        self.json["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def write(self, path: Path) -> Path:
        """Write a .glb, a .gltf with a base64 buffer, or (NAME.external.gltf) one with a buffer file beside it."""
        if path.suffix != ".gltf":
            path.write_bytes(self.glb())
            return path
        if path.stem.endswith(".external"):
            binary = path.parent / "its buffer.bin"
            binary.write_bytes(self.data)
            uri = "its%20buffer.bin"
        else:
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        self.json["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        path.write_text(json.dumps(self.json))
        return path


def grid(columns: int, rows: int, size: tuple[float, float] = (1.0, 1.0)) -> dict[str, NDArray[Any]]:
    """A flat grid in the xy plane facing +z: positions (N, 3), faces (F, 3), uvs (N, 2) with v down."""
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    positions = np.stack([x.ravel() * size[0], y.ravel() * size[1], np.zeros(x.size)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, up, both = corner + 1, corner + columns + 1, corner + columns + 2
    faces = np.concatenate([np.stack([corner, right, both], 1), np.stack([corner, both, up], 1)])
    return {"positions": positions, "faces": faces, "uvs": np.stack([x.ravel(), 1 - y.ravel()], axis=1)}


def cube() -> dict[str, NDArray[Any]]:
    """A cube of side 1 about the origin as exporters write it: 24 vertices, hard edges, six uv squares."""
    axes = np.eye(3)
    positions, normals, faces, uvs = [], [], [], []
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    for axis in range(3):
        for sign in (1.0, -1.0):
            right, up = axes[(axis + 1) % 3], axes[(axis + 2) % 3] * sign
            start = 2 * len(faces)
            positions.append(sign * axes[axis] * 0.5 + square[:, :1] * right + square[:, 1:] * up)
            normals.append(np.tile(sign * axes[axis], (4, 1)))
            uvs.append((square * (1, -1) + 0.5) / 3 + np.array([axis / 3, sign > 0]) * (1, 0.5))
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return {
        "positions": np.concatenate(positions),
        "normals": np.concatenate(normals),
        "faces": np.array(faces),
        "uvs": np.concatenate(uvs),
    }


def bent_bar(path: Path, **skin_options: Any) -> Path:
    """A bar of two joints along y with a bending clip and smooth weights: the smallest animated character."""
    builder = GltfBuilder()
    shape = grid(2, 8, (0.5, 2.0))
    weight = np.clip((shape["positions"][:, 1] - 0.5), 0, 1)
    zeros = np.zeros_like(weight)
    root = builder.node(name="root")
    tip = builder.node(root, name="tip", translation=[0, 1, 0])
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 1, 3] = -1
    primitive = builder.primitive(
        shape["positions"],
        shape["faces"],
        TEXCOORD_0=shape["uvs"],
        NORMAL=np.tile([0.0, 0, 1], (len(weight), 1)),
        JOINTS_0=np.tile([0, 1, 0, 0], (len(weight), 1)),
        WEIGHTS_0=np.stack([1 - weight, weight, zeros, zeros], axis=1),
    )
    builder.node(mesh=builder.mesh(primitive, name="bar"), skin=builder.skin([root, tip], inverse), name="bar")
    half = np.sqrt(0.5)
    builder.clip("bend", (tip, "rotation", "LINEAR", [0, 1], [[0, 0, 0, 1], [0, 0, half, half]]))
    return builder.write(path)
