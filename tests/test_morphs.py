"""Morph targets end to end: read, welded, baked, drawn and written, against what the file says in 64 bits."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_gltf import GltfBuilder, grid
from builders_morphs import CLIP_TIMES, CLIP_WEIGHTS, NAMES, ellipsoid, shifts_of, skin_weights, write_head

import runtime
from benchmarks._points import MIN_VERSION_CODE, PointCapture, differing_points
from preprocess.errors import InputError
from preprocess.load import load_character
from preprocess.mesh.morphs import Morph, choose_shapes, shift_vertices, vertex_turns
from runtime.animation.bounds import JointBoxes, stored_joint_boxes
from runtime.animation.mixer import Mixer
from runtime.animation.pose import sample, skinning_matrices
from runtime.asset.morphs import Morphs, MorphTarget, pack_morphs, unpack_morphs
from runtime.errors import AssetError
from runtime.gpu.gl_state import saved_state

ROOT = Path(__file__).resolve().parent.parent
RMS_REL, MAX_REL = 2e-4, 2e-3  # of the diagonal: the accuracy that is promised
EYE = np.array([0.0, 1.0, 4.0])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_head(tmp_path_factory.mktemp("morphs") / "head.glb")


@pytest.fixture(scope="module")
def folder(source: Path) -> Path:
    out = source.with_suffix(".seamless")
    command = [sys.executable, "-m", "preprocess", str(source), "-o", str(out), "--color-size", "64"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    return out


@pytest.fixture(autouse=True)
def _intact_state(request: pytest.FixtureRequest) -> Iterator[None]:
    if "ctx" not in request.fixturenames:
        yield
        return
    request.getfixturevalue("ctx")
    with saved_state(range(16), (0,), True):
        yield


# Reading


def test_targets_of_one_name_are_one_morph(source: Path) -> None:
    character = load_character(source)
    mesh, skeleton = character.mesh, character.skeleton
    assert tuple(morph.name for morph in mesh.morphs) == skeleton.morphs == NAMES
    expected = shifts_of(mesh.surface.positions)
    teeth = np.unique(mesh.surface.faces[mesh.face_parts == 1])
    expected["smile"][teeth] = (0, 0.05, 0)
    expected["long"][teeth] = expected["twist"][teeth] = 0.0
    for morph in mesh.morphs:
        np.testing.assert_allclose(morph.dense_shifts(mesh.num_vertices), expected[morph.name], atol=1e-6)
    assert len(mesh.morphs[0].vertices) < 0.5 * mesh.num_vertices  # sparse


@pytest.mark.parametrize("interpolation", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_clips_move_morphs(tmp_path: Path, interpolation: str) -> None:
    character = load_character(write_head(tmp_path / "a.glb", interpolation=interpolation))
    times = np.array([0.0, 0.2, 0.5, 0.9, 1.0])
    found = sample(character.clips[0], character.skeleton, times).weights
    index = np.minimum(np.searchsorted(CLIP_TIMES, times, side="right") - 1, 1)
    t = ((times - np.array(CLIP_TIMES)[index]) / 0.5)[:, None]
    a, b = CLIP_WEIGHTS[index], CLIP_WEIGHTS[index + 1]
    if interpolation == "LINEAR":
        expected = a + t * (b - a)
    elif interpolation == "STEP":
        expected = np.where(t < 1, a, b)
    else:  # glTF 2.0, appendix C.5, tangents over half a second
        out_tangent, in_tangent = -0.25 * 0.5, 0.5 * 0.5
        expected = (2 * t**3 - 3 * t**2 + 1) * a + (t**3 - 2 * t**2 + t) * out_tangent
        expected += (3 * t**2 - 2 * t**3) * b + (t**3 - t**2) * in_tangent
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-6)


def _two_nodes(builder: GltfBuilder, **spec: Any) -> list[int]:
    """Two squares with a target each, that lifts them."""
    nodes = []
    for number in range(2):
        shape = grid(1, 1)
        primitive = builder.primitive(shape["positions"] + (2.0 * number, 0, 0), shape["faces"])
        primitive["targets"] = [{"POSITION": builder.accessor(np.tile([0.0, 0, 1], (4, 1)))}]
        nodes.append(builder.node(mesh=builder.mesh(primitive, name=f"part{number}", **spec), name=f"node{number}"))
    return nodes


def test_names_missing_double_and_contradicting(tmp_path: Path) -> None:
    unnamed = GltfBuilder()
    _two_nodes(unnamed)
    assert load_character(unnamed.write(tmp_path / "a.glb")).skeleton.morphs == ("part0.0", "part1.0")

    agreeing = GltfBuilder()
    first, second = _two_nodes(agreeing, extras={"targetNames": ["up"]})
    agreeing.clip("a", (first, "weights", "LINEAR", [0, 1], [0, 1]))
    agreeing.clip("b", *((node, "weights", "LINEAR", [0, 1], [0, 1]) for node in (first, second)))
    assert load_character(agreeing.write(tmp_path / "b.glb")).skeleton.morphs == ("up",)

    differing = GltfBuilder()
    first, second = _two_nodes(differing, extras={"targetNames": ["up"]})
    differing.clip("a", (first, "weights", "LINEAR", [0, 1], [0, 1]), (second, "weights", "LINEAR", [0, 1], [1, 0]))
    character = load_character(differing.write(tmp_path / "c.glb"))
    assert character.skeleton.morphs == ("up", "up (node1)")
    weights = sample(character.clips[0], character.skeleton, [0.25]).weights
    np.testing.assert_allclose(weights, [[0.25, 0.75]])

    double = GltfBuilder()
    shape = grid(1, 1)
    primitive = double.primitive(shape["positions"], shape["faces"])
    lift = {"POSITION": double.accessor(np.tile([0.0, 0, 1], (4, 1)))}
    primitive["targets"] = [lift, lift, lift]
    double.node(mesh=double.mesh(primitive, name="face", extras={"targetNames": ["up", "up", 3]}))
    assert load_character(double.write(tmp_path / "d.glb")).skeleton.morphs == ("up", "face.1", "face.2")


def test_what_a_morph_parts_is_not_welded(tmp_path: Path) -> None:
    """Two squares that share an edge's points, as lips do, and come apart where one of them moves."""
    builder = GltfBuilder()
    shape = grid(1, 1)
    positions = np.concatenate([shape["positions"], shape["positions"] + (0, 1, 0)])
    primitive = builder.primitive(positions, np.concatenate([shape["faces"], shape["faces"] + 4]))
    lifted = np.zeros((8, 3))
    lifted[4:] = (0, 0.5, 0)
    primitive["targets"] = [{"POSITION": builder.accessor(lifted)}]
    builder.node(mesh=builder.mesh(primitive))
    mesh = load_character(builder.write(tmp_path / "a.glb")).mesh
    assert mesh.num_vertices == 8  # six, were they welded
    primitive["targets"] = [{"POSITION": builder.accessor(np.tile([0.0, 0.5, 0], (8, 1)))}]
    assert load_character(builder.write(tmp_path / "b.glb")).mesh.num_vertices == 6


def test_bad_targets_end_in_one_line(tmp_path: Path) -> None:
    def write(name: str, shifts: np.ndarray, **spec: Any) -> Path:
        builder = GltfBuilder()
        shape = grid(1, 1)
        primitive = builder.primitive(shape["positions"], shape["faces"])
        primitive["targets"] = [{"POSITION": builder.accessor(shifts)}]
        node = builder.node(mesh=builder.mesh(primitive, **spec))
        builder.clip("a", (node, "weights", "LINEAR", [0, 1], [0.0, np.nan]))
        return builder.write(tmp_path / name)

    with pytest.raises(InputError, match=r"target 0: POSITION has 3 entries for 4 vertices"):
        load_character(write("short.glb", np.zeros((3, 3))))
    broken = load_character(write("nan.glb", np.array([[0, 0, 1.0], [0, np.nan, 0], [0, 0, np.inf], [0, 0, 1]])))
    assert any("2 entries of morph targets are not finite" in warning for warning in broken.warnings)
    np.testing.assert_array_equal(broken.mesh.morphs[0].vertices, np.sort(broken.mesh.morphs[0].vertices))
    assert any("keys that are not finite" in warning for warning in broken.warnings)
    kept = load_character(write("beyond.glb", np.ones((4, 3)), weights=[3.5]))  # glTF allows it
    assert kept.skeleton.morph_weights == (3.5,)


# Parts of the way


def test_turns_do_to_every_corner_what_the_file_says() -> None:
    """Three corners of a cube's vertex, whose normals change each in its own way: one matrix does all of it."""
    rng = np.random.default_rng(0)
    normals = np.concatenate([np.eye(3), [[0, 0, 1.0]] * 2])
    changes = np.concatenate([rng.normal(size=(3, 3)), [[0.1, 0.2, 0]] * 2])
    turns = vertex_turns(normals, changes, np.array([3, 3, 3, 7, 7]), np.array([3, 7]))
    np.testing.assert_allclose(np.einsum("ij,nj->ni", turns[0], normals[:3]), changes[:3], atol=1e-12)
    np.testing.assert_allclose(turns[1] @ normals[3], changes[3], atol=1e-12)
    np.testing.assert_allclose(turns[1] @ [1, 0, 0], 0, atol=1e-12)  # the smallest matrix that does


def test_shapes_show_every_morph() -> None:
    def morph(vertices: list[int]) -> Morph:
        count = len(vertices)
        return Morph("", 0.0, np.array(vertices, np.int64), np.ones((count, 3)), np.zeros((count, 3, 3)))

    morphs = [morph([0, 1]), morph([2, 3]), morph([1, 2]), morph([])]
    shapes = choose_shapes(morphs, 4)
    np.testing.assert_array_equal(shapes.sum(axis=0), [1, 1, 1, 0])
    assert len(shapes) == 2  # the first two share no vertex
    np.testing.assert_array_equal(choose_shapes(morphs, 4, most=1), [[1, 1, 1, 0]])
    np.testing.assert_array_equal(shift_vertices(morphs, np.array([[1.0, 0, 2, 0]]), 4)[0, :, 0], [1, 3, 2, 0])


def test_maps_come_back_from_their_image() -> None:
    rng = np.random.default_rng(3)
    targets = [
        MorphTarget("a", 0.5, np.array([0, 70_000, 99_999]), rng.normal(size=(3, 3, 4)).astype(np.float32)),
        MorphTarget("b", 0.0, np.zeros(0, np.int64), np.zeros((0, 3, 4), np.float32)),
        MorphTarget("c", 0.0, np.array([5]), np.zeros((1, 3, 4), np.float32)),
    ]
    image, entries = pack_morphs(targets)
    again = unpack_morphs(image, entries, 100_000, "it")
    for one, other in zip(targets, again):
        np.testing.assert_array_equal(one.texels, other.texels)
        np.testing.assert_allclose(one.rows, other.rows, atol=np.abs(one.rows).max(initial=0) / 60_000)
    np.testing.assert_array_equal(again[2].rows, 0)  # nothing is exactly nothing
    with pytest.raises(AssetError, match="not of this character"):
        unpack_morphs(image, entries, 99_999, "it")


def test_sums_against_their_slow_twin() -> None:
    rng = np.random.default_rng(4)
    targets = tuple(
        MorphTarget(name, 0.0, np.sort(rng.choice(30, 8, replace=False)), rng.normal(size=(8, 3, 4)).astype(np.float32))
        for name in "abc"
    )
    morphs = Morphs(targets, (6, 5))
    weights = np.array([[0.0, 0, 0], [0.3, 0, -1], [0, 2, 0], [1, 1, 1]])
    dense = np.zeros((4, 30, 3, 4))
    for actor in range(4):
        for number, target in enumerate(targets):
            for texel, rows in zip(target.texels, target.rows):
                dense[actor, texel] += weights[actor, number] * rows
    np.testing.assert_allclose(morphs.blend(weights), dense[:, morphs.texels], atol=1e-6)
    numbers = morphs.texel_numbers.astype(int)
    assert numbers.shape == (4, 5, 4)
    for row, column in ((0, 0), (3, 4)):
        for corner, (down, right) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            texel = (row + down) * 6 + column + right
            number = numbers[row, column, corner]
            assert (number == 0) == (texel not in morphs.texels) and (not number or morphs.texels[number - 1] == texel)


# Drawn


def _expected(asset: runtime.Asset, rest: np.ndarray, weights: np.ndarray, teeth: np.ndarray, pose: Any) -> np.ndarray:
    """Points at rest, morphed and posed as the file says, in 64 bits."""
    shifts = shifts_of(rest)
    shifts["smile"][teeth] = (0, 0.05, 0)
    shifts["long"][teeth] = shifts["twist"][teeth] = 0.0
    moved = rest + sum(weight * shifts[name] for name, weight in zip(NAMES, weights))
    matrices = np.einsum("nj,jrc->nrc", skin_weights(rest), skinning_matrices(asset.skeleton, pose)[0])
    return np.einsum("nrc,nc->nr", matrices[:, :3, :3], moved) + matrices[:, :3, 3]


@pytest.fixture
def model(ctx: moderngl.Context, folder: Path) -> Iterator[runtime.Model]:
    made = runtime.Model(ctx, runtime.load(folder))
    yield made
    made.release()


@pytest.fixture
def picture(ctx: moderngl.Context) -> Iterator[moderngl.Framebuffer]:
    color, depth = ctx.texture((64, 64), 4), ctx.depth_texture((64, 64))
    made = ctx.framebuffer([color], depth)
    made.use()
    yield made
    for thing in (made, color, depth):
        thing.release()


def test_drawn_points_are_the_file_s(
    ctx: moderngl.Context, model: runtime.Model, source: Path, picture: moderngl.Framebuffer
) -> None:
    """Every target alone, mixtures, and a clip: RMS and maximum against the file in 64 bits."""
    if ctx.version_code < MIN_VERSION_CODE:
        pytest.skip("reading points back needs OpenGL 4.3")
    character = load_character(source)
    surface = character.mesh.surface
    diagonal = surface.diagonal_m
    camera = runtime.Camera(eye=tuple(EYE), target=(0, 1, 0), fovy_deg=60)
    capture = PointCapture(model, {})
    actor = model.actor()
    rng = np.random.default_rng(7)

    def corners(level: int = 0) -> tuple[np.ndarray, np.ndarray]:
        points = capture.points(actor, camera, level, 1.0)
        which = points[:, 3:6].argmax(axis=1)
        uvs = points[:, 6:].reshape(-1, 3, 2)[np.arange(len(points)), which]
        return points[:, :3].astype(np.float64) + EYE, uvs

    try:
        at_rest, uvs = corners()
        nearest = np.array([np.linalg.norm(surface.positions - point, axis=1).argmin() for point in at_rest])
        assert set(nearest) == set(range(len(surface.positions)))
        teeth = np.isin(nearest, surface.faces[character.mesh.face_parts == 1])
        rest = surface.positions[nearest]
        vertex_of = {tuple(uv): number for number, uv in enumerate(uvs)}
        cases = [*np.eye(3), *rng.uniform(0, 1, (4, 3)), np.array([-0.5, 1.5, 0.0])]
        for weights in cases:
            actor.set_morph_weights(dict(zip(NAMES, weights)))
            found, places = corners()
            order = [vertex_of[tuple(uv)] for uv in places]
            wanted = _expected(model.asset, rest, weights, teeth, sample(model.asset.clips[0], model.asset.skeleton, 0))
            off = np.linalg.norm(found - wanted[order], axis=1) / diagonal
            assert np.sqrt((off**2).mean()) <= RMS_REL and off.max() <= MAX_REL, weights
        actor.set_morph_weights(None)
        actor.play("nod", time_s=0.75, loop=False)
        found, places = corners()
        pose = sample(character.clips[0], character.skeleton, 0.75)
        assert pose.weights is not None
        wanted = _expected(model.asset, rest, pose.weights[0], teeth, pose)
        off = np.linalg.norm(found - wanted[[vertex_of[tuple(uv)] for uv in places]], axis=1) / diagonal
        assert np.sqrt((off**2).mean()) <= RMS_REL and off.max() <= MAX_REL
        low, high = actor.bounds
        assert (found >= low).all() and (found <= high).all()
    finally:
        capture.release()


def test_a_morphed_surface_has_no_cracks(
    ctx: moderngl.Context, model: runtime.Model, picture: moderngl.Framebuffer
) -> None:
    """All copies of a point are the same bits, tessellated at every level; each at its own uv they are not."""
    if ctx.version_code < MIN_VERSION_CODE:
        pytest.skip("reading points back needs OpenGL 4.3")
    camera = runtime.Camera(eye=tuple(EYE), target=(0, 1, 0), fovy_deg=60)
    actor = model.actor("nod", time_s=0.4)
    actor.set_morph_weights([0.7, -0.3, 0.9])
    for defines in ({}, {"WITHOUT_CANONICAL_UVS": 1}):
        capture = PointCapture(model, defines)
        try:
            differ = [differing_points(capture.points(actor, camera, level, 3.0))[0] for level in (0, 1, 2)]
        finally:
            capture.release()
        assert (sum(differ) == 0) == (not defines)


def test_bounds_hold_in_every_mixture(folder: Path, source: Path) -> None:
    asset = runtime.load(folder)
    mixer = Mixer(asset.skeleton, asset.clips)
    carrier = JointBoxes(stored_joint_boxes(asset.joint_bounds, asset.manifest.bind_bounds), asset.morph_reaches)
    mesh = load_character(source).mesh
    rng = np.random.default_rng(1)
    weights = rng.uniform(-1, 2, (50, 3))
    rows = np.repeat(mixer.joint_rows(mixer.add_row()), 50, axis=0)
    boxes = carrier.around(rows, weights)
    points = mesh.surface.positions + shift_vertices(mesh.morphs, weights, mesh.num_vertices)
    assert (points >= boxes[:, :1]).all() and (points <= boxes[:, 1:]).all()
    clip_box = asset.manifest.clip_bounds["face"]
    moved = mesh.surface.positions + shift_vertices(mesh.morphs, CLIP_WEIGHTS, mesh.num_vertices)
    assert (moved >= clip_box[0]).all() and (moved <= clip_box[1]).all()


def test_weights_from_code(model: runtime.Model) -> None:
    actor, other = model.actor("face", time_s=0.5), model.actor("face", time_s=0.5)
    assert list(actor.morph_weights) == list(NAMES)
    np.testing.assert_allclose(list(actor.morph_weights.values()), CLIP_WEIGHTS[1], atol=1e-6)
    actor.set_morph_weights({"smile": 0.25})
    np.testing.assert_allclose(list(actor.morph_weights.values()), [0.25, 0.0, 0.4], atol=1e-6)
    actor.set_morph_weights({"smile": None})
    np.testing.assert_allclose(list(actor.morph_weights.values()), CLIP_WEIGHTS[1], atol=1e-6)
    model.set_morph_weights([actor, other], [[1, np.nan, 0], [0, 0, 0.5]])
    np.testing.assert_allclose(list(actor.morph_weights.values()), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(list(other.morph_weights.values()), [0, 0, 0.5], atol=1e-6)
    model.set_morph_weights([actor, other], {"smile": [0.1, 0.2]})
    assert [round(one.morph_weights["smile"], 6) for one in (actor, other)] == [0.1, 0.2]
    for bad in ({"smlie": 1}, {"smile": np.nan}, {"smile": "x"}, {"smile": 1e6}, [1, 2], [[1, 2, 3]] * 2, "smile", 3):
        with pytest.raises(ValueError, match=r"\w"):
            actor.set_morph_weights(bad)
    with pytest.raises(ValueError, match="did you mean 'smile'"):
        actor.set_morph_weights({"smlie": 1})


def test_a_character_without_targets_is_as_before(ctx: moderngl.Context, ball: runtime.Asset) -> None:
    model = runtime.Model(ctx, ball)
    try:
        assert "MORPHS" not in model.shader_defines and "morph_numbers" not in model.textures
        actor = model.actor()
        assert actor.morph_weights == {} and model.asset.morph_names == ()
        with pytest.raises(ValueError, match="no morph"):
            actor.set_morph_weights({"smile": 1})
    finally:
        model.release()


def _picture(renderer: runtime.Renderer, thing: Any, camera: runtime.Camera, into: moderngl.Framebuffer) -> np.ndarray:
    into.use()
    into.clear(depth=1.0)
    renderer.draw([thing], camera, view="normal", lod=0, tessellation="off")
    return np.frombuffer(into.read(components=3), np.uint8).reshape(64, 64, 3).astype(float)


def test_a_crowd_shows_what_actors_show(
    ctx: moderngl.Context, model: runtime.Model, picture: moderngl.Framebuffer
) -> None:
    """Weights baked with the clips, and an actor's own over them: the pictures of a single actor, and its bounds."""
    renderer, crowd, actor = runtime.Renderer(ctx), runtime.Crowd(ctx, model, 3), model.actor("nod", time_s=0.5)
    camera = runtime.Camera(eye=(1.0, 1.5, 3.0), target=(0, 1, 0), fovy_deg=60)
    try:
        crowd.play("nod", phases_s=0.5)
        crowd.show([False, True, False])
        bare = _picture(renderer, model.actor(), camera, picture)
        wanted, found = (_picture(renderer, thing, camera, picture) for thing in (actor, crowd))
        assert np.abs(wanted - bare).mean() > 1.0  # the clip shows
        assert np.abs(wanted - found).mean() < 0.25
        own = {"smile": 0.9, "twist": -1.5}
        actor.set_morph_weights(own)
        radius = crowd.state.spheres[1][1]
        crowd.set_morph_weights({"smile": [0.1, 0.9], "twist": [3, -1.5]}, which=[0, 1])
        wanted, found = (_picture(renderer, thing, camera, picture) for thing in (actor, crowd))
        assert np.abs(wanted - found).mean() < 0.25
        assert crowd.state.spheres[1][1] > radius
        crowd.set_morph_weights(None)
        actor.set_morph_weights(None)
        wanted, found = (_picture(renderer, thing, camera, picture) for thing in (actor, crowd))
        assert np.abs(wanted - found).mean() < 0.25
        with pytest.raises(ValueError, match="no morph"):
            crowd.set_morph_weights({"frown": 1})
    finally:
        crowd.release()
        renderer.release()


# Written


def test_model_glb_has_the_targets_of_every_level(folder: Path, source: Path) -> None:
    """Read again as any viewer reads it: the finest level moves as the source does, and so do the clips."""
    import json
    import shutil

    from runtime.gltf.document import read_document

    document = read_document(folder / "model.glb")
    for mesh in document.items("meshes"):
        assert mesh["extras"]["targetNames"] == list(NAMES)
        assert all(len(primitive["targets"]) == 3 for primitive in mesh["primitives"])
    levels = [number for number, node in enumerate(document.items("nodes")) if "mesh" in node]
    for animation in document.items("animations"):
        moved = [c["target"]["node"] for c in animation["channels"] if c["target"]["path"] == "weights"]
        assert moved == levels
    again, ours = load_character(folder / "model.glb"), load_character(source)
    tree_at = np.array([np.linalg.norm(ours.mesh.surface.positions - p, axis=1).argmin()
                        for p in again.mesh.surface.positions])  # fmt: skip
    for one, other in zip(again.mesh.morphs, ours.mesh.morphs):
        expected = other.dense_shifts(ours.mesh.num_vertices)[tree_at]
        np.testing.assert_allclose(one.dense_shifts(again.mesh.num_vertices), expected, atol=2e-4)
    for one, other in zip(again.clips, ours.clips):
        for time_s in (0.0, 0.3, 0.8):
            weights = [sample(clip, c.skeleton, time_s).weights for clip, c in ((one, again), (other, ours))]
            np.testing.assert_allclose(weights[0], weights[1], atol=1e-6)
    manifest = json.loads((folder / "manifest.json").read_text())
    copy = folder.parent / "damaged.seamless"
    shutil.copytree(folder, copy)
    try:
        for change in ({"texels": 3}, {"name": "long"}, {"shift_m": -1.0}, {"reach": [[99, [0, 0, 0], [0, 0, 0]]]}):
            damaged = json.loads(json.dumps(manifest))
            damaged["morphs"]["targets"][0].update(change)
            (copy / "manifest.json").write_text(json.dumps(damaged))
            with pytest.raises(AssetError):
                runtime.load(copy)
    finally:
        shutil.rmtree(copy)


def test_flat_faces_stay_flat_shaded(asset_path: Any) -> None:
    """AnimatedMorphCube leans over: each side's normal turns as the file says, its corners alike."""
    character = load_character(asset_path("AnimatedMorphCube/AnimatedMorphCube.gltf"))
    mesh = character.mesh
    for morph in mesh.morphs:
        turns = np.zeros((mesh.num_vertices, 3, 3))
        turns[morph.vertices] = morph.turns
        turned = mesh.corner_normals + np.einsum("fkij,fkj->fki", turns[mesh.surface.faces], mesh.corner_normals)
        positions = mesh.surface.positions + morph.dense_shifts(mesh.num_vertices)
        a, b, c = (positions[mesh.surface.faces[:, k]] for k in range(3))
        flat = np.cross(b - a, c - a)
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        turned /= np.linalg.norm(turned, axis=2, keepdims=True)
        assert np.einsum("fkc,fc->fk", turned, flat).min() > 0.999


def test_info_tells_what_a_file_holds(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    from preprocess.cli import main

    assert main(["info", str(source)]) == 0
    text = capsys.readouterr().out
    for line in ("  body", "  neck", "  nod: 1.00 s (joints and morphs)", "  face: 1.00 s (morphs)"):
        assert line in text.splitlines()
    assert main(["info", str(source), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [morph["name"] for morph in found["morphs"]] == list(NAMES)
    largest = np.linalg.norm(shifts_of(ellipsoid()["positions"])["smile"], axis=1).max()
    assert found["morphs"][0]["largest_shift_m"] == pytest.approx(largest, rel=1e-5)
    assert [part["name"] for part in found["parts"]] == ["body", "teeth"]
    assert main(["info", str(source.parent / "missing.glb")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
