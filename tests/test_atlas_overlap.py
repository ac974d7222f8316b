"""Exact signs, the one-to-one test and the count of shared texels, against slow exact twins."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from preprocess.atlas.crowding import measure_crowding
from preprocess.mesh.predicates import count_folds, face_orientation
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.uv_overlap import find_overlap


def exact_turn(a, b, c) -> int:
    """Sign of the turn a, b, c in rational numbers: the slow twin."""
    ax, ay, bx, by, cx, cy = (Fraction(float(x)) for x in (*a, *b, *c))
    value = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (value > 0) - (value < 0)


def overlap_slowly(uvs, face_uvs) -> int:
    """Overlapping pairs by separating axes in rational numbers, all pairs."""
    triangles = []
    for face in face_uvs:
        t = uvs[face]
        turn = exact_turn(*t)
        if turn:
            triangles.append(t if turn > 0 else t[::-1])

    def apart(p, q):
        return any(all(exact_turn(p[k], p[(k + 1) % 3], x) <= 0 for x in q) for k in range(3))

    return sum(not apart(p, q) and not apart(q, p) for i, p in enumerate(triangles) for q in triangles[i + 1 :])


def test_orientation_is_exact_where_floats_are_not():
    # Points on one line of slope 1/3, and moved by one unit in the last place: plain float arithmetic gets many wrong.
    rng = np.random.default_rng(3)
    x = rng.random((400, 3))
    uvs = np.stack([x, x / 3 + 0.1], axis=-1).reshape(-1, 2)
    nudged = uvs.copy()
    nudged[2::3, 1] = np.nextafter(nudged[2::3, 1], rng.choice([-1.0, 2.0], 400))
    uvs = np.concatenate([uvs, nudged, np.repeat(rng.random((5, 2)), 3, axis=0)])
    faces = np.arange(len(uvs), dtype=np.int32).reshape(-1, 3)
    expected = [exact_turn(*uvs[f]) for f in faces]
    assert {-1, 0, 1} <= set(expected)
    np.testing.assert_array_equal(face_orientation(uvs, faces), expected)


def test_orientation_of_no_faces():
    assert len(face_orientation(np.zeros((0, 2)), np.zeros((0, 3), np.int32))) == 0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("spread", [0.05, 0.6])
def test_overlap_equals_the_slow_twin(seed, spread):
    rng = np.random.default_rng(seed)
    centre = rng.random((40, 1, 2))
    uvs = (centre + spread * (rng.random((40, 3, 2)) - 0.5)).reshape(-1, 2)
    uvs = np.round(uvs * 16) / 16 if seed % 2 else uvs  # coarse coordinates: shared points, edges and flat triangles
    faces = np.arange(120, dtype=np.int32).reshape(-1, 3)
    found = find_overlap(uvs, faces)
    assert found.num_pairs == min(overlap_slowly(uvs, faces), 4 * (40 - found.num_flat))
    assert found.num_flat == sum(exact_turn(*uvs[f]) == 0 for f in faces)


def test_a_triangulated_square_is_one_to_one_and_a_fold_is_not():
    n = 30
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    uvs = np.stack([x.ravel(), y.ravel()], axis=1)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n + 2], 1), np.stack([corner, corner + n + 2, corner + n + 1], 1)]
    ).astype(np.int32)
    assert find_overlap(uvs, faces).one_to_one
    # All faces share edges and corners only; move one vertex across an opposite edge by the least there is.
    vertex = 15 * (n + 1) + 15
    bent = uvs.copy()
    bent[vertex, 0] = np.nextafter(uvs[vertex + 1, 0], 2)
    found = find_overlap(bent, faces)
    assert found.num_pairs > 0 and found.faces.any()


def test_coincident_triangles_stop_counting():
    uvs = np.tile([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]], (3000, 1))
    found = find_overlap(uvs, np.arange(9000, dtype=np.int32).reshape(-1, 3))
    assert found.num_pairs == 4 * 3000  # of 4.5 million


def test_uvs_at_one_point_are_flat_not_slow():
    found = find_overlap(np.full((3, 2), 0.5), np.tile(np.array([0, 1, 2], np.int32), (20000, 1)))
    assert (found.num_pairs, found.num_flat) == (0, 20000) and not found.one_to_one


def test_folds_are_counted_by_chart():
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 1e-12], [0.5, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 3], [0, 4, 1]], np.int32)
    np.testing.assert_array_equal(count_folds(uvs, faces, np.array([0, 1, 2, 2]), 3), [0, 1, 2])


def test_crowding_is_zero_two_texels_apart_and_not_when_charts_touch():
    square = np.array([[0.1, 0.1], [0.4, 0.1], [0.4, 0.4], [0.1, 0.4]])
    positions = np.concatenate([np.c_[square, np.zeros(4)], np.c_[square + 5, np.zeros(4)]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)

    def crowding(gap_px, size_px=100):
        uvs = np.concatenate([square, square + np.array([0.3 + gap_px / size_px, 0])])
        return measure_crowding(TexturedSurface(positions, faces, uvs, faces), size_px)

    assert crowding(2.01) == 0
    assert 0.01 < crowding(0.0) < 0.1  # two columns of about 32 texels of about 2 * 32 * 32
    assert crowding(0.5) <= crowding(0.0)
