"""Primitives compressed with Draco (KHR_draco_mesh_compression), by the package DracoPy.

Attributes are told apart by their unique ids. Source: the extension's specification (Khronos Group).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.errors import InputError
from runtime.gltf.document import COMPONENT_DTYPES, ELEMENT_SHAPES, Document

EXTENSION = "KHR_draco_mesh_compression"
INSTALL = "install what decodes it with `pip install DracoPy`, or decompress it with `gltf-transform copy`"


def _as_accessor(document: Document, index: int, values: NDArray[Any], where: str) -> NDArray[Any]:
    """Decoded values as the accessor says they are stored."""
    spec = document.item("accessors", index)
    dtype, shape = COMPONENT_DTYPES.get(spec.get("componentType", 0)), ELEMENT_SHAPES.get(spec.get("type", ""))
    if dtype is None or shape is None or spec.get("count") != len(values):
        raise InputError(f"{where}: accessor {index} does not fit its Draco data: export the file again")
    return np.ascontiguousarray(values.reshape(len(values), *shape) if values.size else values, dtype)


def provide(document: Document, primitive: dict[str, Any], where: str) -> None:
    """Decode a primitive, and let its accessors give what was decoded.

    Raises
    ------
    InputError, AssetError
        If the decoder is not installed, or the data is damaged.
    """
    spec = primitive["extensions"][EXTENSION]
    given = spec.get("attributes")
    if not isinstance(given, dict) or not isinstance(spec.get("bufferView"), int):
        raise InputError(f"{where}: its Draco data is missing: export the file again")
    data = document.view_bytes(spec["bufferView"])
    wanted = [primitive.get("indices"), *primitive.get("attributes", {}).values()]
    counts = [document.item("accessors", index).get("count", 0) for index in wanted if index is not None]
    if max(counts, default=0) > 3 * document.limits.triangles:
        raise InputError(f"{where} has more than {document.limits.triangles} triangles: raise --limit triangles=N")
    try:
        import DracoPy
    except ImportError:
        raise InputError(f"{where} is compressed with Draco: {INSTALL}") from None
    try:
        mesh = DracoPy.decode(data)
        faces = np.asarray(mesh.faces, np.uint32)
        found = {int(one["unique_id"]): np.asarray(one["data"]) for one in mesh.attributes}
    except Exception as error:  # the package raises its own kinds, and plain ones, for damage of every kind
        raise InputError(f"{where}: its Draco data is damaged ({str(error)[:60]}): export the file again") from None
    for name, index in primitive.get("attributes", {}).items():
        if name in given:
            values = found.get(given[name]) if isinstance(given[name], int) else None
            if values is None:
                raise InputError(f"{where}: its Draco data has no {name}: export the file again")
            try:
                document.provide(index, _as_accessor(document, index, values, where))
            except ValueError:
                raise InputError(f"{where}: {name} does not fit its Draco data: export the file again") from None
    if primitive.get("indices") is not None:
        document.provide(primitive["indices"], faces.reshape(-1))
