"""Meshes of very many charts and textures of very many texels: what bounds the time and the memory of a build."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from builders_erase import make_cube, paint
from scipy import sparse

from preprocess.erase import EraseOptions, erase_mips, plan_erasure
from preprocess.erase.mips import is_crowded
from preprocess.mesh.seams import find_seams
from preprocess.numerics.cholesky import factor_symmetric
from preprocess.numerics.nested_dissection import order_by_dissection

eraser = importlib.import_module("preprocess.erase.eraser")
solve = importlib.import_module("preprocess.erase.solve")


def grid_system(side: int) -> tuple[sparse.csc_array, np.ndarray]:
    """Stiffness and mass of a square grid, and where its nodes lie."""
    line = sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(side, side))
    eye = sparse.eye_array(side)
    matrix = sparse.csc_array(sparse.kron(line, eye) + sparse.kron(eye, line) + 0.01 * sparse.eye_array(side * side))
    y, x = np.divmod(np.arange(side * side), side)
    return matrix, np.stack([x, y, 0 * x], axis=1).astype(float)


@pytest.mark.parametrize("channels", [1, 3, 12])
def test_a_dissected_system_has_the_same_solution(channels: int) -> None:
    matrix, points = grid_system(40)
    order = order_by_dissection(matrix, points)
    np.testing.assert_array_equal(np.sort(order), np.arange(1600))
    wanted = np.random.default_rng(0).normal(size=(1600, channels))
    factor = factor_symmetric(matrix, order)
    np.testing.assert_allclose(factor.solve(matrix @ wanted), wanted, atol=1e-10)


def test_dissection_keeps_the_factor_small() -> None:
    matrix, points = grid_system(100)
    scattered = factor_symmetric(matrix, np.random.default_rng(0).permutation(len(points)))
    dissected = factor_symmetric(matrix, order_by_dissection(matrix, points))
    by_degree = factor_symmetric(matrix)
    assert dissected.lu.nnz < 2.2 * by_degree.lu.nnz
    assert dissected.lu.nnz < 0.1 * scattered.lu.nnz


def test_dissection_of_points_in_one_place_ends() -> None:
    matrix, _ = grid_system(25)
    order = order_by_dissection(matrix, np.zeros((625, 3)))
    np.testing.assert_array_equal(np.sort(order), np.arange(625))


def test_many_unknowns_are_erased_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = make_cube()
    seams, texels = find_seams(surface), paint(96, 96)
    usual = plan_erasure(surface, seams, 96, 96).erase(texels)
    monkeypatch.setattr(solve, "MANY_UNKNOWNS", 1000)
    plan = plan_erasure(surface, seams, 96, 96)
    assert plan.is_large and plan.factor is not None and plan.factor.lu.order is not None
    np.testing.assert_allclose(plan.erase(texels).texels, usual.texels, atol=1e-6)


def test_many_unknowns_are_solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = make_cube()
    seams = find_seams(surface)
    sizes: list[int] = []
    texels = np.where(paint(96, 96) > 0.5, 1.0, 0.0)  # leaves its range where it is made smooth
    monkeypatch.setattr(solve, "MANY_UNKNOWNS", 1000)

    def note_size(factor: solve.Factor, bounded: np.ndarray) -> object:
        sizes.append(factor.jump.shape[1])
        return solve.factorise_bounded(factor, bounded)

    monkeypatch.setattr(eraser, "factorise_bounded", note_size)
    options = EraseOptions(seam_weight=3e9, jump_limit=0.2 / 255)
    levels = erase_mips(texels, surface, seams, options, levels=255)
    assert levels[0].is_large and not levels[-1].is_large
    assert sizes and max(sizes) <= 1000
    assert levels[0].stored.rms.max() < 0.1 * levels[0].before.rms.max()


def test_chains_end_where_charts_are_less_than_a_texel(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = make_cube(size_uv=0.02)
    seams = find_seams(surface)
    assert not is_crowded(surface, seams, 128, 128)
    assert not is_crowded(surface, seams, 32, 32)  # few texels cost nothing
    monkeypatch.setattr("preprocess.erase.mips.FEW_TEXELS", 16)
    assert is_crowded(surface, seams, 32, 32)
    sizes = [level.texels.shape[0] for level in erase_mips(paint(128, 128), surface, seams, levels=255)]
    assert sizes == [128, 64]
