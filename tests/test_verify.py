"""The build's measurement of itself: right builds pass, and each kind of damage is reported as what it is."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_gltf import GltfBuilder

from preprocess import pipeline
from preprocess.files.images import Image, read_image, write_image
from preprocess.load import Character, load_character
from preprocess.pipeline import build
from preprocess.progress import Progress
from preprocess.settings import Settings
from preprocess.verify.goals import Finding, judge
from preprocess.verify.measure import measure
from preprocess.verify.retries import RETRIES, next_retry
from preprocess.verify.source import Source
from runtime.asset.asset import load

SIDE = 32  # of the images


def write_tube(path: Path, **material: Any) -> Path:
    """A closed, skinned tube of two joints with one chart, every kind of texture, and a clip."""
    around, along = 12, 8
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, around + 1), np.linspace(0.0, 2.0, along + 1))
    radial = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], axis=-1).reshape(-1, 3)
    positions = 0.3 * radial + height.reshape(-1, 1) * [0.0, 1.0, 0.0]
    uvs = np.stack([angle / (2 * np.pi) * 0.9 + 0.05, 0.95 - height / 2.0 * 0.9], axis=-1).reshape(-1, 2)
    corner = (np.arange(along)[:, None] * (around + 1) + np.arange(around)).ravel()
    right, up, both = corner + 1, corner + around + 1, corner + around + 2
    faces = np.concatenate([np.stack([corner, right, both], 1), np.stack([corner, both, up], 1)])
    weight = np.clip(positions[:, 1] - 0.5, 0, 1)
    zeros = np.zeros_like(weight)
    builder = GltfBuilder()
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    paint = np.stack([40 + 5 * x, 200 - 4 * y, 90 + 2 * x + 2 * y], axis=-1).astype(np.uint8)
    relief = np.full((SIDE, SIDE, 3), [160, 128, 240], np.uint8)
    glow = np.stack([8 * y, 4 * x, 255 - 8 * x], axis=-1).astype(np.uint8)
    builder.add(
        "materials",
        name="skin",
        pbrMetallicRoughness={"baseColorTexture": {"index": builder.texture(paint)}, "metallicFactor": 0.0},
        normalTexture={"index": builder.texture(relief)},
        emissiveTexture={"index": builder.texture(glow)},
        emissiveFactor=[1.0, 1.0, 1.0],
        **material,
    )
    root = builder.node(name="root")
    tip = builder.node(root, name="tip", translation=[0, 1, 0])
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 1, 3] = -1
    primitive = builder.primitive(
        positions,
        faces,
        TEXCOORD_0=uvs,
        NORMAL=radial,
        JOINTS_0=np.tile([0, 1, 0, 0], (len(weight), 1)),
        WEIGHTS_0=np.stack([1 - weight, weight, zeros, zeros], axis=1),
    )
    primitive["material"] = 0
    builder.node(mesh=builder.mesh(primitive, name="tube"), skin=builder.skin([root, tip], inverse), name="tube")
    half = np.sqrt(0.5)
    builder.clip("bend", (tip, "rotation", "LINEAR", [0, 1], [[0, 0, 0, 1], [0, 0, half, half]]))
    return builder.write(path)


@pytest.fixture(scope="module")
def character(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return load_character(write_tube(tmp_path_factory.mktemp("verify") / "tube.glb"))


@pytest.fixture(scope="module")
def whole(character: Character) -> Path:
    """The character, built; textures small, for the sake of time."""
    destination = character.source.parent / "tube.seamless"
    build(character.source, destination, Settings(color_size_px=64), Progress(quiet=True))
    return destination


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "tube.seamless"))


def wrong(folder: Path, character: Character) -> set[str]:
    """Kinds of findings that do not hold."""
    return {finding.kind for finding in judge(measure(load(folder), character)) if not finding.holds}


def edit_texels(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    image = read_image(path)
    write_image(path, Image(change(image.texels.copy()), image.format))


def edit_manifest(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def test_a_right_build_is_within_every_goal_and_says_so(whole: Path, character: Character) -> None:
    assert wrong(whole, character) == set()
    manifest = json.loads((whole / "manifest.json").read_text())
    measured = manifest["measurements"]
    assert measured["vertices"]["count"] > 100 and measured["tried_again_with"] == []
    assert 0 < measured["normals"]["skin"]["rms"] < 1.0 and measured["matched"] > 0.9
    assert not any("goal" in warning for warning in manifest["warnings"])
    assert "verify" in manifest["timings"] and sorted(path.name for path in whole.glob("try-*")) == []


def test_a_moved_patch_of_the_position_map_is_reported_with_its_place(folder: Path, character: Character) -> None:
    def move(texels: np.ndarray) -> np.ndarray:
        texels[: len(texels) // 8, :, 0] += 0.05
        return texels

    edit_manifest(folder, lambda manifest: manifest["textures"]["position"].pop("words", None))
    edit_texels(folder / "position.exr", move)
    assert "vertices" in wrong(folder, character)
    text = next(f.text for f in judge(measure(load(folder), character)) if f.kind == "vertices")
    assert "material 'skin'" in text and "joint " in text and "goals" in text


def test_exchanged_joints_in_the_weight_map_are_reported(folder: Path, character: Character) -> None:
    def exchange(texels: np.ndarray) -> np.ndarray:
        height = len(texels) // 2  # joints above, weights below
        texels[height:, :, :2] = texels[height:, :, 1::-1]
        return texels

    edit_manifest(folder, lambda manifest: manifest["textures"]["weights"].pop("details", None))
    edit_texels(folder / "weights.png", exchange)
    assert {"vertices", "weights"} <= wrong(folder, character)


@pytest.mark.parametrize(
    ("file", "change", "kind"),
    [
        ("normal.png", lambda texels: texels[..., [1, 0, 2]], "normals"),
        ("normal.png", lambda texels: 1.0 - texels, "normals"),
        ("base_color.png", lambda texels: texels[..., ::-1], "base_color"),
        ("base_color.png", lambda texels: texels * 0.9, "base_color"),
        ("base_color.png", lambda texels: np.roll(texels, 8, axis=0), "base_color"),
        ("emissive.png", lambda texels: texels * 0.7, "emission"),
    ],
)
def test_damaged_looks_are_reported_and_nothing_else(
    folder: Path, character: Character, file: str, change: Callable[[np.ndarray], np.ndarray], kind: str
) -> None:
    edit_texels(folder / file, change)
    assert wrong(folder, character) == {kind}


def test_boxes_that_do_not_hold_the_character_are_reported(folder: Path, character: Character) -> None:
    edit_manifest(folder, lambda m: m["bounds"]["clips"].update(bend=[[-0.3, 0, -0.3], [0.3, 2, 0.3]]))
    assert wrong(folder, character) == {"outside"}


def test_moved_joints_are_reported(folder: Path, character: Character) -> None:
    moved = character.skeleton.translation + np.array([0.0, 0.05, 0.0])
    bones = dataclasses.replace(character.skeleton, translation=moved)
    assert {"joints", "vertices"} <= wrong(folder, dataclasses.replace(character, skeleton=bones))


def test_emission_is_that_of_the_file(whole: Path, character: Character) -> None:
    """A material of another strength is another file: the reference is not what was baked."""
    material = dataclasses.replace(character.materials[0], emissive_factor=(4.0, 2.0, 0.0))
    assert "emission" in wrong(whole, dataclasses.replace(character, materials=(material,)))


def test_normals_of_the_source_follow_the_uvs_of_their_texture(character: Character) -> None:
    """A card facing +z with u right and v down: its normal map's x is world x, its y world y; turned uvs turn both."""
    source = Source(character)
    faces, shares = np.arange(4), np.full((4, 3), 1 / 3)
    steps = np.zeros((4, 2, 3))
    smooth = np.einsum("nk,nkc->nc", shares, character.mesh.corner_normals[faces])
    smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], smooth)  # of a tube that stands upright, seen from outside
    local = np.array([160, 128, 240]) / 255 * 2 - 1
    expected = local[0] * right + local[1] * np.array([0.0, 1.0, 0.0]) + local[2] * smooth
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.abs(source.normals(faces, shares, steps) - expected).max() < 1e-3


def test_a_build_that_comes_out_wrong_tries_again_and_then_warns(
    character: Character, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage that writes is damaged: the first time only, then every time."""
    write, calls = pipeline.write_folder, []

    def damaged(folder: Path, *rest: Any, times: int) -> dict[str, Any]:
        manifest = write(folder, *rest)
        calls.append(folder)
        if len(calls) <= times:
            edit_texels(folder / "position.exr", lambda texels: texels + (np.arange(texels.shape[1]) % 2)[:, None] / 50)
            manifest["textures"]["position"].pop("words", None)
            edit_manifest(folder, lambda m: m["textures"]["position"].pop("words", None))
        return manifest

    for times, expected in ((1, 2), (9, 3)):
        calls.clear()
        monkeypatch.setattr(pipeline, "write_folder", lambda *a, times=times, **k: damaged(*a, times=times))
        destination = tmp_path / f"{times}.seamless"
        result = build(character.source, destination, Settings(color_size_px=64), Progress(quiet=True))
        assert len(calls) == expected
        assert any("vertices of level 0" in warning for warning in result.warnings) == (times == 9)
        manifest = json.loads((destination / "manifest.json").read_text())
        assert manifest["measurements"]["tried_again_with"][0] == RETRIES[0].words
        assert {path.name for path in destination.iterdir()} >= {"model.glb", "position.exr", "weights.png"}
        assert not list(destination.glob("try-*"))


def test_retries_keep_what_a_person_fixed() -> None:
    manifest = {"textures": {"position": {"size": [64, 64]}, "weights": {"size": [32, 32]}}, "atlas": {"mode": "keep"}}
    gross = [Finding("vertices", "", False, True)]
    words, changed = next_retry(Settings(), manifest, gross, []) or ("", Settings())
    assert (changed.geometry_size_px, changed.weight_size_px, changed.atlas) == (128, 64, "auto")
    fixed = Settings(geometry_size_px=64)
    assert (next_retry(fixed, manifest, gross, []) or ("", fixed))[1].atlas == "unwrap"
    assert next_retry(Settings(geometry_size_px=64, atlas="keep"), manifest, gross, []) is None
    assert next_retry(Settings(), manifest, [Finding("vertices", "", True)], []) is None
    assert next_retry(Settings(), manifest, gross, [words, "another atlas"]) is None
