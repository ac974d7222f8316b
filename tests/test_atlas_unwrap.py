"""The base-mesh atlas: one-to-one, disks, straight and matched seams, the floor, on good and bad meshes."""

from __future__ import annotations

import numpy as np
import pytest
from builders_atlas import FAMILIES, copies, patch, skinned, tetrahedron, tube

from preprocess.atlas import build_atlas, default_floor
from preprocess.atlas.layout import chart_characteristics
from preprocess.atlas.unwrap import unwrap
from preprocess.errors import InputError
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.seams import find_seams
from preprocess.mesh.uv_overlap import find_overlap


@pytest.fixture(scope="module", params=list(FAMILIES))
def unwrapped(request):
    """Name, source mesh, floor and result of each family."""
    mesh = skinned(*FAMILIES[request.param])
    floor = max(int(0.1 * mesh.num_faces), 20)
    return request.param, mesh, floor, unwrap(mesh, floor, 512, 4.0, 4.0)


def test_every_atlas_is_one_to_one_and_inside_the_square(unwrapped):
    _, _, _, made = unwrapped
    surface = made.mesh.surface
    made.mesh.validate()
    assert find_overlap(surface.uvs, surface.face_uvs).one_to_one
    assert surface.uvs.min() > 0 and surface.uvs.max() < 1
    assert (face_orientation(surface.uvs, surface.face_uvs) == -1).all(), "no chart is mirrored (v runs down)"


def test_every_chart_is_a_disk(unwrapped):
    _, _, _, made = unwrapped
    surface = made.mesh.surface
    edges = find_edges(surface.faces)
    cut = cut_edges(edges, surface.face_uvs)
    _, characteristic = chart_characteristics(surface.faces, edges, cut)
    assert (characteristic == 1).all()
    assert len(characteristic) == made.layout.num_charts


def test_paths_are_straight_and_matched_on_both_sides(unwrapped):
    """Every vertex of a path lies on the segment of its side, at one fraction on all sides, to rounding."""
    _, _, _, made = unwrapped
    layout, uvs = made.layout, made.mesh.surface.uvs
    fraction = {}
    for uv, side in zip(layout.boundary_uvs, layout.boundary_sides, strict=True):
        path = layout.side_paths[side]
        first, last = uvs[layout.side_uvs[side]], uvs[layout.side_uvs[layout.side_ends[side]]]
        a, b = (first, last) if layout.side_forward[side] else (last, first)
        axis = b - a
        t = float((uvs[uv] - a) @ axis / (axis @ axis))
        assert np.abs(uvs[uv] - a - t * axis).max() < 1e-12
        key = (path, layout.uv_vertices[uv])
        if uv not in layout.side_uvs:
            assert abs(fraction.setdefault(key, t) - t) < 1e-11
            assert 0 < t < 1
        else:
            assert min(abs(t), abs(t - 1)) < 1e-12


def test_polygons_are_convex_and_valid(unwrapped):
    _, _, _, made = unwrapped
    layout, uvs = made.layout, made.mesh.surface.uvs
    assert (layout.num_sides >= 3).all()
    for low, high in zip(layout.chart_first[:-1], layout.chart_first[1:], strict=True):
        corner = uvs[layout.side_uvs[low:high]]
        side = np.roll(corner, -1, axis=0) - corner
        following = np.roll(side, -1, axis=0)
        assert (side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0] < 0).all()
    ends = np.sort(
        np.stack(
            [layout.path_vertices[layout.path_first[:-1]], layout.path_vertices[layout.path_first[1:] - 1]], axis=1
        ),
        axis=1,
    )
    assert (ends[:, 0] != ends[:, 1]).all(), "no path ends where it starts"
    assert len(np.unique(ends, axis=0)) == len(ends), "two corners share one path at most"


def test_seams_pair_up(unwrapped):
    name, _, _, made = unwrapped
    seams = find_seams(made.mesh.surface)
    edges = find_edges(made.mesh.surface.faces)
    cut = cut_edges(edges, made.mesh.surface.face_uvs)
    if "mobius" not in name:
        assert len(seams.vertices) == (cut & edges.glued).sum()
    assert len(seams.foldover_uvs) == 0


def test_attributes_survive_splits(unwrapped):
    """Corner data is linear in position here, so it must still be after edges were split."""
    _, mesh, _, made = unwrapped
    corner = made.mesh.surface.positions[made.mesh.surface.faces]
    scale = max(mesh.surface.diagonal_m, 1e-300)
    np.testing.assert_allclose(
        made.mesh.corner_texcoords / scale, np.stack([corner[..., :2], corner[..., 1:]], axis=2) / scale, atol=1e-12
    )
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    before = mesh.surface.positions[mesh.surface.faces]
    expected = np.linalg.norm(np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0]), axis=1).sum()
    assert area == pytest.approx(expected, rel=1e-9, abs=1e-300)


def test_charts_keep_the_gutter(unwrapped):
    """Vertices of different charts are never nearer than the gutter (boundary sampled every fifth of a texel)."""
    name, _, _, made = unwrapped
    if made.layout.num_charts > 120:
        pytest.skip("quadratic test")
    uvs = made.mesh.surface.uvs * 512
    layout = made.layout
    start = uvs[layout.side_uvs]
    stop = uvs[layout.side_uvs[layout.side_ends]]
    chart = np.repeat(np.arange(layout.num_charts), layout.num_sides)
    count = np.maximum(np.ceil(5 * np.linalg.norm(stop - start, axis=1)).astype(int), 2)
    points = np.concatenate(
        [a + np.linspace(0, 1, n)[:, None] * (b - a) for a, b, n in zip(start, stop, count, strict=True)]
    )
    owner = np.repeat(chart, count)
    assert points.min() > 1.9 and points.max() < 512 - 1.9, name
    from scipy.spatial import cKDTree

    trees = [cKDTree(points[owner == c]) for c in range(layout.num_charts)]
    for c, tree in enumerate(trees):
        others = points[owner != c]
        if len(others):
            assert tree.query(others)[0].min() > 3.99, name


def test_floor_is_reached():
    for positions, faces in (FAMILIES["closed tube"], FAMILIES["torus"], FAMILIES["cape"], tube(24, 60, 20, True)):
        mesh = skinned(positions, faces)
        atlas = build_atlas(mesh, mode="unwrap", floor=100)
        assert atlas.floor_faces <= 100
        from preprocess.decimate import decimate_to

        assert len(decimate_to(atlas.mesh.surface, 100).lods[0].faces) <= 100


def test_a_flat_patch_is_hardly_stretched():
    atlas = build_atlas(skinned(*patch(24, 24)), mode="unwrap")
    assert atlas.stretch_l2 < 1.2
    assert atlas.straightened > 0.6


def test_same_input_same_bits():
    mesh = skinned(*FAMILIES["torus"])
    first, second = (unwrap(mesh, 120, 512, 4.0, 4.0).mesh.surface for _ in range(2))
    assert first.uvs.tobytes() == second.uvs.tobytes()
    assert first.face_uvs.tobytes() == second.face_uvs.tobytes()


def test_scale_and_place_do_not_matter():
    positions, faces = FAMILIES["torus"]
    small = unwrap(skinned(positions, faces), 120, 512, 4.0, 4.0)
    large = unwrap(skinned(positions * 1024.0, faces), 120, 512, 4.0, 4.0)
    np.testing.assert_allclose(small.mesh.surface.uvs, large.mesh.surface.uvs, atol=1e-6)


def test_small_parts_keep_some_texels():
    positions, faces = copies(tetrahedron(), 2, 5.0)
    positions[4:] = positions[4:] * 1e-4 + 7  # one of them ten thousand times smaller
    atlas = build_atlas(skinned(positions, faces), mode="unwrap", size_px=256, min_chart_px=4)
    edges = find_edges(atlas.mesh.surface.faces)
    count, charts = label_faces(edges, cut_edges(edges, atlas.mesh.surface.face_uvs))
    corner = atlas.mesh.surface.uvs[atlas.mesh.surface.face_uvs] * 256
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = np.bincount(charts, 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), count)
    assert area.min() > 0.3, "a part never vanishes"


def test_thousands_of_parts_take_bounded_time():
    import time

    mesh = skinned(*copies((np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])), 3000))
    start = time.process_time()
    atlas = build_atlas(mesh, mode="unwrap", size_px=1024)
    assert time.process_time() - start < 20
    assert atlas.num_charts == 3000 and atlas.overlap == 0
    assert any("need 3000 faces" in warning for warning in atlas.warnings)


def test_too_many_charts_for_the_texture_are_refused_in_one_line():
    mesh = skinned(*copies(tetrahedron(), 200))
    with pytest.raises(InputError, match="do not fit into 32 x 32 texels") as error:
        build_atlas(mesh, mode="unwrap", size_px=32)
    assert "\n" not in str(error.value)


def test_default_floor():
    assert default_floor(26756) == 802 and default_floor(576) == 200
