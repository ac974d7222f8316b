"""Materials of OBJ files go along with their faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_straighten_parts import two_charts

from preprocess.cli import main
from preprocess.files.images import Image, write_image
from preprocess.files.obj import read_looks, read_obj, write_obj
from preprocess.files.obj_materials import ObjLooks, move_library

CORNERS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
QUAD, TRIANGLE = "f 1/1 2/2 3/3 4/4\n", "f 1/1 2/2 3/3\n"


def looks_of(folder: Path, text: str) -> ObjLooks:
    (folder / "a.obj").write_text(text)
    looks = read_looks(folder / "a.obj")
    assert looks is not None
    assert len(looks.face_materials) == len(read_obj(folder / "a.obj").faces)
    return looks


def test_materials_are_those_of_the_last_usemtl_above(tmp_path: Path) -> None:
    text = CORNERS + TRIANGLE + "usemtl my skin \n" + QUAD + "  usemtl B\r\n" + TRIANGLE + "usemtl my skin\n" + QUAD
    looks = looks_of(tmp_path, text)
    assert looks.names == ("my skin", "B") and not looks.smooth
    assert looks.face_materials.tolist() == [-1, 0, 0, 1, 0, 0]
    assert list(looks.runs()) == [
        ("", 0, 1),
        ("usemtl my skin\n", 1, 3),
        ("usemtl B\n", 3, 4),
        ("usemtl my skin\n", 4, 6),
    ]
    assert looks.of(np.array([5, 3, 3])).face_materials.tolist() == [0, 1, 1]


@pytest.mark.parametrize(
    ("line", "smooth"), [("s 1\n", True), ("s off\n", False), ("s 0\n", False), ("vn 0 0 1\n", True), ("", False)]
)
def test_smoothness(tmp_path: Path, line: str, smooth: bool) -> None:
    looks = looks_of(tmp_path, CORNERS + line + TRIANGLE)
    assert looks.smooth == smooth and looks.names == () and ("s 1" in looks.header(tmp_path)) == smooth


def test_library_names_with_spaces_and_several(tmp_path: Path) -> None:
    (tmp_path / "my mat.mtl").write_text("")
    text = CORNERS + TRIANGLE
    assert looks_of(tmp_path, "mtllib my mat.mtl\n" + text).libraries == (tmp_path / "my mat.mtl",)
    assert looks_of(tmp_path, "mtllib a.mtl b.mtl\n" + text).libraries == (tmp_path / "a.mtl", tmp_path / "b.mtl")


def test_a_round_trip_keeps_them(tmp_path: Path) -> None:
    text = "mtllib a.mtl\n" + CORNERS + "vn 0 0 1\nusemtl caf\u00e9\n" + QUAD + "usemtl B\n" + TRIANGLE
    looks = looks_of(tmp_path, text)
    (tmp_path / "sub").mkdir()
    write_obj(tmp_path / "sub" / "b.obj", read_obj(tmp_path / "a.obj"), looks)
    again = read_looks(tmp_path / "sub" / "b.obj")
    assert again is not None and again.names == looks.names and again.smooth
    np.testing.assert_array_equal(again.face_materials, looks.face_materials)
    assert again.libraries[0].resolve() == (tmp_path / "a.mtl").resolve()
    assert read_looks(tmp_path / "a.glb") is None


def test_libraries_name_the_images_beside_them(tmp_path: Path) -> None:
    text = "newmtl A\nKd 1 1 1\nmap_Kd -s 1 1 1 tex\\my color.png\nbump -bm 0.5 other.png\n  norm n.png\n"
    moved = move_library(text, tmp_path, tmp_path / "out", ["my color.png", "n.png"]).splitlines()
    assert moved == [
        "newmtl A",
        "Kd 1 1 1",
        "map_Kd -s 1 1 1 my color.png",
        "bump -bm 0.5 ../other.png",
        "  norm n.png",
    ]


def test_commands_carry_them_along(tmp_path: Path) -> None:
    surface = two_charts(4)
    looks = ObjLooks((tmp_path / "a.mtl",), ("A", "B"), (np.arange(len(surface.faces)) % 2).astype(np.int32), True)
    write_obj(tmp_path / "a.obj", surface, looks)
    (tmp_path / "a.mtl").write_text("newmtl A\nmap_Kd tex/c.png\n")
    (tmp_path / "tex").mkdir()
    write_image(tmp_path / "tex/c.png", Image(np.full((16, 16, 3), 0.5)))
    mesh, image = str(tmp_path / "a.obj"), str(tmp_path / "tex/c.png")
    assert main(["straighten", mesh, image, "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/a.mtl").read_text() == "newmtl A\nmap_Kd c.png\n"
    straight = read_looks(tmp_path / "out/a.obj")
    assert straight is not None and straight.libraries == (tmp_path / "out/a.mtl",) and straight.names == ("A", "B")
    assert main(["decimate", mesh, "-o", str(tmp_path / "low.obj"), "--faces", str(len(surface.faces) // 2)]) == 0
    low = read_looks(tmp_path / "low.obj")
    assert low is not None and low.libraries == (tmp_path / "a.mtl",) and low.smooth
    assert set(low.names) <= {"A", "B"} and (low.face_materials >= 0).all()
