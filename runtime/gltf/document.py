"""glTF 2.0 files (.gltf, .glb, .vrm): the JSON as it is, and accessors read one at a time when asked for.

Files hold thousands of accessors (one a channel of a clip), so nothing is decoded before it is asked for.
Source: Khronos Group, glTF 2.0 Specification, sections 3.6 (binary data) and 4.4 (GLB).
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS, Limits
from runtime.gltf.local_files import read_regular
from runtime.gltf.meshopt_views import decode_view
from runtime.gltf.schema import check_types
from runtime.gltf.uris import read_uri

GLB_MAGIC = b"glTF"
CHUNK_JSON, CHUNK_BIN = 0x4E4F534A, 0x004E4942

COMPONENT_DTYPES: dict[int, np.dtype[Any]] = {
    5120: np.dtype("<i1"),
    5121: np.dtype("<u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
ELEMENT_SHAPES: dict[str, tuple[int, ...]] = {
    "SCALAR": (),
    "VEC2": (2,),
    "VEC3": (3,),
    "VEC4": (4,),
    "MAT2": (2, 2),
    "MAT3": (3, 3),
    "MAT4": (4, 4),
}
# Extensions that hide the bytes of a buffer view, and how a person gets rid of them.
COMPRESSED_VIEWS = ("EXT_meshopt_compression", "KHR_meshopt_compression", "MESHOPT_compression")


@dataclass(frozen=True)
class Document:
    """A glTF file: its JSON, and its binary data on demand.

    Attributes
    ----------
    path : Path
    json : dict
        The root object. What readers look at has the right type (schema.py).
    limits : Limits
    notes : tuple of str
        What had to be changed in its text.
    """

    path: Path
    json: dict[str, Any]
    _glb_chunk: bytes | None = field(default=None, repr=False)
    limits: Limits = LIMITS
    notes: tuple[str, ...] = ()
    _buffers: dict[int, bytes] = field(default_factory=dict, repr=False, compare=False)
    # Accessors that were decoded, and the bytes of all with and of all without data.
    _decoded: set[int] = field(default_factory=set, repr=False, compare=False)
    _provided: dict[int, NDArray[Any]] = field(default_factory=dict, repr=False, compare=False)
    _totals: dict[bool, int] = field(default_factory=lambda: {True: 0, False: 0}, repr=False, compare=False)

    def items(self, kind: str) -> list[dict[str, Any]]:
        """The top-level list of that name ("nodes", "meshes" ...), empty where the file has none."""
        found: list[dict[str, Any]] = self.json.get(kind, [])
        return found

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """One entry of a top-level list.

        Raises
        ------
        AssetError
            If the index is not one of the list.
        """
        entries = self.items(kind)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(entries):
            raise AssetError(
                f"{self.path.name}: {kind}[{str(index)[:20]}] does not exist (there are {len(entries)}): export again"
            )
        return entries[index]

    def provide(self, index: int, values: NDArray[Any]) -> None:
        """Let an accessor give these values, as they would be stored, in place of those of its buffer view."""
        self._provided[index] = values

    def accessor(self, index: int) -> NDArray[Any]:
        """Decode one accessor.

        Normalised integers become float32 in [0, 1] or [-1, 1]; other components keep their type. Interleaved and
        sparse data are resolved.

        Returns
        -------
        (N,) for SCALAR, (N, C) for vectors, (N, C, C) for matrices
            A new, contiguous array. Matrices are in the order of mathematics: [n, row, column].

        Raises
        ------
        AssetError
            If the accessor does not exist, is malformed or reaches outside its data.
        """
        spec = self.item("accessors", index)
        where = f"{self.path.name}: accessor {index}"
        dtype = COMPONENT_DTYPES.get(spec.get("componentType", 0))
        shape = ELEMENT_SHAPES.get(spec.get("type", ""))
        count = spec.get("count")
        if dtype is None or shape is None or not isinstance(count, int) or count < 0:
            raise AssetError(f"{where} is malformed (type, componentType or count): export again")
        backed = "bufferView" in spec and index not in self._provided
        if backed:
            offset = spec.get("byteOffset", 0)
            view = self._read_view(spec["bufferView"], offset, dtype, shape, count, where)
        provided = self._provided.get(index)
        if provided is None:
            self._count(index, count * dtype.itemsize * int(np.prod(shape, dtype=np.int64)), backed, where)
        if provided is not None:
            values = provided.copy()
        else:
            values = view.copy() if backed else np.zeros((count, *shape), dtype)
        if "sparse" in spec:
            self._apply_sparse(values, spec["sparse"], dtype, shape, where)
        if dtype.kind == "f":  # damaged bytes may be signalling NaNs, which would warn wherever they are used
            with np.errstate(invalid="ignore"):
                np.multiply(values, dtype.type(1), out=values)
        if len(shape) == 2:
            values = np.ascontiguousarray(values.swapaxes(1, 2))
        if spec.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0)).astype(
                np.float32, copy=False
            )
        return values

    def _count(self, index: int, num_bytes: int, backed: bool, where: str) -> None:
        """Refuse an accessor with which all that were decoded are more than the file's bytes may ask for."""
        if index in self._decoded:
            return
        self._decoded.add(index)
        self._totals[backed] += num_bytes
        if self._totals[False] > self.limits.unbacked_bytes:
            raise AssetError(
                f"{where}: accessors have {self._totals[False]} bytes and no data for them: export again, or raise "
                "--limit unbacked_bytes=N"
            )
        if backed and self._totals[True] > self.limits.reuse * (held := sum(map(len, self._buffers.values()))):
            raise AssetError(
                f"{where}: accessors read the file's {held} bytes more than {self.limits.reuse} times over: export "
                "again, or raise --limit reuse=N"
            )

    def view_bytes(self, index: int) -> bytes:
        """The raw bytes of a buffer view.

        Raises
        ------
        AssetError
            If it does not exist, is compressed or reaches outside its buffer.
        """
        data, start, length, _ = self._locate_view(index, f"{self.path.name}: bufferView {index}")
        return data[start : start + length]

    def image_bytes(self, index: int) -> bytes:
        """The encoded bytes (PNG, JPEG ...) of an image, wherever it is stored.

        Raises
        ------
        AssetError
            If the image or its file does not exist.
        """
        spec = self.item("images", index)
        if "bufferView" in spec:
            return self.view_bytes(spec["bufferView"])
        if not isinstance(spec.get("uri"), str):
            raise AssetError(f"{self.path.name}: image {index} has neither a uri nor a bufferView: export again")
        return read_uri(spec["uri"], self.path, f"image {index}", self.limits.file_bytes)

    def require_extensions(self, supported: Iterable[str]) -> None:
        """Refuse a file that cannot be read rightly without an extension which is not in `supported`.

        Raises
        ------
        AssetError
        """
        missing = sorted(set(map(str, self.json.get("extensionsRequired", []))) - set(supported))
        if missing:
            raise AssetError(f"{self.path.name} requires {', '.join(missing)}, which is not read: {_advice(missing)}")

    def _apply_sparse(
        self, values: NDArray[Any], sparse: dict[str, Any], dtype: np.dtype[Any], shape: tuple[int, ...], where: str
    ) -> None:
        try:
            count, at, new = sparse["count"], sparse["indices"], sparse["values"]
            index_dtype = COMPONENT_DTYPES[at["componentType"]]
            index_view, value_view = at["bufferView"], new["bufferView"]
        except (KeyError, TypeError):
            raise AssetError(f"{where}: its sparse part is malformed: export again") from None
        rows = self._read_view(index_view, at.get("byteOffset", 0), index_dtype, (), count, where).astype(np.int64)
        if len(rows) and not (0 <= rows.min() and rows.max() < len(values)):
            raise AssetError(f"{where}: a sparse index is outside its {len(values)} elements: export again")
        values[rows] = self._read_view(value_view, new.get("byteOffset", 0), dtype, shape, count, where)

    def _locate_view(self, index: Any, where: str) -> tuple[bytes, int, int, int]:
        """Buffer, start, length and stride (0: packed) of a buffer view, all checked."""
        view = self.item("bufferViews", index)
        hidden = [name for name in COMPRESSED_VIEWS if name in view.get("extensions", {})]
        stride = view.get("byteStride", 0)
        if hidden and (hidden[0] in self.json.get("extensionsRequired", []) or not self._has_data(view.get("buffer"))):
            decoded = self._decoded_view(index, hidden[0], where)
            if not isinstance(stride, int) or stride < 0:
                raise AssetError(f"{where}: bufferView {index} is malformed: export again")
            return decoded, 0, len(decoded), stride
        data = self._buffer(view.get("buffer"))
        start, length, stride = view.get("byteOffset", 0), view.get("byteLength", 0), view.get("byteStride", 0)
        if not all(isinstance(n, int) and n >= 0 for n in (start, length, stride)):
            raise AssetError(f"{where}: bufferView {index} is malformed: export again")
        if start + length > len(data):
            raise AssetError(f"{where} needs {start + length} bytes of a buffer of {len(data)}: the file is cut short")
        return data, start, length, stride

    def _decoded_view(self, index: int, extension: str, where: str) -> bytes:
        """The bytes of a compressed view, decoded once; they count as the file's own."""
        key = -1 - index
        if key not in self._buffers:
            spec = self.item("bufferViews", index)["extensions"][extension]
            if "buffer" not in spec:
                raise AssetError(f"{where} is compressed with {extension}: {_advice([extension])}")
            start, length = spec.get("byteOffset", 0), spec.get("byteLength", 0)
            data = self._buffer(spec.get("buffer"))
            whole = isinstance(start, int) and isinstance(length, int) and 0 <= start and 0 <= length
            if not whole or start + length > len(data):
                raise AssetError(f"{where}: its compressed data reaches outside its buffer: the file is cut short")
            self._buffers[key] = decode_view(spec, data[start : start + length], self.limits.file_bytes, where)
        return self._buffers[key]

    def _read_view(
        self, view: Any, offset: Any, dtype: np.dtype[Any], shape: tuple[int, ...], count: int, where: str
    ) -> NDArray[Any]:
        """A read-only array over the bytes of a buffer view. Matrices stay as stored: [n, column, row]."""
        data, start, length, stride = self._locate_view(view, where)
        size = dtype.itemsize
        inner: tuple[int, ...]
        if len(shape) == 2:  # columns of matrices start at multiples of four bytes
            column = -(-shape[1] * size // 4) * 4
            inner, element = (column, size), column * shape[0]
            used = column * (shape[0] - 1) + shape[1] * size
        else:
            element = used = size * (shape[0] if shape else 1)
            inner = (size,) if shape else ()
        stride = stride or element
        if not isinstance(offset, int) or offset < 0 or not isinstance(count, int) or count < 0:
            raise AssetError(f"{where} is malformed (count or byteOffset): export again")
        if count and offset + stride * (count - 1) + used > length:
            raise AssetError(f"{where} reaches outside bufferView {view}: the file is damaged, export again")
        if not count:
            return np.zeros((0, *shape), dtype)
        return np.ndarray((count, *shape), dtype, data, start + offset, (stride, *inner))

    def _has_data(self, index: Any) -> bool:
        """Whether a buffer is more than a length: compressed files may hold an uncompressed copy, or none."""
        return "uri" in self.item("buffers", index) or (index == 0 and self._glb_chunk is not None)

    def _buffer(self, index: Any) -> bytes:
        if index not in self._buffers:
            spec = self.item("buffers", index)
            if isinstance(spec.get("uri"), str):
                data = read_uri(spec["uri"], self.path, f"buffer {index}", self.limits.file_bytes)
            elif index == 0 and self._glb_chunk is not None:
                data = self._glb_chunk
            else:
                raise AssetError(f"{self.path.name}: buffer {index} has no data: export again")
            self._buffers[index] = data
        return self._buffers[index]


def _advice(extensions: Iterable[str]) -> str:
    text = " ".join(extensions).lower()
    if "meshopt" in text:
        return "decompress it, for example with `gltf-transform copy`, or `gltfpack` without -c"
    if "draco" in text:
        return "decompress it, for example with `gltf-transform copy`, or export without Draco compression"
    if "basisu" in text or "webp" in text or "avif" in text:
        return "store its textures as PNG or JPEG"
    return "turn the extension off in the exporter"


def _whole_text(root: Any) -> bool:
    """Replace halves of surrogate pairs, which no encoding can write, in all text below a value; whether any was."""
    found = False
    stack = [root]
    while stack:  # text may be nested as deep as the parser goes
        holder = stack.pop()
        items = list(holder.items()) if isinstance(holder, dict) else list(enumerate(holder))
        for key, item in items:
            if isinstance(item, dict | list):
                stack.append(item)
            elif isinstance(item, str) and item != (clean := item.encode("utf-8", "replace").decode()):
                holder[key], found = clean, True
    return found


def _parse_json(data: bytes, path: Path, limits: Limits) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The root object, and what had to be changed in its text."""
    text, notes = data.rstrip(b"\0").decode("utf-8-sig", "replace"), []
    try:
        root = json.loads(text)
    except (ValueError, RecursionError):
        raise AssetError(
            f"{path.name} is not a glTF file: its JSON does not parse: export it as .glb or .gltf"
        ) from None
    if not isinstance(root, dict) or not isinstance(root.get("asset"), dict):
        raise AssetError(f"{path.name} is not a glTF file: it has no asset object: export it as .glb or .gltf")
    version = str(root["asset"].get("version", ""))
    if not version.startswith("2"):
        raise AssetError(f"{path.name} is glTF version {version[:20] or 'unknown'}: export it as glTF 2.0")
    halves = re.search(rb"\\u[dD][89a-fA-F]", data) is not None and _whole_text(root)
    if halves or ("\ufffd" in text and b"\xef\xbf\xbd" not in data):
        notes.append("names that are not clean UTF-8 have question marks where their letters were damaged")
    check_types(root, path.name, limits)
    return root, tuple(notes)


def _split_glb(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB container."""
    if len(data) < 20:
        raise AssetError(f"{path.name} is cut short ({len(data)} bytes): export or download it again")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise AssetError(f"{path.name} is GLB version {version}: export it as glTF 2.0")
    if length > len(data):
        raise AssetError(f"{path.name} is cut short ({len(data)} of {length} bytes): export or download it again")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        at += 8
        if at + size > length:
            raise AssetError(f"{path.name} is damaged: a chunk reaches outside the file: export or download it again")
        chunks.setdefault(kind, data[at : at + size])
        at += size
    if CHUNK_JSON not in chunks:
        raise AssetError(f"{path.name} is damaged: it has no JSON chunk: export it again")
    return chunks[CHUNK_JSON], chunks.get(CHUNK_BIN)


def read_document(path: Path | str, limits: Limits = LIMITS) -> Document:
    """Open a .gltf, .glb or .vrm file. Told apart by content, not by name.

    Parameters
    ----------
    path : Path or str
    limits : Limits

    Returns
    -------
    Document

    Raises
    ------
    AssetError
        If the file is missing, cut short or not glTF 2.0.
    """
    path = Path(path)
    data = read_regular(path, limits.file_bytes)
    binary = None
    if data[:4] == GLB_MAGIC:
        data, binary = _split_glb(data, path)
    elif data.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{":
        raise AssetError(f"{path.name} is not a glTF file: export it as .glb or .gltf")
    root, notes = _parse_json(data, path, limits)
    return Document(path, root, binary, limits, notes)
