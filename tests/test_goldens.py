"""Golden images: every view and every demo looks as it did, on software OpenGL; `./run goldens` renews them.

Differences are written to out/goldens as pictures, side by side: the golden, what was drawn, how far they are apart.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_asset import build_ball
from PIL import Image

import runtime
from runtime.asset.asset import Asset, load
from runtime.gpu.textures import is_software
from runtime.render.views import VIEWS

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = ROOT / "tests" / "golden"
OUT = ROOT / "out" / "goldens"
SIDE_PX = 128
# Versions of Mesa and of compilers round differently: outlines by a pixel here and there, colours by a step.
TOLERANCE_MEAN = 0.3  # of 255, over all pixels and channels
TOLERANCE_FAR = (0.003, 16)  # no more than this part of the pixels may differ by more than so many steps

SIZE = ["--size", f"{SIDE_PX}x{SIDE_PX}"]
# Arguments for a picture of the small built body, or why there is none to compare.
DEMOS: dict[str, list[str] | str] = {
    "viewer": ["--clip", "bend", "--time", "0.3"],
    "crowd": ["--count", "60"],
    "compare": ["--size", "320x240"],
    "embed_glfw": "a window around demos.walk_scene, which has its golden",
    "embed_pygame": "a window around demos.walk_scene, which has its golden",
    "embed_moderngl_window": "a window around demos.walk_scene, which has its golden",
    "gallery": "pictures of viewer, crowd and compare on a page; each has its golden",
    "creature": "writes a glTF file, no picture",
}
WAYS: dict[str, dict[str, Any]] = {
    **{f"view {name}": {"view": name} for name in VIEWS if name != "depth"},
    "tessellated": {"view": "wireframe", "lod": 2, "tessellation": 4.0},
    "coarse": {"view": "wireframe", "lod": 2, "tessellation": "off"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small body: four joints, three levels."""
    return build_ball(tmp_path_factory.mktemp("golden") / "ball.seamless", sizes=(12, 6, 3))


@pytest.fixture(scope="module")
def glass(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """The same of a blended, a cut-out and a solid material."""
    blended = {"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 0.8, 0.6, 0.7]}}
    cut = {"alphaMode": "MASK", "alphaCutoff": 0.5, "doubleSided": True, "emissiveFactor": [0.2, 0.1, 0.0]}
    materials = [{**blended, "doubleSided": True}, cut, {"pbrMetallicRoughness": {"roughnessFactor": 0.4}}]
    folder = tmp_path_factory.mktemp("golden") / "glass.seamless"
    return load(build_ball(folder, sizes=(12, 6, 3), materials=materials, face_materials=(0, 1, 2, 0, 1, 0)))


@pytest.fixture
def matches(ctx: moderngl.Context, request: pytest.FixtureRequest) -> Callable[[str, np.ndarray], None]:
    """Function that holds a picture (H, W, 3) uint8 to the golden of a name."""
    if not is_software(ctx):
        pytest.skip(f"goldens are of Mesa's software renderer, not of {ctx.info['GL_RENDERER']}")

    def compare(name: str, picture: np.ndarray) -> None:
        path = GOLDEN / f"{name.replace(' ', '_')}.png"
        if request.config.getoption("--renew-goldens"):
            GOLDEN.mkdir(exist_ok=True)
            Image.fromarray(picture).save(path, optimize=True)
        assert path.is_file(), f"{path.name} is not there: look at what is drawn, then ./run goldens"
        golden = np.asarray(Image.open(path).convert("RGB")).astype(int)
        assert golden.shape == picture.shape, f"{path.name} is {golden.shape}, the picture {picture.shape}"
        apart = np.abs(golden - picture)
        far = float((apart.max(axis=2) > TOLERANCE_FAR[1]).mean())
        if apart.mean() > TOLERANCE_MEAN or far > TOLERANCE_FAR[0]:
            OUT.mkdir(parents=True, exist_ok=True)
            sheet = np.concatenate([golden, picture, np.minimum(8 * apart, 255)], axis=1).astype(np.uint8)
            Image.fromarray(sheet).save(OUT / path.name)
            pytest.fail(
                f"{path.name}: {apart.mean():.2f} of 255 apart on average, {far:.2%} of the pixels by more than "
                f"{TOLERANCE_FAR[1]}; see {OUT / path.name}, and ./run goldens if it should look so"
            )

    return compare


class Canvas:
    """A model, a renderer and a framebuffer, released together."""

    def __init__(self, ctx: moderngl.Context, asset: Asset, **quality: Any) -> None:
        self.model = runtime.Model(ctx, asset)
        self.renderer = runtime.Renderer(ctx, quality=runtime.Quality(**quality))
        self.framebuffer = ctx.simple_framebuffer((SIDE_PX, SIDE_PX), 4)
        self.framebuffer.use()

    def picture(self, things: Any, camera: Any, **how: Any) -> np.ndarray:
        self.renderer.clear(0.85, 0.86, 0.88)
        self.renderer.draw(things, camera, **how)
        data = self.framebuffer.read(components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(SIDE_PX, SIDE_PX, 3)[::-1].copy()

    def release(self) -> None:
        framebuffer = self.framebuffer
        for thing in (*framebuffer.color_attachments, framebuffer.depth_attachment, framebuffer):
            thing.release()
        self.renderer.release()
        self.model.release()


@pytest.fixture
def canvas(ctx: moderngl.Context, folder: Path) -> Any:
    made = Canvas(ctx, load(folder))
    yield made
    made.release()


@pytest.mark.parametrize("name", WAYS)
def test_views(canvas: Canvas, matches: Any, name: str) -> None:
    actor = canvas.model.actor("bend", time_s=0.3, tint=(1.0, 0.9, 0.8))
    camera = runtime.framing(canvas.model.asset.manifest.bind_bounds)
    matches(name, canvas.picture([actor], camera, **{"tessellation": "off", **WAYS[name]}))
    canvas.picture([actor], camera, tessellation=2.0)  # Mesa holds on to the program before it until then


@pytest.mark.parametrize("view", ["lit", "lod"])
def test_a_crowd(ctx: moderngl.Context, canvas: Canvas, matches: Any, view: str) -> None:
    crowd = runtime.Crowd(ctx, canvas.model, 25)
    side = np.arange(5) * 3.0
    crowd.place_on_ground(np.stack(np.meshgrid(side - 6, [0.0], -4 * side), -1).reshape(-1, 3), np.arange(25.0))
    crowd.play("bend", phases_s=np.linspace(0, 1, 25))
    crowd.tint(np.linspace((1, 0.6, 0.4), (0.4, 0.6, 1), 25))
    matches(f"crowd {view}", canvas.picture([crowd], runtime.Camera((0, 8, 14), (0, 0, -10)), view=view))
    crowd.release()


@pytest.mark.parametrize("prepass", [False, True])
def test_materials(ctx: moderngl.Context, glass: Asset, matches: Any, prepass: bool) -> None:
    """Two actors, the nearer one first in the list: the farther is drawn first where blended."""
    canvas, away = Canvas(ctx, glass, blend_prepass=prepass), np.eye(4)
    away[:3, 3] = (1.0, 0.3, -3.0)
    actors = [canvas.model.actor("bend", time_s=0.3), canvas.model.actor("bend", transform=away, tint=(0.5, 0.7, 1))]
    camera = runtime.framing(glass.manifest.bind_bounds, margin=1.4)
    matches("blended prepass" if prepass else "blended", canvas.picture(actors, camera, tessellation="off"))
    canvas.release()


def test_the_walk_scene(ctx: moderngl.Context, folder: Path, matches: Any) -> None:
    """What the embedding demos put into their windows."""
    from demos.walk_scene import WalkScene

    scene, framebuffer = WalkScene(ctx, folder, 30), ctx.simple_framebuffer((SIDE_PX, SIDE_PX), 4)
    scene.steer(1.0, 0.3)
    for _ in range(10):
        scene.update(1 / 30)
    scene.draw(framebuffer)
    data = framebuffer.read(components=3, alignment=1)
    matches("walk scene", np.frombuffer(data, np.uint8).reshape(SIDE_PX, SIDE_PX, 3)[::-1].copy())
    for thing in (*framebuffer.color_attachments, framebuffer.depth_attachment, framebuffer, scene):
        thing.release()


@pytest.mark.parametrize("name", [name for name, how in DEMOS.items() if not isinstance(how, str)])
def test_demos(folder: Path, matches: Any, tmp_path: Path, name: str) -> None:
    main = __import__(f"demos.{name}", fromlist=["main"]).main
    out = tmp_path / "picture.png"
    assert main([str(folder), "--headless", "--out", str(out), *SIZE, *DEMOS[name]]) == 0
    matches(f"demo {name}", np.asarray(Image.open(out).convert("RGB")))


def test_every_demo_has_a_golden_or_a_reason() -> None:
    programs = {path.stem for path in (ROOT / "demos").glob("*.py") if 'if __name__ == "__main__"' in path.read_text()}
    programs |= {path.parent.name for path in (ROOT / "demos").glob("*/__main__.py")}
    assert programs == set(DEMOS)
    assert all((GOLDEN / f"demo_{name}.png").is_file() for name, how in DEMOS.items() if not isinstance(how, str))


def test_every_view_has_a_golden_and_every_golden_a_picture() -> None:
    """Depth writes no colour; its pictures are those of test_crowd and test_picking, in numbers."""
    demos = {f"demo {name}" for name, how in DEMOS.items() if not isinstance(how, str)}
    demos = {f"demo {name}" for name, how in DEMOS.items() if not isinstance(how, str)}
    names = {*WAYS, "crowd lit", "crowd lod", "walk scene", "blended", "blended prepass", *demos}
    assert {path.stem for path in GOLDEN.glob("*.png")} == {name.replace(" ", "_") for name in names}
