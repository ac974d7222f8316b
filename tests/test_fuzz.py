"""Properties of the readers, on files that hypothesis makes up: a file is read, or refused in one short line, soon.

The suite tries the same few hundred each time. `./run fuzz [SECONDS]` goes on with others for an hour, and stops at
the first that breaks a property, made as small as it gets.
"""

from __future__ import annotations

import copy
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_gltf_fuzz import everything, places

from preprocess.errors import InputError
from preprocess.files.obj import read_looks, read_obj
from preprocess.files.polygons import cut_polygons
from preprocess.load import load_character

COMMON: dict[str, Any] = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
ROUNDS = os.environ.get("SEAMSKIN_FUZZ_ROUNDS")
settings.register_profile("readers", max_examples=int(ROUNDS or 60), derandomize=ROUNDS is None, **COMMON)
settings.load_profile("readers")

LIMIT_S = 5.0  # of processor time, for a file of fifty triangles
LONGEST_LINE = 300
WHOLE = everything()
PLACES = list(places(WHOLE.json))
NUMBERS = st.one_of(
    st.integers(-3, 12),
    st.sampled_from([2**31, 2**53, 2**70, 10**300, 1e9, 1e12, 1e30, 1e150, 1e308, -1e30, 1e-30, 5e-324]),
    st.floats(width=32),
)
TEXT = st.one_of(
    st.text(max_size=8),
    st.sampled_from(
        ["SCALAR", "VEC3", "MAT4", "CUBICSPLINE", "weights", "../x", "data:;base64,AA", "/dev/zero", "\ud83d"]
    ),
)
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXT,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["index", "node", "x"]), inner, max_size=3)
    ),
    max_leaves=6,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def read(reader: Any, path: Path) -> Any:
    """What a reader makes of a file; None where it refuses it, in one short line that names it."""
    start = time.process_time()
    try:
        return reader(path)
    except InputError as error:
        line = str(error)
        assert "\n" not in line and len(line) < LONGEST_LINE and path.name in line
        return None
    finally:
        assert time.process_time() - start < LIMIT_S


def check_character(path: Path) -> None:
    character = read(load_character, path)
    if character is not None:
        character.mesh.validate()
        character.skeleton.validate()
        assert all(np.isfinite(track.values).all() for clip in character.clips for track in clip.tracks)
        assert len({clip.name for clip in character.clips}) == len(character.clips)
        "".join([character.name, *character.skeleton.names, *character.warnings]).encode()


def edited(changes: list[tuple[int, bool, Any]]) -> GltfBuilder:
    """The file with a bit of everything, some of its JSON's values replaced or deleted."""
    builder = GltfBuilder()
    builder.json, builder.data = copy.deepcopy(WHOLE.json), WHOLE.data
    for which, deleted, value in changes:
        *above, last = PLACES[which]
        try:
            holder: Any = builder.json
            for key in above:
                holder = holder[key]
            if deleted:
                del holder[last]
            else:
                holder[last] = value
        except (KeyError, IndexError, TypeError):  # an earlier change took this place away
            continue
    return builder


@given(st.lists(st.tuples(st.integers(0, len(PLACES) - 1), st.booleans(), VALUES), min_size=1, max_size=4))
def test_any_change_of_a_files_json(folder: Path, changes: list[tuple[int, bool, Any]]) -> None:
    path = folder / "json.glb"
    path.write_bytes(edited(changes).glb())
    check_character(path)


@given(
    st.lists(
        st.tuples(st.integers(0, len(WHOLE.data) // 4 - 1), NUMBERS | st.binary(min_size=4, max_size=4)),
        min_size=1,
        max_size=8,
    )
)
def test_any_change_of_a_files_numbers(folder: Path, changes: list[tuple[int, Any]]) -> None:
    builder = GltfBuilder()
    builder.json, builder.data = copy.deepcopy(WHOLE.json), bytearray(WHOLE.data)
    for word, value in changes:
        with np.errstate(over="ignore"):
            new = value if isinstance(value, bytes) else np.float32(min(max(value, -3e38), 3e38)).tobytes()
        builder.data[4 * word : 4 * word + 4] = new
    path = folder / "numbers.glb"
    path.write_bytes(builder.glb())
    check_character(path)


@given(st.binary(max_size=64), st.integers(0, len(WHOLE.data)), st.booleans())
def test_any_bytes_anywhere(folder: Path, data: bytes, where: int, cut: bool) -> None:
    whole = WHOLE.glb()
    path = folder / "bytes.glb"
    path.write_bytes(whole[:where] + data + (b"" if cut else whole[where + len(data) :]))
    check_character(path)


TOKEN = st.one_of(
    st.integers(-9, 9).map(str),
    st.tuples(st.integers(-5, 9), st.integers(-5, 9)).map(lambda pair: f"{pair[0]}/{pair[1]}"),
    st.floats(width=32).map(str),
    st.sampled_from(
        ["1/1/1", "1//1", "1/", "/1", "1/1/", "#", "# x", "\\", "1e999", "nan", "-0", "9" * 400, "0x1", "1_0", "é"]
    ),
)
LINE = st.tuples(
    st.sampled_from(["v", "vt", "vn", "f", "usemtl", "mtllib", "s", "o", "", "#", "l", " v", "f\t", "\ufeffv"]),
    st.lists(TOKEN, max_size=6),
    st.sampled_from(["\n", "\r\n", " \\\n", "\\\n", " \n", "\r", "\n\n", "\t\n"]),
).map(lambda line: f"{line[0]} {' '.join(line[1])}{line[2]}")
GOOD = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


@given(st.booleans(), st.lists(LINE, max_size=12), st.booleans())
def test_any_lines_of_an_obj(folder: Path, good: bool, lines: list[str], ends: bool) -> None:
    path = folder / "lines.obj"
    path.write_bytes((GOOD * good + "".join(lines) + "\nf 1/1 2/2 3/3\n" * ends).encode("utf-8", "surrogatepass"))
    surface = read(read_obj, path)
    if surface is not None:
        surface.validate()
        looks = read(read_looks, path)
        assert looks is not None and len(looks.face_materials) == len(surface.faces)


@given(st.binary(max_size=200))
def test_any_bytes_of_an_obj(folder: Path, data: bytes) -> None:
    path = folder / "bytes.obj"
    path.write_bytes(data)
    read(read_obj, path)


@given(st.lists(st.integers(1, 9), min_size=3, max_size=40), st.integers(0, 39), st.floats(-3, 3), st.floats(-3, 3))
def test_star_shaped_polygons_are_covered_once(radii: list[int], first: int, tilt: float, turn: float) -> None:
    """Seen from their middle all corners are in order: simple, mostly concave, with known area, and not planar."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    flat = np.roll(flat, first, axis=0)
    corners = np.concatenate([flat, flat @ [[tilt], [turn]]], axis=1)  # in a slanting plane
    triangles = cut_polygons(corners, np.array([len(radii)]))
    assert len(triangles) == len(radii) - 2
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    areas = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    x, y = flat.T
    whole = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    if len(radii) > 3:  # of three corners the middle may lie outside
        np.testing.assert_allclose(areas.sum(), whole, rtol=1e-9, atol=1e-9)
        assert areas.min() >= -1e-9
