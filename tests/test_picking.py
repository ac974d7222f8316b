"""Rays of cameras, and who is under the mouse: the same as the picture says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from builders_scene import Scene
from test_runtime_state import driver_state

import runtime
from runtime.errors import RenderError
from runtime.gpu import gl_state

SIZE = (64, 48)
CAMERAS = [
    runtime.Camera((1.5, 2.0, 6.0), (0.0, 1.0, 0.0)),
    runtime.Camera.first_person((0.2, 1.4, -5.0), 0.1, -0.05),
    runtime.MatrixCamera(
        np.array([[1, 0, 0, 0.1], [0, 1, 0, -1], [0, 0, 1, -5], [0, 0, 0, 1.0]]), np.diag([0.4, 0.5, -0.1, 1.0])
    ),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_ray_goes_through_its_point_of_the_picture(camera: Any) -> None:
    matrices = camera.matrices(*SIZE)
    for point in ((0.0, 0.0), (13.25, 40.5), (64.0, 48.0), (-7.0, 90.0)):
        origin, direction = camera.ray(point, SIZE)
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        for distance in (1.0, 7.0):
            seen = matrices.clip_from_world @ np.append(origin + distance * direction - matrices.eye, 1.0)
            x, y = seen[:2] / seen[3]
            assert ((x + 1) / 2 * SIZE[0], (1 - y) / 2 * SIZE[1]) == pytest.approx(point, abs=1e-6)
            assert not matrices.is_perspective or seen[3] > 0


def test_somebody_looks_where_they_head() -> None:
    for heading, pitch in ((0.0, 0.0), (np.pi / 2, 0.0), (2.0, 0.5), (-1.0, -1.5), (0.3, np.pi / 2), (1.0, -np.pi / 2)):
        camera = runtime.Camera.first_person((3.0, 1.7, -2.0), heading, pitch)
        rotation = camera.matrices(*SIZE).rotation
        level = np.cos(pitch)
        ahead = [level * np.sin(heading), np.sin(pitch), level * np.cos(heading)]
        np.testing.assert_allclose(-rotation[2], ahead, atol=1e-12)
        np.testing.assert_allclose(
            rotation[0], [-np.cos(heading), 0, np.sin(heading)], atol=1e-9
        )  # the horizon is level
    with pytest.raises(ValueError, match="heading must be finite"):
        runtime.Camera.first_person((0, 0, 0), float("nan"))


@pytest.fixture
def crowd(scene: Scene) -> Iterator[runtime.Crowd]:
    made = runtime.Crowd(scene.ctx, scene.model, 6)
    made.place_on_ground([(2.2 * x, 0.0, -3.0 * z) for z in (1, 2) for x in (-1, 0, 1)], np.arange(6.0))
    made.play("bend", phases_s=np.arange(6) / 7.0)
    yield made
    made.release()


def test_who_is_picked_is_who_is_drawn(scene: Scene, crowd: runtime.Crowd) -> None:
    """Every pixel of a picture in which everybody has a colour of their own."""
    scene.renderer.add_view("who", '#include "surface.glsl"\nout vec4 result;\nvoid main() { result = surface_tint; }')
    actors = [scene.model.actor(clip="bend", time_s=0.1 * index) for index in range(3)]
    for index, actor in enumerate(actors):
        actor.transform[:3, 3] = [0.9 * index - 1.0, 0.1 * index, -0.4 * index]
        actor.tint = (0.1 + 0.1 * index, 0, 0, 1)
    crowd.tint([(0, 0.1 + 0.1 * index, 0) for index in range(6)])
    crowd.show(False, [4])
    actors[1].visible = False
    things: list[Any] = [*actors, crowd]
    camera = runtime.Camera((1.0, 6.0, 8.0), (0.3, 0.9, -2.0))
    height, width = scene.picture(things, camera=camera).shape[:2]
    picture = scene.picture(things, camera=camera, view="who", lod=0).astype(int)
    seen: set[Any] = set()
    for y in range(1, height, 7):
        for x in range(1, width, 7):
            around = picture[y - 1 : y + 2, x - 1 : x + 2, :3].reshape(-1, 3)
            if (around != around[4]).any():
                continue  # an outline: a hair decides
            hit = runtime.pick(scene.renderer, things, camera, (x + 0.5, y + 0.5), (width, height))
            red, green, _ = np.rint(around[4] / 25.5).astype(int)
            if not red and not green:
                assert hit is None
                continue
            assert hit is not None
            expected = (actors[red - 1], None) if red else (crowd, green - 1)
            assert (hit.thing, hit.number) == expected
            seen.add(expected)
            origin, direction = camera.ray((x + 0.5, y + 0.5), (width, height))
            np.testing.assert_allclose(hit.position, origin + hit.distance_m * direction)
    assert len(seen) >= 6


def test_a_hit_lies_on_the_surface(scene: Scene) -> None:
    """The ray through the middle of the body meets its front, whose place the position view tells."""
    actor = scene.model.actor()
    camera = runtime.Camera((0.0, 1.0, 5.0), (0.0, 1.0, 0.0))
    hit = runtime.pick(scene.renderer, [actor], camera, (32, 24), SIZE)
    assert hit is not None and hit.thing is actor
    np.testing.assert_allclose(hit.position[:2], [0.0, 1.0], atol=1e-6)
    assert hit.position[2] == pytest.approx(0.35, abs=0.03) and hit.distance_m == pytest.approx(5 - hit.position[2])
    inside = runtime.Camera((0.0, 1.0, 0.0), (0.0, 1.0, -1.0))
    assert runtime.pick(scene.renderer, [actor], inside, (32, 24), SIZE) is None  # back faces are not drawn
    behind = runtime.Camera((0.0, 1.0, 5.0), (0.0, 1.0, 10.0))
    assert runtime.pick(scene.renderer, [actor], behind, (32, 24), SIZE) is None


def test_picking_leaves_everything_as_it_was(scene: Scene, crowd: runtime.Crowd) -> None:
    actor = scene.model.actor()
    scene.picture([actor, crowd])  # type: ignore[list-item]
    scene.framebuffer.use()
    scene.framebuffer.viewport = (3, 4, 20, 10)
    gl = gl_state.functions()
    before, drawn, counts = driver_state(gl), dict(scene.renderer.last_drawn), crowd.last_counts.copy()
    for things in ([actor, crowd], [], [crowd]):
        runtime.pick(scene.renderer, things, CAMERAS[0], (32, 24), SIZE)  # type: ignore[arg-type]
        assert driver_state(gl) == before and scene.ctx.fbo is scene.framebuffer
    assert scene.renderer.last_drawn == drawn and (crowd.last_counts == counts).all() and crowd.state.visible.all()
    with pytest.raises(RenderError, match="only actors and crowds can be picked, not 5"):
        runtime.pick(scene.renderer, [5], CAMERAS[0], (32, 24), SIZE)  # type: ignore[list-item]
    with pytest.raises(ValueError, match="a point of the picture"):
        runtime.pick(scene.renderer, [actor], CAMERAS[0], ("x", 1), SIZE)  # type: ignore[arg-type]
    actor.transform[0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        runtime.pick(scene.renderer, [actor], CAMERAS[0], (32, 24), SIZE)
    assert driver_state(gl) == before
    scene.renderer.release()
    with pytest.raises(RenderError, match="released"):
        runtime.pick(scene.renderer, [scene.model.actor()], CAMERAS[0], (32, 24), SIZE)
