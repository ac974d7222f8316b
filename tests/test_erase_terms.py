"""Intervals, region and energies of seam erasure, against brute force."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from preprocess.erase.energies import (
    inward_normals,
    jump_rows,
    lerp_targets,
    sample_rows,
    slope_rows,
    value_rows,
)
from preprocess.erase.grid import _mark_near, build_grid
from preprocess.erase.intervals import MERGE_REL, _cut, cut_into_intervals
from preprocess.erase.matrix import GRADIENT_MASS, _square_elements, grid_matrix
from preprocess.erase.prolongation import _blend_square, _find_free, spread_far, spread_near
from preprocess.erase.region import find_inside, find_region, silhouette_lines
from preprocess.mesh.seams import find_seams
from preprocess.mesh.texels import px_to_uv, sample_bilinear, uv_to_px
from tests.builders_erase import make_cube, make_pair, make_square, paint

SIZES = [(16, 16), (31, 12), (8, 40)]


def cut_slowly(lines_px: np.ndarray) -> list[np.ndarray]:
    """Twin of `_cut`: all crossings of all axes, sorted; near ones merged."""
    cuts = []
    for sides in lines_px:
        gammas = [0.0, 1.0]
        for first, last in sides:
            for axis in range(2):
                a, b = first[axis], last[axis]
                if a != b:
                    lines = np.arange(np.ceil(min(a, b)), np.floor(max(a, b)) + 1)
                    gammas += [g for g in (lines - a) / (b - a) if 0 < g < 1]
        kept = [0.0]
        for g in sorted(gammas):
            if g > kept[-1] + MERGE_REL:
                kept.append(g)
        if kept[-1] > 1 - MERGE_REL:
            kept[-1] = 1.0
        cuts.append(np.array(kept))
    return cuts


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("repeat", [False, True])
def test_intervals_cover_edges_and_stay_in_cells(size, repeat):
    surface = make_cube()
    seams = find_seams(surface)
    pieces = cut_into_intervals(surface.uvs[seams.uv_pairs], *size, repeat=repeat)
    assert (pieces.end > pieces.start).all()
    for edge in range(len(seams.vertices)):
        mine = pieces.edges == edge
        assert pieces.start[mine][0] == 0.0 and pieces.end[mine][-1] == 1.0
        assert (pieces.start[mine][1:] == pieces.end[mine][:-1]).all()
    ends = pieces.fractions(np.stack([pieces.start, pieces.end], axis=1))
    assert ends.min() > -1e-9 and ends.max() < 1 + 1e-9


def test_cuts_equal_slow_twin():
    rng = np.random.default_rng(1)
    lines = rng.uniform(-3, 9, (40, 2, 2, 2))
    lines[0] = 2.0  # no length
    lines[1, 0] = [[1, 1], [4, 1]]  # along a texel line, from centre to centre
    lines[2, 1] = lines[2, 0]  # both sides equal
    lines[3, :, 1, 0] = lines[3, :, 0, 0]  # upright
    edges, start, end = _cut(lines)
    for e, expected in enumerate(cut_slowly(lines)):
        mine = edges == e
        np.testing.assert_allclose(np.append(start[mine], end[mine][-1]), expected, atol=1e-9)


def test_intervals_of_no_edges():
    pieces = cut_into_intervals(np.zeros((0, 2, 2, 2)), 8, 8)
    assert len(pieces) == 0 and pieces.texels.shape == (0, 2, 4)
    assert jump_rows(pieces, np.zeros(0)).shape == (0, 64)


def integrate(function, edges_lengths: np.ndarray, num: int = 20000) -> float:
    """Mean over the length of a function of (edge, gamma), by the midpoint rule."""
    gamma = (np.arange(num) + 0.5) / num
    parts = [function(e, gamma).mean() for e in range(len(edges_lengths))]
    return float(np.dot(parts, edges_lengths) / edges_lengths.sum())


@pytest.mark.parametrize("size", SIZES)
def test_jump_is_the_brute_force_integral(size):
    surface = make_cube()
    seams = find_seams(surface)
    image = paint(*size, channels=1)

    def squared_jump(edge, gamma):
        ends = surface.uvs[seams.uv_pairs[edge]]
        sides = [sample_bilinear(image, (1 - gamma)[:, None] * a + gamma[:, None] * b)[:, 0] for a, b in ends]
        return (sides[0] - sides[1]) ** 2

    rows = jump_rows(cut_into_intervals(surface.uvs[seams.uv_pairs], *size), seams.lengths_m)
    energy = float(np.sum((rows @ image.ravel()) ** 2))
    assert energy == pytest.approx(integrate(squared_jump, seams.lengths_m), rel=2e-5)


def test_jump_wraps_with_a_repeating_sampler():
    surface = make_pair(shift_uv=(0.75, 0.6))  # the second triangle runs over the image's right and lower edge
    seams = find_seams(surface)
    width = height = 12
    image = paint(width, height, channels=1)
    tiled = np.tile(image, (3, 3, 1))
    rows = jump_rows(cut_into_intervals(surface.uvs[seams.uv_pairs], width, height, repeat=True), seams.lengths_m)

    def squared_jump(edge, gamma):
        ends = (surface.uvs[seams.uv_pairs[edge]] + 1) / 3
        sides = [sample_bilinear(tiled, (1 - gamma)[:, None] * a + gamma[:, None] * b)[:, 0] for a, b in ends]
        return (sides[0] - sides[1]) ** 2

    energy = float(np.sum((rows @ image.ravel()) ** 2))
    assert energy == pytest.approx(integrate(squared_jump, seams.lengths_m), rel=2e-5)


@pytest.mark.parametrize("size", SIZES)
def test_slope_is_the_brute_force_integral(size):
    surface = make_cube()
    seams = find_seams(surface)
    image = paint(*size, channels=1)
    normals = inward_normals(surface, seams, *size)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1.0)
    centres = uv_to_px(surface.uvs[surface.face_uvs[seams.faces]].mean(axis=2), *size)
    middles = uv_to_px(surface.uvs[seams.uv_pairs].mean(axis=2), *size)
    assert (np.einsum("skd,skd->sk", normals, centres - middles) > 0).all(), "normals point into the faces"
    step = 1e-6

    def squared_slope(edge, gamma):
        total = 0.0
        for side in range(2):
            a, b = uv_to_px(surface.uvs[seams.uv_pairs[edge, side]], *size)
            points = (1 - gamma)[:, None] * a + gamma[:, None] * b
            ahead = sample_bilinear(image, px_to_uv(points + step * normals[edge, side], *size))
            behind = sample_bilinear(image, px_to_uv(points - step * normals[edge, side], *size))
            total = total + (ahead - behind)[:, 0] / (2 * step)
        return total**2

    rows = slope_rows(cut_into_intervals(surface.uvs[seams.uv_pairs], *size), seams.lengths_m, normals)
    energy = float(np.sum((rows @ image.ravel()) ** 2))
    assert energy == pytest.approx(integrate(squared_slope, seams.lengths_m), rel=1e-3)


def test_values_along_the_silhouette_are_the_brute_force_integral():
    surface = make_pair()
    seams = find_seams(surface)
    lines = silhouette_lines(surface, seams)
    lengths = np.linspace(1, 2, len(lines))
    image = paint(20, 14, channels=2)
    ends = np.random.default_rng(3).random((len(lines), 2, 2))
    pieces = cut_into_intervals(lines, 20, 14)
    rows, scale = value_rows(pieces, lengths)
    deviation = rows @ image.reshape(-1, 2) - lerp_targets(pieces, scale, ends)
    for channel in range(2):

        def squared(edge, gamma, channel=channel):
            a, b = lines[edge, 0]
            sampled = sample_bilinear(image, (1 - gamma)[:, None] * a + gamma[:, None] * b)[:, channel]
            return (sampled - (1 - gamma) * ends[edge, 0, channel] - gamma * ends[edge, 1, channel]) ** 2

        assert np.sum(deviation[:, channel] ** 2) == pytest.approx(integrate(squared, lengths), rel=2e-5)


def test_energy_gradients_equal_finite_differences():
    surface = make_cube()
    seams = find_seams(surface)
    pieces = cut_into_intervals(surface.uvs[seams.uv_pairs], 12, 9)
    normals = inward_normals(surface, seams, 12, 9)
    image = paint(12, 9, channels=1).ravel()
    direction = np.random.default_rng(5).normal(size=image.size)
    for rows in (jump_rows(pieces, seams.lengths_m), slope_rows(pieces, seams.lengths_m, normals)):
        gradient = 2 * (rows.T @ (rows @ image))
        ahead, behind = (np.sum((rows @ (image + s * direction)) ** 2) for s in (1e-4, -1e-4))
        assert (ahead - behind) / 2e-4 == pytest.approx(gradient @ direction, rel=1e-7)


def test_sample_rows_are_bilinear_samples():
    image = paint(9, 7, channels=2)
    uvs = np.random.default_rng(2).random((30, 2))
    sampled = sample_rows(uvs, 9, 7) @ image.reshape(-1, 2) * np.sqrt(30)
    np.testing.assert_allclose(sampled, sample_bilinear(image, uvs), atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_inside_equals_slow_twin(size):
    surface = make_cube()
    width, height = size
    expected = np.zeros((height, width), bool)
    y, x = np.mgrid[0:height, 0:width]
    for triangle in uv_to_px(surface.uvs, width, height)[surface.face_uvs]:
        signs = []
        for k in range(3):
            (ax, ay), (bx, by) = triangle[k], triangle[(k + 1) % 3]
            signs.append((bx - ax) * (y - ay) - (by - ay) * (x - ax))
        expected |= (np.min(signs, axis=0) >= -1e-9) | (np.max(signs, axis=0) <= 1e-9)
    np.testing.assert_array_equal(find_inside(surface, width, height), expected)


def test_inside_wraps_as_tiles_do():
    cube = make_cube()
    moved = dataclasses.replace(cube, uvs=cube.uvs * 1.7 + np.array([0.43, -0.91]))
    tiles = dataclasses.replace(moved, uvs=(moved.uvs + 1) / 4)
    expected = find_inside(tiles, 80, 60).reshape(4, 15, 4, 20).any(axis=(0, 2))
    np.testing.assert_array_equal(find_inside(moved, 20, 15, repeat=True), expected)
    np.testing.assert_array_equal(find_inside(moved, 20, 15), find_inside(tiles, 80, 60)[15:30, 20:40])


def test_region_reads_what_samples_read():
    surface = make_cube()
    seams = find_seams(surface)
    region = find_region(surface, seams, 24, 24)
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([1, 1, 1], 4000)
    uvs = np.einsum("nk,nkd->nd", weights, surface.uvs[surface.face_uvs[rng.integers(0, 12, 4000)]])
    read = np.flatnonzero(np.abs(sample_rows(uvs, 24, 24)).sum(axis=0) > 1e-12)
    assert region.used.ravel()[read].all()
    assert (region.used | ~region.inside).all()


def test_square_elements_equal_sums_over_texels():
    for side in (1, 2, 4, 8):
        k = np.arange(side + 1) / side
        hats = np.stack([1 - k, k])
        outer = np.where((k == 0) | (k == 1), 0.5, 1.0)
        basis = [np.outer(hats[j], hats[i]) for j in (0, 1) for i in (0, 1)]
        expected = np.empty((4, 4))
        for a, one in enumerate(basis):
            for b, two in enumerate(basis):
                mass = np.sum(np.outer(outer, outer) * one * two)
                along_x = np.sum(outer[:, None] * np.diff(one, axis=1) * np.diff(two, axis=1))
                along_y = np.sum(outer[None, :] * np.diff(one, axis=0) * np.diff(two, axis=0))
                expected[a, b] = 3.0 * mass + 0.7 * (along_x + along_y)
        np.testing.assert_allclose(_square_elements(np.array([side]), 3.0, 0.7)[0], expected, atol=1e-12)


def full_matrix(region, change: float, inside: float, outside: float) -> np.ndarray:
    """The full grid's matrix, texel by texel."""
    height, width = region.inside.shape
    matrix = np.zeros((width * height, width * height))
    for row in range(height):
        for column in range(width):
            here = row * width + column
            matrix[here, here] += change * region.inside[row, column]
            for down, right in ((0, 1), (1, 0)):
                r, c = row + down, column + right
                if r < height and c < width and region.used[row, column] and region.used[r, c]:
                    weight = inside if region.inside[row, column] and region.inside[r, c] else outside
                    there = r * width + c
                    matrix[here, here] += weight
                    matrix[there, there] += weight
                    matrix[here, there] -= weight
                    matrix[there, here] -= weight
    return matrix


@pytest.mark.parametrize("reaches", [(2, 2), (4, 3), (100, 51)])
def test_coarse_matrix_is_the_full_grid_matrix_seen_through_interpolation(reaches):
    surface = make_square()
    seams = find_seams(surface)
    width, height = 44, 40
    region = find_region(surface, seams, width, height)
    grid = build_grid(region, fine_reach=reaches[0], reach=reaches[1])
    assert set(grid.nodes) <= set(np.flatnonzero(region.used))
    # Interpolate every free unknown to all texels, the slow way.
    spread = np.zeros((width * height, len(grid.nodes)))
    for corners, side in zip(grid.squares, grid.square_sides):
        for dy in range(side + 1):
            for dx in range(side + 1):
                texel = grid.nodes[corners[0]] + dy * width + dx
                spread[texel] = 0.0
                for corner, weight in zip(
                    corners, np.outer([1 - dy / side, dy / side], [1 - dx / side, dx / side]).ravel()
                ):
                    spread[texel, corner] += weight
    spread = spread @ grid.interpolation.toarray()
    spread[grid.nodes] = grid.interpolation.toarray()
    assert spread.sum(axis=1)[region.used.ravel()] == pytest.approx(1.0), "every used texel is covered"
    coarse = grid_matrix(grid, 0.3, 0.9, 1.7)
    coarse = (grid.interpolation.T @ coarse @ grid.interpolation).toarray()
    np.testing.assert_allclose(coarse, spread.T @ full_matrix(region, 0.3, 0.9, 1.7) @ spread, atol=1e-10)
    if reaches[0] == 100:
        assert len(grid.nodes) == region.used.sum(), "all texels are unknowns"


def test_mark_near_equals_slow_twin():
    x, y = np.array([0, 5, 7]), np.array([1, 1, 6])
    for shift in (0, 1):
        for repeat in (False, True):
            mask = np.zeros((8, 9), np.bool_)
            expected = mask.copy()
            _mark_near(x, y, 2, shift, repeat, mask)
            for a, b in zip(x, y):
                for dx in range(-2, 3):
                    for dy in range(-2, 3):
                        row, column = (b + dy) >> shift, (a + dx) >> shift
                        if repeat:
                            expected[row % 8, column % 9] = True
                        elif 0 <= row < 8 and 0 <= column < 9:
                            expected[row, column] = True
            np.testing.assert_array_equal(mask, expected)


def test_squares_are_blended_bilinearly():
    change = np.array([[0.0, 1], [1.0, 2], [2.0, 0], [5.0, 1]])
    y, x = np.divmod(np.arange(16), 4)
    expected = sample_bilinear(change.reshape(2, 2, 2), px_to_uv(np.stack([x, y], axis=1) / 4, 2, 2))
    np.testing.assert_allclose(_blend_square(4) @ change, expected, atol=1e-14)


@pytest.mark.parametrize("repeat", [False, True])
def test_every_texel_gets_its_change_once(repeat):
    """A change that is linear in place is the same on squares of every size, and relaxing it at k / 4k keeps it."""
    surface = make_square()
    region = find_region(surface, find_seams(surface), 256, 256, repeat=repeat)
    grid = build_grid(region, fine_reach=2, reach=2)
    y, x = np.divmod(np.arange(256 * 256), 256)
    linear = np.stack([1.0 + x + 2.0 * y, 5.0 - x], axis=1)
    found = np.full((256 * 256, 2), np.nan)
    times = np.zeros(256 * 256, int)
    for texels, change in spread_far(grid, linear[grid.nodes], 0.0):
        assert len(np.unique(texels)) == len(texels)
        times[texels] += ~np.isin(texels, grid.nodes)
        found[texels] = change
    texels, change = spread_near(grid, region, linear[grid.nodes], 0.0, 0.25)
    assert (times[texels] == 0).all() and times.max() == 1
    found[texels] = change
    inside = region.inside.ravel()
    np.testing.assert_allclose(found[inside], linear[inside], atol=1e-10)


def test_relaxed_texels_have_their_neighbours_and_no_seam():
    surface = make_cube()
    seams = find_seams(surface)
    region = find_region(surface, seams, 64, 64)
    grid = build_grid(region, fine_reach=2, reach=2)
    texels = np.unique(np.concatenate([grid.nodes, np.flatnonzero(region.inside)]))
    rows, above, below = _find_free(texels, region)
    assert len(rows) > 100
    np.testing.assert_array_equal(texels[above], texels[rows] - 64)
    np.testing.assert_array_equal(texels[below], texels[rows] + 64)
    np.testing.assert_array_equal(texels[rows - 1], texels[rows] - 1)
    np.testing.assert_array_equal(texels[rows + 1], texels[rows] + 1)
    read = cut_into_intervals(silhouette_lines(surface, seams), 64, 64).texels
    assert not np.isin(texels[rows], read).any()


def test_weights_table_of_gradient_mass():
    """An interior texel's gradient terms add up to a diagonal of one, the authors' normalisation."""
    region = find_region(make_square(), find_seams(make_square()), 20, 20)
    grid = build_grid(region, fine_reach=100, reach=51)
    diagonal = grid_matrix(grid, 0.0, GRADIENT_MASS, GRADIENT_MASS).diagonal()
    assert diagonal.max() == pytest.approx(1.0)
