"""Charts for surfaces that have none: one-to-one, little stretched, few, on good and bad meshes."""

from __future__ import annotations

import numpy as np
import pytest
from builders_atlas import FAMILIES, copies, patch, tetrahedron, tube

from preprocess.atlas.distortion import overlapping_charts, singular_values, turned_areas
from preprocess.atlas.flatten import LEAST_HEIGHT_REL, flatten_free, local_triangles, project_charts
from preprocess.atlas.merge import MOST_STRETCH, merge_charts
from preprocess.atlas.segment import CONE_COSINE, grow_regions
from preprocess.atlas.unwrap import unwrap
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.face_geometry import face_frames


def lay_out(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Corner uvs, charts and their number."""
    faces = np.asarray(faces, np.int32)
    face_uvs, uvs = unwrap(np.asarray(positions, float), faces, np.zeros(len(faces), np.int32))
    edges = find_edges(faces)
    num_charts, charts = label_faces(edges, cut_edges(edges, face_uvs))
    assert np.bincount(charts[np.repeat(np.arange(len(faces)), 3)], minlength=num_charts).sum() == 3 * len(faces)
    return uvs[face_uvs], charts, num_charts


@pytest.mark.parametrize("name", FAMILIES)
def test_every_chart_is_one_to_one_and_little_stretched(name: str) -> None:
    positions, faces = FAMILIES[name]
    corners, charts, num_charts = lay_out(positions, faces)
    assert np.isfinite(corners).all()
    assert (turned_areas(corners) > 0).all()
    assert not overlapping_charts(corners, charts, num_charts).any()
    flat = local_triangles(np.asarray(positions, float), np.asarray(faces))
    largest, smallest = singular_values(flat, corners)
    weights = turned_areas(flat)
    bad = (largest > MOST_STRETCH * 1.001) | (smallest * MOST_STRETCH * 1.001 < 1)
    assert weights[bad].sum() <= 0.002 * weights.sum()


def test_a_box_unfolds_into_one_chart_without_stretch() -> None:
    """Six squares, five folds: a cross, in which every face keeps its shape."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    uvs, _, num_charts = lay_out(corners, faces)
    assert num_charts <= 2
    largest, smallest = singular_values(local_triangles(corners, faces), uvs)
    np.testing.assert_allclose([largest, smallest], 1.0, atol=1e-9)


def test_an_open_tube_is_unrolled() -> None:
    """Developable: one chart (or one and a rest), each face as it is."""
    positions, faces = tube(24, 30, 9.0, closed=False)
    uvs, _, num_charts = lay_out(positions, faces)
    assert num_charts <= 2
    largest, smallest = singular_values(local_triangles(positions, faces), uvs)
    assert largest.max() < 1.01 and smallest.min() > 0.99


def test_groups_are_kept_apart() -> None:
    positions, faces = patch(12, 12)
    faces = faces.astype(np.int32)
    groups = (positions[faces].mean(axis=1)[:, 0] > 0.5).astype(np.int32)
    face_uvs, _ = unwrap(positions, faces, groups)
    edges = find_edges(faces)
    num_charts, charts = label_faces(edges, cut_edges(edges, face_uvs))
    assert num_charts == 2 and len(np.unique(np.stack([charts, groups]), axis=1).T) == 2


def test_regions_stay_within_their_cone() -> None:
    positions, faces = tube(32, 40, 6.0, closed=True)
    faces = faces.astype(np.int32)
    areas, normals, _ = face_frames(positions, faces)
    count, regions = grow_regions(find_edges(faces).neighbors, normals, areas, np.zeros(len(faces), np.int32))
    assert regions.min() == 0 and regions.max() == count - 1
    means = np.stack([np.bincount(regions, areas * normals[:, k]) for k in range(3)], axis=1)
    means /= np.linalg.norm(means, axis=1)[:, None]
    # Each was within the cone of what its region was when it came.
    assert ((means[regions] * normals).sum(axis=1) > 2 * CONE_COSINE**2 - 1).all()


def test_free_maps_of_developable_surfaces_are_isometries() -> None:
    positions, faces = tube(40, 10, 2.0, closed=False)
    faces = faces[positions[faces].mean(axis=1)[:, 0] > 0.2].astype(np.int32)
    used, faces = np.unique(faces, return_inverse=True)
    faces, charts = faces.reshape(-1, 3).astype(np.int32), np.zeros(len(faces.reshape(-1, 3)), np.int32)
    flat = local_triangles(positions[used], faces)
    guess = project_charts(positions[used], faces, charts, 1)
    uvs = flatten_free(guess, flat, faces, charts, 60)
    largest, smallest = singular_values(flat, uvs[faces])
    assert largest.max() < 1.001 and smallest.min() > 0.999


def test_thin_triangles_are_laid_out_with_some_height() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0], [2, 2, 2.0]])
    flat = local_triangles(points, np.array([[0, 1, 2], [0, 0, 1], [0, 1, 3]]))
    assert (flat[:, 1, 0] > 0).all() and (flat[:, 2, 1] > 0).all()
    longest = np.linalg.norm(flat - np.roll(flat, -1, axis=1), axis=2).max(axis=1)
    assert (2 * turned_areas(flat) >= 0.99 * LEAST_HEIGHT_REL * longest**2).all()
    assert flat[2, 2] == pytest.approx([2, np.sqrt(8)])


def test_singular_values_by_hand() -> None:
    flat = np.array([[[0, 0], [1, 0], [0, 1.0]]])
    for matrix in (np.diag([3.0, 0.5]), np.array([[1.0, 1], [0, 1]]), np.array([[0.0, -2], [2, 0]])):
        expected = np.linalg.svd(matrix, compute_uv=False)
        found = singular_values(flat, flat @ matrix.T + (5.0, -2.0))
        np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-12)


def test_barred_edges_stay_cut() -> None:
    positions, faces = patch(6, 6)
    faces = faces.astype(np.int32)
    edges = find_edges(faces)
    flat = local_triangles(positions, faces)
    everything = np.ones(len(edges.glued), bool)
    cut, uvs = merge_charts(positions, faces, edges, everything, flat, everything)
    assert cut.all() and (uvs == flat).all()
    cut, uvs = merge_charts(positions, faces, edges, everything, flat, ~everything)
    assert label_faces(edges, cut)[0] == 1


def test_many_parts_take_no_time_each() -> None:
    """Work is shared by all charts: no step loops over parts in Python but the choice of borders."""
    positions, faces = copies(tetrahedron(), 400)
    _, _, num_charts = lay_out(positions, faces)
    assert 400 <= num_charts <= 800
