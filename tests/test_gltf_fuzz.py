"""Damaged files: whatever is changed in a glTF file, it loads or is refused in one line; nothing else, and soon."""

from __future__ import annotations

import copy
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from builders_gltf import GltfBuilder, cube, grid

from preprocess.errors import InputError
from preprocess.load import load_character

JSON_ROUNDS, BINARY_ROUNDS = 400, 200
LIMIT_S = 5.0  # a file of fifty triangles; far more than any takes on a loaded machine
VALUES: list[Any] = [None, -1, 0, 1, 2, 3, 7, 12, 10**9, 2**70, 1.5, -5.5, 1e30, float("nan"), float("inf"), "", "x"]
VALUES += [
    "../x",
    "SCALAR",
    "VEC3",
    "MAT4",
    "CUBICSPLINE",
    5121,
    5123,
    5126,
    [],
    {},
    [[]],
    [1, 2],
    [None],
    {"a": 1},
    True,
]


def everything() -> GltfBuilder:
    """A small file with a bit of all that is read: skin, rigid part, clip, material, texture, sparse data, targets."""
    builder = GltfBuilder()
    root = builder.node(name="root", rotation=[0, 0.6, 0, 0.8], scale=[0.1, 0.1, 0.1])
    tip = builder.node(root, name="tip", translation=[0, 1, 0])
    shape, box = grid(2, 4), cube()
    weight = shape["positions"][:, 1]
    body = builder.primitive(
        shape["positions"],
        shape["faces"],
        TEXCOORD_0=shape["uvs"],
        JOINTS_0=np.tile([0, 1, 0, 0], (len(weight), 1)),
        WEIGHTS_0=np.stack([1 - weight, weight, 0 * weight, 0 * weight], axis=1),
    )
    block = builder.primitive(box["positions"], box["faces"], NORMAL=box["normals"], COLOR_0=np.ones((24, 4)))
    block["targets"] = [{"POSITION": builder.accessor(np.ones((24, 3)))}]
    texture = builder.texture(np.zeros((2, 2, 3), np.uint8), wrapS=33071)
    info = {"index": texture, "extensions": {"KHR_texture_transform": {"scale": [2, 2], "rotation": 1}}}
    body["material"] = builder.add(
        "materials",
        name="skin",
        pbrMetallicRoughness={"baseColorTexture": info, "baseColorFactor": [1, 1, 1, 1]},
        normalTexture={"index": texture, "scale": 0.5},
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 2}},
        alphaMode="MASK",
    )
    at = builder.view(np.array([1], np.uint16).tobytes())
    new = builder.view(np.array([[1, 1]], np.float32).tobytes())
    builder.json["accessors"][body["attributes"]["TEXCOORD_0"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": at, "componentType": 5123},
        "values": {"bufferView": new},
    }
    builder.node(mesh=builder.mesh(body), skin=builder.skin([root, tip], np.tile(np.eye(4), (2, 1, 1))))
    builder.node(tip, name="hand", mesh=builder.mesh(block, weights=[0.5]), scale=[-1, 1, 1])
    builder.clip("nod", (tip, "rotation", "LINEAR", [0, 1], [[0, 0, 0, 1], [0, 0, 0.6, 0.8]]))
    return builder


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, (*path, key))


def outcome(path: Path) -> bool:
    """Whether the file loads. Fails on anything but a one-line refusal, and on slowness."""
    start = time.process_time()
    try:
        load_character(path).mesh.validate()
        loaded = True
    except InputError as error:
        assert "\n" not in str(error) and path.name in str(error)
        loaded = False
    assert time.process_time() - start < LIMIT_S
    return loaded


def test_changed_json(tmp_path: Path) -> None:
    builder = everything()
    path = tmp_path / "changed.glb"
    path.write_bytes(builder.glb())
    assert outcome(path)
    original = builder.json
    where = list(places(original))
    dice = random.Random(20)
    outcomes = []
    for _ in range(JSON_ROUNDS):
        builder.json = copy.deepcopy(original)
        for target in dice.sample(where, dice.choice((1, 1, 2))):
            holder: Any = builder.json
            try:
                for key in target[:-1]:
                    holder = holder[key]
                if dice.random() < 0.15:
                    del holder[target[-1]]
                else:
                    holder[target[-1]] = copy.deepcopy(dice.choice(VALUES))
            except (KeyError, IndexError, TypeError):  # the first change took the place of the second away
                continue
        path.write_bytes(builder.glb())
        outcomes.append(outcome(path))
    assert any(outcomes) and not all(outcomes)


def test_changed_bytes(tmp_path: Path) -> None:
    whole = everything().glb()
    start = whole.index(b"BIN\0") + 4
    path = tmp_path / "changed.glb"
    dice = random.Random(21)
    words = [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\1\0\xa0\x7f", b"\xff\xff\x7f\x7f", b"\0\0\0\0", b"\xff\xff\xff\xff"]
    outcomes = []
    for _ in range(BINARY_ROUNDS):
        data = bytearray(whole)
        for _ in range(dice.choice((1, 2, 8))):
            at = start + 4 * dice.randrange((len(data) - start) // 4)
            data[at : at + 4] = dice.choice([*words, dice.randbytes(4)])
        path.write_bytes(data)
        outcomes.append(outcome(path))
    assert any(outcomes) and not all(outcomes)


def test_cut_anywhere(tmp_path: Path) -> None:
    whole = everything().glb()
    path = tmp_path / "cut.glb"
    for length in range(0, len(whole), max(len(whole) // 60, 1)):
        path.write_bytes(whole[:length])
        assert not outcome(path)
