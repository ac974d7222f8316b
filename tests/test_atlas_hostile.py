"""Atlases of what other hands may bring: cards, boxes, needles, mirrored and stacked uvs, tiny and huge."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from builders_atlas import copies, grid_of_charts, patch, skinned, tube

from preprocess.atlas import Atlas, build_atlas
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import snap_canonical_uvs
from preprocess.mesh.uv_overlap import find_overlap

BOX = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
BOX_FACES = np.array(
    [
        f
        for a, b, c, d in [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
        for f in ((a, b, c), (a, c, d))
    ]
)


def one_material(mesh: SkinnedMesh) -> SkinnedMesh:
    return dataclasses.replace(mesh, face_materials=np.zeros(mesh.num_faces, np.int32))


def cards(count: int) -> SkinnedMesh:
    """Two-triangle strips a tenth as wide as long, all with the same uvs."""
    positions, faces = patch(1, 1)
    many, many_faces = copies((positions * (1.0, 0.1, 1.0), faces), count)
    uvs = np.tile(positions[:, :2] * (0.1, 0.01), (count, 1))
    return one_material(skinned(many, many_faces, uvs, many_faces))


def limb() -> SkinnedMesh:
    """A closed tube three hundred times as long as wide, without uvs."""
    return skinned(*tube(6, 200, 600.0, closed=True))


def boxes(count: int) -> SkinnedMesh:
    return one_material(skinned(*copies((BOX, BOX_FACES), count)))


def mirrored() -> SkinnedMesh:
    """Both halves of a sheet on one half of the texture."""
    positions, faces = patch(12, 8, 0.05)
    uvs = np.stack([np.abs(positions[:, 0] - 0.5), positions[:, 1]], axis=1)
    return skinned(positions, faces, uvs, faces)


def tiled() -> SkinnedMesh:
    positions, faces = patch(8, 8)
    return skinned(positions, faces, positions[:, :2] * 7.0 - 3.0, faces)


def no_area() -> SkinnedMesh:
    positions, faces = patch(8, 8, 0.1)
    return skinned(positions, faces, np.full((len(positions), 2), 0.25), faces)


def one_part_without_uvs() -> SkinnedMesh:
    """Two patches; all uvs of the second are at one point, as where a file has none."""
    mesh = grid_of_charts(2)
    uvs = mesh.surface.uvs.copy()
    uvs[len(uvs) // 2 :] = 0.0
    mesh = mesh.with_surface(dataclasses.replace(mesh.surface, uvs=uvs))
    return dataclasses.replace(mesh, has_uvs=False)


def scaled(size: float) -> SkinnedMesh:
    positions, faces = tube(12, 20, 6.0, closed=True)
    return skinned(positions * size, faces)


CASES = {
    "600 cards": lambda: cards(600),
    "400 boxes": lambda: boxes(400),
    "long limb": limb,
    "mirrored halves": mirrored,
    "stacked uvs": lambda: grid_of_charts(40),
    "tiled": tiled,
    "no uv area": no_area,
    "one part without uvs": one_part_without_uvs,
    "tiny": lambda: scaled(1e-3),
    "huge": lambda: scaled(1e4),
}


@pytest.fixture(scope="module", params=list(CASES))
def case(request) -> tuple[str, Atlas, float]:
    start = time.process_time()
    atlas = build_atlas(CASES[request.param]())
    return request.param, atlas, time.process_time() - start


def test_every_case_has_its_texels_one_to_one_as_stored(case) -> None:
    _, atlas, seconds = case
    surface = atlas.mesh.surface
    atlas.mesh.validate()
    assert atlas.overlap == 0 and find_overlap(snap_canonical_uvs(surface.uvs), surface.face_uvs).one_to_one
    assert surface.uvs.min() >= 0 and surface.uvs.max() <= 1
    texels = atlas.texels
    assert texels["sparse_area"] <= 0.001 and texels["stretched_area"] <= 0.001
    assert texels["sparse_faces"] == texels["stretched_faces"] == 0
    assert atlas.stretch_l2 <= 1.3
    assert seconds < 40, "compilation included"


def test_size_does_not_matter() -> None:
    tiny, huge = (build_atlas(scaled(s)) for s in (2.0**-10, 2.0**13))
    np.testing.assert_allclose(tiny.mesh.surface.uvs, huge.mesh.surface.uvs, atol=1e-9)


def test_cards_stay_rectangles_and_limbs_keep_their_width() -> None:
    atlas = build_atlas(cards(600))
    assert atlas.num_charts == 600
    corners = atlas.mesh.surface.uvs[atlas.mesh.surface.face_uvs]
    lengths = np.sort(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2), axis=1)
    np.testing.assert_allclose(lengths[:, 0] ** 2 + lengths[:, 1] ** 2, lengths[:, 2] ** 2, rtol=1e-6)
    np.testing.assert_allclose(lengths[:, 1] / lengths[:, 0], 10.0, rtol=1e-6)


def test_hundreds_of_boxes_are_a_chart_or_two_each() -> None:
    assert build_atlas(boxes(400)).num_charts <= 800


def test_a_part_without_uvs_leaves_the_others_alone() -> None:
    from preprocess.atlas.flatten import local_triangles
    from preprocess.atlas.source_charts import find_sound_charts

    surface = one_part_without_uvs().surface
    flat = local_triangles(surface.positions, surface.faces)
    labels = find_sound_charts(surface, flat, np.ones((len(flat), 2)))
    half = len(labels) // 2
    assert (labels[:half] == 0).all() and (labels[half:] == -1).all()
