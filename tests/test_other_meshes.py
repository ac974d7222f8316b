"""Meshes of other formats: the same surface as the OBJ says, seams found, refusals in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from preprocess.errors import InputError
from preprocess.files.obj import read_obj
from preprocess.load.read_surface import read_surface
from preprocess.mesh.seams import find_seams

trimesh = pytest.importorskip("trimesh")

# Two squares side by side whose common edge is a seam: the second chart lies elsewhere.
OBJ = """v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0
vt .1 .1\nvt .4 .1\nvt .4 .5\nvt .1 .5\nvt .6 .2\nvt .9 .2\nvt .9 .6\nvt .6 .6
f 1/1 2/2 5/3\nf 1/1 5/3 4/4\nf 2/5 3/6 6/7\nf 2/5 6/7 5/8
"""
POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0)]
UVS = [(0.1, 0.1), (0.4, 0.1), (0.4, 0.5), (0.1, 0.5), (0.6, 0.2), (0.9, 0.2), (0.9, 0.6), (0.6, 0.6)]
FACES = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]


def corners(surface) -> list[list[float]]:
    """Positions and uvs of all corners, by face: what two readings have in common whatever their numbering."""
    rows = np.concatenate([surface.positions[surface.faces], surface.uvs[surface.face_uvs]], axis=2)
    return np.round(rows.reshape(len(surface.faces), -1), 6).tolist()


@pytest.mark.parametrize("suffix", ["ply", "dae", "3mf"])
def test_other_formats_are_the_same_surface(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "mesh.obj").write_text(OBJ)
    mesh = trimesh.Trimesh(POINTS, FACES, process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.array(UVS))
    path = tmp_path / f"mesh.{suffix}"
    try:
        mesh.export(path)
        trimesh.load_scene(path, process=False)
    except (ImportError, ValueError) as error:
        pytest.skip(f"trimesh does not write {suffix} here: {error}")
    if suffix == "3mf":  # trimesh writes none of a 3MF's texture coordinates
        with pytest.raises(InputError, match="no texture coordinates"):
            read_surface(path)
        return
    surface = read_surface(path)
    expected = read_obj(tmp_path / "mesh.obj")
    assert corners(surface) == corners(expected)
    assert len(surface.positions) == 6 and len(find_seams(surface).vertices) == 1


@pytest.mark.parametrize("suffix", ["ply", "off", "dae", "3mf", "stl"])
@pytest.mark.parametrize(
    "content", [b"", b"nonsense\n", b"ply\nformat ascii 1.0\nelement vertex 9\n", b"OFF\n3 1 0\n0 0"]
)
def test_damaged_files_end_in_one_line(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError) as refusal:
        read_surface(path)
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 300


def test_a_mesh_without_uvs_is_refused(tmp_path: Path) -> None:
    trimesh.Trimesh(POINTS, FACES, process=False).export(tmp_path / "plain.off")
    with pytest.raises(InputError, match="no texture coordinates"):
        read_surface(tmp_path / "plain.off")
