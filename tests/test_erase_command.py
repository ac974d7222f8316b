"""`python -m preprocess erase`: formats come back as they were, and bad input is one line that loses nothing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from preprocess.cli import main
from preprocess.commands import erase as command
from preprocess.erase import measure_seams
from preprocess.files.images import Image, read_image, write_image
from preprocess.files.obj import write_obj
from preprocess.load.read_surface import read_surface
from preprocess.mesh.seams import find_seams
from preprocess.mesh.texels import sample_bilinear
from tests.builders_erase import make_cube, make_square, paint


@pytest.fixture
def cube(tmp_path):
    path = tmp_path / "cube.obj"
    write_obj(path, make_cube())
    return path


def save(path: Path, texels: np.ndarray, fmt: str, names: tuple[str, ...], **attributes) -> Path:
    height, width, channels = texels.shape
    spec = oiio.ImageSpec(width, height, channels, fmt)
    spec.channelnames = names
    for key, value in attributes.items():
        spec.attribute(key.replace("__", ":"), value)
    write_image(path, Image(texels, fmt, names, spec))
    return path


def jump(mesh: Path, image: Path) -> tuple[float, float]:
    surface = read_surface(mesh)
    read = read_image(image, native=True)
    measured = measure_seams(read.texels, surface, find_seams(surface))
    return float(measured.rms.max()), float(measured.max.max())


@pytest.mark.parametrize(
    ("suffix", "fmt", "channels", "floor"),
    [
        (".png", "uint8", 3, 0.5),
        (".png", "uint8", 4, 0.5),
        (".png", "uint8", 1, 0.5),
        (".png", "uint16", 3, 2.0),
        (".tif", "uint8", 3, 0.5),
        (".tif", "uint16", 4, 2.0),
        (".tif", "float", 3, 1e-4),
        (".exr", "half", 3, 2e-3),
        (".exr", "float", 5, 1e-4),
    ],
)
def test_formats_come_back(cube, tmp_path, capsys, suffix, fmt, channels, floor):
    names = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}.get(
        channels, ("height", "w.x", "w.y", "w.z", "ao")
    )
    image = paint(64, 48, channels)
    source = save(tmp_path / f"in{suffix}", image, fmt, names, Artist="somebody", XResolution=72.0)
    output = tmp_path / "out" / f"erased{suffix}"
    assert main(["erase", str(cube), str(source), "-o", str(output)]) == 0
    before, after = read_image(source, native=True), read_image(output, native=True)
    assert (after.format, after.channel_names) == (before.format, before.channel_names)
    assert after.texels.shape == before.texels.shape and after.texels.dtype == before.texels.dtype
    assert after.metadata.get_string_attribute("Artist") == before.metadata.get_string_attribute("Artist")
    for key in ("oiio:ColorSpace", "XResolution"):
        assert str(after.metadata.getattribute(key)) == str(before.metadata.getattribute(key))
    assert jump(cube, output)[1] <= floor < jump(cube, source)[1]
    assert "in" + suffix in capsys.readouterr().out


def test_several_images_and_mips(cube, tmp_path):
    images = [
        save(tmp_path / "a.png", paint(32, 32), "uint8", ("R", "G", "B")),
        save(tmp_path / "b.exr", paint(32, 32), "float", ("R", "G", "B")),
        save(tmp_path / "c.png", paint(16, 40, 1), "uint16", ("Y",)),
    ]
    folder = tmp_path / "many"
    assert main(["erase", str(cube), *map(str, images), "-o", str(folder), "--mips", "--global"]) == 0
    levels = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    assert {"a.png", "b.exr", "c.png", "mips/a.1.png", "mips/a.5.png", "mips/b.3.exr"} <= set(levels)
    assert "mips/a.6.png" not in levels
    for name in levels:
        if name.endswith(".png"):
            eight = read_image(folder / name).format == "uint8"
            assert jump(cube, folder / name)[1] <= (0.5 if eight else 2.0)
    assert read_image(folder / "mips" / "c.2.png").texels.shape == (10, 4, 1)


@pytest.mark.parametrize("value", ["lerp", "texture"])
def test_seam_values(cube, tmp_path, value):
    source = save(tmp_path / "a.png", paint(32, 32), "uint8", ("R", "G", "B"))
    assert main(["erase", str(cube), str(source), "-o", str(tmp_path / "o.png"), "--seam-value", value]) == 0
    assert jump(cube, tmp_path / "o.png")[1] <= 0.5


def test_borders_are_kept_and_drawn(cube, tmp_path, capsys):
    image = paint(64, 64)
    image[:32] = 1 - 0.3 * image[:32]
    source = save(tmp_path / "a.png", image, "uint8", ("R", "G", "B"))
    arguments = ["erase", str(cube), str(source), "-o", str(tmp_path / "o.png")]
    assert main([*arguments, "--keep-borders", "0.3", "--report", str(tmp_path / "report.png")]) == 0
    assert "seams left" in capsys.readouterr().out
    picture = read_image(tmp_path / "report.png").texels
    assert ((picture[..., 0] - picture[..., 1]) > 0.5).any() and ((picture[..., 1] - picture[..., 0]) > 0.5).any()
    assert jump(cube, tmp_path / "o.png")[1] > 50


def test_mesh_without_seams_copies_the_image(tmp_path, capsys):
    mesh = tmp_path / "square.obj"
    write_obj(mesh, make_square())
    source = save(tmp_path / "a.png", paint(20, 20), "uint8", ("R", "G", "B"))
    assert main(["erase", str(mesh), str(source), "-o", str(tmp_path / "o.png")]) == 0
    assert (tmp_path / "o.png").read_bytes() == source.read_bytes()
    assert "no seams" in capsys.readouterr().out


def test_uvs_outside_the_image_wrap_with_a_note(tmp_path, capsys):
    cube = make_cube()
    mesh = tmp_path / "moved.obj"
    write_obj(mesh, dataclasses.replace(cube, uvs=cube.uvs + np.array([0.6, 0.3])))
    source = save(tmp_path / "a.png", paint(40, 40), "uint8", ("R", "G", "B"))
    assert main(["erase", str(mesh), str(source), "-o", str(tmp_path / "o.png")]) == 0
    assert "wrap" in capsys.readouterr().out
    surface = read_surface(mesh)
    texels = read_image(tmp_path / "o.png", native=True).texels
    assert measure_seams(texels, surface, find_seams(surface), repeat=True).max.max() <= 0.5


def test_an_edge_with_three_faces_is_joined_across_all(tmp_path, capsys):
    """Three fins on one spine, each a chart of its own: all three agree along the spine, and a note says so."""
    fins = tmp_path / "fins.obj"
    fins.write_text(
        "v 0 0 0\nv 0 0 1\nv 1 0 0\nv 0 1 0\nv -1 0 0\n"
        "vt 0.1 0.1\nvt 0.1 0.45\nvt 0.4 0.2\nvt 0.6 0.1\nvt 0.65 0.4\nvt 0.9 0.2\n"
        "vt 0.1 0.6\nvt 0.3 0.9\nvt 0.45 0.6\n"
        "f 1/1 2/2 3/3\nf 2/5 1/4 4/6\nf 1/7 2/8 5/9\n"
    )
    source = save(tmp_path / "a.png", paint(64, 64), "uint8", ("R", "G", "B"))
    assert main(["erase", str(fins), str(source), "-o", str(tmp_path / "o.png")]) == 0
    assert "1 mesh edges have three or more faces" in capsys.readouterr().out
    texels = read_image(tmp_path / "o.png").texels
    spine = [np.array(uvs) for uvs in ([[0.1, 0.1], [0.1, 0.45]], [[0.6, 0.1], [0.65, 0.4]], [[0.1, 0.6], [0.3, 0.9]])]
    along = np.linspace(0, 1, 200)[:, None]
    samples = [sample_bilinear(texels, ((1 - along) * ends[0] + along * ends[1]) * (1, -1) + (0, 1)) for ends in spine]
    for k in range(3):
        assert np.abs(samples[k] - samples[k - 1]).max() <= (1 if k == 0 else 0.5) / 255


def refused(capsys, arguments: list, *words: str) -> None:
    """Status 2 and one line on stderr that holds all the words."""
    assert main([str(a) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "Traceback" not in error
    for word in words:
        assert word in error, error


def test_refusals_lose_nothing(cube, tmp_path, capsys, monkeypatch):
    good = save(tmp_path / "good.png", paint(16, 16), "uint8", ("R", "G", "B"))
    output = tmp_path / "kept.png"
    output.write_bytes(b"before")

    def refuse(*arguments, words):
        refused(capsys, ["erase", *arguments, "-o", output], *words)
        assert output.read_bytes() == b"before"
        assert not [p for p in tmp_path.iterdir() if "partial" in p.name]

    refuse(cube, tmp_path / "none.png", words=["none.png", "no such file"])
    torn = tmp_path / "torn.png"
    torn.write_bytes(b"this is no image")
    refuse(cube, torn, words=["torn.png", "does not decode"])
    cut = tmp_path / "cut.png"
    cut.write_bytes(good.read_bytes()[:200])
    refuse(cube, cut, words=["cut.png"])
    broken = paint(16, 16)
    broken[3, 5, 1] = np.nan
    nan = save(tmp_path / "nan.exr", broken, "float", ("R", "G", "B"))
    refuse(cube, nan, words=["nan.exr", "column 5, row 3", "not finite"])
    bare = tmp_path / "bare.obj"
    bare.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    refuse(bare, good, words=["bare.obj", "texture coordinates"])
    refuse(cube, good, good, words=["one file", "2 images"])
    monkeypatch.setattr(command, "_available_bytes", lambda: 100 << 20)
    refuse(cube, good, words=["good.png", "GB", "16 x 16"])


def test_a_failed_second_image_leaves_no_first(cube, tmp_path, capsys):
    good = save(tmp_path / "good.png", paint(16, 16), "uint8", ("R", "G", "B"))
    broken = paint(16, 16)
    broken[0, 0, 0] = np.inf
    bad = save(tmp_path / "bad.exr", broken, "float", ("R", "G", "B"))
    refused(capsys, ["erase", cube, good, bad, "-o", tmp_path / "many"], "bad.exr")
    assert not (tmp_path / "many").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("mesh", "image"), [("blub.obj", "blub.png"), ("Fox.glb", None)])
def test_real_textures_are_seamless_as_stored(asset_path, tmp_path, mesh, image):
    surface = read_surface(asset_path(mesh))
    seams = find_seams(surface)
    if image is None:
        from preprocess.load import load_character

        texels = load_character(asset_path(mesh)).materials[0].base_color.image.texels
        source = save(tmp_path / "fox.png", texels[..., :3], "uint8", ("R", "G", "B"))
    else:
        source = asset_path(image)
    assert main(["erase", str(asset_path(mesh)), str(source), "-o", str(tmp_path / "o.png")]) == 0
    stored = measure_seams(read_image(tmp_path / "o.png", native=True).texels, surface, seams)
    before = measure_seams(read_image(source, native=True).texels, surface, seams)
    assert stored.max.max() <= 0.5
    assert (stored.rms < 0.06 * before.rms).all()
