"""Seam erasure as a whole: exact, as the dense solution, in range as stored, at every mip level, on hard meshes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from preprocess.erase import (
    GLOBAL,
    LOCAL,
    EraseOptions,
    Weights,
    choose_color_seams,
    choose_normal_seams,
    draw_decision,
    erase,
    measure_seams,
    plan_erasure,
)
from preprocess.erase import eraser as eraser_module
from preprocess.erase import prepare as plan_module
from preprocess.erase.energies import inward_normals, jump_rows, lerp_targets, sample_rows, slope_rows, value_rows
from preprocess.erase.matrix import GRADIENT_MASS
from preprocess.erase.solve import NotConvergedError
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from tests.builders_erase import MESHES, make_square, paint
from tests.test_erase_terms import full_matrix


def dense_solution(plan, image: np.ndarray, samples=None) -> np.ndarray:
    """Minimise the same energies over all used texels of the full grid."""
    height, width, channels = image.shape
    weights, region = plan.options.weights, plan.region
    p0 = image.reshape(-1, channels)
    matrix = full_matrix(
        region, weights.change / region.num_inside, weights.inside_gradient * GRADIENT_MASS,
        weights.outside_gradient * GRADIENT_MASS,
    )  # fmt: skip
    pull = full_matrix(region, 0.0, 0.0, weights.outside_gradient * GRADIENT_MASS)
    force = -pull @ p0
    terms = [(weights.slope, slope_rows(
        plan.intervals, plan.lengths_m, inward_normals(plan.surface, plan.seams, width, height)), 0.0)]  # fmt: skip
    if plan.options.seam_value != "none":
        lengths = plan_module._silhouette_lengths(plan.surface, plan.seams)
        rows, scale = value_rows(plan.silhouette, lengths)
        target = rows @ p0
        if plan.options.seam_value == "lerp":
            nodes = p0[plan.grid.nodes]
            target = lerp_targets(plan.silhouette, scale, plan._own_end_values(nodes))
        terms.append((weights.value, rows, target))
    if samples is not None:
        uvs, values = samples
        terms.append((weights.samples, sample_rows(uvs, width, height), values / np.sqrt(len(uvs))))
    for weight, rows, target in terms:
        dense = rows.toarray()
        matrix += weight * dense.T @ dense
        force += weight * dense.T @ (target - dense @ p0)
    jump = jump_rows(plan.intervals, plan.lengths_m).toarray()
    used = np.flatnonzero(region.used.ravel())
    force -= plan.options.seam_weight * jump.T @ (jump @ p0)
    matrix += plan.options.seam_weight * jump.T @ jump
    solution = p0.copy()
    solution[used] += np.linalg.solve(matrix[np.ix_(used, used)], force[used])
    return solution.reshape(image.shape)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("size", [(24, 24), (40, 16), (8, 8)])
@pytest.mark.parametrize("weights", [LOCAL, GLOBAL], ids=["local", "global"])
def test_seams_vanish(name, size, weights):
    surface = MESHES[name]
    seams = find_seams(surface)
    image = paint(*size)
    erased = erase(image, surface, seams, EraseOptions(weights=weights))
    assert (erased.after <= 1e-11).all() and (erased.before > 1e-6).all()
    measured = measure_seams(erased.texels, surface, seams)
    np.testing.assert_allclose(measured.total, erased.after, rtol=1e-3, atol=1e-20)
    assert measured.max.max() < 1e-4
    np.testing.assert_allclose(measure_seams(image, surface, seams).total, erased.before, rtol=1e-9)


@pytest.mark.parametrize("seam_value", ["none", "texture", "lerp"])
@pytest.mark.parametrize("name", ["pair", "cube"])
def test_solution_equals_dense_solve(name, seam_value, monkeypatch):
    monkeypatch.setattr(plan_module, "_reaches", lambda weights, num: (40, 21))  # all texels are unknowns
    surface = MESHES[name]
    seams = find_seams(surface)
    image = paint(26, 22, channels=2)
    plan = plan_erasure(surface, seams, 26, 22, EraseOptions(seam_value=seam_value, seam_weight=1e6))
    np.testing.assert_allclose(plan.erase(image).texels, dense_solution(plan, image), atol=1e-6)


def test_samples_hold_known_values(monkeypatch):
    monkeypatch.setattr(plan_module, "_reaches", lambda weights, num: (40, 21))
    surface = MESHES["pair"]
    seams = find_seams(surface)
    image = paint(26, 22, channels=1)
    uvs = surface.uvs
    values = np.array([0.2, 0.4, 0.6, 0.4, 0.6, 0.9])[:, None]
    plan = plan_erasure(surface, seams, 26, 22, EraseOptions(seam_weight=1e6), sample_uvs=uvs)
    erased = plan.erase(image, sample_values=values)
    np.testing.assert_allclose(erased.texels, dense_solution(plan, image, (uvs, values)), atol=1e-6)
    free = erase(image, surface, seams).texels
    missed, held = (np.abs(sample_bilinear(t, uvs) - values).max() for t in (free, erased.texels))
    assert held < 0.1 * missed
    with pytest.raises(ValueError, match="samples"):
        plan.erase(image)


def test_coarse_solution_agrees_with_the_full_grid(monkeypatch):
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = ndimage.gaussian_filter(paint(128, 128), (2, 2, 0))
    for weights in (LOCAL, GLOBAL):
        plan = plan_erasure(surface, seams, 128, 128, EraseOptions(weights=weights))
        with monkeypatch.context() as patch:
            patch.setattr(plan_module, "_reaches", lambda weights, num: (100, 51))
            full = plan_erasure(surface, seams, 128, 128, EraseOptions(weights=weights))
        assert len(plan.grid.nodes) < len(full.grid.nodes)
        difference = plan.erase(image).texels - full.erase(image).texels
        silhouette = np.zeros((128, 128), bool)
        silhouette.ravel()[plan.region.cells] = True
        away = ndimage.distance_transform_cdt(~silhouette, "chessboard") >= 4
        assert np.abs(difference[plan.region.inside]).max() < 1 / 255
        assert np.abs(difference[plan.region.inside & away]).max() < 0.5 / 255


def test_constants_and_sums_survive():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    constant = np.full((32, 32, 1), 0.37)
    np.testing.assert_allclose(erase(constant, surface, seams).texels, constant, atol=1e-8)
    parts = paint(32, 32, channels=4)
    parts /= parts.sum(axis=2, keepdims=True)
    np.testing.assert_allclose(erase(parts, surface, seams).texels.sum(axis=2), 1.0, atol=1e-7)


def test_unused_texels_stay_and_input_is_not_changed():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = paint(64, 64)
    kept = image.copy()
    plan = plan_erasure(surface, seams, 64, 64)
    erased = plan.erase(image).texels
    np.testing.assert_array_equal(image, kept)
    np.testing.assert_array_equal(erased[~plan.region.used], image[~plan.region.used])


def test_many_channels_are_solved_as_each_alone():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = paint(32, 24, channels=5)
    plan = plan_erasure(surface, seams, 32, 24)
    together = plan.erase(image).texels
    alone = np.concatenate([plan.erase(image[:, :, c : c + 1]).texels for c in range(5)], axis=2)
    np.testing.assert_allclose(together, alone, atol=1e-5)
    again = plan.erase(image).texels
    np.testing.assert_array_equal(together, again)


def test_global_reaches_further_than_local():
    surface = MESHES["pair"]
    seams = find_seams(surface)
    image = np.zeros((128, 128, 1))
    image[:, 64:] = 0.5
    inside = plan_erasure(surface, seams, 128, 128).region.inside
    local, everywhere = (
        np.abs(erase(image, surface, seams, EraseOptions(weights=w)).texels - image)[inside] for w in (LOCAL, GLOBAL)
    )
    assert (everywhere > 0.01).sum() > 3 * (local > 0.01).sum()


def test_only_joined_seams_are_closed():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = paint(64, 64)
    joined = np.arange(len(seams.vertices)) % 2 == 0
    texels = erase(image, surface, seams, EraseOptions(joined=joined)).texels
    left = measure_seams(texels, surface, seams).seam_rms.max(axis=1)
    assert left[joined].max() < 1e-5 and left[~joined].min() > 1e-3
    nothing = erase(image, surface, seams, EraseOptions(joined=np.zeros(len(joined), bool)))
    np.testing.assert_array_equal(nothing.texels, image)


def test_a_finite_seam_weight_leaves_a_little():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = paint(64, 64)
    soft, hard = (erase(image, surface, seams, EraseOptions(seam_weight=w)) for w in (1e6, None))
    assert (hard.after < soft.after).all() and (soft.after < 1e-3 * soft.before).all()


def test_mesh_without_seams_returns_the_input():
    surface = make_square()
    image = paint(20, 20)
    erased = erase(image, surface, find_seams(surface))
    np.testing.assert_array_equal(erased.texels, image)
    assert erased.repeats == 0


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 5)])
def test_tiny_images(size):
    surface = MESHES["cube"]
    seams = find_seams(surface)
    erased = erase(paint(*size), surface, seams)
    assert np.isfinite(erased.texels).all() and (erased.after <= 1e-11).all()


@pytest.mark.parametrize("repeat", [False, True])
def test_uvs_outside_the_image(repeat):
    surface = dataclasses.replace(MESHES["cube"], uvs=MESHES["cube"].uvs + np.array([0.43, -0.21]))
    seams = find_seams(surface)
    erased = erase(paint(40, 32), surface, seams, EraseOptions(repeat=repeat))
    assert (erased.after <= 1e-11).all()
    assert measure_seams(erased.texels, surface, seams, repeat=repeat).max.max() < 1e-4
    if repeat:  # moving by whole images changes nothing
        moved = dataclasses.replace(surface, uvs=surface.uvs + np.array([1.0, -2.0]))
        same = erase(paint(40, 32), moved, seams, EraseOptions(repeat=True))
        np.testing.assert_allclose(same.texels, erased.texels, atol=1e-5)


def test_degenerate_edges_and_overlaps():
    cube = MESHES["cube"]
    uvs = cube.uvs.copy()
    uvs[4:8] = uvs[4]  # a chart shrunk to a point
    uvs[8:12] = uvs[0:4]  # two charts on the same texels
    uvs[13] = uvs[12]  # a zero-length uv edge
    positions = cube.positions.copy()
    positions[1] = positions[0]  # a zero-length 3D edge
    surface = TexturedSurface(positions, cube.faces, uvs, cube.face_uvs)
    seams = find_seams(surface)
    erased = erase(paint(32, 32), surface, seams)
    assert np.isfinite(erased.texels).all() and (erased.after <= 1e-11).all()


def test_refusals():
    surface = MESHES["pair"]
    seams = find_seams(surface)
    plan = plan_erasure(surface, seams, 16, 16)
    with pytest.raises(ValueError, match="planned for"):
        plan.erase(np.zeros((8, 16, 1)))
    broken = np.zeros((16, 16, 1))
    broken[3, 4] = np.nan
    with pytest.raises(ValueError, match="finite"):
        plan.erase(broken)


def test_not_converging_is_an_error(monkeypatch):
    monkeypatch.setattr(eraser_module, "TOLERANCE_REL", 0.0)
    monkeypatch.setattr("preprocess.erase.solve.MAX_REPEATS", 2)
    with pytest.raises(NotConvergedError):
        erase(paint(24, 24), MESHES["cube"], find_seams(MESHES["cube"]))


def test_painted_borders_and_creases_are_left():
    surface = MESHES["pair"]
    seams = find_seams(surface)
    image = np.zeros((32, 32, 3))
    image[:, 16:] = 0.4
    assert choose_color_seams(image, surface, seams).joined.all()
    assert choose_color_seams(image, surface, seams, 0.5).joined.all()
    decision = choose_color_seams(image, surface, seams, 0.3)
    assert decision.num_left == 1 and decision.difference[0] == pytest.approx(0.4, rel=1e-6)
    assert choose_color_seams(image, surface, seams, 0.3, made_here=np.ones(1, bool)).joined.all()

    normals = np.zeros((2, 3, 3))
    normals[..., 2] = 1.0
    assert choose_normal_seams(surface, seams, normals).joined.all()
    normals[1] = [0, np.sin(0.2), np.cos(0.2)]
    hard = choose_normal_seams(surface, seams, normals)
    assert hard.num_left == 1 and hard.difference[0] == pytest.approx(0.2)
    assert choose_normal_seams(surface, seams, normals, 0.3).joined.all()

    picture = draw_decision(image, surface, seams, decision)
    assert picture.shape == image.shape
    assert ((picture[..., 0] - picture[..., 1]) > 0.5).sum() > 10, "the seam left is drawn red"


def test_weights_can_be_set():
    surface = MESHES["pair"]
    seams = find_seams(surface)
    image = paint(48, 48)
    stiff = erase(image, surface, seams, EraseOptions(weights=Weights(change=1e6))).texels
    loose = erase(image, surface, seams, EraseOptions(weights=Weights(change=1e1))).texels
    inside = plan_erasure(surface, seams, 48, 48).region.inside
    assert np.abs(stiff - image)[inside].sum() < np.abs(loose - image)[inside].sum()


def test_seams_along_texel_centres_read_cells_of_the_region():
    """Rounding decides between the cells beside such an edge, differently for the pair and for one side alone."""
    num_columns, size_px = 9, 64
    row = num_columns + 1
    left = np.arange(num_columns)
    positions = np.array([[x, y, 0.0] for y in range(3) for x in range(row)])
    quads = np.stack([left, left + 1, left + row + 1, left + row], axis=1)
    quads = np.concatenate([quads, quads + row])
    uv_quads = quads.copy()
    uv_quads[num_columns:] += row  # the middle row is twice in uv: a seam
    for seed in range(6):
        x = np.sort(np.random.default_rng(seed).uniform(5, 60, row))
        rows_px = [np.full(row, 5.0), np.full(row, 20.0), 30 + 4 * np.sin(x), 50 + 4 * np.sin(x)]
        surface = TexturedSurface(
            positions,
            np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32),
            (np.concatenate([np.stack([x, y], axis=1) for y in rows_px]) + 0.5) / size_px,
            np.concatenate([uv_quads[:, [0, 1, 2]], uv_quads[:, [0, 2, 3]]]).astype(np.int32),
        )
        plan = plan_erasure(surface, find_seams(surface), size_px, size_px)
        assert np.isin(plan.intervals.texels[:, :, 0], plan.region.cells).all()
