"""The tools on plain arrays: types and shapes of callers, the same results as the commands, refusals in one line."""

from __future__ import annotations

import doctest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from preprocess import api
from preprocess.files.obj import read_obj, write_obj
from preprocess.mesh.surface import TexturedSurface

POSITIONS = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)]
FACES = [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)]
UVS = [(0.1, 0.1), (0.4, 0.12), (0.41, 0.5), (0.1, 0.5), (0.6, 0.2), (0.9, 0.2), (0.9, 0.6), (0.62, 0.57)]
FACE_UVS = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
MESH = (POSITIONS, FACES, UVS, FACE_UVS)


def noise(dtype: Any, *shape: int) -> np.ndarray:
    values = np.random.default_rng(5).random(shape)
    return (values * np.iinfo(dtype).max).astype(dtype) if np.dtype(dtype).kind == "u" else values.astype(dtype)


def test_examples_of_the_docstrings() -> None:
    assert doctest.testmod(api).failed == 0


@pytest.mark.parametrize("kind", [np.int64, np.uint16, np.int32])
def test_any_integers_are_indices(kind: Any) -> None:
    seams = api.find_seams(POSITIONS, np.array(FACES, kind), UVS, np.array(FACE_UVS, kind))
    assert seams.vertices.tolist() == [[1, 4]] and len(seams.boundary_vertices) == 6
    assert seams.lengths == pytest.approx([1.0])
    # Both sides run from vertex 1 to vertex 4.
    assert {tuple(side) for side in seams.uv_pairs[0].tolist()} == {(1, 2), (4, 7)}


@pytest.mark.parametrize("dtype,step", [(np.uint8, 0.5), (np.uint16, 1.5), (np.float32, 1e-4), (np.float64, 1e-5)])
@pytest.mark.parametrize("shape", [(40, 56), (40, 56, 1), (40, 56, 4)])
def test_images_come_back_in_their_shape_and_type(dtype: Any, step: float, shape: tuple[int, ...]) -> None:
    image = noise(dtype, *shape)
    kept = image.copy()
    found = api.erase(image, *MESH)
    assert np.array_equal(image, kept)  # what was given stays
    assert found.image.shape == shape and found.image.dtype == dtype
    assert found.before.max.max() > 100 * step and found.after.max.max() < step
    again = api.measure_seams(found.image, *MESH)
    assert np.allclose(again.max, found.after.max) and np.allclose(again.rms, found.after.rms)


def test_seams_that_are_not_joined_stay() -> None:
    image = noise(np.uint8, 32, 32, 3)
    found = api.erase(image, *MESH, joined=[False])
    assert np.array_equal(found.image, image)


def test_uvs_alone_need_no_second_indices() -> None:
    square = ([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)], [(0, 0), (1, 0), (1, 1), (0, 1)])
    seams = api.find_seams(*square)
    assert len(seams.vertices) == 0 and len(seams.boundary_vertices) == 4


def grid(side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat square of 2 side² triangles, its uvs a square as well: everything inside may collapse."""
    line = np.linspace(0.0, 1.0, side + 1)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    a, b, c, d = corner, corner + 1, corner + side + 2, corner + side + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x, y, np.zeros_like(x)], axis=1), faces, np.stack([x, 1 - y], axis=1)


def test_decimate_keeps_a_square_square() -> None:
    positions, faces, uvs = grid(8)
    found = api.decimate(positions, faces, uvs, num_faces=2)
    assert len(found.faces) == 2 and len(found.face_source) == 2
    corners = found.positions[found.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(1.0)
    within = api.decimate(positions, faces, uvs, error=0.01)
    assert len(within.faces) <= 2 + len(faces) / 10 and within.error <= 0.01


def test_straighten_keeps_the_surface() -> None:
    found = api.straighten(*MESH, tolerance=0.02)
    assert found.num_edges >= found.num_runs > 0
    assert len(found.uvs) == len(found.old_uvs) and len(found.faces) == len(found.face_source)
    assert np.allclose(found.positions[: len(POSITIONS)], POSITIONS)


@pytest.mark.parametrize(
    "change,what",
    [
        ({"faces": np.array(FACES) + 1}, "count from 0"),
        ({"faces": np.array(FACES) - 1}, "faces must lie in 0 … 5"),
        ({"faces": np.array(FACES, float)}, "faces must be an array of integers"),
        ({"faces": FACES[:3]}, "one row per face"),
        ({"positions": np.full((6, 3), np.nan)}, "not finite"),
        ({"positions": np.zeros((6, 2))}, "positions must be an array of numbers of shape"),
        ({"uvs": np.zeros((8, 3))}, "uvs must be an array of numbers of shape"),
        ({"face_uvs": None}, "give face_uvs"),
        ({"face_uvs": np.full((4, 3), 99)}, "face_uvs must lie in 0 … 7"),
    ],
)
def test_malformed_arrays_are_refused_in_one_line(change: dict[str, Any], what: str) -> None:
    arrays = {"positions": POSITIONS, "faces": FACES, "uvs": UVS, "face_uvs": FACE_UVS} | change
    for call in (api.find_seams, lambda **kept: api.erase(noise(np.uint8, 8, 8), **kept), api.straighten):
        with pytest.raises(ValueError) as refusal:
            call(**arrays)  # type: ignore[operator]
        assert what in str(refusal.value) and "\n" not in str(refusal.value) and len(str(refusal.value)) < 300


@pytest.mark.parametrize(
    "image", [np.zeros(4), np.zeros((4, 0, 3)), np.zeros((4, 4), np.int32), np.full((4, 4), np.nan)]
)
def test_malformed_images_are_refused(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match="an image"):
        api.erase(image, *MESH)


@pytest.mark.parametrize("options", [{}, {"num_faces": 2, "error": 0.1}, {"num_faces": 2, "strict": "very"}])
def test_decimate_wants_one_target(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        api.decimate(*MESH, **options)


def test_meshes_of_files_are_arrays_too(tmp_path: Path) -> None:
    surface = TexturedSurface(
        np.array(POSITIONS, float), np.array(FACES, np.int32), np.array(UVS), np.array(FACE_UVS, np.int32)
    )
    write_obj(tmp_path / "mesh.obj", surface)
    read = read_obj(tmp_path / "mesh.obj")
    seams = api.find_seams(read.positions, read.faces, read.uvs, read.face_uvs)
    assert len(seams.vertices) == 1
