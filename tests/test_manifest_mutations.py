"""Every value of a manifest and of a model's JSON, replaced by wrong ones: `load` refuses, or nothing changes.

What a manifest alone says (names, boxes, levels' errors) may load as another value of the right kind; `check` holds
those to what it measures.
"""

from __future__ import annotations

import copy
import json
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_asset import build_ball
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from preprocess.files.images import Image, write_image
from runtime.asset.asset import Asset, load
from runtime.asset.weight_quadtree import WeightDetails, pack_details
from runtime.errors import AssetError

DELETED = object()
WRONG = (
    *(None, True, False, 0, 1, -1, 7, 300, 2**31, 2**64, 0.5, -1e30, 1e308),
    *("", "x", "../outside.png", "/dev/zero", "model.glb", "\x00", "a" * 5000),
    *([], {}, [1], [[]], [None], {"a": 1}, [1e9, -1e9, 0.5], [2**31] * 3),
    DELETED,
)
LONGEST_LINE = 300
ROUNDS = int(os.environ.get("SEAMSKIN_FUZZ_ROUNDS", "150"))  # `./run fuzz` asks for many more
# What a character may lack: without them it is another one, and a list of files says that they were there (`check`).
OPTIONAL = {("textures", name) for name in ("base_color", "orm")} | {("textures", "weights", "details")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball with every part that a manifest can have: details of weights, words of positions, files."""
    place = tmp_path_factory.mktemp("mutations") / "ball.seamless"
    build_ball(place, sizes=(2, 1), position_px=4, weight_px=4, color_px=16)
    manifest = json.loads((place / "manifest.json").read_text())
    quarters = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    joints = np.tile(np.arange(2), (4, 4, 1))
    weights = np.tile(np.array([155, 100]), (4, 4, 1))
    details = pack_details(WeightDetails(np.ones(4, np.int64), quarters, joints, weights), wide=False)
    write_image(place / "weight_details.png", Image(details / 255.0, "uint8"))
    manifest["textures"]["weights"]["details"] = {"file": "weight_details.png", "leaves": 4, "slots": 2}
    low, high = [-1.0, 0.0, -1.0], [1.0, 2.0, 1.0]
    steps = np.random.default_rng(0).integers(0, 1 << 10, (4, 4, 3)) / 1023.0
    write_image(place / "position.exr", Image(np.array(low) + steps * 2.0, "float"))
    manifest["textures"]["position"]["words"] = {"bits": [10, 10, 10], "low": low, "high": high}
    manifest["schema"] = 2
    manifest["files"] = {"model.glb": "0" * 64}
    (place / "manifest.json").write_text(json.dumps(manifest))
    write_image(place.parent / "outside.png", Image(np.zeros((16, 16, 3)), "uint8"))
    return place


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a JSON value."""
    yield path
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from places(inner, (*path, key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from places(inner, (*path, number))


def edited(root: Any, path: tuple[Any, ...], value: Any) -> Any:
    """The JSON with one value replaced."""
    if not path:
        return None if value is DELETED else value
    root = copy.deepcopy(root)
    here = root
    for key in path[:-1]:
        here = here[key]
    if value is DELETED:
        del here[path[-1]]
    else:
        here[path[-1]] = value
    return root


def drawn(asset: Asset) -> list[Any]:
    """All that decides a picture, but for what the manifest alone says."""
    skeleton = asset.skeleton
    arrays = [level for name in sorted(asset.textures) for level in asset.textures[name].levels]
    for lod in asset.lods:
        arrays += [lod.uvs, lod.canonical_uvs, lod.triangles]
    arrays += [skeleton.parents, skeleton.translation, skeleton.rotation, skeleton.scale, skeleton.inverse_bind]
    arrays += [track.values for clip in asset.clips for track in clip.tracks]
    details = asset.weight_details
    arrays += [details.depths, details.places, details.joints, details.weights]
    shapes = [(array.shape, array.dtype.str, array.tobytes()) for array in arrays]
    draws = [lod.draws for lod in asset.lods]
    return [shapes, draws, asset.materials, asset.weight_size, asset.colors_moved, asset.joint_names, asset.clip_names]


def outcome(folder: Path) -> Asset | None:
    """The asset, or None for a proper refusal. Every other exception, and every warning, fails the test."""
    try:
        return load(folder)
    except AssetError as error:
        assert "\n" not in str(error) and len(str(error).replace(str(folder), "")) < LONGEST_LINE
        return None


def test_every_wrong_value_of_a_manifest_is_refused_or_changes_nothing(folder: Path) -> None:
    path = folder / "manifest.json"
    text = path.read_text()
    manifest, right = json.loads(text), drawn(load(folder))
    refused = tried = 0
    try:
        for place in places(manifest):
            for value in WRONG:
                path.write_text(json.dumps(edited(manifest, place, value)))
                asset = outcome(folder)
                tried, refused = tried + 1, refused + (asset is None)
                if asset is not None:
                    left_out = value is DELETED and place in OPTIONAL
                    assert left_out or drawn(asset) == right, (place, value)
                    boxes = [asset.manifest.bind_bounds, *asset.manifest.clip_bounds.values()]
                    assert all(np.isfinite(box).all() and (box[0] <= box[1]).all() for box in boxes)
                    assert all(0.0 <= lod.error_m < 1e10 for lod in asset.lods)
    finally:
        path.write_text(text)
    assert tried > 2000 and refused > tried // 2


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length :]


def join_glb(root: Any, rest: bytes) -> bytes:
    """A GLB file of other JSON."""
    body = json.dumps(root).encode()
    body += b" " * (-len(body) % 4)
    head = struct.pack("<III", 0x46546C67, 2, 20 + len(body) + len(rest))
    return head + struct.pack("<II", len(body), 0x4E4F534A) + body + rest


def test_every_wrong_value_of_a_model_is_refused_or_loads(folder: Path) -> None:
    path = folder / "model.glb"
    data = path.read_bytes()
    model, rest = split_glb(data)
    rng = np.random.default_rng(1)
    refused = tried = 0
    try:
        for place in places(model):
            for number in rng.choice(len(WRONG), 6, replace=False):
                path.write_bytes(join_glb(edited(model, place, WRONG[number]), rest))
                tried, refused = tried + 1, refused + (outcome(folder) is None)
    finally:
        path.write_bytes(data)
    assert tried > 1000 and refused > tried // 3


UNCHECKED = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]  # each example puts back what it changed
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=ROUNDS, deadline=None, suppress_health_check=UNCHECKED)
@given(data=st.data())
def test_any_json_in_a_manifest_and_a_model_is_refused_or_loads(folder: Path, data: st.DataObject) -> None:
    """Several values at once, of any shape."""
    path = folder / data.draw(st.sampled_from(["manifest.json", "model.glb"]))
    before = path.read_bytes()
    root, rest = (json.loads(before), b"") if path.suffix == ".json" else split_glb(before)
    try:
        for _ in range(data.draw(st.integers(1, 3))):
            place = data.draw(st.sampled_from(list(places(root))[1:]))
            root = edited(root, place, data.draw(JSON))
        path.write_bytes(json.dumps(root).encode() if path.suffix == ".json" else join_glb(root, rest))
        outcome(folder)
    finally:
        path.write_bytes(before)


@settings(max_examples=ROUNDS, deadline=None, suppress_health_check=UNCHECKED)
@given(data=st.data())
def test_any_damage_to_a_file_is_refused_or_loads(
    folder: Path, data: st.DataObject, capfd: pytest.CaptureFixture[str]
) -> None:
    """Files cut short, and bytes that changed; libraries keep quiet."""
    path = folder / data.draw(st.sampled_from(sorted(p.name for p in folder.iterdir() if p.is_file())))
    before = path.read_bytes()
    damaged = bytearray(before[: data.draw(st.integers(0, len(before)))])
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(before)), st.integers(0, 255)), max_size=4)):
        if at < len(damaged):
            damaged[at] = value
    try:
        path.write_bytes(damaged)
        outcome(folder)
    finally:
        path.write_bytes(before)
    assert capfd.readouterr().err == ""
