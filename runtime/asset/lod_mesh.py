"""Levels of detail as the runtime has them: uvs and triangles, read from model.glb, in an order that GPUs like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.asset.manifest import LodEntry
from runtime.errors import REBUILD, AssetError
from runtime.gltf.document import Document
from runtime.validation import describe

TRIANGLES = 4  # glTF's number of that mode

UV_STEPS = 65535  # uvs lie in [0, 1] and are stored as 16-bit numbers of steps where these say exactly what they are


def uv_steps(uvs: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """The 16-bit steps nearest to uvs, (N, 2)."""
    return np.rint(np.clip(uvs.astype(np.float64), 0.0, 1.0) * UV_STEPS).astype(np.uint16)


@dataclass(frozen=True)
class DrawRange:
    """Faces [first, first + count) of a LOD share the material of that number."""

    first: int
    count: int
    material: int


@dataclass(frozen=True)
class LodMesh:
    """One level of detail: uvs and triangles, nothing else. N vertices, one for each distinct set of uvs.

    Attributes
    ----------
    uvs : (N, 2) float32
        Where each vertex samples its material.
    canonical_uvs : (N, 2) float32
        Where each vertex fetches position and weights; the same bits for every copy of a surface point.
    triangles : (F, 3) uint32, counter-clockwise seen from outside
    draws : tuple of DrawRange, in order, covering all faces
    error_m : float
        Largest distance to the full mesh, metres, as measured when it was built.
    normal_uvs : (N, 2) float32 or None
        Where each vertex samples the normal texture, in [0, 1]: beside hard edges that is not where its material is.
        None where it is everywhere.
    """

    uvs: NDArray[np.float32]
    canonical_uvs: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    draws: tuple[DrawRange, ...]
    error_m: float
    normal_uvs: NDArray[np.float32] | None = None


def _merge_vertices(
    vertices: NDArray[np.float32], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """One vertex for each distinct row of uvs, (N, 4 or 6), in order of first use by the triangles."""
    rows = np.ascontiguousarray(vertices)
    rows[rows == 0.0] = 0.0  # -0 and 0 are one place
    words = rows.view(np.uint64)
    order = np.lexsort(words.T[::-1])
    new = np.ones(len(order), bool)
    new[1:] = (words[order[1:]] != words[order[:-1]]).any(axis=1)
    merged = np.empty(len(order), np.int64)
    merged[order] = np.cumsum(new) - 1
    corners = merged[triangles].ravel()
    kept, first = np.unique(corners, return_index=True)
    by_use = kept[np.argsort(first, kind="stable")]
    renumbered = np.zeros(int(new.sum()), np.uint32)
    renumbered[by_use] = np.arange(len(by_use), dtype=np.uint32)
    representative = order[np.flatnonzero(new)][by_use]
    return rows[representative], renumbered[corners].reshape(-1, 3)


def _read_vertices(document: Document, accessors: tuple[int | None, ...], where: str) -> NDArray[np.float32]:
    """Uvs, canonical uvs and normal uvs of a primitive's vertices, (N, 6); normal uvs are uvs where there are none."""
    uvs, canonical = (document.accessor(index) for index in accessors[:2] if index is not None)
    normals = uvs if accessors[2] is None else document.accessor(accessors[2])
    if uvs.ndim != 2 or uvs.shape[1] != 2 or not uvs.shape == canonical.shape == normals.shape:
        raise AssetError(f"{where}: TEXCOORD_0, _OWNER_UV and TEXCOORD_1 do not fit each other: {REBUILD}")
    vertices = np.concatenate([uvs, canonical, normals], axis=1).astype(np.float32)
    if not np.isfinite(vertices).all():
        raise AssetError(f"{where} has uvs that are not finite: {REBUILD}")
    return vertices


def _read_lod(document: Document, mesh_index: Any, where: str, error_m: float) -> LodMesh:
    """One LOD's mesh: its primitives become draw ranges over one merged vertex list."""
    arrays: list[NDArray[np.float32]] = []
    all_triangles: list[NDArray[np.int64]] = []
    draws: list[DrawRange] = []
    num_vertices = first = 0
    starts: dict[tuple[int | None, ...], int] = {}  # where a primitive's arrays begin
    for primitive in document.item("meshes", mesh_index).get("primitives", []):
        attributes = primitive.get("attributes", {})
        if "TEXCOORD_0" not in attributes or "_OWNER_UV" not in attributes or "indices" not in primitive:
            raise AssetError(f"{where} has no TEXCOORD_0, _OWNER_UV or indices: {REBUILD}")
        own, second = attributes["TEXCOORD_0"], attributes.get("TEXCOORD_1")
        key = (own, attributes["_OWNER_UV"], None if second == own else second)
        if key not in starts:
            starts[key] = num_vertices
            arrays.append(_read_vertices(document, key, where))
            num_vertices += len(arrays[-1])
        start = starts[key]
        indices = document.accessor(primitive["indices"])
        if indices.dtype.kind != "u" or indices.ndim != 1 or primitive.get("mode", TRIANGLES) != TRIANGLES:
            raise AssetError(f"{where} is not made of triangles: {REBUILD}")
        indices = indices.astype(np.int64)
        if len(indices) % 3 or (len(indices) and indices.max() >= num_vertices - start):
            raise AssetError(f"{where} has triangles of vertices that do not exist: {REBUILD}")
        all_triangles.append(indices.reshape(-1, 3) + start)
        draws.append(DrawRange(first, len(indices) // 3, int(primitive.get("material", -1))))
        first += len(indices) // 3
    if not first:
        raise AssetError(f"{where} has no triangles: {REBUILD}")
    has_normal_uvs = any(key[2] is not None for key in starts)
    vertices = np.concatenate(arrays)[:, : 6 if has_normal_uvs else 4]
    vertices, merged = _merge_vertices(vertices, np.concatenate(all_triangles))
    normal_uvs = np.ascontiguousarray(vertices[:, 4:]) if has_normal_uvs else None
    uvs, canonical = np.ascontiguousarray(vertices[:, :2]), np.ascontiguousarray(vertices[:, 2:4])
    return LodMesh(uvs, canonical, merged, tuple(draws), error_m, normal_uvs)


def read_lods(document: Document, entries: Sequence[LodEntry]) -> tuple[LodMesh, ...]:
    """The levels of detail of model.glb.

    Parameters
    ----------
    document : Document
    entries : sequence of LodEntry
        What the manifest says of each level, the finest first.

    Raises
    ------
    AssetError
        If a level is missing or damaged.
    """
    nodes = {str(node.get("name")): node for node in document.items("nodes") if "mesh" in node}
    if len(nodes) != len(entries) or len({entry.node for entry in entries}) != len(entries):
        raise AssetError(f"{document.path} has {len(nodes)} levels and the manifest {len(entries)}: {REBUILD}")
    lods = []
    for entry in entries:
        if entry.node not in nodes:
            raise AssetError(f"{document.path} has no mesh node {describe(entry.node)} of the manifest: {REBUILD}")
        where = f"{document.path}: {entry.node[:60]}"
        lods.append(_read_lod(document, nodes[entry.node]["mesh"], where, entry.error_m))
        if len(lods[-1].triangles) != entry.faces:
            raise AssetError(f"{where} has {len(lods[-1].triangles)} faces, the manifest says {entry.faces}: {REBUILD}")
    return tuple(lods)
