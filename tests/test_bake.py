"""Rasterising and baking: texels carry the surface's values, and samples at vertices are exact after the fit."""

from __future__ import annotations

import numpy as np

from preprocess.bake.geometry import bake_positions, bake_weights, fit_vertices
from preprocess.files.resample import sample_footprints
from preprocess.files.srgb import linear_to_srgb, srgb_to_linear
from preprocess.mesh.raster import fill_outside, interpolate_corners, rasterise
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import px_to_uv, sample_bilinear, uv_to_px


def wavy_grid(n: int = 9) -> SkinnedMesh:
    """A curved sheet of 2 (n - 1)^2 triangles whose uvs fill the middle of the square; two joints."""
    u, v = np.meshgrid(np.linspace(0.1, 0.9, n), np.linspace(0.15, 0.85, n))
    uvs = np.stack([u.ravel(), v.ravel()], axis=1)
    positions = np.stack([uvs[:, 0], uvs[:, 1], 0.1 * np.sin(7 * uvs[:, 0]) * np.cos(5 * uvs[:, 1])], axis=1)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]).astype(np.int32)
    weights = np.stack([uvs[:, 0], 1 - uvs[:, 0]], axis=1)
    return SkinnedMesh(
        surface=TexturedSurface(positions, faces, uvs, faces.copy()),
        corner_normals=np.broadcast_to([0.0, 0.0, 1.0], (len(faces), 3, 3)).copy(),
        corner_tangents=None,
        corner_texcoords=uvs[faces][:, :, None],
        corner_colors=None,
        joint_indices=np.tile(np.array([[0, 1]], np.int32), (n * n, 1)),
        joint_weights=weights,
        face_materials=np.zeros(len(faces), np.int32),
        face_parts=np.zeros(len(faces), np.int32),
        has_uvs=True,
    )


def slow_face_at(corners: np.ndarray, point: np.ndarray) -> set[int]:
    """Faces that contain a point, one by one, with a hair of tolerance."""
    found = set()
    for f, (a, b, c) in enumerate(corners):
        matrix = np.array([[*a, 1], [*b, 1], [*c, 1]]).T
        if np.linalg.solve(matrix, [*point, 1]).min() > -1e-9:
            found.add(f)
    return found


def test_raster_agrees_with_a_slow_search() -> None:
    mesh = wavy_grid(5)
    coverage = rasterise(mesh.surface.uvs, mesh.surface.face_uvs, 24, 17)
    corners = uv_to_px(mesh.surface.uvs, 24, 17)[mesh.surface.face_uvs]
    for y in range(17):
        for x in range(24):
            expected = slow_face_at(corners, np.array([x, y], float))
            assert bool(expected) == bool(coverage.inside[y, x])
            if expected:
                assert coverage.faces[y, x] in expected


def test_a_linear_signal_is_exact_also_outside_the_chart() -> None:
    mesh = wavy_grid(5)
    linear = mesh.surface.uvs @ np.array([[2.0, -1.0], [0.5, 3.0]]) + 1.0
    coverage = rasterise(mesh.surface.uvs, mesh.surface.face_uvs, 40, 30)
    texels = interpolate_corners(coverage, linear[mesh.surface.face_uvs])
    y, x = np.nonzero(coverage.faces >= 0)
    assert (~coverage.inside[y, x]).any()
    expected = px_to_uv(np.stack([x, y], 1), 40, 30) @ np.array([[2.0, -1.0], [0.5, 3.0]]) + 1.0
    assert np.abs(texels[y, x] - expected).max() < 1e-5


def test_degenerate_triangles_cover_nothing() -> None:
    uvs = np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5]])
    assert (rasterise(uvs, np.array([[0, 1, 2]], np.int32), 8, 8).faces == -1).all()
    assert rasterise(np.zeros((0, 2)), np.zeros((0, 3), np.int32), 8, 8).faces.shape == (8, 8)


def test_fill_outside_takes_the_nearest_texel() -> None:
    values = np.zeros((1, 5, 1))
    values[0, [0, 4], 0] = 1, 2
    known = np.array([[True, False, False, False, True]])
    assert fill_outside(values, known)[0, [1, 3], 0].tolist() == [1, 2]


def test_positions_at_vertices_are_exact() -> None:
    mesh = wavy_grid()
    texture = bake_positions(mesh, (64, 64))
    assert np.abs(sample_bilinear(texture, mesh.surface.uvs) - mesh.surface.positions).max() < 1e-4 * 1.5
    plain = interpolate_corners(
        rasterise(mesh.surface.uvs, mesh.surface.face_uvs, 64, 64), mesh.surface.positions[mesh.surface.faces]
    )
    plain_error = np.abs(sample_bilinear(plain, mesh.surface.uvs) - mesh.surface.positions).max()
    assert plain_error > 4e-4  # the fit is what makes them exact


def test_fit_changes_nothing_where_samples_are_right() -> None:
    rng = np.random.default_rng(1)
    texels = rng.random((16, 16, 2))
    uvs = rng.random((40, 2))
    assert np.abs(fit_vertices(texels, uvs, sample_bilinear(texels, uvs)) - texels).max() < 1e-12


def test_weights_are_a_partition_of_unity() -> None:
    texels = bake_weights(wavy_grid(), 3, (32, 32))
    assert (texels >= 0).all()
    assert np.abs(texels.sum(axis=2) - 1).max() < 1e-12
    assert (texels[..., 2] == 0).all()


def test_srgb_round_trip() -> None:
    values = np.linspace(0, 1, 256)
    assert np.abs(linear_to_srgb(srgb_to_linear(values)) - values).max() < 1e-12


def slow_wrap(i: int, size: int, mode: str) -> int:
    if mode == "CLAMP_TO_EDGE":
        return min(max(i, 0), size - 1)
    if mode == "REPEAT":
        return i % size
    period = list(range(size)) + list(range(size - 1, -1, -1))
    return period[i % (2 * size)]


def test_wrap_modes_agree_with_a_slow_twin() -> None:
    rng = np.random.default_rng(2)
    image = rng.random((5, 7, 3)).astype(np.float32)
    uvs = rng.uniform(-2.5, 3.5, (200, 2))
    still = np.zeros_like(uvs)
    for mode_s in ("REPEAT", "CLAMP_TO_EDGE", "MIRRORED_REPEAT"):
        for mode_t in ("REPEAT", "CLAMP_TO_EDGE", "MIRRORED_REPEAT"):
            got = sample_footprints(image, uvs, still, still, mode_s, mode_t, False)
            for (u, v), value in zip(uvs, got):
                x, y = u * 7 - 0.5, v * 5 - 0.5
                x0, y0 = int(np.floor(x)), int(np.floor(y))
                expected = np.zeros(3)
                for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
                    weight = abs(1 - dx - (x - x0)) * abs(1 - dy - (y - y0))
                    expected += weight * image[slow_wrap(y0 + dy, 5, mode_t), slow_wrap(x0 + dx, 7, mode_s)]
                assert np.abs(value - expected).max() < 1e-5


def test_a_minified_checkerboard_averages_to_grey() -> None:
    board = (np.indices((64, 64)).sum(axis=0) % 2).astype(np.float32)[..., None]
    uvs = np.random.default_rng(3).random((50, 2))
    step = np.array([[4 / 64, 0.0]]).repeat(50, 0)
    got = sample_footprints(board, uvs, step, step[:, ::-1].copy(), "REPEAT", "REPEAT", False)
    assert np.abs(got - 0.5).max() < 0.05
