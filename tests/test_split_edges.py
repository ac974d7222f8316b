"""Splitting edges: the surface, its uvs and everything on its corners stay what they were."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from preprocess.mesh.seams import find_seams
from preprocess.mesh.split_edges import apply_split, split_edges
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from tests.builders_straighten import moebius, ring_in_square, tube, two_charts


def areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))[faces]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2


@pytest.mark.parametrize("chosen", list(itertools.product([False, True], repeat=3)))
def test_one_triangle(chosen: tuple[bool, ...]) -> None:
    """Every set of split edges: parts keep the orientation, fill the triangle, and use every midpoint."""
    flat = np.array([[0.0, 0], [1, 0], [0, 1]])
    faces = np.array([[0, 1, 2]], np.int32)
    edges = np.array([[0, 1], [1, 2], [2, 0]])[np.array(chosen)]
    split = split_edges(TexturedSurface(np.column_stack([flat, [0.0] * 3]), faces, flat, faces), edges)
    split.surface.validate()
    assert len(split.surface.faces) == 1 + sum(chosen)
    assert split.num_edges == sum(chosen)
    signed = areas(split.surface.uvs, split.surface.face_uvs)[:, 2]
    assert (signed > 0).all()
    assert signed.sum() == pytest.approx(0.5)
    assert np.unique(split.surface.faces).tolist() == list(range(3 + sum(chosen)))


@pytest.mark.parametrize("make", [two_charts, tube, ring_in_square, moebius])
def test_random_edges(make) -> None:
    surface = make()
    rng = np.random.default_rng(0)
    ends = np.concatenate([surface.faces, np.roll(surface.faces, -1, axis=1)])[:, :2]
    edges = ends[rng.uniform(size=len(ends)) < 0.3][:, ::-1]
    before = [a.copy() for a in (surface.positions, surface.uvs, surface.faces, surface.face_uvs)]
    split = split_edges(surface, edges)
    after = split.surface
    after.validate()
    for copy, array in zip(before, (surface.positions, surface.uvs, surface.faces, surface.face_uvs), strict=True):
        np.testing.assert_array_equal(copy, array)
    np.testing.assert_array_equal(after.positions[: len(surface.positions)], surface.positions)
    np.testing.assert_array_equal(after.uvs[: len(surface.uvs)], surface.uvs)
    assert (split.face_source[: len(surface.faces)] == np.arange(len(surface.faces))).all()
    for points, ids, old_points, old_ids in (
        (after.positions, after.faces, surface.positions, surface.faces),
        (after.uvs, after.face_uvs, surface.uvs, surface.face_uvs),
    ):
        expected = np.einsum("fck,fkd->fcd", split.corner_weights, old_points[old_ids[split.face_source]])
        np.testing.assert_allclose(points[ids], expected, atol=1e-14)
        total = np.zeros((len(surface.faces), 3))
        np.add.at(total, split.face_source, areas(points, ids))
        np.testing.assert_allclose(total, areas(old_points, old_ids), atol=1e-14)
    # No crack opens: seams and boundaries keep their length, and every edge still has its two faces.
    old, new = find_seams(surface), find_seams(after)
    assert new.lengths_m.sum() == pytest.approx(old.lengths_m.sum())
    assert new.boundary_lengths_m.sum() == pytest.approx(old.boundary_lengths_m.sum())


def test_no_edges() -> None:
    surface = two_charts(4)
    split = split_edges(surface, np.zeros((0, 2), int))
    np.testing.assert_array_equal(split.surface.faces, surface.faces)
    assert split.num_edges == 0
    far = split_edges(surface, np.array([[0, len(surface.positions) - 1]]))
    assert far.num_edges == 0


def character(surface: TexturedSurface, width: int) -> SkinnedMesh:
    rng = np.random.default_rng(0)
    num_faces, num_vertices = len(surface.faces), len(surface.positions)
    normals = rng.normal(size=(num_faces, 3, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    weights = rng.uniform(size=(num_vertices, width))
    weights[rng.uniform(size=weights.shape) < 0.4] = 0.0
    weights[:, 0] += 0.1
    joints = np.stack([rng.choice(7, width, replace=False) for _ in range(num_vertices)]).astype(np.int32)
    return SkinnedMesh(
        surface=surface,
        corner_normals=normals,
        corner_tangents=np.concatenate([normals[..., [1, 2, 0]], np.full((num_faces, 3, 1), -1.0)], axis=2),
        corner_texcoords=surface.uvs[surface.face_uvs][:, :, None],
        corner_colors=rng.uniform(size=(num_faces, 3, 4)).astype(np.float32),
        joint_indices=np.where(weights > 0, joints, 0).astype(np.int32),
        joint_weights=weights / weights.sum(axis=1, keepdims=True),
        face_materials=rng.integers(0, 3, num_faces).astype(np.int32),
        face_parts=np.zeros(num_faces, np.int32),
        has_uvs=True,
    )


@pytest.mark.parametrize("width", [1, 4])
def test_character_follows(width: int) -> None:
    surface = two_charts(6)
    mesh = character(surface, width)
    split = split_edges(surface, surface.faces[::3, :2])
    after = apply_split(mesh, split)
    after.validate()
    dense, old = after.dense_weights(7), mesh.dense_weights(7)
    np.testing.assert_allclose(dense, old[split.vertex_source].mean(axis=1), atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(after.corner_normals, axis=2), 1.0)
    assert after.corner_tangents is not None
    assert (after.corner_tangents[..., 3] == -1.0).all()
    np.testing.assert_allclose(after.corner_texcoords[:, :, 0], after.surface.uvs[after.surface.face_uvs], atol=1e-14)
    whole = (split.corner_weights == 1.0).any(axis=2)
    corner = split.corner_weights.argmax(axis=2)
    rows = np.broadcast_to(split.face_source[:, None], corner.shape)
    np.testing.assert_array_equal(after.corner_normals[whole], mesh.corner_normals[rows, corner][whole])
    np.testing.assert_array_equal(after.face_materials, mesh.face_materials[split.face_source])
