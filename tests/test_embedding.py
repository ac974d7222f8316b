"""The runtime inside other people's windows: every toolkit shows the same scene, and misuse is told, not suffered."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_animation import random_skeleton
from builders_asset import build_ball

import runtime
from demos.gait import pace
from demos.walk_scene import WalkScene, find_hand
from runtime.animation.clip import Clip, Track

ROOT = Path(__file__).resolve().parent.parent
TOOLKITS = ("glfw", "pygame", "moderngl_window")
CAMERA = runtime.Camera((0, 2, 8), (0, 1, 0))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_ball(tmp_path_factory.mktemp("embedding") / "ball.seamless")


def read_pixels(path: Path) -> np.ndarray:
    import OpenImageIO as oiio

    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8)).astype(int)


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """A virtual X display of our own."""
    server = shutil.which("Xvfb")
    if server is None:
        pytest.skip("Xvfb is not installed: the windowing examples need a display")
    command = [server, "-displayfd", "1", "-screen", "0", "640x480x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        number = process.stdout.readline().strip()
        assert number, "Xvfb did not start"
        yield f":{number}"
        process.terminate()


@pytest.fixture(scope="module")
def pictures(ball: Path, display: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The last frame of the scripted walk, from every toolkit that is installed."""
    folder = tmp_path_factory.mktemp("windows")
    found = {}
    for toolkit in TOOLKITS:
        if importlib.util.find_spec(toolkit) is None:
            continue
        out = folder / f"{toolkit}.png"
        command = [sys.executable, "-m", f"demos.embed_{toolkit}", str(ball), "--size", "320x200"]
        command += ["--frames", "12", "--out", str(out)]
        environment = {**os.environ, "DISPLAY": display}
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr
        found[toolkit] = read_pixels(out)
    return found


@pytest.mark.parametrize("toolkit", TOOLKITS)
def test_every_toolkit_shows_the_same_walk(pictures: dict[str, np.ndarray], toolkit: str) -> None:
    if toolkit not in pictures:
        pytest.skip(f"{toolkit} is not installed")
    picture = pictures[toolkit]
    assert picture.shape[:2] == (200, 320)
    sky, middle = picture[5, 5], picture[60:190, 60:260].reshape(-1, picture.shape[2])
    assert (np.abs(middle - sky).sum(axis=1) > 40).mean() > 0.5
    reference = next(iter(pictures.values()))
    assert np.abs(picture[:, :, :3] - reference[:, :, :3]).max() <= 2


def test_a_missing_folder_is_one_line() -> None:
    command = [sys.executable, "-m", "demos.embed_pygame", "nowhere.seamless", "--frames", "1"]
    environment = {"SDL_VIDEODRIVER": "dummy", "PATH": "", "PYTHONPATH": str(ROOT), "PYGAME_HIDE_SUPPORT_PROMPT": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and "embed_pygame:" in done.stderr


def test_the_scene_walks_turns_and_holds_its_lantern(ctx: moderngl.Context, ball: Path) -> None:
    scene = WalkScene(ctx, ball, num_walkers=12)
    start, held = scene.hero_place.copy(), scene.lantern.transform.copy()
    scene.update(0.5)
    assert (scene.hero_place == start).all() and not scene.walking
    scene.steer(1.0, 0.0)
    for _ in range(10):
        scene.update(0.1)
    assert scene.walking and scene.hero.clip == "bend"
    np.testing.assert_allclose(scene.hero_place - start, [0, 0, scene.pace_m_s], atol=1e-9)
    assert np.linalg.norm(scene.lantern.transform[:3, 3] - held[:3, 3]) > 0.5 * scene.pace_m_s
    scene.steer(0.0, 1.0)
    scene.update(0.25)
    assert scene.heading == pytest.approx(0.6) and scene.walking  # small steps on the spot
    scene.steer(0.0, 0.0)
    scene.update(0.25)
    assert scene.heading == pytest.approx(0.6) and not scene.walking
    color, depth = ctx.renderbuffer((64, 48), 4), ctx.depth_renderbuffer((64, 48))
    framebuffer = ctx.framebuffer([color], depth)
    scene.draw(framebuffer)
    assert len(np.unique(np.frombuffer(framebuffer.read(), np.uint8))) > 20
    for thing in (framebuffer, color, depth, scene):
        thing.release()
    scene.release()


def test_the_pace_of_a_clip_leaves_the_standing_foot_where_it_is() -> None:
    skeleton = random_skeleton(5, 0)
    left, right = skeleton.joint_nodes[1:]
    skeleton.parents[:] = [-1, 0, 0, 0, 0]
    skeleton.rotation[:], skeleton.scale[:], skeleton.translation[:] = [0, 0, 0, 1], 1, 0
    skeleton.__dict__.pop("levels", None)
    times = np.array([0.0, 0.5, 1.0])
    tracks = []
    for node, order in ((int(left), (0.4, -0.4, 0.4)), (int(right), (-0.4, 0.4, -0.4))):
        heights = [0.0, 0.0, 0.2] if node == left else [0.2, 0.0, 0.0]  # the one that goes back is on the ground
        places = np.stack([np.zeros(3), heights, order], axis=1)
        tracks.append(Track(node, "translation", "LINEAR", times, places))
    assert pace(skeleton, Clip("walk", 1.0, tuple(tracks)), 1.0) == pytest.approx(1.6)
    assert pace(skeleton, Clip("stand", 1.0, ()), 1.0) == 0.0
    assert pace(skeleton, Clip("still", 0.0, ()), 1.0) == 0.0


@pytest.mark.parametrize(
    ("names", "hand"),
    [
        (("hips", "hand_l", "hand_r"), "hand_r"),
        (("LeftHand", "RightHand"), "RightHand"),
        (("Hand.R", "Hand.L"), "Hand.R"),
        (("root", "head"), "head"),
        (("a", "b"), "a"),
    ],
)
def test_a_hand_is_found(names: tuple[str, ...], hand: str) -> None:
    assert find_hand(names) == hand


@pytest.fixture
def target(ctx: moderngl.Context) -> Any:
    color, depth = ctx.renderbuffer((64, 64), 4), ctx.depth_renderbuffer((64, 64))
    framebuffer = ctx.framebuffer([color], depth)
    framebuffer.use()
    framebuffer.clear(depth=1.0)
    yield framebuffer
    for thing in (framebuffer, color, depth):
        thing.release()


def test_the_contract_in_its_own_words(ctx: moderngl.Context, ball: Path, target: Any) -> None:
    model = runtime.Model(ctx, runtime.load(ball))
    actor = model.actor(clip="bend")
    renderer = runtime.Renderer(ctx)
    for _ in range(3):
        actor.update(1 / 60)
        renderer.draw([actor], CAMERA)
    assert np.frombuffer(target.read(), np.uint8).any()
    assert ctx.gc_mode is None
    for thing in (actor, renderer, model):
        thing.release()
        thing.release()


def test_actors_of_different_models_zero_and_removed_ones(ctx: moderngl.Context, ball: Path, target: Any) -> None:
    asset = runtime.load(ball)
    models = [runtime.Model(ctx, asset) for _ in range(2)]
    renderer = runtime.Renderer(ctx)
    renderer.draw([], CAMERA)
    assert not np.frombuffer(target.read(), np.uint8).any()
    actors = [model.actor(clip=0) for model in models for _ in range(3)]

    def leaving() -> Any:
        for actor in list(actors):
            yield actor
            actor.release()  # while the list is being drawn

    renderer.draw(leaving(), CAMERA)
    renderer.draw(actors, CAMERA)
    for thing in (renderer, *models):
        thing.release()


def test_a_broken_transform_is_told_and_the_rest_still_draws(ctx: moderngl.Context, ball: Path, target: Any) -> None:
    model, renderer = runtime.Model(ctx, runtime.load(ball)), runtime.Renderer(ctx)
    good, bad = model.actor(clip=0), model.actor(clip=0)
    bad.transform[1, 1] = np.inf
    with pytest.raises(ValueError, match="actor 1 of those to draw is not finite"):
        renderer.draw([good, bad], CAMERA)
    bad.visible = False
    renderer.draw([good, bad], CAMERA)
    assert np.frombuffer(target.read(), np.uint8).any()
    for thing in (renderer, model):
        thing.release()


def test_a_closed_context_is_told(ball: Path) -> None:
    context = moderngl.create_context(standalone=True, backend="egl")
    model, renderer = runtime.Model(context, runtime.load(ball)), runtime.Renderer(context)
    crowd, actor = runtime.Crowd(context, model, 3), model.actor(clip=0)
    context.release()
    for things in ([actor], [crowd], []):
        with pytest.raises(runtime.RenderError, match="released"):
            renderer.draw(things, CAMERA)
    with pytest.raises(runtime.RenderError, match="released"):
        runtime.Crowd(context, model, 1)
    for thing in (crowd, actor, renderer, model):
        thing.release()


def test_thousands_of_actors_come_and_go_while_drawing(ctx: moderngl.Context, ball: Path, target: Any) -> None:
    model, renderer = runtime.Model(ctx, runtime.load(ball)), runtime.Renderer(ctx)
    sizes = []
    for cycle in range(40):
        actors = [model.actor(clip=0, time_s=0.01 * index) for index in range(50)]
        renderer.draw(actors, CAMERA, view="depth")
        for actor in actors:
            actor.release()
        del actors
        sizes.append((model.mixer.num_rows, model.mixer._capacity, model._joint_texture.height))  # type: ignore[union-attr]
        assert sizes[cycle] == sizes[0]
    for thing in (renderer, model):
        thing.release()


def test_importing_everything_is_quick_and_light() -> None:
    code = (
        "import time; start = time.process_time(); import moderngl, numpy; third = time.process_time();"
        "import runtime; [getattr(runtime, name) for name in runtime.__all__];"
        "import sys; print(time.process_time() - start, time.process_time() - third);"
        "print([m for m in ('scipy', 'numba', 'preprocess', 'demos') if m in sys.modules])"
    )
    times, heavy = [], ""
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
        first, heavy = done.stdout.splitlines()
        times.append(float(first.split()[0]))
    assert heavy == "[]"
    assert min(times) < 0.3


def test_loading_in_slices_gives_the_same_model(ctx: moderngl.Context, ball: Path, target: Any) -> None:
    renderer = runtime.Renderer(ctx)
    at_once = runtime.Model(ctx, runtime.load(ball))
    renderer.draw([at_once.actor(clip=0)], CAMERA)
    wanted = target.read()
    loading = runtime.Loading(ctx, ball)
    steps, model = 0, None
    while model is None:
        model = loading.step(budget_s=0.0)
        steps += 1
        time.sleep(0.001)
    assert steps > 8 and loading.step() is model
    target.clear(depth=1.0)
    renderer.draw([model.actor(clip=0)], CAMERA)
    assert target.read() == wanted
    for thing in (loading, loading, at_once, renderer):
        thing.release()


def test_a_model_in_slices_refuses_to_draw_before_it_is_whole(ctx: moderngl.Context, ball: Path, target: Any) -> None:
    model = runtime.Model(ctx, runtime.load(ball), in_slices=True)
    assert model.upload_slice()
    with pytest.raises(runtime.RenderError, match="not uploaded yet"):
        model.actor(clip=0)
    model.release()
    with pytest.raises(runtime.RenderError, match="released"):
        model.upload_slice()


def test_loading_a_bad_folder_is_told(ctx: moderngl.Context, tmp_path: Path) -> None:
    loading = runtime.Loading(ctx, tmp_path)
    for _ in range(2):
        with pytest.raises(runtime.AssetError, match="manifest"):
            while loading.step() is None:
                time.sleep(0.001)
    loading.release()
