"""Wavefront OBJ files in and out, with separate indices for positions and texture coordinates.

Of the shape only what a textured surface needs is read: `v`, `vt` and `f`; `read_looks` has the materials. A vertex
of the parameter mesh is a (position, uv) pair (paper, section 5.2: the set Z), so texture coordinates that a file
repeats corner by corner are welded where they belong to one surface vertex and have equal values, and one that
several surface vertices share is split.
OBJ's v runs up; ours runs down.
"""

from __future__ import annotations

import contextlib
import os
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.errors import InputError
from preprocess.files.obj_materials import ObjLooks
from preprocess.files.polygons import cut_polygons
from preprocess.mesh.surface import TexturedSurface
from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS, Limits
from runtime.gltf.local_files import read_regular

_NEWLINE, _SPACE, _SLASH = 10, 32, 47
_BREAK = re.compile(rb"\\ *\n")
_CONTINUED = re.compile(rb"^(?:v|vt|vn|vp|f|l|p) [^\n]*?\\ *\n(?:[^\n]*?\\ *\n)*", re.MULTILINE)
_COMMENT = re.compile(rb"^((?:v|vt|vn|f) [^#\n]*)#[^\n]*", re.MULTILINE)


@dataclass(frozen=True)
class _Records:
    """All lines of one keyword: their text without the keyword, and the number of each line in the file."""

    text: bytes
    lines: NDArray[np.int64]
    tokens_per_line: NDArray[np.int64]


def _select_lines(buffer: NDArray[np.uint8], starts: NDArray[np.int64], keyword: bytes) -> _Records:
    """Lines that begin with a keyword and a space."""
    padded = np.r_[buffer, np.full(len(keyword) + 1, _NEWLINE, np.uint8)]
    chosen = padded[starts + len(keyword)] == _SPACE
    for offset, letter in enumerate(keyword):
        chosen &= padded[starts + offset] == letter
    lengths = np.diff(np.r_[starts, len(buffer)])
    kept = buffer[np.repeat(chosen, lengths)]
    line_of_byte = np.repeat(np.arange(int(chosen.sum())), lengths[chosen])
    first = np.r_[0, np.cumsum(lengths[chosen])][:-1]
    kept = kept.copy()
    for offset in range(len(keyword)):
        kept[first + offset] = _SPACE
    blank = (kept == _SPACE) | (kept == _NEWLINE)
    token_starts = ~blank & np.r_[True, blank[:-1]] if len(kept) else ~blank
    tokens = np.bincount(line_of_byte[token_starts], minlength=int(chosen.sum()))
    return _Records(kept.tobytes(), np.flatnonzero(chosen) + 1, tokens)


def _numbers(text: bytes, expected: int, dtype: type, path: Path, keyword: str) -> NDArray[np.float64]:
    """All numbers of a text, or an InputError where something in it is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            values: NDArray[Any] = np.fromstring(text, dtype=dtype, sep=" ") if expected else np.zeros(0, dtype)
        except (ValueError, DeprecationWarning):
            values = np.zeros(0, dtype)
    if len(values) != expected:
        raise InputError(f"{path.name}: a '{keyword}' line holds something that is no number: export the OBJ again")
    return values


def _read_vectors(records: _Records, size: int, least: int, path: Path, keyword: str) -> Floats:
    """The first `size` numbers of each line, (N, size); later ones (w, vertex colours) are ignored.

    A line may have as few as `least`: the others are 0, as the format has it.
    """
    short = records.tokens_per_line < least
    if short.any():
        line = int(records.lines[np.flatnonzero(short)[0]])
        raise InputError(f"{path.name}, line {line}: '{keyword}' needs {least} numbers: export the OBJ again")
    values = np.r_[_numbers(records.text, int(records.tokens_per_line.sum()), np.float64, path, keyword), 0.0]
    first = np.r_[0, np.cumsum(records.tokens_per_line)][:-1]
    columns = np.arange(size)
    there = columns < records.tokens_per_line[:, None]
    result: Floats = values[np.where(there, first[:, None] + columns, -1)]
    return result


def _check_range(
    vectors: Floats, used: NDArray[np.integer], most: float, records: _Records, path: Path, keyword: str
) -> Floats:
    """The vectors, zeros for those that no face uses and that are out of range.

    Raises
    ------
    InputError
        If one that a face uses is.
    """
    bad = np.logical_or.reduce(~(np.abs(vectors) <= most), axis=1)
    if not bad.any():
        return vectors
    needed = np.zeros(len(vectors), bool)
    needed[used] = True
    if (bad & needed).any():
        line = int(records.lines[np.flatnonzero(bad & needed)[0]])
        raise InputError(
            f"{path.name}, line {line}: {int((bad & needed).sum())} '{keyword}' lines are not finite or beyond "
            f"{most:g}: repair the mesh first"
        )
    return np.where(bad[:, None], 0.0, vectors)


def _read_corners(records: _Records, path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Position and texture index of every corner as the file writes them (0 where a corner has no texture index)."""
    written = records.text.replace(b"//", b"/0/").replace(b"/ ", b" ").replace(b"/\n", b"\n")
    text = np.frombuffer(written, np.uint8).copy()
    blank = (text == _SPACE) | (text == _NEWLINE)
    corner_starts = np.flatnonzero(~blank & np.r_[True, blank[:-1]]) if len(text) else np.zeros(0, np.int64)
    slash = text == _SLASH
    slashes_before = np.r_[0, np.cumsum(slash)]
    fields = np.diff(np.r_[slashes_before[corner_starts], slashes_before[-1]]) + 1
    text[slash] = _SPACE
    values = _numbers(text.tobytes(), int(fields.sum()), np.int64, path, "f").astype(np.int64)
    first = np.r_[0, np.cumsum(fields)][:-1]
    textures = np.zeros(len(first), np.int64)
    textures[fields > 1] = values[first[fields > 1] + 1]
    return values[first], textures


def _absolute(
    indices: NDArray[np.int64], line: NDArray[np.int64], defined: NDArray[np.int64], path: Path, what: str
) -> NDArray[np.int64]:
    """Zero-based indices; negative ones count back from the last element defined above their line."""
    above = np.searchsorted(defined, line)
    absolute = np.where(indices < 0, above + indices, indices - 1)
    bad = (absolute < 0) | (absolute >= len(defined))
    if bad.any():
        first = np.flatnonzero(bad)[0]
        raise InputError(
            f"{path.name}, line {int(line[first])}: {what} {int(indices[first])} does not exist "
            f"(the file has {len(defined)}): export the OBJ again"
        )
    return absolute


def weld_texture_vertices(faces: Ints, uvs: Floats, corner_uvs: NDArray[np.integer]) -> tuple[Floats, Ints]:
    """Make each texture vertex one (surface vertex, uv) pair, in the order of the uvs given.

    Parameters
    ----------
    faces : (F, 3) int, surface vertices
    uvs : (N, 2) float64
    corner_uvs : (F, 3) int, into uvs; several may hold equal values

    Returns
    -------
    uvs : (T, 2) float64
    face_uvs : (F, 3) int32
    """
    if not len(faces):
        return np.zeros((0, 2)), np.zeros((0, 3), np.int32)
    order = np.lexsort((np.arange(len(uvs)), uvs[:, 1], uvs[:, 0]))
    fresh = np.r_[True, (np.diff(uvs[order], axis=0) != 0).any(axis=1)]
    representative = np.empty(len(uvs), np.int64)
    representative[order] = order[fresh][np.cumsum(fresh) - 1]
    keys = representative[corner_uvs.ravel()] * (int(faces.max()) + 1) + faces.ravel()
    unique, inverse = np.unique(keys, return_inverse=True)
    return uvs[unique // (int(faces.max()) + 1)], inverse.reshape(-1, 3).astype(np.int32)


def clean_lines(data: bytes) -> bytes:
    """An OBJ file's text with plain line ends, spaces for tabs and nothing before keywords.

    Lines of numbers that end in a backslash are joined with the next, and lose their comments. Names may end in a
    backslash (paths of Windows) and hold any sign.
    """
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\t", b" ") + b"\n"
    if b"\n " in data or data[:1] == b" ":
        data = b"\n".join(line.strip() for line in data.split(b"\n"))
    if b"\\" in data:
        data = _CONTINUED.sub(lambda found: _BREAK.sub(b" ", found[0]), data)
    if b"#" in data:
        data = _COMMENT.sub(rb"\1", data)
    return data


def read_obj(path: Path, limits: Limits = LIMITS) -> TexturedSurface:
    """Read the one textured surface of an OBJ file; polygons are cut into triangles.

    Parameters
    ----------
    path : Path
    limits : Limits

    Returns
    -------
    TexturedSurface
        Positions as in the file (none welded, none dropped; one out of range that no face uses is at the origin); uvs
        welded by (position, value), v turned down.

    Raises
    ------
    InputError
        If the file is missing, is no OBJ, has no faces or no texture coordinates, or holds an index or a number
        that means nothing.
    """
    path = Path(path)
    data = _read_file(path, limits)
    if b"\0" in data[:4096]:
        raise InputError(f"{path.name}: not an OBJ file (it is binary): give an OBJ or glTF mesh")
    data = clean_lines(data)
    buffer = np.frombuffer(data, np.uint8)
    starts = np.r_[0, np.flatnonzero(buffer == _NEWLINE)[:-1] + 1]

    position_lines = _select_lines(buffer, starts, b"v")
    uv_lines = _select_lines(buffer, starts, b"vt")
    face_lines = _select_lines(buffer, starts, b"f")
    if not len(face_lines.lines):
        raise InputError(f"{path.name}: no faces in it: give a mesh with at least one triangle")
    short = face_lines.tokens_per_line < 3
    if short.any():
        line = int(face_lines.lines[np.flatnonzero(short)[0]])
        raise InputError(f"{path.name}, line {line}: a face needs three corners: export the OBJ again")

    positions = _read_vectors(position_lines, 3, 3, path, "v")
    file_uvs = _read_vectors(uv_lines, 2, 1, path, "vt")
    corner_positions, corner_uvs = _read_corners(face_lines, path)
    line_of_corner = np.repeat(face_lines.lines, face_lines.tokens_per_line)
    missing = corner_uvs == 0
    if missing.any():
        line = int(line_of_corner[np.flatnonzero(missing)[0]])
        raise InputError(f"{path.name}, line {line}: a face has no texture coordinates (vt): export it with uvs")
    corner_positions = _absolute(corner_positions, line_of_corner, position_lines.lines, path, "vertex")
    corner_uvs = _absolute(corner_uvs, line_of_corner, uv_lines.lines, path, "texture vertex")
    positions = _check_range(positions, corner_positions, limits.number, position_lines, path, "v")
    file_uvs = _check_range(file_uvs, corner_uvs, limits.uv, uv_lines, path, "vt")
    triangles = cut_polygons(positions[corner_positions], face_lines.tokens_per_line)
    faces, face_uvs = corner_positions[triangles], corner_uvs[triangles]

    file_uvs = np.stack([file_uvs[:, 0], 1.0 - file_uvs[:, 1]], axis=1)
    uvs, welded = weld_texture_vertices(faces.astype(np.int32), file_uvs, face_uvs)
    surface = TexturedSurface(positions, faces.astype(np.int32), uvs, welded)
    surface.validate()
    return surface


def _read_file(path: Path, limits: Limits) -> bytes:
    try:
        return read_regular(path, limits.file_bytes)
    except AssetError as error:
        raise InputError(error) from None


def read_looks(path: Path, limits: Limits = LIMITS) -> ObjLooks | None:
    """Materials and smoothness of the faces that `read_obj` gives, in its order; None for a file that is no OBJ.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() != ".obj":
        return None
    data = clean_lines(_read_file(path, limits))
    buffer = np.frombuffer(data, np.uint8)
    breaks = np.flatnonzero(buffer == _NEWLINE)
    faces = _select_lines(buffer, np.r_[0, breaks[:-1] + 1], b"f")
    names: dict[str, int] = {}
    libraries: list[Path] = []
    lines, materials, smooth = [0], [-1], b"\nvn " in data
    for found in re.finditer(rb"^(usemtl|mtllib|s) +(.*?) *$", data, re.MULTILINE):
        value = found[2].decode("utf-8", errors="surrogateescape")
        if found[1] == b"mtllib":
            libraries += _library_paths(path.parent, value)
        elif found[1] == b"usemtl":
            lines.append(int(np.searchsorted(breaks, found.start())) + 1)
            materials.append(names.setdefault(value, len(names)))
        else:
            smooth = smooth or value not in ("off", "0")
    above = np.searchsorted(np.array(lines), faces.lines, side="right") - 1
    of_line = np.array(materials, np.int32)[above]
    of_face = np.repeat(of_line, np.maximum(faces.tokens_per_line - 2, 0))
    return ObjLooks(tuple(dict.fromkeys(libraries)), tuple(names), of_face, smooth)


def _library_paths(folder: Path, value: str) -> list[Path]:
    """Files of a mtllib line: one whose name holds spaces, or several parted by them."""
    whole = folder / value
    return [whole] if whole.is_file() or " " not in value else [folder / part for part in value.split()]


def write_obj(path: Path, surface: TexturedSurface, looks: ObjLooks | None = None) -> None:
    """Write a surface as OBJ with separate indices, whole or not at all; numbers survive the round trip.

    Parameters
    ----------
    path : Path
    surface : TexturedSurface
    looks : ObjLooks, optional
        Materials of its faces, and whether it is shaded smooth.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    path = Path(path)
    corners = np.stack([surface.faces, surface.face_uvs], axis=2) + 1
    flipped = np.stack([surface.uvs[:, 0], 1.0 - surface.uvs[:, 1]], axis=1)
    parts = [
        looks.header(path.parent) if looks else "",
        ("v %.17g %.17g %.17g\n" * len(surface.positions)) % tuple(surface.positions.ravel().tolist()),
        ("vt %.17g %.17g\n" * len(flipped)) % tuple(flipped.ravel().tolist()),
    ]
    for keyword_lines, first, last in looks.runs() if looks else [("", 0, len(corners))]:
        run = corners[first:last]
        parts += [keyword_lines, ("f %d/%d %d/%d %d/%d\n" * len(run)) % tuple(run.ravel().tolist())]
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text("".join(parts), encoding="utf-8", errors="surrogateescape", newline="\n")
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place") from error
    finally:
        with contextlib.suppress(OSError):  # a folder that cannot be written to: nothing lies there
            partial.unlink(missing_ok=True)
