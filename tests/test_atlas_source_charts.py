"""Which of the source's charts are kept, and that placing charts changes neither their shape nor their order."""

from __future__ import annotations

import numpy as np
import pytest
from builders_atlas import grid_of_charts, patch

from preprocess.atlas.build import build_atlas
from preprocess.atlas.chart_scales import SAFE_FILL, chart_densities, texture_side, wanted_side
from preprocess.atlas.flatten import local_triangles
from preprocess.atlas.placement import place_charts
from preprocess.atlas.source_charts import find_charts, find_sound_charts
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.straighten.overlap import find_meeting_segments
from tests.builders_straighten import ring_in_square, tube, two_charts, weld_uvs, with_dart


def sound(surface: TexturedSurface) -> np.ndarray:
    flat = local_triangles(surface.positions, surface.faces)
    return find_sound_charts(surface, flat, np.ones((len(surface.faces), 2)))


def chart_labels(surface: TexturedSurface) -> np.ndarray:
    edges = find_edges(surface.faces)
    return label_faces(edges, cut_edges(edges, surface.face_uvs))[1]


@pytest.mark.parametrize("make", [two_charts, tube, ring_in_square, with_dart])
def test_placed_charts_keep_their_shape_and_lie_apart(make) -> None:
    surface = make()
    after = place_charts(surface, np.zeros(len(surface.faces)))
    after.validate()
    assert after.uvs.min() > 0 and after.uvs.max() < 1
    np.testing.assert_array_equal(after.faces, surface.faces)
    # Each chart is the source's, scaled and turned: every edge keeps its length but for one factor a chart.
    charts = chart_labels(surface)
    old, new = surface.uvs[surface.face_uvs], after.uvs[after.face_uvs]
    old_length, new_length = (np.linalg.norm(np.roll(c, -1, axis=1) - c, axis=2) for c in (old, new))
    for chart in range(charts.max() + 1):
        scale = new_length[charts == chart].sum() / old_length[charts == chart].sum()
        np.testing.assert_allclose(new_length[charts == chart], old_length[charts == chart] * scale, atol=1e-12)
    seams = find_seams(after)
    ids = np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs])
    uv_charts = np.zeros(len(after.uvs), int)
    uv_charts[after.face_uvs] = charts[:, None]
    assert not find_meeting_segments(after.uvs[ids], ids, uv_charts[ids[:, 0]], True, 2.0 / 1024).any()


def test_squares_fill_the_square() -> None:
    """Sixteen equal squares in four rows of four."""
    flat = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = np.tile(flat, (16, 1))
    all_faces = (faces[None] + 4 * np.arange(16)[:, None, None]).reshape(-1, 3).astype(np.int32)
    positions = np.column_stack([uvs, np.repeat(np.arange(16.0), 4)])
    placed = place_charts(TexturedSurface(positions, all_faces, uvs, all_faces), np.zeros(32))
    corners = placed.uvs[placed.face_uvs]
    p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    assert 0.5 * np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum() > 0.85


def test_mirrored_halves_are_two_charts() -> None:
    """One uv island folded onto itself along a shared edge."""
    positions = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0]])
    faces = np.array([[0, 2, 1], [0, 1, 3]], np.int32)
    uvs = np.array([[0.5, 0.5], [0.5, 0.9], [0.9, 0.5], [0.9, 0.5]])
    surface = TexturedSurface(positions, faces, uvs, faces)
    assert find_charts(surface).tolist() == [0, 1] == sound(surface).tolist()
    straight = TexturedSurface(positions, faces, np.array([[0.5, 0.5], [0.5, 0.9], [0.9, 0.5], [0.1, 0.5]]), faces)
    assert find_charts(straight).tolist() == [0, 0] == sound(straight).tolist()
    assert find_charts(straight, np.array([0, 1])).tolist() == [0, 1]


def test_charts_that_share_a_vertex_only() -> None:
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[1, 1], [2, 1], [2, 2]]], float) / 4
    surface = weld_uvs(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0]]),
        np.array([[0, 1, 2], [2, 3, 4]], np.int32),
        corners,
    )
    assert len(surface.uvs) == 5
    assert find_charts(surface).tolist() == [0, 1]
    assert len(place_charts(surface, np.zeros(2)).uvs) == 6


def test_one_folded_chart_among_fifty_does_not_condemn_the_others() -> None:
    mesh = grid_of_charts(51)
    uvs = mesh.surface.uvs.copy()
    per_chart = len(uvs) // 51
    folded = slice(7 * per_chart, 8 * per_chart)
    middle = uvs[folded, 0].mean()
    uvs[folded, 0] = middle + np.abs(uvs[folded, 0] - middle)
    surface = TexturedSurface(mesh.surface.positions, mesh.surface.faces, uvs, mesh.surface.face_uvs)
    charts = find_charts(surface)
    assert charts.max() == 51  # the folded one is two halves, each one-to-one: both are kept
    assert (sound(surface) == charts).all()
    uvs[folded] = uvs[folded][0]  # and now it has no area at all
    labels = sound(TexturedSurface(surface.positions, surface.faces, uvs, surface.face_uvs))
    per_chart = len(labels) // 51
    assert (labels[7 * per_chart : 8 * per_chart] == -1).all() and (labels == -1).sum() == per_chart
    assert labels.max() == 49


def test_faces_that_overlap_within_a_chart_are_taken_out_of_it() -> None:
    """A vertex pulled over its neighbours folds two of 800 faces; those, and what they cover, go."""
    positions, faces = patch(20, 20)
    uvs = positions[:, :2].copy()
    inner = 21 * 10 + 10
    uvs[inner] += (0.06, 0.0)  # beyond the next vertex, 0.05 away
    labels = sound(TexturedSurface(positions, faces.astype(np.int32), uvs, faces.astype(np.int32)))
    assert 2 <= (labels == -1).sum() <= 12 and labels.max() == 0


@pytest.mark.parametrize("squeeze, kept", [(0.3, True), (0.2, False)])
def test_crushed_charts_are_not_kept(squeeze: float, kept: bool) -> None:
    """Five times as long as wide is more than the limit of four."""
    positions, faces = patch(8, 8)
    faces = faces.astype(np.int32)
    labels = sound(TexturedSurface(positions, faces, positions[:, :2] * (1.0, squeeze), faces))
    assert (labels == 0).all() if kept else (labels == -1).all()


def test_mostly_unsound_parts_are_unwrapped_as_a_whole() -> None:
    positions, faces = patch(10, 10)
    faces = faces.astype(np.int32)
    for share, expected in ((0.3, True), (0.7, False)):
        uvs = positions[:, :2].copy()
        uvs[positions[:, 0] < share, 0] = 0.0  # flat there
        labels = sound(TexturedSurface(positions, faces, uvs, faces))
        assert (labels >= 0).any() == expected


def test_texels_follow_need_and_what_is_left_goes_to_those_with_least() -> None:
    areas, charts = np.array([1.0, 1.0, 2.0]), np.array([0, 1, 2])
    density = chart_densities(np.array([1000.0, 10.0, 0.0]), areas, charts, 3)
    assert density[0] == 1000.0 and density[1] == density[2] > 10.0
    side = texture_side(np.sqrt((areas * np.maximum([1000.0, 10, 0], 500.0) ** 2 / SAFE_FILL).sum()))
    assert (areas * density**2).sum() <= SAFE_FILL * side**2 * (1 + 1e-9)
    plain = chart_densities(np.zeros(3), areas, charts, 3)
    assert plain.min() == plain.max() > 0


def test_wanted_side_is_that_of_the_finest_part() -> None:
    """A square metre on a quarter of the atlas that needs 100 texels a metre wants 200 texels a side."""
    uvs = np.array([[0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    surface = TexturedSurface(np.c_[2 * uvs, np.zeros(4)], faces, uvs, faces)
    assert wanted_side(surface, np.array([100.0, 100.0])) == pytest.approx(200.0)
    assert wanted_side(surface, np.zeros(2)) == 0.0
    assert [texture_side(s) for s in (0.0, 512.0, 540.0, 600.0, 1e9)] == [512, 512, 512, 1024, 4096]


def test_too_many_charts_are_shrunk_not_refused() -> None:
    mesh = grid_of_charts(600, cells=1)
    atlas = build_atlas(mesh, mode="repack", straighten_rel=None)
    assert atlas.num_charts == 600 and atlas.overlap == 0
    # Cards stay rectangles.
    corners = atlas.mesh.surface.uvs[atlas.mesh.surface.face_uvs]
    p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]
    cosine = (p * q).sum(axis=1) / np.linalg.norm(p, axis=1) / np.linalg.norm(q, axis=1)
    assert np.abs(cosine[::2]).max() < 1e-6
