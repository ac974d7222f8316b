"""One mesh primitive of a glTF file as plain arrays, in the file's own mesh space.

Sources: glTF 2.0 specification, section 3.7; KHR_mesh_quantization (accessors of integers are taken as they are).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.errors import InputError
from preprocess.load import draco
from runtime.gltf.document import Document
from runtime.gltf.morph_names import MAX_TARGETS

POINTS, TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 0, 4, 5, 6
FARTHEST = 1e9  # that a target may move anything
MAX_SETS = 8  # TEXCOORD_n and JOINTS_n beyond this are taken for damage


@dataclass(frozen=True)
class Target:
    """A morph target of a primitive, where it does anything. N touched source vertices.

    Attributes
    ----------
    vertices : (N,) int64
    shifts : (N, 3) float64, metres, mesh space
    turns : (N, 3) float64
        What is added to unit normals.
    """

    vertices: NDArray[np.int64]
    shifts: Floats
    turns: Floats


@dataclass(frozen=True)
class Primitive:
    """N source vertices, F triangles, L texture coordinate sets, K influences.

    Attributes
    ----------
    faces : (F, 3) int64, into the source vertices
    positions : (N, 3) float64
    normals : (N, 3) float64 or None
        Unit, or NaN where the file's normal is unusable.
    tangents : (N, 4) float64 or None
    texcoords : (N, L, 2) float64
    colors : (N, 4) float32 or None
    joints : (N, K) int64 or None
        Into the skin's joints.
    weights : (N, K) float64 or None
        As stored: neither normalised nor clipped.
    material : int or None
    targets : tuple of Target
    """

    faces: NDArray[np.int64]
    positions: Floats
    normals: Floats | None
    tangents: Floats | None
    texcoords: Floats
    colors: NDArray[np.float32] | None
    joints: NDArray[np.int64] | None
    weights: Floats | None
    material: int | None
    targets: tuple[Target, ...] = ()


def _attribute(
    document: Document, attributes: dict[str, Any], name: str, num_vertices: int, widths: tuple[int, ...], where: str
) -> NDArray[Any] | None:
    """Values of one vertex attribute, checked against the number of vertices; None where the primitive lacks it."""
    if name not in attributes:
        return None
    values = document.accessor(attributes[name])
    if values.ndim != 2 or values.shape[1] not in widths:
        raise InputError(f"{where}: {name} has the wrong type: export the file again")
    if len(values) != num_vertices:
        raise InputError(
            f"{where}: {name} has {len(values)} entries for {num_vertices} vertices: export the file again"
        )
    return values


def _triangles(mode: int, indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of a list, strip or fan, (F, 3); every other one of a strip turned so that all wind one way."""
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    first = np.arange(max(len(indices) - 2, 0))
    if mode == TRIANGLE_FAN:
        return indices[np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)]
    odd = first % 2
    return indices[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]


def _read_faces(
    document: Document, spec: dict[str, Any], mode: int, num_vertices: int, where: str
) -> NDArray[np.int64]:
    if "indices" not in spec:
        return _triangles(mode, np.arange(num_vertices))
    indices = document.accessor(spec["indices"])
    if indices.ndim != 1 or indices.dtype.kind != "u":
        raise InputError(f"{where}: its indices are not unsigned integers: export the file again")
    indices = indices.astype(np.int64)
    if len(indices) and indices.max() >= num_vertices:
        raise InputError(
            f"{where}: index {indices.max()} of accessor {spec['indices']} is outside its {num_vertices} vertices: "
            "export the file again"
        )
    return _triangles(mode, indices)


def _unit(vectors: Floats) -> Floats:
    """Unit vectors; NaN where the length is zero or not finite."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        units: Floats = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    units[~np.isfinite(units).all(axis=1)] = np.nan
    return units


def _read_targets(
    document: Document, spec: dict[str, Any], count: int, lengths: Floats | None, where: str, warnings: list[str]
) -> tuple[Target, ...]:
    """Morph targets of a primitive whose normals, where it has any, were of these lengths (N,)."""
    listed = spec.get("targets", [])
    if len(listed) > MAX_TARGETS:
        raise InputError(f"{where} has {len(listed)} morph targets, {MAX_TARGETS} at most are read: export fewer")
    targets, num_bad = [], 0
    for number, attributes in enumerate(listed):
        place = f"{where}, target {number}"
        for name in ("POSITION", "NORMAL"):  # before anything of that length is made
            entries = document.item("accessors", attributes[name]).get("count") if name in attributes else count
            if entries != count:
                raise InputError(f"{place}: {name} has {entries} entries for {count} vertices: export the file again")
        rows = np.zeros((count, 6))
        shifts = _attribute(document, attributes, "POSITION", count, (3,), place)
        turns = _attribute(document, attributes, "NORMAL", count, (3,), place) if lengths is not None else None
        if shifts is not None:
            rows[:, :3] = shifts
        if turns is not None and lengths is not None:
            rows[:, 3:] = turns / np.maximum(lengths, 1e-30)[:, None]
        bad = ~(np.abs(rows) <= FARTHEST).all(axis=1)
        num_bad += int(bad.sum())
        rows[bad] = 0.0
        used = np.flatnonzero(rows.any(axis=1))
        targets.append(Target(used, rows[used, :3], rows[used, 3:]))
    if num_bad:
        warnings.append(f"{where}: {num_bad} entries of morph targets are not finite: they move nothing")
    return tuple(targets)


def _numbered(
    document: Document, attributes: dict[str, Any], stem: str, count: int, width: int, where: str
) -> list[Any]:
    """Values of STEM_0, STEM_1 ... until one is missing."""
    found = []
    for number in range(MAX_SETS):
        values = _attribute(document, attributes, f"{stem}_{number}", count, (width,), where)
        if values is None:
            break
        found.append(values)
    return found


def _whole(joints: NDArray[Any], where: str) -> NDArray[np.int64]:
    """Joint numbers as integers, also where an exporter stored them as floats."""
    if joints.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            if not ((joints == np.rint(joints)) & (np.abs(joints) < 2**31)).all():
                raise InputError(f"{where}: JOINTS are not whole numbers: export the file again")
    return joints.astype(np.int64)


def _read_texcoords(
    document: Document, attributes: dict[str, Any], count: int, where: str, warnings: list[str]
) -> Floats:
    sets = _numbered(document, attributes, "TEXCOORD", count, 2, where)
    if not sets:
        return np.zeros((count, 0, 2))
    texcoords = np.stack([values.astype(np.float64) for values in sets], axis=1)
    bad = ~(np.abs(texcoords) <= document.limits.uv).all(axis=2)
    if bad.any():
        warnings.append(
            f"{where}: {int(bad.sum())} texture coordinates are not finite or beyond {document.limits.uv:g}: set to 0"
        )
        texcoords[bad] = 0.0
    return texcoords


def read_primitive(document: Document, spec: dict[str, Any], where: str) -> tuple[Primitive | None, list[str]]:
    """Decode one primitive.

    Parameters
    ----------
    document : Document
    spec : dict
        The primitive's JSON.
    where : str
        How messages name the primitive.

    Returns
    -------
    primitive : Primitive or None
        None where it draws no triangles.
    warnings : list of str

    Raises
    ------
    InputError, AssetError
        If it is malformed: not finite positions, lengths that differ, indices out of range, compression.
    """
    warnings: list[str] = []
    mode = spec.get("mode", TRIANGLES)
    if mode not in (TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN):
        return None, [f"{where}: points or lines dropped"]
    attributes = spec.get("attributes", {})
    if draco.EXTENSION in spec.get("extensions", {}):
        if "bufferView" not in document.item("accessors", attributes.get("POSITION")):
            draco.provide(document, spec, where)
        else:
            warnings.append(f"{where}: its uncompressed copy is read instead of the Draco one")
    if "POSITION" not in attributes:
        return None, [f"{where}: it has no positions: dropped"]
    positions = document.accessor(attributes["POSITION"]).astype(np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{where}: POSITION is not made of vectors of three: export the file again")
    count = len(positions)
    faces = _read_faces(document, spec, mode, count, where)
    if not len(faces):
        return None, [*warnings, f"{where}: it has no triangles: dropped"]

    raw_normals = _attribute(document, attributes, "NORMAL", count, (3,), where)
    normals = None if raw_normals is None else raw_normals.astype(np.float64)
    lengths = None if normals is None else np.linalg.norm(normals, axis=1)
    targets = _read_targets(document, spec, count, lengths, where, warnings)
    check_positions(positions[np.unique(faces)], document.limits.number, where)
    tangents = _attribute(document, attributes, "TANGENT", count, (4,), where)
    colors = _attribute(document, attributes, "COLOR_0", count, (3, 4), where)
    if colors is not None:
        opaque = np.ones((count, 4), np.float32)
        opaque[:, : colors.shape[1]] = np.nan_to_num(colors, nan=1.0)
        colors = opaque
    if "COLOR_1" in attributes:
        warnings.append(f"{where}: COLOR_1 dropped (glTF draws COLOR_0 alone)")
    joints = [_whole(values, where) for values in _numbered(document, attributes, "JOINTS", count, 4, where)]
    weights = _numbered(document, attributes, "WEIGHTS", count, 4, where)
    if len(joints) != len(weights):
        raise InputError(f"{where} has {len(joints)} JOINTS but {len(weights)} WEIGHTS sets: export the file again")
    primitive = Primitive(
        faces=faces,
        positions=positions,
        normals=None if normals is None else _unit(normals),
        tangents=None if tangents is None else tangents.astype(np.float64),
        texcoords=_read_texcoords(document, attributes, count, where, warnings),
        colors=colors,
        joints=np.concatenate(joints, axis=1) if joints else None,
        weights=np.concatenate(weights, axis=1).astype(np.float64) if weights else None,
        material=spec.get("material"),
        targets=targets,
    )
    return _without_unused(primitive), warnings


def check_positions(positions: Floats, most: float, where: str) -> None:
    """Refuse positions that the pipeline cannot carry.

    Raises
    ------
    InputError
    """
    bad = ~(np.abs(positions) <= most).all(axis=1)
    if bad.any():
        raise InputError(
            f"{where}: {int(bad.sum())} positions are not finite or beyond {most:g}: repair the mesh and export again"
        )


def _without_unused(primitive: Primitive) -> Primitive:
    """The primitive with only the vertices that its faces use: many primitives may share one long list of them."""
    used, corners = np.unique(primitive.faces, return_inverse=True)
    if len(used) == len(primitive.positions):
        return primitive
    arrays = ("positions", "normals", "tangents", "texcoords", "colors", "joints", "weights")
    values: dict[str, Any] = {name: getattr(primitive, name) for name in arrays}
    kept: dict[str, Any] = {name: None if array is None else array[used] for name, array in values.items()}
    number = np.full(len(primitive.positions), -1)
    number[used] = np.arange(len(used))
    targets = []
    for target in primitive.targets:
        rows = number[target.vertices]
        here = rows >= 0
        targets.append(Target(rows[here], target.shifts[here], target.turns[here]))
    return replace(primitive, faces=corners.reshape(-1, 3), targets=tuple(targets), **kept)
