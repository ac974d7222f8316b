"""OBJ files in and out: separate indices survive, odd files are read, bad ones refused in one line."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from preprocess.errors import InputError
from preprocess.files.obj import read_obj, weld_texture_vertices, write_obj
from preprocess.load.read_surface import read_surface
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from runtime.gltf.limits import Limits
from tests.builders_decimate import box, two_strips

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "mesh.obj"
    path.write_bytes(text.encode())
    return path


def test_round_trip_is_exact(tmp_path: Path) -> None:
    surface = box(3)
    write_obj(tmp_path / "a.obj", surface)
    again = read_obj(tmp_path / "a.obj")
    np.testing.assert_array_equal(again.positions, surface.positions)
    np.testing.assert_array_equal(again.faces, surface.faces)
    np.testing.assert_array_equal(again.face_uvs, surface.face_uvs)
    np.testing.assert_allclose(again.uvs, surface.uvs, rtol=0, atol=1e-15)  # 1 - (1 - v)
    assert [path.name for path in tmp_path.iterdir()] == ["a.obj"]


def areas(surface: TexturedSurface) -> np.ndarray:
    corners = surface.positions[surface.faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def polygon_of(folder: Path, points: list[tuple[float, float]]) -> TexturedSurface:
    """One face over points of the plane z = 0, its uvs the points themselves."""
    lines = [f"v {x} {y} 0\nvt {x} {y}\n" for x, y in points]
    corners = " ".join(f"{n}/{n}" for n in range(1, len(points) + 1))
    return read_obj(write(folder, "".join(lines) + f"f {corners}\n"))


@pytest.mark.parametrize(
    ("points", "area"),
    [
        ([(0, 0), (4, 0), (4, 1), (1, 1), (1, 2), (4, 2), (4, 3), (0, 3)], 9.0),  # a C: its first corner sees all
        ([(4, 0), (4, 1), (1, 1), (1, 2), (4, 2), (4, 3), (0, 3), (0, 0)], 9.0),  # the same, its first sees little
        ([(0, 0), (2, 1), (0, 2), (1, 1)], 1.0),  # a dart, cut at its notch
        ([(2, 1), (0, 2), (1, 1), (0, 0)], 1.0),
        ([(4, 0), (4, 1), (3, 1), (2, 1), (1, 1), (1, 2), (4, 2), (4, 3), (2, 3), (0, 3), (0, 0), (2, 0)], 9.0),
    ],
)
def test_concave_polygons_are_covered_once(tmp_path: Path, points: list[tuple[float, float]], area: float) -> None:
    """By Gauss's formula for the area; corners in a line stay corners, so that neighbours that use them fit."""
    surface = polygon_of(tmp_path, points)
    assert len(surface.faces) == len(points) - 2
    assert (areas(surface)[:, 2] > 0).all()
    np.testing.assert_allclose(areas(surface)[:, 2].sum(), area, rtol=1e-12)
    assert set(surface.faces.ravel().tolist()) == set(range(len(points)))


def test_a_polygon_of_many_corners_in_a_line_stays_quick(tmp_path: Path) -> None:
    line = [(x / 100, 1.0) for x in range(2999, 0, -1)]
    points = [(0.0, 0.0), (30.0, 0.0), (30.0, 1.0), *line, (0.0, 1.0), (10.0, 0.5)]
    start = time.process_time()
    surface = polygon_of(tmp_path, points)
    assert time.process_time() - start < 2.0
    np.testing.assert_allclose(areas(surface)[:, 2].sum(), 30.0 - 5.0, rtol=1e-9)
    assert len(surface.faces) == len(points) - 2 and (areas(surface)[:, 2] > 0).all()


def test_polygons_that_cross_themselves_still_become_triangles(tmp_path: Path) -> None:
    assert len(polygon_of(tmp_path, [(0, 0), (1, 1), (1, 0), (0, 1)]).faces) == 2


def test_a_byte_order_mark_hides_no_line(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"\xef\xbb\xbf" + f"{TRIANGLE}v 5 5 5\nf 1/1 2/2 3/3\n".encode())
    assert read_obj(tmp_path / "a.obj").positions[[0, 3]].tolist() == [[0, 0, 0], [5, 5, 5]]


def test_comments_after_numbers_and_a_second_coordinate_that_is_left_out(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0 # second\nv 0 1 0\nvt 0\nvt 1 # u alone\nvt 0 1\nf 1/1 2/2 3/3\n"
    surface = read_obj(write(tmp_path, text))
    np.testing.assert_array_equal(surface.uvs, [[0, 1], [1, 1], [0, 0]])


def test_numbers_beyond_the_limits_matter_where_faces_use_them(tmp_path: Path) -> None:
    used = "f 1/1 2/2 3/3\n"
    surface = read_obj(write(tmp_path, TRIANGLE + "v 1e160 nan 0\nvt 1e30 0\n" + used))
    assert np.isfinite(surface.positions).all() and surface.faces.tolist() == [[0, 1, 2]]
    with pytest.raises(InputError, match="line 1: 1 'v' lines are not finite or beyond 1e"):
        read_obj(write(tmp_path, TRIANGLE.replace("v 0 0 0", "v 1e160 0 0") + used))
    with pytest.raises(InputError, match="line 4: 1 'vt' lines are not finite or beyond 65536"):
        read_obj(write(tmp_path, TRIANGLE.replace("vt 0 0", "vt 1e6 0") + used))
    assert read_obj(write(tmp_path, TRIANGLE.replace("vt 0 0", "vt 1e6 0") + used), Limits(uv=1e7)).uvs.max() == 1e6
    with pytest.raises(InputError, match="does not exist") as refusal:
        read_obj(write(tmp_path, TRIANGLE + f"f 1/1 2/2 {'9' * 5000}/3\n"))
    assert len(str(refusal.value)) < 300


def test_v_is_turned_down(tmp_path: Path) -> None:
    surface = read_obj(write(tmp_path, TRIANGLE + "f 1/1 2/2 3/3\n"))
    np.testing.assert_array_equal(surface.uvs, [[0, 1], [1, 1], [0, 0]])


@pytest.mark.parametrize(
    "faces",
    [
        "f 1/1 2/2 3/3\n",
        "f 1/1/1 2/2/1 3/3/1\n",
        "f -3/-3 -2/-2 -1/-1\n",
        "f 1/1\t2/2 \\\n 3/3\n",
        "  f   1/1 2/2 3/3  \r\n# comment\nusemtl x\ng y\n",
        "f 1/1/ 2/2/ 3/3/\n",
        "f 1/1 2/2 3/3 # the last\n",
        "f 1/1 \\  \n2/2 \\\n 3/3\n",
        "usemtl dir\\\nf 1/1 2/2 3/3\n",
        "# ends in \\\nf 1/1 2/2 3/3\n",
    ],
)
def test_spellings_of_one_triangle(tmp_path: Path, faces: str) -> None:
    surface = read_obj(write(tmp_path, TRIANGLE + "vn 0 0 1\n" + faces))
    assert surface.faces.tolist() == [[0, 1, 2]] == surface.face_uvs.tolist()


def test_negative_indices_count_from_their_own_line(tmp_path: Path) -> None:
    text = TRIANGLE + "f -3/-3 -2/-2 -1/-1\n" + "v 5 0 0\nv 6 0 0\nv 5 1 0\n" + "f -3/-3 -2/-2 -1/-1\n"
    assert read_obj(write(tmp_path, text)).faces.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_polygons_become_fans_and_colours_are_ignored(tmp_path: Path) -> None:
    text = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 1 1 0 1 0 0\nv 0 1 0 1 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    surface = read_obj(write(tmp_path, text + "f 1/1 2/2 3/3 4/4\n"))
    assert surface.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert surface.positions[2].tolist() == [1, 1, 0]


def test_repeated_uvs_are_one_texture_vertex_and_shared_ones_are_split(tmp_path: Path) -> None:
    """Two triangles with uvs written corner by corner: equal values at one vertex are no seam."""
    text = TRIANGLE + "v 1 1 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 2/4 4/5 3/6\n"
    surface = read_obj(write(tmp_path, text))
    assert len(surface.uvs) == 4
    assert not len(find_seams(surface).vertices)
    # Two separate triangles that use the same three vt: each vertex gets a texture vertex of its own.
    text = TRIANGLE + "v 5 0 0\nv 6 0 0\nv 5 1 0\nf 1/1 2/2 3/3\nf 4/1 5/2 6/3\n"
    assert len(read_obj(write(tmp_path, text)).uvs) == 6


def test_weld_keeps_seams() -> None:
    surface = two_strips()
    uvs, face_uvs = weld_texture_vertices(surface.faces, surface.uvs, surface.face_uvs)
    np.testing.assert_array_equal(uvs[face_uvs], surface.uvs[surface.face_uvs])
    assert len(uvs) == len(surface.uvs)
    empty_uvs, empty_faces = weld_texture_vertices(np.zeros((0, 3), np.int32), surface.uvs, np.zeros((0, 3), np.int32))
    assert empty_uvs.shape == (0, 2) and empty_faces.shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no faces"),
        (TRIANGLE, "no faces"),
        (TRIANGLE + "f 1 2 3\n", "no texture coordinates"),
        (TRIANGLE + "vn 0 0 1\nf 1//1 2//1 3//1\n", "no texture coordinates"),
        (TRIANGLE + "f 1/1 2/2\n", "line 7: a face needs three corners"),
        (TRIANGLE + "f 1/1 2/2 9/3\n", "vertex 9 does not exist"),
        (TRIANGLE + "f 1/1 2/2 3/9\n", "texture vertex 9 does not exist"),
        (TRIANGLE + "f -9/1 2/2 3/3\n", "vertex -9 does not exist"),
        (TRIANGLE + "f a/1 2/2 3/3\n", "no number"),
        ("v 0 0\n" + TRIANGLE + "f 1/1 2/2 3/3\n", "line 1: 'v' needs 3 numbers"),
        ("v nan 0 0\n" + TRIANGLE + "f 1/1 2/2 3/3\n", "line 1: 1 'v' lines are not finite"),
        ("vt 0 inf\n" + TRIANGLE + "f 1/1 2/2 3/3\n", "not finite"),
        ("\0\1\2" + TRIANGLE, "binary"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as refusal:
        read_obj(write(tmp_path, text))
    assert "\n" not in str(refusal.value)


def test_missing_files_and_other_kinds(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_surface(tmp_path / "none.obj")
    with pytest.raises(InputError, match="not a mesh that is read"):
        read_surface(tmp_path / "mesh.fbx")
    with pytest.raises(InputError, match="cannot be written"):
        write_obj(tmp_path / "nowhere" / "a.obj", box(1))


def test_blub(asset_path) -> None:  # type: ignore[no-untyped-def]
    surface = read_surface(asset_path("blub.obj"))
    assert (len(surface.positions), len(surface.uvs), len(surface.faces)) == (7106, 7317, 14208)
    assert len(find_seams(surface).vertices) == 208
