"""Hard edges inside charts: normals are right up to the edge, smooth parts stay smooth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import moderngl
import numpy as np
import pytest
from builders_creases import NET, PALETTE, cube_net, load_cube, painted_cube, side_of
from builders_scene import Scene

import runtime
from preprocess.bake.color_borders import BORDER, find_color_borders
from preprocess.bake.hard_edges import (
    INSET,
    LEAST_AREA_REL,
    MAX_MOVE_PX,
    STIFFNESS,
    bake_surface,
    erase_surface,
    find_hard_starts,
    find_normal_uvs,
    move_from_creases,
    move_seams,
)
from preprocess.decimate import DecimateOptions, decimate
from preprocess.fit.level_normal_uvs import find_hard_edges, find_level_normal_uvs
from preprocess.load import load_character
from preprocess.mesh.edges import next_corners, pair_inside_charts
from preprocess.mesh.raster import cover_atlas, rasterise
from preprocess.mesh.seams import find_seams, pick_seams
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import bilinear_stencil, uv_to_px
from preprocess.pipeline import build
from preprocess.progress import Progress
from preprocess.settings import Settings

SIZE = (96, 96)


def doubled_areas(uvs: np.ndarray) -> np.ndarray:
    first, second = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def strip(width_px: float, bend_deg: float, size: int = 64) -> tuple[TexturedSurface, np.ndarray]:
    """Five bands side by side in one chart, each turned against the one before; corner normals of the bands."""
    across = np.cumsum([0.0, 12.0, width_px, width_px, width_px, 12.0]) + 6.3
    u = np.repeat(across, 2) / size
    v = np.tile([8.2, 50.7], 6) / size
    faces = []
    for band in range(5):
        a = 2 * band
        faces += [[a, a + 1, a + 3], [a, a + 3, a + 2]]
    faces = np.array(faces, np.int32)
    positions = np.stack([u, -v, np.zeros(12)], axis=1)
    turn = np.radians(bend_deg) * np.repeat(np.arange(5), 2)
    normals = np.stack([np.sin(turn), np.zeros(10), np.cos(turn)], axis=1)
    surface = TexturedSurface(positions, faces, np.stack([u, v], axis=1), faces)
    return surface, np.repeat(normals[:, None], 3, axis=1)


# Which edges are hard


def slow_twins(surface: TexturedSurface) -> np.ndarray:
    twins = np.full(surface.faces.size, -1)
    halves = {}
    for face in range(len(surface.faces)):
        for k in range(3):
            ends = tuple((surface.faces[face, c % 3], surface.face_uvs[face, c % 3]) for c in (k, k + 1))
            halves[ends] = 3 * face + k
    for (start, end), half in halves.items():
        twins[half] = halves.get((end, start), -1)
    return twins


def test_pairs_inside_charts_equal_a_slow_search(tmp_path: Path) -> None:
    surface = load_cube(tmp_path, cells=3).mesh.surface
    twins = pair_inside_charts(surface)
    np.testing.assert_array_equal(twins, slow_twins(surface))
    assert (twins < 0).sum() == 14 * 3  # seven seams of the net, both sides, three edges each


def test_only_edges_of_the_cube_are_hard(tmp_path: Path) -> None:
    mesh = load_cube(tmp_path, cells=3).mesh
    hard = find_hard_starts(mesh.corner_normals, pair_inside_charts(mesh.surface))
    assert hard.sum() == 5 * 3 * 2
    ends = np.stack([mesh.surface.faces.reshape(-1), np.roll(mesh.surface.faces, -1, axis=1).reshape(-1)], axis=1)
    places = mesh.surface.positions[ends[hard]]
    assert ((np.abs(places) > 0.49).all(axis=1).sum(axis=1) == 2).all()  # both ends on two sides at once


@pytest.mark.parametrize(("angle_deg", "expected"), [(4.0, False), (6.0, True)])
def test_an_edge_is_hard_above_five_degrees(angle_deg: float, expected: bool) -> None:
    surface, normals = strip(8.0, angle_deg)
    assert find_hard_starts(normals, pair_inside_charts(surface)).any() == expected


def test_an_edge_may_be_hard_at_one_end_only() -> None:
    surface, normals = strip(8.0, 0.0)
    bent = normals.copy()
    bent[2:, :][surface.faces[2:] == 2] = (1.0, 0.0, 0.0)  # of one vertex on the first fold, on its far side
    twins = pair_inside_charts(surface)
    hard = find_hard_starts(bent, twins)
    assert set(surface.faces.reshape(-1)[np.flatnonzero(hard)]) == {2}
    assert 0 < hard.sum() and not hard[twins[hard]].any()


def test_smooth_characters_need_no_normal_uvs(tmp_path: Path) -> None:
    assert find_normal_uvs(load_cube(tmp_path, cells=3, smooth=True).mesh, SIZE) is None


# Where corners move


@pytest.mark.parametrize("turn_rad", [0.0, 0.35, np.pi / 4])
def test_every_sample_reads_texels_of_its_own_side(tmp_path: Path, turn_rad: float) -> None:
    mesh = load_cube(tmp_path, turn_rad=turn_rad).mesh
    normal = find_normal_uvs(mesh, SIZE)
    assert normal is not None
    rng = np.random.default_rng(1)
    shares = np.concatenate([rng.dirichlet((0.4, 0.4, 0.4), 3000), np.eye(3)])
    side = side_of(mesh.corner_normals[:, 0])
    owner = rasterise(normal.uvs, normal.face_uvs, *SIZE).faces
    # Where the net's outline turns inwards, sides that no edge joins are neighbours in the atlas as well.
    turns = (np.array([[1, 1], [2, 1], [1, 2], [2, 2]]) - (2.0, 1.5)) / 5.5
    turns = turns @ np.array([[np.cos(turn_rad), np.sin(turn_rad)], [-np.sin(turn_rad), np.cos(turn_rad)]]) + 0.5
    for face in range(mesh.num_faces):
        points = shares @ normal.corners[face]
        clear = np.linalg.norm((points[:, None] - turns) * SIZE, axis=2).min(axis=1) > 2.0
        texels, weights = bilinear_stencil(points[clear], *SIZE)
        read = owner.reshape(-1)[texels]
        assert clear.mean() > 0.85 and (read >= 0).all()
        assert (side[read] == side[face])[weights > 1e-6].all()


def test_moves_equal_least_squares_a_fan(tmp_path: Path) -> None:
    mesh = load_cube(tmp_path, cells=2).mesh
    surface = mesh.surface
    normal = find_normal_uvs(mesh, SIZE)
    assert normal is not None
    corners = uv_to_px(surface.uvs, *SIZE)[surface.face_uvs]
    moved = uv_to_px(normal.uvs, *SIZE)
    hard = normal.hard
    wanted = {}
    for fan in range(len(normal.uvs)):
        rows, distances = [], []
        for face, k in np.argwhere(normal.face_uvs == fan):
            for half, is_hard in ((k, hard[face, k]), ((k + 2) % 3, hard_at_end(surface, hard, face, (k + 2) % 3))):
                if not is_hard:
                    continue
                a, b, c = (corners[face, (half + i) % 3] for i in range(3))
                n = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
                n *= np.sign(n @ (c - a))
                rows.append(n)
                distances.append(INSET * np.abs(n).sum())
        system = np.concatenate([np.array(rows).reshape(-1, 2), np.sqrt(STIFFNESS) * np.eye(2)])
        wanted[fan] = np.linalg.lstsq(system, np.r_[distances, 0.0, 0.0], rcond=None)[0]
    start = np.zeros_like(moved)
    start[normal.face_uvs.reshape(-1)] = corners.reshape(-1, 2)
    step_px = SIZE[0] / 65535
    np.testing.assert_allclose(moved - start, np.array([wanted[f] for f in range(len(moved))]), atol=step_px)


def hard_at_end(surface: TexturedSurface, hard: np.ndarray, face: int, half: int) -> bool:
    twin = slow_twins(surface)[3 * face + half]
    return twin >= 0 and bool(hard.reshape(-1)[twin])


def test_smooth_neighbours_stay_together(tmp_path: Path) -> None:
    mesh = load_cube(tmp_path, cells=4).mesh
    normal = find_normal_uvs(mesh, SIZE)
    assert normal is not None
    twins = pair_inside_charts(mesh.surface)
    smooth = np.flatnonzero((twins >= 0) & ~normal.hard.reshape(-1))
    uvs = normal.corners.reshape(-1, 2)
    np.testing.assert_array_equal(uvs[smooth], uvs[next_corners(twins[smooth])])
    apart = np.flatnonzero(normal.hard.reshape(-1))
    gap = uvs[apart] - uvs[next_corners(twins[apart])]
    assert (np.linalg.norm(gap * SIZE, axis=1) >= 2 * INSET - 0.1).all()


@pytest.mark.parametrize("width_px", [0.05, 0.4, 1.0, 2.0, 3.0, 6.0])
def test_thin_faces_neither_turn_over_nor_vanish(width_px: float) -> None:
    surface, normals = strip(width_px, 30.0)
    twins = pair_inside_charts(surface)
    normal = move_from_creases(surface, twins, find_hard_starts(normals, twins), (64, 64))
    before, after = doubled_areas(surface.uvs[surface.face_uvs]), doubled_areas(normal.corners)
    rounding = 64 / 65535 * 50 / 64**2
    assert (after / before >= LEAST_AREA_REL - rounding / np.abs(before)).all()
    assert np.linalg.norm((normal.corners - surface.uvs[surface.face_uvs]) * 64, axis=2).max() <= MAX_MOVE_PX + 0.01


def test_flat_and_mirrored_faces_are_no_trouble(tmp_path: Path) -> None:
    surface, normals = strip(8.0, 30.0)
    flat = dataclasses.replace(surface, uvs=np.where(np.arange(12)[:, None] < 4, surface.uvs[:1], surface.uvs))
    mirrored = dataclasses.replace(surface, uvs=surface.uvs * (-1, 1) + (1, 0))
    twins = pair_inside_charts(surface)
    hard = find_hard_starts(normals, twins)
    straight = move_from_creases(surface, twins, hard, (64, 64))
    assert np.isfinite(move_from_creases(flat, twins, hard, (64, 64)).uvs).all()
    turned = move_from_creases(mirrored, twins, hard, (64, 64))
    np.testing.assert_allclose(turned.uvs * (-1, 1) + (1, 0), straight.uvs, atol=1.01 / 65535)


def test_nothing_moves_where_nothing_is_hard() -> None:
    surface, _ = strip(8.0, 0.0)
    twins = pair_inside_charts(surface)
    normal = move_from_creases(surface, twins, np.zeros(len(twins), bool), (64, 64))
    np.testing.assert_allclose(normal.corners, surface.uvs[surface.face_uvs], atol=0.51 / 65535)
    none = TexturedSurface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros((0, 3), np.int32))
    assert move_from_creases(none, np.zeros(0, np.int64), np.zeros(0, bool), (64, 64)).uvs.shape == (0, 2)


# Seams, seen at normal uvs


def test_seams_keep_their_points(tmp_path: Path) -> None:
    mesh = load_cube(tmp_path, cells=2).mesh
    surface = mesh.surface
    normal = find_normal_uvs(mesh, SIZE)
    assert normal is not None
    seams = find_seams(surface)
    moved = move_seams(seams, surface, normal)
    ground = erase_surface(surface, normal)
    ground.validate()
    of_point = np.zeros(len(ground.uvs), np.int64)
    of_point[ground.face_uvs.reshape(-1)] = ground.faces.reshape(-1)
    np.testing.assert_array_equal(of_point[moved.uv_pairs], np.repeat(seams.vertices[:, None], 2, axis=1))
    distance_px = (ground.uvs[moved.uv_pairs] - surface.uvs[seams.uv_pairs]) * SIZE
    assert 1.0 < np.linalg.norm(distance_px, axis=-1).max() < 3.0
    covered = cover_atlas(mesh.with_surface(bake_surface(surface, normal)), *SIZE)
    assert covered.inside.sum() < rasterise(surface.uvs, surface.face_uvs, *SIZE).inside.sum()


def test_picked_seams_stand_alone(tmp_path: Path) -> None:
    seams = find_seams(load_cube(tmp_path, cells=2).mesh.surface)
    chosen = np.arange(len(seams.vertices)) % 3 == 0
    picked = pick_seams(seams, chosen)
    np.testing.assert_array_equal(picked.uv_pairs, seams.uv_pairs[chosen])
    assert len(picked.faces) == chosen.sum() and not len(picked.boundary_uvs) and not len(picked.foldover_uvs)


# Coarser levels


def chain_of(mesh: SkinnedMesh) -> tuple:
    return decimate(mesh.surface, DecimateOptions(min_faces=12)).lods


def test_levels_of_a_cube_keep_its_edges(tmp_path: Path) -> None:
    mesh = load_cube(tmp_path, cells=8).mesh
    normal = find_normal_uvs(mesh, SIZE)
    assert normal is not None
    lods = chain_of(mesh)
    assert len(lods) > 2
    np.testing.assert_array_equal(
        find_level_normal_uvs(mesh.surface, normal, lods[0], SIZE), normal.corners[lods[0].face_source]
    )
    owner = rasterise(normal.uvs, normal.face_uvs, *SIZE).faces
    side = side_of(mesh.corner_normals[:, 0])
    shares = np.random.default_rng(2).dirichlet((0.5, 0.5, 0.5), 300)
    for lod in lods[1:]:
        if lod.error_m > 1e-6:
            continue
        corners = find_level_normal_uvs(mesh.surface, normal, lod, SIZE)
        assert corners is not None
        triangles = lod.positions[lod.faces]
        facing = side_of(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
        for face in range(lod.num_faces):
            texels, weights = bilinear_stencil(shares @ corners[face], *SIZE)
            wrong = side[owner.reshape(-1)[texels]] != facing[face]
            assert (weights * wrong).sum(axis=1).mean() < 0.01  # but for the outline's inward turns


def test_levels_seen_from_afar_need_none(tmp_path: Path) -> None:
    mesh = load_cube(tmp_path, cells=4).mesh
    normal = find_normal_uvs(mesh, SIZE)
    assert normal is not None
    coarse = dataclasses.replace(chain_of(mesh)[1], error_m=0.2)
    assert find_level_normal_uvs(mesh.surface, normal, coarse, SIZE) is None


def test_level_edges_are_hard_only_from_end_to_end() -> None:
    surface, _ = strip(8.0, 30.0)
    twins = pair_inside_charts(surface)
    lines = uv_to_px(surface.uvs, 64, 64)[[[2, 3], [4, 5]]]
    hard = find_hard_edges(surface, twins, lines, (64, 64))
    ends = np.stack([surface.faces.reshape(-1), np.roll(surface.faces, -1, axis=1).reshape(-1)], axis=1)
    assert {tuple(sorted(pair)) for pair in ends[hard].tolist()} == {(2, 3), (4, 5)}
    half = lines.copy()
    half[:, 1] = half.mean(axis=1)
    assert not find_hard_edges(surface, twins, half, (64, 64)).any()
    beside = lines + np.array([0.6, 0.0])
    assert not find_hard_edges(surface, twins, beside, (64, 64)).any()


# Colours


def test_gaps_are_the_differences_of_the_palette(tmp_path: Path) -> None:
    character = load_character(painted_cube(tmp_path / "box.glb"))
    mesh = character.mesh
    borders = find_color_borders(character, mesh, SIZE)
    side = np.empty(mesh.num_faces, np.int64)
    triangles = mesh.surface.positions[mesh.surface.faces]
    facing = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    for number, (_, _, normal, _, _) in enumerate(NET):
        side[facing @ np.array(normal) > 0] = number
    left, right = (PALETTE[side[borders.edges.halves[:, k] // 3]] / 255.0 for k in range(2))
    np.testing.assert_allclose(borders.gaps, np.repeat(np.abs(left - right).max(axis=1)[:, None], 3, axis=1), atol=1e-6)
    assert borders.half_edges().sum() == 2 * 12 * 2  # all twelve edges of the cube, of two pieces each, from both sides


def test_one_end_of_an_edge_may_have_a_border(tmp_path: Path) -> None:
    character = load_character(painted_cube(tmp_path / "box.glb"))
    borders = find_color_borders(character, character.mesh, SIZE)
    fading = dataclasses.replace(borders, gaps=borders.gaps * (1.0, 0.5, 0.0))
    glued = borders.edges.halves[borders.gaps[:, 0] > BORDER]
    half_edges = fading.half_edges()
    assert half_edges[glued[:, 0]].all() and not half_edges[glued[:, 1]].any()


def test_painted_borders_are_drawn_to_the_pixel(tmp_path: Path, ctx: moderngl.Context) -> None:
    settings = Settings(atlas="unwrap", color_size_px=128)
    build(painted_cube(tmp_path / "box.glb"), tmp_path / "box", settings, Progress(quiet=True))
    asset = runtime.load(tmp_path / "box")
    assert asset.colors_moved and asset.lods[0].normal_uvs is not None
    scene = Scene(ctx, asset)
    places = view_of(scene, "position", [scene.model.actor()], lod=0)
    colors = view_of(scene, "base_color", [scene.model.actor()], lod=0)
    crowd = runtime.Crowd(ctx, scene.model, 1)
    many = view_of(scene, "base_color", [crowd], lod=0)
    crowd.release()
    scene.release()
    drawn = places[..., 3] > 0
    place = places[drawn][:, :3] / 255 - 0.5
    normals = np.array([normal for _, _, normal, _, _ in NET])
    wanted = PALETTE[(place @ normals.T).argmax(axis=1)]
    clear = np.diff(np.sort(np.abs(place), axis=1)[:, 1:], axis=1)[:, 0] > 0.004
    wrong = np.abs(colors[drawn][:, :3] - wanted).max(axis=1) > 3
    assert clear.mean() > 0.95 and wrong[clear].mean() < 0.002
    assert (np.abs(colors - many).max(axis=2) > 2).mean() < 0.002


# Whole characters


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A built cube in one chart."""
    folder = tmp_path_factory.mktemp("box")
    settings = Settings(atlas="keep", color_size_px=128)
    build(cube_net(folder / "box.glb", cells=2), folder / "box", settings, Progress(quiet=True))
    return folder / "box"


def test_normal_uvs_are_read_as_they_were_written(box: Path) -> None:
    asset = runtime.load(box)
    finest = asset.lods[0]
    assert finest.normal_uvs is not None and finest.normal_uvs.shape == finest.uvs.shape
    np.testing.assert_allclose(finest.normal_uvs * 65535, np.rint(finest.normal_uvs * 65535), atol=0.01)
    assert 1 / 128 < np.abs(finest.normal_uvs - finest.uvs).max() < 3 / 128
    # 26 points of a grid of 2 cells a side; 4 more where seams part them, and a copy on each hard edge.
    assert len(np.unique(finest.canonical_uvs, axis=0)) == 26
    split = np.unique(np.c_[finest.uvs, finest.canonical_uvs], axis=0)
    assert len(finest.uvs) == len(split) + 5 * 3


def view_of(scene: Scene, name: str, actors: object, **how: object) -> np.ndarray:
    camera = runtime.Camera(eye=(0.9, 0.8, 1.1), target=(0, 0, 0), fovy_deg=32)
    return scene.picture(actors, camera, view=name, **how)


@pytest.mark.parametrize("tessellation", ["off", 5])
def test_drawn_normals_are_right_up_to_the_edges(box: Path, ctx: moderngl.Context, tessellation: object) -> None:
    scene = Scene(ctx, runtime.load(box))
    actors = [scene.model.actor()]
    places = view_of(scene, "position", actors, lod=0, tessellation=tessellation)
    normals = view_of(scene, "normal", actors, lod=0, tessellation=tessellation)
    scene.release()
    drawn = places[..., 3] > 0
    assert drawn.mean() > 0.5
    found = normals[drawn][:, :3] / 255 * 2 - 1
    place = places[drawn][:, :3] / 255 - 0.5
    wanted = np.zeros_like(place)
    wanted[np.arange(len(place)), np.abs(place).argmax(axis=1)] = np.sign(np.abs(place).max(axis=1))
    wanted *= np.where(place > 0, 1, -1)
    # Eight bits must say which side it is; where the net's outline turns inwards, other sides are near in the atlas.
    clear = np.diff(np.sort(np.abs(place), axis=1)[:, 1:], axis=1)[:, 0] > 0.004
    clear &= np.linalg.norm(np.abs(place) - 0.5, axis=1) > 0.12
    cosine = (found * wanted).sum(axis=1) / np.linalg.norm(found, axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert clear.mean() > 0.9
    assert angle[clear].max() < 1.0


def test_crowds_and_patches_draw_the_same_normals(box: Path, ctx: moderngl.Context) -> None:
    scene = Scene(ctx, runtime.load(box))
    single = view_of(scene, "normal", [scene.model.actor()], lod=0)
    crowd = runtime.Crowd(ctx, scene.model, 1)
    many = view_of(scene, "normal", [crowd], lod=0)
    patches = view_of(scene, "normal", [scene.model.actor()], lod=0, tessellation=3)
    crowd.release()
    scene.release()
    for other in (many, patches):
        assert (np.abs(single - other).max(axis=2) > 2).mean() < 0.002


def test_own_shaders_read_normal_uvs(box: Path, ctx: moderngl.Context) -> None:
    text = (
        '#include "include/surface.glsl"\nout vec4 result;\n'
        "void main() { result = vec4(surface_normal_uv, length(surface_normal_uv - surface_uv) * 64.0, 1.0); }\n"
    )
    scene = Scene(ctx, runtime.load(box))
    scene.renderer.add_view("uvs", text)
    moved = view_of(scene, "uvs", [scene.model.actor()], lod=0)
    scene.release()
    assert moved[..., 2].max() > 64  # more than half a texel of 128
