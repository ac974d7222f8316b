"""Seams of files with few decimals: straight as far as was written is straight, and nothing is refused for less."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from preprocess.cli import main
from preprocess.decimate import DecimateOptions, decimate_to
from preprocess.decimate.measure import make_reference, measure
from preprocess.decimate.seam_precision import MOST_UV, straighten_within, uv_step, written_tolerance_uv
from preprocess.decimate.topology import build_half_edges, source_uvs
from preprocess.errors import InputError
from preprocess.files.obj import read_obj, write_obj
from preprocess.mesh.surface import TexturedSurface
from tests.builders_decimate import square
from tests.builders_straighten import grid_faces, weld_uvs


def wrapped(around: int, along: int, place: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> TexturedSurface:
    """A grid of uvs whose points of space are welded where they meet."""
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0.0, 1.0, around + 1), np.linspace(0.0, 1.0, along + 1)))
    points, faces = place(u, v), grid_faces(around, along)
    _, first, inverse = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    # Turned and shrunk: no side of the square is along an axis, so every uv along a side is rounded.
    turned = np.stack([0.3 + 0.4 * u - 0.21 * v, 0.1 + 0.21 * u + 0.4 * v], axis=1)
    return weld_uvs(points[first], inverse.ravel()[faces].astype(np.int32), turned[faces])


def tube(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), 3.0 * v], axis=1)


def torus(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    radius = 1.0 + 0.4 * np.cos(2 * np.pi * v)
    ring = np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)]) * radius
    return np.stack([*ring, 0.4 * np.sin(2 * np.pi * v)], axis=1)


def rounded(surface: TexturedSurface, decimals: int) -> TexturedSurface:
    return TexturedSurface(surface.positions, surface.faces, np.round(surface.uvs, decimals), surface.face_uvs)


@pytest.mark.parametrize("decimals", [6, 7, 15])
@pytest.mark.parametrize(
    ("place", "fewest"),
    # A plane is two faces. Each rim of a tube is a triangle, and so is each seam of a torus: two times three quads of
    # one strip, and nine quads, of two faces each.
    [(lambda u, v: np.stack([u, v, 0.05 * np.sin(5 * u)], axis=1), 2), (tube, 6), (torus, 18)],
)
def test_rounded_uvs_reach_the_same_faces(
    place: Callable[[np.ndarray, np.ndarray], np.ndarray], fewest: int, decimals: int
) -> None:
    surface = rounded(wrapped(36, 24, place), decimals)
    lod = decimate_to(surface, 1).lods[0]
    assert lod.num_faces == fewest
    assert np.isfinite(lod.positions).all() and np.isfinite(lod.uvs).all()


def test_the_step_is_what_most_were_written_with() -> None:
    exact = np.random.default_rng(1).random((500, 2))
    assert uv_step(np.round(exact, 4)) == pytest.approx(1e-4)
    assert uv_step(np.round(exact, 6)) == pytest.approx(1e-6)
    some = np.round(exact, 6)
    some[::20] = np.round(exact[::20], 7)
    assert uv_step(some) == pytest.approx(1e-6)
    six_digits = np.array([[float(f"{x:.6g}") for x in row] for row in exact])
    assert uv_step(six_digits) == pytest.approx(1e-6)
    assert uv_step(exact.astype(np.float32).astype(np.float64)) == pytest.approx(2.0**-24, rel=0.01)
    assert uv_step(exact) == 0.0 and uv_step(np.zeros((3, 2))) == 0.0
    assert written_tolerance_uv(np.round(exact, 2)) == MOST_UV


def test_no_uv_moves_further_than_the_tolerance_and_no_face_folds() -> None:
    surface = rounded(wrapped(36, 24, tube), 6)
    half_edges, _ = build_half_edges(surface)
    uvs = source_uvs(half_edges, surface)
    moved = straighten_within(half_edges, surface.positions, uvs, 2e-6)
    assert 0.0 < np.abs(moved - uvs).max() <= 2e-6
    assert straighten_within(half_edges, surface.positions, uvs, 0.0) is uvs

    def areas(of: np.ndarray) -> np.ndarray:
        corners = of[half_edges.wedge[: 3 * half_edges.num_faces].reshape(-1, 3)]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]

    assert (np.sign(areas(moved)) == np.sign(areas(uvs))).all()


def test_a_seam_tolerance_in_texels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Seams that waver by a fifth of a texel of 1024 are straight to a half, and not to a tenth."""
    surface = wrapped(36, 24, tube)
    shaken = np.random.default_rng(2).uniform(-0.2 / 1024, 0.2 / 1024, surface.uvs.shape)
    write_obj(
        tmp_path / "tube.obj", TexturedSurface(surface.positions, surface.faces, surface.uvs + shaken, surface.face_uvs)
    )
    reached = []
    for texels in ("0.1", "0.8"):
        arguments = ["decimate", str(tmp_path / "tube.obj"), "--faces", "1", "--seam-tolerance", texels]
        assert main([*arguments, "-o", str(tmp_path / "out.obj")]) == 0
        reached.append(len(read_obj(tmp_path / "out.obj").faces))
    assert reached[1] == 6 < reached[0]
    assert main(["decimate", str(tmp_path / "tube.obj"), "--faces", "1", "--seam-tolerance", "-1", "-o", "x.obj"]) == 2
    assert "--seam-tolerance" in capsys.readouterr().err


def test_only_what_faces_use_matters() -> None:
    surface = square(4)
    for far in (1e308, np.nan):
        positions = np.concatenate([surface.positions, np.full((2, 3), far)])
        uvs = np.concatenate([surface.uvs, np.full((2, 2), far)])
        lod = decimate_to(TexturedSurface(positions, surface.faces, uvs, surface.face_uvs), 8).lods[0]
        assert np.isfinite(lod.positions).all() and lod.positions.max() <= 1.0
        with pytest.raises(InputError, match="positions are not finite or beyond"):
            used = surface.positions.copy()
            used[3] = far
            decimate_to(TexturedSurface(used, surface.faces, surface.uvs, surface.face_uvs), 8)


def test_a_file_with_six_decimals_stays_near_below_its_crooked_corners(asset_path: Callable[[str], Path]) -> None:
    """All but 35 of blub's seam points are straight and matched to the six decimals that were written."""
    surface = read_obj(asset_path("blub.obj"))
    reference = make_reference(surface)
    for faces, most_rel in ((710, 0.00087), (400, 0.0013)):
        lod = decimate_to(surface, faces).lods[0]
        assert lod.num_faces <= faces and measure(reference, lod).mean_m < most_rel * surface.diagonal_m
    assert decimate_to(surface, 1, DecimateOptions(seam_tolerance_uv=0.0)).lods[0].num_faces > 390
