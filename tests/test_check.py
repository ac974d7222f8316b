"""`check`: fresh builds are sound, and each claim of a manifest that its files do not bear out is named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_asset import build_ball
from builders_gltf import GltfBuilder, bent_bar, cube

from preprocess.cli import main
from preprocess.mesh.seams import find_seams, pack_seams, seam_order, unpack_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.pipeline import build
from preprocess.progress import Progress
from preprocess.settings import Settings
from preprocess.verify import goals
from preprocess.verify.claims import check_claims, check_files
from runtime.asset.asset import load


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bent_bar(tmp_path_factory.mktemp("check") / "bar.glb")


@pytest.fixture(scope="module")
def whole(source: Path) -> Path:
    destination = source.parent / "bar.seamless"
    build(source, destination, Settings(color_size_px=64), Progress(quiet=True))
    return destination


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "bar.seamless"))


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def test_a_fresh_build_is_sound(whole: Path, source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(whole), "--source", str(source)]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "sound" and not err
    assert "this never opens" in out  # the weights' row looks broken and is not
    assert "WRONG" not in out and "is the file that it was built from" in out


def test_hard_edges_stay_known_at_every_level(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A cube's seams are hard edges: its normals are left there, whatever is worst in a coarse mip level."""
    builder, shape = GltfBuilder(), cube()
    primitive = builder.primitive(shape["positions"], shape["faces"], NORMAL=shape["normals"], TEXCOORD_0=shape["uvs"])
    builder.node(mesh=builder.mesh(primitive, name="cube"), name="cube")
    source = builder.write(tmp_path / "cube.glb")
    build(source, tmp_path / "cube.seamless", Settings(color_size_px=64), Progress(quiet=True))
    seam = json.loads((tmp_path / "cube.seamless" / "manifest.json").read_text())["textures"]["normal"]["seam"]
    assert seam["left"] > 0 and bytes.fromhex(seam["left_seams"])
    assert main(["check", str(tmp_path / "cube.seamless"), "--source", str(source)]) == 0, capsys.readouterr().out
    edit(tmp_path / "cube.seamless", lambda m: m["textures"]["normal"]["seam"].update(left_seams=""))
    assert main(["check", str(tmp_path / "cube.seamless")]) == 2
    assert "cannot be told" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m["files"].clear(), "lists no files"),
        (lambda m: m.pop("files"), "lists no files"),
        (lambda m: m["files"].pop("model.glb"), "model.glb is read and not among"),
        (lambda m: m["files"].update({"model.glb": "0" * 64}), "model.glb was changed"),
        (lambda m: m["files"].update({"nothing.png": "0" * 64}), "nothing.png is missing"),
        (lambda m: m["files"].update({"../bar.glb": "0" * 64}), "../bar.glb is missing"),
        (lambda m: m["bounds"].update(bind=[[-9, -9, -9], [9, 9, 9]]), "box at rest"),
        (lambda m: m["bounds"].update(joints=None), "boxes of joints"),
        (lambda m: m["bounds"]["joints"].__setitem__(0, None), "boxes of joints"),
        (lambda m: m["bounds"]["joints"].__setitem__(1, [[-9, -9, -9], [9, 9, 9]]), "boxes of joints"),
        (lambda m: m["bounds"]["clips"].update(bend=[[0, 0, 0], [1, 1, 1]]), "box of clip 'bend'"),
        (lambda m: m["lods"][-1].update(error_m=0.0), "error"),
        (lambda m: m["lods"][0].update(error_m=0.4), "error"),
        (lambda m: m["lods"][0].update(vertices=7), "the manifest says"),
        (lambda m: m["textures"]["normal"]["seam"]["stored"][0].update(max=0.5), "normal level 0"),
        (lambda m: m["textures"]["position"]["seam"].update(stored=[]), "lacks textures.position.seam.stored"),
        (lambda m: m["textures"]["position"]["seam"]["stored"][0].update(rms=None), "lacks textures.position"),
        (lambda m: m["atlas"].update(overlap=None), "lacks atlas.overlap"),
        (lambda m: m.pop("atlas"), "lacks atlas.overlap"),
        (lambda m: m["textures"].pop("base_color"), "base_color.png is a texture that the manifest no longer names"),
    ],
)
def test_claims_that_do_not_hold_are_named(
    folder: Path, change: Callable[[dict[str, Any]], object], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(folder, change)
    assert main(["check", str(folder)]) == 2
    out, err = capsys.readouterr()
    assert "not sound" in err and len(err.splitlines()) == 1
    assert any(words in line for line in out.splitlines() if line.startswith("WRONG")), out


def test_every_changed_file_is_named(folder: Path) -> None:
    recorded = json.loads((folder / "manifest.json").read_text())["files"]
    assert [finding.holds for finding in check_files(load(folder))] == [True]
    asset = load(folder)
    for name in recorded:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data + b"\0")
        assert [finding.text for finding in check_files(asset)] == [f"{name} was changed since the build"]
        (folder / name).write_bytes(data)


def test_another_source_is_told_apart(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = bent_bar(tmp_path / "other.glb")
    other.write_bytes(other.read_bytes() + b"\0\0\0\0")
    assert main(["check", str(folder), "--source", str(other)]) == 2
    assert "other.glb is not the file that it was built from" in capsys.readouterr().err


def test_json_says_the_same(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "sound" and len(found["findings"]) > 10
    edit(folder, lambda m: m["lods"][0].update(vertices=7))
    assert main(["check", str(folder), "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "not sound" and sum(not one["holds"] for one in found["findings"]) == 1


def test_what_the_build_warned_of_is_noted_and_no_more(
    folder: Path, source: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A goal that this build misses: it says so in its measurements, and check agrees; worse than that is wrong."""
    rms = json.loads((folder / "manifest.json").read_text())["measurements"]["vertices"]["rms"]
    monkeypatch.setattr(goals, "VERTEX_RMS_REL", rms / 2)
    assert main(["check", str(folder), "--source", str(source)]) == 0
    assert "noted vertices of level 0" in capsys.readouterr().out
    monkeypatch.setattr(goals, "VERTEX_RMS_REL", rms / 4)
    assert main(["check", str(folder), "--source", str(source)]) == 2
    monkeypatch.setattr(goals, "VERTEX_RMS_REL", rms / 2)
    edit(folder, lambda m: m["measurements"]["vertices"].update(rms=rms / 2))
    assert main(["check", str(folder), "--source", str(source)]) == 2
    edit(folder, lambda m: m.update(measurements=[]))
    assert main(["check", str(folder), "--source", str(source)]) == 2
    assert "vertices of level 0" in capsys.readouterr().err


def test_a_folder_that_claims_nothing_is_not_sound(tmp_path: Path) -> None:
    """The test character made by formula has no files, no overlap and no jumps in its manifest."""
    folder = build_ball(tmp_path / "ball.seamless", sizes=(3,), position_px=16, weight_px=8, color_px=16)
    texts = [finding.text for finding in check_claims(load(folder)) if not finding.holds]
    assert len(texts) == 2 and "lists no files" in texts[0] and "lacks atlas.overlap" in texts[1]


def shuffled(surface: TexturedSurface, rng: np.random.Generator) -> TexturedSurface:
    """The same surface with its vertices, uvs and faces in another order, faces turned."""
    vertex, uv = rng.permutation(len(surface.positions)), rng.permutation(len(surface.uvs))
    face = rng.permutation(len(surface.faces))
    faces, face_uvs = np.argsort(vertex)[surface.faces][face], np.argsort(uv)[surface.face_uvs][face]
    turn = rng.integers(0, 3)
    return TexturedSurface(
        surface.positions[vertex],
        np.roll(faces, turn, axis=1).astype(np.int32),
        surface.uvs[uv],
        np.roll(face_uvs, turn, axis=1).astype(np.int32),
    )


def test_marked_seams_are_found_again_in_another_order() -> None:
    shape = cube()
    corners, vertex_of = np.unique(shape["positions"], axis=0, return_inverse=True)
    faces = shape["faces"].astype(np.int32)
    surface = TexturedSurface(corners, vertex_of.ravel()[faces].astype(np.int32), shape["uvs"], faces)
    seams = find_seams(surface)
    rng = np.random.default_rng(3)
    mask = rng.random(len(seams.uv_pairs)) < 0.5
    text = pack_seams(surface, seams, mask)
    assert (unpack_seams(surface, seams, text) == mask).all()
    other = shuffled(surface, rng)
    again = find_seams(other)
    marked = unpack_seams(other, again, text)

    def places(one: TexturedSurface, found: Any, chosen: np.ndarray) -> set[tuple[float, ...]]:
        middles = one.positions[found.vertices[chosen]].mean(axis=1)
        return {tuple(np.round(middle, 6)) for middle in middles}

    assert places(other, again, marked) == places(surface, seams, mask) and marked.sum() == mask.sum()
    assert sorted(seam_order(surface, seams)) == list(range(len(mask)))
    with pytest.raises(ValueError, match="are not"):
        unpack_seams(surface, seams, text + "00")
