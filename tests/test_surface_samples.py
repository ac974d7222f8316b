"""Points beside seams: even over the surface, near the lines asked for, and erasure holds values there."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from builders_erase import make_pair
from builders_gltf import GltfBuilder, cube, grid
from test_erase_limit import LIMIT, LINES, SEAMS, SIZE, SURFACE, fault, striped, waves

from preprocess.bake.materials import normal_tangents
from preprocess.bake.seam_points import NEAR_PX, near_lines, points_near_seams, spread_points
from preprocess.erase import EraseOptions, erase_mips
from preprocess.erase.options import LOCAL
from preprocess.load import load_character
from preprocess.load.tangents import corner_tangents
from preprocess.mesh.seams import find_seams
from preprocess.mesh.texels import uv_to_px


def test_points_are_even_over_the_surface() -> None:
    """A thousand times the area takes a thousand times the points; inside a triangle, equal parts have equal shares."""
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    corners = np.stack([triangle, np.zeros((3, 3)), triangle * np.sqrt(1000.0) + 5])
    points = spread_points(corners, 10_010)
    assert np.bincount(points.faces, minlength=3).tolist() == [10, 0, 10_000]
    assert points.barycentrics.min() >= 0 and np.abs(points.barycentrics.sum(axis=1) - 1).max() < 1e-12
    large = points.barycentrics[points.faces == 2]
    for corner in range(3):
        assert (large[:, corner] > 0.5).mean() == pytest.approx(0.25, abs=0.002)
    same = spread_points(corners, 10_010)
    assert same.barycentrics.tobytes() == points.barycentrics.tobytes()
    assert len(spread_points(corners, 0).faces) == 0


def test_texels_near_lines_are_those_within_reach() -> None:
    lines = np.array([[[3.0, 4.0], [20.0, 11.0]], [[28.0, 2.0], [28.0, 2.0]]])
    near = near_lines(lines, 32, 24)
    row, column = np.mgrid[:24, :32]
    texels = np.stack([column, row], axis=-1).reshape(-1, 1, 2).astype(float)
    along = lines[:, 1] - lines[:, 0]
    t = ((texels - lines[:, 0]) * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12)
    away = np.linalg.norm(texels - lines[:, 0] - np.clip(t, 0, 1)[..., None] * along, axis=2).min(axis=1)
    assert near.ravel()[away < NEAR_PX - 0.75].all() and not near.ravel()[away > NEAR_PX + 0.75].any()
    assert not near_lines(np.zeros((0, 2, 2)), 8, 8).any()


def test_points_lie_beside_the_seams_on_both_sides() -> None:
    surface = make_pair(turn_rad=0.5)
    seams = find_seams(surface)
    uvs = surface.uvs[surface.face_uvs]
    points = points_near_seams(surface, uvs, surface.uvs[seams.uv_pairs], (SIZE, SIZE))
    px = points.interpolate(uv_to_px(uvs, SIZE, SIZE))
    near = near_lines(uv_to_px(LINES, SIZE, SIZE), SIZE, SIZE)
    column, row = np.rint(px).astype(int).T
    assert near[row, column].all()
    assert set(points.faces.tolist()) >= set(seams.faces.ravel().tolist())


def test_erasure_holds_values_at_points() -> None:
    """Stripes that a straight seam cannot carry exactly come nearer to what they were, and the seam stays closed."""
    uvs = SURFACE.uvs[SURFACE.face_uvs]
    points = points_near_seams(SURFACE, uvs, SURFACE.uvs[SEAMS.uv_pairs], (SIZE, SIZE))
    places = points.interpolate(uvs)
    start, line = LINES[:, 0], LINES[:, 1] - LINES[:, 0]
    t = np.einsum("nsa,sa->ns", places[:, None] - start, line) / (line**2).sum(axis=1)
    away = np.linalg.norm(places[:, None] - start - np.clip(t, 0, 1)[..., None] * line, axis=2)
    wanted = waves(np.take_along_axis(t, away.argmin(axis=1)[:, None], axis=1))
    weights = dataclasses.replace(LOCAL, samples=10.0 * len(places))
    options = EraseOptions(weights=weights, seam_weight=1e10, jump_limit=LIMIT)
    with_points = erase_mips(striped(), SURFACE, SEAMS, options, levels=65535, samples=(places, wanted))
    without = erase_mips(striped(), SURFACE, SEAMS, options, levels=65535)
    assert fault(with_points[0].texels / 65535) < 0.8 * fault(without[0].texels / 65535)
    assert max(float(level.stored.max.max()) for level in with_points) <= 0.5 / 255
    assert len(with_points) == len(without)


def test_every_normal_map_has_tangents_of_its_own_texture_coordinates(tmp_path: Path) -> None:
    """Two materials, one with its map on the second set, which is turned by a quarter."""
    builder, shape = GltfBuilder(), grid(2, 2)
    turned = shape["uvs"] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    texture = builder.texture(np.full((4, 4, 3), (128, 128, 255), np.uint8))
    parts = []
    for number in range(3):
        normal = {"normalTexture": {"index": texture, "texCoord": number}} if number < 2 else {}
        material = builder.add("materials", **normal)
        attributes = {"NORMAL": np.tile([0, 0, 1.0], (9, 1)), "TEXCOORD_0": shape["uvs"], "TEXCOORD_1": turned}
        part = builder.primitive(shape["positions"] + [3 * number, 0, 0], shape["faces"], **attributes)
        parts.append(part | {"material": material})
    builder.node(mesh=builder.mesh(*parts))
    character = load_character(builder.write(tmp_path / "two.glb"))
    mesh = character.mesh
    tangents = normal_tangents(character, mesh)
    assert tangents is not None
    for texcoord in range(2):
        faces = mesh.face_materials == texcoord
        assert faces.any()
        uvs = mesh.corner_texcoords[faces][:, :, texcoord]
        np.testing.assert_array_equal(tangents[faces], corner_tangents(mesh, np.flatnonzero(faces), uvs))
    assert np.abs(tangents[mesh.face_materials == 0] - tangents[mesh.face_materials == 1]).max() > 0.9


def test_without_normal_maps_there_are_no_tangents(tmp_path: Path) -> None:
    builder, shape = GltfBuilder(), cube()
    builder.node(mesh=builder.mesh(builder.primitive(shape["positions"], shape["faces"], TEXCOORD_0=shape["uvs"])))
    character = load_character(builder.write(tmp_path / "plain.glb"))
    assert normal_tangents(character, character.mesh) is None
