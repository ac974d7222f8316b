"""The built-in character: its solids, mesh, charts, weights, clips and file."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from demos.creature.anatomy import build_body
from demos.creature.build import Creature, model_creature, write
from demos.creature.clips import build_clips
from demos.creature.field import Cone, Ellipsoid, Field, Piece
from demos.creature.motion import Motion, to_quaternions, turn
from demos.creature.noise import _hash, cells, fractal_noise, value_noise
from demos.creature.raster import cover_texels
from demos.creature.skeleton import build_joints
from demos.creature.surface import corner_cotangents, face_normals, unique_edges
from demos.gallery import PICTURES, make_pictures
from preprocess.files.images import read_image
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.pipeline import build
from preprocess.progress import Progress
from preprocess.settings import Settings

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def creature() -> Creature:
    return model_creature()


@pytest.fixture(scope="module")
def glb(creature: Creature, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("creature") / "creature.glb"
    write(path, creature)
    return path


# Solids


@pytest.mark.parametrize("radii", [(0.3, 0.1), (0.1, 0.3), (0.2, 0.2)])
def test_cone_is_the_distance_to_a_dense_row_of_spheres(radii: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (200, 3))
    cone = Cone((-0.3, 0.1, 0.0), (0.4, 0.0, 0.3), *radii)
    t = np.linspace(0, 1, 4001)
    centres = np.array(cone.a) + t[:, None] * (np.array(cone.b) - np.array(cone.a))
    sizes = radii[0] + t * (radii[1] - radii[0])
    twin = (np.linalg.norm(points[:, None] - centres, axis=2) - sizes).min(axis=1)
    assert np.allclose(cone.distance(points), twin, atol=1e-6)


def test_flat_cone_and_ellipsoid_are_distances_to_first_order_at_the_surface() -> None:
    solids = (
        Cone((0, 0, 0), (0, 0.4, 0), 0.3, 0.2, flat_axis=(1, 0, 0), flatness=0.4),
        Ellipsoid((0.1, 0, 0), (0.3, 0.2, 0.5), pitch=20, yaw=30, roll=40),
    )
    rng = np.random.default_rng(2)
    for solid in solids:
        field = Field((Piece("part", solid, 0.1),))
        points = field.project(rng.uniform(0.1, 0.5, (300, 3)), 60)
        assert np.abs(solid.distance(points)).max() < 1e-6
        assert np.allclose(np.linalg.norm(field.gradient(points), axis=1), 1.0, atol=1e-3)


def test_leaving_out_far_pieces_changes_nothing_near_the_skin() -> None:
    field = build_body()
    rng = np.random.default_rng(3)
    points = rng.uniform((-0.4, 0.0, -1.1), (0.4, 0.9, 0.7), (4000, 3))
    folded = points * np.where(points[:, :1] < 0, -1.0, 1.0) ** np.array([1.0, 0.0, 0.0])
    whole = np.full(len(points), 10.0)
    for piece in field.pieces:  # every piece at every point
        sign = -1.0 if piece.carve else 1.0
        other, before = sign * piece.solid.distance(folded), whole
        share = np.clip(0.5 + sign * 0.5 * (before - other) / piece.blend, 0.0, 1.0)
        whole = before + (other - before) * share - sign * piece.blend * share * (1.0 - share)
    near = np.abs(whole) < 0.03
    assert near.sum() > 200
    assert np.allclose(field.distance(points)[near], whole[near], atol=1e-9)
    mix = field.regions_at(points[near])
    assert (mix >= 0).all() and np.allclose(mix.sum(axis=1), 1.0)
    assert field.distance(np.zeros((0, 3))).shape == (0,)


# Patterns


def test_noise_lies_in_its_range_is_continuous_and_repeats() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-20, 20, (500, 3))
    for noise in (value_noise, fractal_noise):
        values = noise(points)
        assert values.min() >= 0 and values.max() <= 1 and np.ptp(values) > 0.5
        assert np.abs(noise(points + 1e-6) - values).max() < 1e-4
        assert np.array_equal(values, noise(points.copy()))


def test_cells_find_the_two_nearest_sites() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-3, 3, (40, 3))
    first, second, _ = cells(points, 7, 0.8)
    grid = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    h = _hash(*grid.T, 7)
    shifts = np.stack([(h >> np.uint32(s)) & np.uint32(1023) for s in (0, 10, 20)], axis=1) / 1023.0
    sites = grid + 0.1 + 0.8 * shifts
    distances = np.sort(np.linalg.norm(points[:, None] - sites, axis=2), axis=1)
    assert np.allclose(first, distances[:, 0], atol=1e-5)
    assert np.allclose(second, distances[:, 1], atol=1e-5)


def test_faces_that_share_edges_cover_each_texel_once() -> None:
    # A fan around a texel centre whose spokes run through other centres: every texel of the square belongs to one.
    rim = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]]) * 3.0
    uvs = np.concatenate([[[4.5, 4.5]], 4.5 + rim]) / 9.0
    faces = np.array([[0, 1 + k, 1 + (k + 1) % 8] for k in range(8)])
    for order in (faces, faces[:, ::-1]):
        face, x, y, barycentric = cover_texels(uvs, order, 9)
        counts = np.bincount(y * 9 + x, minlength=81).reshape(9, 9)
        assert (counts[2:7, 2:7] == 1).all() and counts.max() == 1
        centres = np.einsum("nk,nkc->nc", barycentric, uvs[order[face]])
        assert np.allclose(centres * 9, np.stack([x, y], axis=1) + 0.5)


# Skeleton and motion


def test_joints_are_a_tree_with_two_equal_sides() -> None:
    joints = build_joints()
    assert len(joints.names) >= 20 and len(set(joints.names)) == len(joints.names)
    assert joints.parents[0] == -1 and (joints.parents[1:] < np.arange(1, len(joints.names))).all()
    assert (joints.parents[1:] >= 0).all()
    for name in joints.names:
        if name.endswith(".L"):
            left, right = joints.index(name), joints.index(name.replace(".L", ".R"))
            assert np.array_equal(joints.positions[left] * [-1, 1, 1], joints.positions[right])
            assert np.array_equal(joints.tips[left] * [-1, 1, 1], joints.tips[right])


def test_quaternions_turn_as_their_matrices() -> None:
    rng = np.random.default_rng(6)
    matrices = turn(*rng.uniform(-180, 180, (3, 400)))
    q = to_quaternions(matrices).astype(float)
    assert np.allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-6)
    vectors = rng.normal(size=(400, 3))
    axis, w = q[:, :3], q[:, 3:]
    turned = vectors + 2 * np.cross(axis, np.cross(axis, vectors) + w * vectors)
    assert np.allclose(turned, np.einsum("nij,nj->ni", matrices, vectors), atol=1e-5)


def test_reach_puts_the_end_joint_where_it_should_be() -> None:
    joints = build_joints()
    motion = Motion(joints, "test", 1.0, 9)
    motion.rotate("hips", x=motion.wave(10.0), y=motion.wave(20.0))
    rest = joints.positions[joints.index("foot.L")]
    target = rest + np.stack([0 * motion.phase, 0.03 + 0 * motion.phase, motion.wave(0.05)], axis=1)
    motion.reach("thigh.L", "shin.L", "foot.L", target, np.array([0.2, 0.3, 1.0]), turn(motion.wave(15.0)))
    rotation, position = motion.world("foot.L")
    assert np.allclose(position, target, atol=1e-9)
    assert np.allclose(rotation, turn(motion.wave(15.0)), atol=1e-9)


def test_reach_out_of_reach_points_there() -> None:
    motion = Motion(build_joints(), "test", 1.0, 2)
    target = np.array([[0.4, -1.0, 0.3]] * 2)
    motion.reach("thigh.L", "shin.L", "foot.L", target, np.array([0.0, 0.0, 1.0]), turn(np.zeros(2)))
    hip, foot = motion.world("thigh.L")[1], motion.world("foot.L")[1]
    cosine = ((foot - hip) * (target - hip)).sum(axis=1) / np.linalg.norm(foot - hip, axis=1)
    assert np.allclose(cosine / np.linalg.norm(target - hip, axis=1), 1.0, atol=1e-6)


def test_clips_loop_and_feet_stay_planted() -> None:
    joints = build_joints()
    clips = {motion.name: motion for motion in build_clips(joints)}
    assert set(clips) == {"idle", "walk", "greet"}
    for motion in clips.values():
        assert np.allclose(motion.rotations[:, 0], motion.rotations[:, -1], atol=1e-9)
        assert np.allclose(motion.shifts[:, 0], motion.shifts[:, -1], atol=1e-9)
        assert np.allclose(motion.scales[:, 0], motion.scales[:, -1], atol=1e-9)
        assert np.abs(np.diff(motion.rotations, axis=1)).max() < 0.5  # no joint jumps from one frame to the next
    for name, feet in (("idle", ("foot", "hand")), ("greet", ("foot",))):
        for foot in feet:
            for side in "LR":
                _, place = clips[name].world(f"{foot}.{side}")
                assert np.abs(place - joints.positions[joints.index(f"{foot}.{side}")]).max() < 2e-3
    walk = clips["walk"]
    standing = np.zeros(len(walk.phase))
    for foot in ("foot.L", "foot.R", "hand.L", "hand.R"):
        _, place = walk.world(foot)
        rest = joints.positions[joints.index(foot)]
        down = place[:, 1] < rest[1] + 1e-6
        standing += down
        both = down[1:] & down[:-1]
        speed = np.diff(place[:, 2])[both]
        assert both.sum() > 0.5 * len(both) and np.allclose(speed, speed.mean(), atol=1e-3)  # the ground's speed
        assert np.abs(place[down, 0] - rest[0]).max() < 2e-3
    assert standing.min() >= 2  # at least two feet on the ground at any time


# Mesh, charts, weights, textures


def test_body_is_one_closed_even_surface_of_the_right_size(creature: Creature) -> None:
    mesh = creature.mesh
    assert 15_000 <= len(mesh.faces) <= 30_000
    edges, _, count = unique_edges(mesh.faces)
    assert (count == 2).all()
    assert len(np.unique(mesh.faces)) == len(mesh.points)
    assert len(mesh.points) - len(edges) + len(mesh.faces) == 2  # one sphere
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    assert len(np.unique(start * len(mesh.points) + end)) == len(start)  # every edge once in each direction
    normals, areas = face_normals(mesh.points, mesh.faces)
    volume = (normals * mesh.points[mesh.faces[:, 0]] * areas[:, None]).sum() / 3
    assert 0.05 < volume < 0.5
    assert np.abs(build_body().distance(mesh.points)).max() < 1.5e-3
    assert ((mesh.normals[mesh.faces].mean(axis=1) * normals).sum(axis=1) > 0).mean() > 0.9999
    smallest = np.degrees(np.arctan2(1.0, corner_cotangents(mesh.points, mesh.faces))).min(axis=1)
    assert smallest.min() > 1.5 and np.median(smallest) > 40.0
    assert np.isfinite(mesh.points).all() and abs(mesh.points[:, 1].min()) < 0.01


def test_charts_are_few_and_lie_apart_without_folds(creature: Creature) -> None:
    mesh = creature.mesh
    assert 6 <= mesh.charts.max() + 1 <= 14
    assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1
    face, x, y, _ = cover_texels(mesh.uvs, mesh.face_uvs, 2048)
    covered = np.bincount(y * 2048 + x, minlength=2048 * 2048)
    assert covered.max() == 1
    assert 0.45 < covered.mean() < 0.9
    flat = mesh.uvs[mesh.face_uvs]
    first, second = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    double = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    assert (double < 0).all()  # v points down: counter-clockwise outside is clockwise in rows and columns
    texels = np.full((512, 512), -1)
    face, x, y, _ = cover_texels(mesh.uvs, mesh.face_uvs, 512)
    texels[y, x] = mesh.charts[face]
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):  # two texels of gutter even at half size
        for step in (1, 2):
            other = np.roll(texels, (-dy * step, -dx * step), axis=(0, 1))
            assert ((texels == other) | (texels < 0) | (other < 0)).all()


def test_seams_are_curved_and_of_unequal_lengths(creature: Creature) -> None:
    mesh = creature.mesh
    surface = TexturedSurface(mesh.points, mesh.faces.astype(np.int32), mesh.uvs, mesh.face_uvs.astype(np.int32))
    seams = find_seams(surface)
    assert len(seams.boundary_faces) == 0 and len(seams.foldover_uvs) == 0
    assert len(seams.vertices) > 400
    ends = mesh.uvs[seams.uv_pairs]
    along = ends[:, :, 1] - ends[:, :, 0]
    lengths = np.linalg.norm(along, axis=2)
    assert np.std(np.log(lengths[:, 0] / lengths[:, 1])) > 0.02  # the two sides differ, as in real characters
    directions = np.degrees(np.arctan2(along[:, 0, 1], along[:, 0, 0])) % 180
    assert (np.histogram(directions, 12, (0, 180))[0] > 0).all()


def test_weights_are_smooth_and_sum_to_one(creature: Creature) -> None:
    weights, indices = creature.joint_weights.astype(float), creature.joint_indices
    assert weights.shape == indices.shape == (len(creature.mesh.points), 4)
    assert (weights >= 0).all() and np.allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert (indices[weights == 0] == 0).all() and indices.max() < len(creature.joints.names)
    assert (np.diff(weights, axis=1) <= 1e-7).all()
    dense = np.zeros((len(weights), len(creature.joints.names)))
    np.add.at(dense, (np.arange(len(weights))[:, None], indices.astype(int)), weights)
    edges, _, _ = unique_edges(creature.mesh.faces)
    assert np.abs(dense[edges[:, 0]] - dense[edges[:, 1]]).max() < 0.45
    used = dense.max(axis=0)
    unused = [name for name, most in zip(creature.joints.names, used, strict=True) if most < 0.3]
    assert unused == ["root"]
    assert (dense > 0).sum(axis=1).max() <= 4 and (dense > 0).sum(axis=1).mean() > 1.5


def test_textures_are_painted_everywhere_and_the_frame_is_orthonormal(creature: Creature) -> None:
    textures, mesh = creature.textures, creature.mesh
    for texels in (textures.base_color, textures.orm, textures.normal):
        assert texels.shape == (1024, 1024, 3) and texels.dtype == np.uint8
        assert len(np.unique(texels.reshape(-1, 3), axis=0)) > 500
    normal = textures.normal / 127.5 - 1.0
    assert np.abs(np.linalg.norm(normal, axis=2) - 1.0).max() < 0.02
    assert normal[..., 2].min() > 0 and normal[..., 2].mean() > 0.9 and normal[..., :2].std() > 0.03
    assert (textures.orm[..., 2] == 0).all() and textures.orm[..., 1].min() > 5
    tangent, normals = mesh.tangents[:, :3], mesh.normals[mesh.uv_to_vertex]
    assert np.allclose(np.linalg.norm(tangent, axis=1), 1.0)
    assert np.abs((tangent * normals).sum(axis=1)).max() < 1e-9
    assert (np.abs(mesh.tangents[:, 3]) == 1).all()


# The file


def test_file_goes_through_the_door_that_every_file_takes(glb: Path, creature: Creature) -> None:
    from preprocess.load import load_character

    character = load_character(glb)
    assert character.warnings == ()
    mesh = character.mesh
    assert mesh.num_faces == len(creature.mesh.faces) and mesh.num_vertices == len(creature.mesh.points)
    assert mesh.has_uvs and mesh.corner_tangents is not None
    assert character.skeleton.num_joints == len(creature.joints.names)
    assert {clip.name for clip in character.clips} == {"idle", "walk", "greet"}
    assert all(clip.duration_s > 0.9 for clip in character.clips)
    (material,) = character.materials
    assert material.base_color and material.normal and material.metallic_roughness and material.occlusion
    mesh.validate()


def test_file_is_the_same_however_often_it_is_written(glb: Path, creature: Creature, tmp_path: Path) -> None:
    again = tmp_path / "again.glb"
    write(again, creature)
    assert again.read_bytes() == glb.read_bytes()


@pytest.mark.slow
def test_command_makes_the_same_file_in_another_process(glb: Path, tmp_path: Path) -> None:
    path = tmp_path / "folder" / "other.glb"
    environment = os.environ | {"PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "demos.creature", "-o", str(path)]
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    assert path.read_bytes() == glb.read_bytes()


@pytest.mark.slow
def test_the_demo_draws_every_picture(glb: Path, tmp_path: Path) -> None:
    """Each picture of the page, from a build with small textures: none is blank, and none breaks."""
    built = tmp_path / "creature.seamless"
    small = Settings(color_size_px=256, geometry_size_px=128, weight_size_px=64, lod_ratios=(0.5, 0.2, 0.05))
    build(glb, built, small, Progress(quiet=True))
    make_pictures(glb, built, tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    for file, title, _ in PICTURES:
        assert title in page
        picture = read_image(tmp_path / file, native=True).texels
        assert picture.shape[1] >= 1500 and picture.std() > 10.0, file
