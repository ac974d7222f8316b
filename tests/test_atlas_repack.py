"""Chart finding and packing: charts keep their shape, lie apart, and fill the square."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from preprocess.atlas.repack import _find_place, _occupy, _pack_bits, _rasterise, find_charts, repack_charts
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten.overlap import find_meeting_segments
from tests.builders_straighten import ring_in_square, tube, two_charts, weld_uvs, with_dart


def outline(surface: TexturedSurface) -> tuple[np.ndarray, np.ndarray]:
    """Ends and texture vertices of all silhouette edges."""
    seams = find_seams(surface)
    ids = np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs])
    return surface.uvs[ids], ids


@pytest.mark.parametrize("density", ["surface", "source"])
@pytest.mark.parametrize("make", [two_charts, tube, ring_in_square, with_dart])
def test_packed_charts(make, density: str) -> None:
    surface = make()
    size, gutter = 256, 6.0
    packed = repack_charts(surface, size, gutter, density=density)
    after = packed.surface
    after.validate()
    assert after.uvs.min() >= 0.5 * gutter / size and after.uvs.max() <= 1 - 0.5 * gutter / size
    np.testing.assert_array_equal(after.faces, surface.faces)
    # Each chart is the source's, scaled and turned: every edge keeps its length, and no face turns over.
    old, new = surface.uvs[surface.face_uvs], after.uvs[after.face_uvs]
    scale = packed.scales[packed.face_charts][:, None]
    old_length, new_length = (np.linalg.norm(np.roll(c, -1, axis=1) - c, axis=2) for c in (old, new))
    np.testing.assert_allclose(new_length, old_length * scale, atol=1e-12)
    old_area, new_area = (
        (c[:, 1] - c[:, 0])[:, 0] * (c[:, 2] - c[:, 0])[:, 1] - (c[:, 1] - c[:, 0])[:, 1] * (c[:, 2] - c[:, 0])[:, 0]
        for c in (old, new)
    )
    assert (np.sign(old_area) == np.sign(new_area)).all()
    # Charts lie a gutter apart.
    charts = np.zeros(len(after.uvs), int)
    charts[after.face_uvs] = packed.face_charts[:, None]
    ends, ids = outline(after)
    assert not find_meeting_segments(ends, ids, charts[ids[:, 0]], True, gutter / size).any()
    assert packed.coverage == pytest.approx(np.abs(new_area).sum() / 2)
    if density == "source":
        assert np.ptp(packed.scales) < 1e-12
    elif packed.face_charts.max():
        area = np.abs(np.cross(*np.diff(surface.positions[surface.faces], axis=1).transpose(1, 0, 2)))
        area_sq_m = np.bincount(packed.face_charts, np.linalg.norm(area, axis=1))
        per_area = np.bincount(packed.face_charts, np.abs(new_area)) / area_sq_m
        np.testing.assert_allclose(per_area, per_area[0], rtol=1e-9)


def test_squares_fill_the_square() -> None:
    """Sixteen equal squares: a packer that finds the 4 x 4 layout covers nearly all."""
    flat = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = np.tile(flat, (16, 1))
    all_faces = (faces[None] + 4 * np.arange(16)[:, None, None]).reshape(-1, 3).astype(np.int32)
    positions = np.column_stack([uvs, np.repeat(np.arange(16.0), 4)])
    packed = repack_charts(TexturedSurface(positions, all_faces, uvs, all_faces), 512, 2.0)
    assert packed.coverage > 0.9


def test_mirrored_halves_are_two_charts() -> None:
    """One uv island folded onto itself along a shared edge."""
    positions = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0]])
    faces = np.array([[0, 2, 1], [0, 1, 3]], np.int32)
    uvs = np.array([[0.5, 0.5], [0.5, 0.9], [0.9, 0.5], [0.9, 0.5]])
    surface = TexturedSurface(positions, faces, uvs, faces)
    assert find_charts(surface).tolist() == [0, 1]
    packed = repack_charts(surface, 64, 2.0)
    assert len(find_seams(packed.surface).vertices) == 1
    straight = TexturedSurface(positions, faces, np.array([[0.5, 0.5], [0.5, 0.9], [0.9, 0.5], [0.1, 0.5]]), faces)
    assert find_charts(straight).tolist() == [0, 0]


def test_charts_that_share_a_vertex_only() -> None:
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[1, 1], [2, 1], [2, 2]]], float) / 4
    surface = weld_uvs(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0]]),
        np.array([[0, 1, 2], [2, 3, 4]], np.int32),
        corners,
    )
    assert len(surface.uvs) == 5
    assert find_charts(surface).tolist() == [0, 1]
    assert len(repack_charts(surface, 64, 2.0).surface.uvs) == 6


def test_degenerate_charts() -> None:
    """Points and needles in uv are packed as what they are, and fill nothing."""
    base = two_charts(4)
    for uvs in (np.full_like(base.uvs, 0.5), base.uvs * (1.0, 0.0), base.uvs * (1.0, 1e-6)):
        packed = repack_charts(TexturedSurface(base.positions, base.faces, uvs, base.face_uvs), 64, 2.0)
        packed.surface.validate()
        assert packed.surface.uvs.min() >= 0 and packed.surface.uvs.max() <= 1
    empty = TexturedSurface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros((0, 3), np.int32))
    assert repack_charts(empty, 64, 2.0).coverage == 0.0


def test_refusals() -> None:
    with pytest.raises(ValueError, match="density"):
        repack_charts(two_charts(4), 64, 2.0, density="dense")
    base = two_charts(8)
    corners = base.uvs[base.face_uvs].reshape(-1, 2)
    loose = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    with pytest.raises(ValueError, match="do not fit"):
        repack_charts(TexturedSurface(base.positions, base.faces, corners, loose), 32, 8.0)


@pytest.mark.parametrize("seed", range(4))
def test_places_against_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = 90
    grid = np.zeros((size, size), bool)
    occupied = np.zeros((size, 4), np.uint64)
    for _ in range(30):
        bitmap = (rng.uniform(size=rng.integers(1, 30, 2)) < 0.7).astype(np.uint8)
        height, width = bitmap.shape
        places = (
            (x, y)
            for y, x in itertools.product(range(size - height + 1), range(size - width + 1))
            if not (grid[y : y + height, x : x + width] & (bitmap > 0)).any()
        )
        expected = next(places, (-1, -1))
        rows = _pack_bits(bitmap)
        x, y = _find_place(occupied, rows, width, size, 0)
        assert (x, y) == expected
        if x >= 0:
            _occupy(occupied, rows, x, y)
            grid[y : y + height, x : x + width] |= bitmap > 0


def test_cells_against_dense_points() -> None:
    """Every point of a triangle, and every point within reach of it, falls into a marked cell or next to none."""
    points = np.array([[2.2, 3.1], [17.7, 5.0], [6.4, 14.9]])
    cells = _rasterise(points, np.array([[0, 1, 2]]), 0.7072, 20, 20)
    weights = np.random.default_rng(0).dirichlet([1.0, 1.0, 1.0], 20000)
    inside = np.floor(weights @ points).astype(int)
    assert cells[inside[:, 1], inside[:, 0]].all()
    assert not cells[0].any() and not cells[:, 19].any()
