"""Welding, duplicates, manifold splitting and missing normals on small meshes with a known answer."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from builders_gltf import GltfBuilder, cube, grid

from preprocess.load import Character, load_character
from preprocess.load.manifold import make_manifold
from preprocess.load.weld import canonical_influences
from preprocess.mesh.corner_normals import smooth_corner_normals
from preprocess.mesh.grouping import cluster_points, group_rows
from preprocess.mesh.seams import find_seams


def loaded(tmp_path: Path, positions, faces, material: dict | None = None, **attributes) -> Character:
    builder = GltfBuilder()
    primitive = builder.primitive(positions, faces, **attributes)
    if material is not None:
        primitive["material"] = builder.add("materials", **material)
    builder.node(mesh=builder.mesh(primitive))
    character = load_character(builder.write(tmp_path / "a.glb"))
    character.mesh.validate()
    find_seams(character.mesh.surface)
    return character


def said(character: Character, words: str) -> bool:
    return any(words in warning for warning in character.warnings)


def directed_edges_are_unique(faces: np.ndarray) -> bool:
    edges = np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)
    return len(np.unique(edges, axis=0)) == len(edges)


def split(faces, positions=None, sources=None, uvs=None, parts=None):
    faces = np.asarray(faces, np.int64)
    if positions is None:
        positions = np.random.default_rng(0).normal(size=(faces.max() + 1, 3))
    return make_manifold(
        faces,
        positions,
        faces if sources is None else np.asarray(sources),
        faces if uvs is None else np.asarray(uvs),
        np.zeros(len(faces), np.int64) if parts is None else np.asarray(parts),
    )


def test_group_rows_numbers_by_first_occurrence() -> None:
    groups, firsts = group_rows(np.array([5, 3, 5, 9, 3]), np.array([1, 1, 1, 0, 2]))
    assert groups.tolist() == [0, 1, 0, 2, 3] and firsts.tolist() == [0, 1, 3, 4]


@pytest.mark.parametrize("dimension", [2, 3])
def test_clustering_against_its_slow_twin(dimension: int) -> None:
    """Well separated clumps join whole; nothing farther apart than the tolerance does."""
    rng = np.random.default_rng(3)
    centres = rng.uniform(-5, 5, (40, dimension))
    points = (centres[:, None] + rng.uniform(-0.2e-6, 0.2e-6, (40, 5, dimension))).reshape(-1, dimension)
    points = points[rng.permutation(len(points))]
    clusters, firsts = cluster_points(points, 1e-6)
    near = np.abs(points[:, None] - points[None]).max(axis=2) < 1e-6
    np.testing.assert_array_equal(clusters[:, None] == clusters[None], near)
    assert len(firsts) == 40 and (clusters[firsts] == np.arange(40)).all()


def test_clustering_does_not_miss_neighbours_across_cell_borders() -> None:
    for offset in np.linspace(0, 2, 41):
        pair = np.array([[0, 0, 0], [offset, offset, offset], [offset + 0.49, offset + 0.49, offset + 0.49]])
        clusters, _ = cluster_points(pair, 1.0)
        assert clusters[1] == clusters[2]


def test_influences_have_one_form() -> None:
    joints = np.array([[3, 1, 3, 0], [1, 3, 0, 0]])
    weights = np.array([[0.25, 0.5, 0.25, 0.0], [0.5, 0.5, 0.0, 0.0]])
    joints, weights = canonical_influences(joints, weights)
    assert joints.tolist() == [[1, 3], [1, 3]] and weights.tolist() == [[0.5, 0.5], [0.5, 0.5]]


def test_a_cube_welds_and_keeps_hard_edges_and_uv_seams(tmp_path: Path) -> None:
    shape = cube()
    character = loaded(tmp_path, shape["positions"], shape["faces"], NORMAL=shape["normals"], TEXCOORD_0=shape["uvs"])
    mesh = character.mesh
    assert mesh.num_vertices == 8 and len(mesh.surface.uvs) == 24
    seams = find_seams(mesh.surface)
    assert len(seams.vertices) == 12 and not len(seams.boundary_vertices)
    corners = mesh.surface.positions[mesh.surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(mesh.corner_normals, np.repeat(normals[:, None], 3, axis=1), atol=1e-6)


def test_mere_duplication_leaves_no_trace(tmp_path: Path) -> None:
    """Every triangle with vertices of its own, all attributes equal: the grid comes back."""
    shape = grid(4, 3)
    faces = shape["faces"]
    soup = faces.reshape(-1)
    character = loaded(tmp_path, shape["positions"][soup], None, TEXCOORD_0=shape["uvs"][soup])
    assert character.mesh.num_vertices == 20 and len(character.mesh.surface.uvs) == 20
    assert not len(find_seams(character.mesh.surface).vertices)


def test_positions_within_rounding_weld_and_beyond_do_not(tmp_path: Path) -> None:
    for shift, vertices in ((3e-7, 9 + 6), (1e-4, 18)):
        left, right = grid(2, 2), grid(2, 2)
        positions = np.concatenate([left["positions"], right["positions"] + (1 + shift, 0, 0)])
        faces = np.concatenate([left["faces"], right["faces"] + 9])
        assert loaded(tmp_path, positions, faces).mesh.num_vertices == vertices


@pytest.mark.parametrize(("noise", "welds"), [(3e-7, True), (1e-3, False)])
def test_weights_that_differ_by_rounding_weld(tmp_path: Path, noise: float, welds: bool) -> None:
    """A soup whose copies were normalised one by one; joints in any order, equal weights among them."""
    rng = np.random.default_rng(4)
    builder, shape = GltfBuilder(), grid(20, 20)
    soup = shape["faces"].reshape(-1)
    weights = rng.dirichlet((1, 1, 1, 1), len(shape["positions"]))
    weights[::3] = 0.25
    weights = np.clip(weights[soup] + rng.uniform(-noise, noise, (len(soup), 4)), 0, 1)
    shuffle = np.argsort(rng.uniform(size=weights.shape), axis=1)
    primitive = builder.primitive(
        shape["positions"][soup],
        None,
        JOINTS_0=shuffle,
        WEIGHTS_0=np.take_along_axis(weights, shuffle, axis=1),
    )
    joints = [builder.node(name=f"j{k}") for k in range(4)]
    builder.node(mesh=builder.mesh(primitive), skin=builder.skin(joints))
    count = load_character(builder.write(tmp_path / "a.glb")).mesh.num_vertices
    assert count == 441 if welds else count > 1000


def test_triangles_without_area_are_removed_and_counted(tmp_path: Path) -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [1, 0, 0]], float)
    faces = [[0, 1, 2], [0, 3, 1], [1, 4, 2], [0, 0, 2]]  # collinear; two equal points; one index twice
    character = loaded(tmp_path, positions, faces)
    assert character.mesh.num_faces == 1 and said(character, "3 triangles without area removed")


def test_repeated_faces_go(tmp_path: Path) -> None:
    character = loaded(tmp_path, np.eye(3), [[0, 1, 2], [1, 2, 0], [2, 0, 1]])
    assert character.mesh.num_faces == 1 and said(character, "2 duplicate triangles removed")


def test_backs_go_where_the_material_is_double_sided(tmp_path: Path) -> None:
    character = loaded(tmp_path, np.eye(3), [[0, 1, 2], [0, 2, 1]], {"doubleSided": True})
    assert character.mesh.num_faces == 1 and len(character.materials) == 1
    assert said(character, "1 triangles that were the back of another removed")


def test_fronts_become_double_sided_where_it_is_not(tmp_path: Path) -> None:
    shape = grid(2, 1)
    faces = np.concatenate([shape["faces"], shape["faces"][:1, ::-1]])
    character = loaded(tmp_path, shape["positions"], faces, {"name": "cloth"}, TEXCOORD_0=shape["uvs"])
    assert character.mesh.num_faces == 4
    assert [m.name for m in character.materials] == ["cloth", "cloth (double-sided)"]
    assert [m.double_sided for m in character.materials] == [False, True]
    assert character.mesh.face_materials.tolist() == [1, 0, 0, 0]


def back_to_back(tmp_path: Path, positions, uvs, faces) -> Character:
    """A single-sided cloth with another picture behind."""
    count = len(positions)
    both = np.concatenate([faces, faces[:, ::-1] + count])
    twice = np.concatenate([positions, positions])
    character = loaded(tmp_path, twice, both, {}, TEXCOORD_0=np.concatenate([uvs * 0.5, uvs * 0.5 + 0.5]))
    assert character.mesh.num_faces == len(both)
    assert said(character, "edges with three or more faces split")
    assert directed_edges_are_unique(character.mesh.surface.faces)
    return character


def test_two_pictures_back_to_back_stay_two_sheets_closed_at_the_rim(tmp_path: Path) -> None:
    angle = np.arange(8) * np.pi / 4
    positions = np.concatenate([[[0, 0, 0]], np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)])
    rim = np.arange(1, 9)
    faces = np.stack([np.zeros(8, int), rim, np.roll(rim, -1)], axis=1)
    character = back_to_back(tmp_path, positions, positions[:, :2] * 0.5 + 0.5, faces)
    assert character.mesh.num_vertices == 8 + 2  # the rim once, the middle twice
    assert not len(find_seams(character.mesh.surface).boundary_vertices)


def test_edges_across_from_rim_to_rim_are_cut(tmp_path: Path) -> None:
    """The diagonals 1-5 and 3-7 of the grid would have both sheets at both ends: their ends are doubled as well."""
    shape = grid(2, 2)
    character = back_to_back(tmp_path, shape["positions"], shape["uvs"], shape["faces"])
    assert character.mesh.num_vertices == 8 + 2 + 4


def test_a_clean_mesh_is_left_alone() -> None:
    shape = grid(3, 3)
    result = split(shape["faces"], shape["positions"])
    assert result.num_split_edges == result.num_split_vertices == result.num_turned == 0
    np.testing.assert_array_equal(result.vertex_origin[result.faces], shape["faces"])


def test_a_bow_tie_parts_at_its_point() -> None:
    result = split([[0, 1, 2], [0, 3, 4]])
    assert len(result.vertex_origin) == 6 and result.num_split_vertices == 1
    assert sorted(result.vertex_origin) == [0, 0, 1, 2, 3, 4]


def test_a_fin_leaves_the_surface_that_the_source_draws_as_one() -> None:
    """Three faces on edge 0-1: two share source vertices there, so they stay together and the fin is cut off."""
    faces = [[0, 1, 2], [1, 0, 3], [0, 1, 4]]
    sources = [[0, 1, 2], [1, 0, 3], [5, 6, 4]]
    for order in itertools.permutations(range(3)):
        result = split([faces[i] for i in order], sources=[sources[i] for i in order])
        assert result.num_split_edges == 1 and result.num_split_vertices == 2
        back = np.argsort(order)
        together = result.faces[back]
        assert together[0, 0] == together[1, 1] and together[0, 1] == together[1, 0]
        assert not set(together[2]) & set(together[:2].ravel())


def test_two_solids_that_touch_along_an_edge_become_two_solids() -> None:
    """Two tetrahedra with a common edge: four faces there; each pair that encloses a solid stays together."""
    positions = np.array([[0, 0, 0], [0, 0, 1], [1, 1, 0.5], [1, -1, 0.5], [-1, 1, 0.5], [-1, -1, 0.5]], float)

    def outward(tetrahedron):
        centre = positions[list(tetrahedron)].mean(axis=0)
        for face in itertools.combinations(tetrahedron, 3):
            a, b, c = positions[list(face)]
            yield face if np.dot(np.cross(b - a, c - a), a - centre) > 0 else face[::-1]

    faces = [*outward((0, 1, 2, 3)), *outward((0, 1, 4, 5))]
    result = split(faces, positions, sources=np.arange(24).reshape(8, 3), uvs=np.arange(24).reshape(8, 3))
    assert result.num_split_edges == 1 and len(result.vertex_origin) == 8
    assert not set(result.faces[:4].ravel()) & set(result.faces[4:].ravel())
    assert len(set(result.faces[:4].ravel())) == 4  # both stay closed


def test_winding_follows_the_larger_side() -> None:
    shape = grid(4, 4)
    faces = shape["faces"].copy()
    faces[[3, 4, 9]] = faces[[3, 4, 9], ::-1]
    result = split(faces, shape["positions"])
    assert result.num_turned == 3 and result.num_unorientable == 0
    assert np.flatnonzero(result.corners[:, 1] == 2).tolist() == [3, 4, 9]
    assert directed_edges_are_unique(result.faces)


def moebius(num_steps: int) -> list[list[int]]:
    faces = []
    for k in range(num_steps):
        a, b = 2 * k, 2 * k + 1
        c, d = (2 * k + 2, 2 * k + 3) if k < num_steps - 1 else (1, 0)
        faces += [[a, c, b], [b, c, d]]
    return faces


@pytest.mark.parametrize("num_steps", [3, 8, 101])
def test_a_moebius_strip_is_cut_once(num_steps: int) -> None:
    result = split(moebius(num_steps))
    assert result.num_unorientable == 1
    assert directed_edges_are_unique(result.faces)
    assert len(result.vertex_origin) == 2 * num_steps + 2  # one edge cut across the strip
    assert result.num_turned == 0  # the strip winds one way but for one edge: there it is cut


def test_projective_plane_ends_as_a_manifold() -> None:
    """Six vertices, every pair an edge: closed and one-sided."""
    faces = [
        [0, 1, 2],
        [0, 2, 3],
        [0, 3, 4],
        [0, 4, 5],
        [0, 5, 1],
        [1, 2, 4],
        [2, 3, 5],
        [3, 4, 1],
        [4, 5, 2],
        [5, 1, 3],
    ]
    result = split(faces)
    assert result.num_unorientable == 1 and directed_edges_are_unique(result.faces)


@pytest.mark.parametrize("seed", range(30))
def test_any_soup_becomes_an_oriented_manifold(seed: int) -> None:
    """Random triangles over a few vertices: heavily non-manifold, yet the result always is one, and is stable."""
    rng = np.random.default_rng(seed)
    faces = np.stack([rng.permutation(7)[:3] for _ in range(int(rng.integers(1, 60)))])
    result = split(faces, rng.normal(size=(7, 3)), sources=np.arange(faces.size).reshape(-1, 3))
    assert directed_edges_are_unique(result.faces)
    undirected = np.sort(np.stack([result.faces.ravel(), np.roll(result.faces, -1, 1).ravel()], 1), axis=1)
    assert np.unique(undirected, axis=0, return_counts=True)[1].max() <= 2
    turned = np.take_along_axis(faces, result.corners, axis=1)
    np.testing.assert_array_equal(result.vertex_origin[result.faces], turned)
    again = split(result.faces, rng.normal(size=(len(result.vertex_origin), 3)))
    assert again.num_split_vertices == again.num_split_edges == again.num_turned == 0


def test_turned_faces_take_their_normals_along(tmp_path: Path) -> None:
    shape = grid(3, 3)
    faces = np.concatenate([shape["faces"][:1, ::-1], shape["faces"][1:]])
    positions = np.concatenate([shape["positions"], shape["positions"][faces[0]]])
    normals = np.tile([0, 0, 1.0], (len(positions), 1))
    normals[-3:] = (0, 0, -1)  # the turned face was drawn with its own back-facing normals
    faces[0] = len(positions) - np.array([3, 2, 1])
    character = loaded(tmp_path, positions, faces, NORMAL=normals)
    assert said(character, "1 triangles turned over")
    np.testing.assert_allclose(character.mesh.corner_normals, np.broadcast_to([0, 0, 1.0], (18, 3, 3)))


def test_missing_normals_are_smooth_but_sharp_edges_stay_hard() -> None:
    shape = cube()
    _, firsts = np.unique(np.round(shape["positions"], 3), axis=0, return_index=True)
    position = shape["positions"][firsts]
    weld = np.array([np.abs(position - p).sum(axis=1).argmin() for p in shape["positions"]])
    faces = weld[shape["faces"]]
    hard = smooth_corner_normals(position, faces)
    np.testing.assert_allclose(hard, shape["normals"][shape["faces"]], atol=1e-12)
    soft = smooth_corner_normals(position, faces, crease_rad=np.pi)
    np.testing.assert_allclose(soft, (position / np.linalg.norm(position, axis=1, keepdims=True))[faces], atol=1e-12)


def test_many_copies_of_one_place_take_no_time(tmp_path: Path) -> None:
    """Ten thousand faces on the same few points, and interpenetrating copies: bounded, and still a manifold."""
    faces = np.tile(np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]), (5000, 1))
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    character = loaded(tmp_path, positions, faces)
    assert character.mesh.num_faces == 4 and said(character, "19996 duplicate triangles removed")
