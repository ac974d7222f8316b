"""Misuse of actors, crowds, cameras and contexts: one line that names the thing, and everything goes on as before."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders_scene import Scene

import runtime
from runtime import validation
from runtime.errors import AssetError, RenderError

NAN, INF = float("nan"), float("inf")


def refused(work: Callable[[], Any], message: str, kind: type[Exception] = ValueError) -> None:
    """An exception of exactly this kind, in one line."""
    with pytest.raises(kind, match=message) as told:
        work()
    assert type(told.value) is kind and "\n" not in str(told.value) and len(str(told.value)) < 250


@pytest.mark.parametrize("step", [None, "0.1", NAN, INF, 1e10, -1e300, [0.1, 0.2], np.zeros(2), 1j])
def test_time_that_is_none_is_told(actor: runtime.Actor, crowd: runtime.Crowd, step: Any) -> None:
    for who in (actor, crowd):
        refused(lambda who=who: who.update(step), "cannot be updated by .* seconds; check the frame clock")  # type: ignore[misc]
    refused(lambda: actor.model.mixer.note_time_all(step), "check the frame clock")
    assert actor.time_s == 0.0 and crowd.state.clock_s == 0.0


@pytest.mark.parametrize("step", [-0.25, 0, np.float32(0.125), 1e9, -1e9])
def test_time_may_run_backwards_stand_and_leap(scene: Scene, actor: runtime.Actor, step: Any) -> None:
    actor.update(step)
    assert 0.0 <= actor.time_s <= scene.model.mixer.clips[0].duration_s
    before = actor.time_s
    actor.update(0.01)
    assert actor.time_s != before
    assert scene.picture([actor], view="mask")[..., 0].any()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"clip": None}, "no clip None; the character has 'bend'"),
        ({"clip": "Bend"}, "no clip 'Bend'; did you mean 'bend'"),
        ({"clip": "bnd"}, "did you mean 'bend'"),
        ({"clip": "completely else"}, "the character has 'bend'"),
        ({"clip": ""}, "no clip ''"),
        ({"clip": 1.5}, "no clip 1.5"),
        ({"clip": True}, "no clip True"),
        ({"clip": -1}, "no clip -1"),
        ({"clip": ["bend"]}, "no clip"),
        ({"clip": 0, "fade_s": "x"}, "fade_s must be finite numbers, not 'x'"),
        ({"clip": 0, "fade_s": None}, "fade_s"),
        ({"clip": 0, "speed": "fast"}, "speed must be finite numbers up to 1e\\+06, not 'fast'"),
        ({"clip": 0, "speed": 1e12}, "speed"),
        ({"clip": 0, "time_s": None}, "time_s"),
        ({"clip": 0, "time_s": NAN}, "time_s"),
        ({"clip": 0, "layer": "bose"}, "no layer 'bose'; did you mean 'base'"),
        ({"clip": 0, "layer": 5}, "no layer 5"),
        ({"clip": 0, "layer": None}, "no layer None"),
    ],
)
def test_what_cannot_be_played_is_told(actor: runtime.Actor, how: dict[str, Any], message: str) -> None:
    actor.time_s = 0.2
    refused(lambda: actor.play(**how), message)
    assert actor.clip == "bend" and actor.time_s == pytest.approx(0.2)


def test_seeking_speed_and_layers_take_numbers(actor: runtime.Actor) -> None:
    refused(lambda: setattr(actor, "time_s", "x"), "time_s")
    refused(lambda: actor.set_speed(None), "speed")  # type: ignore[arg-type]
    refused(lambda: actor.stop("base", fade_s=None), "fade_s")  # type: ignore[arg-type]
    refused(lambda: actor.set_layer_weight("base", "x"), "weight")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"transform": "x"}, "an actor's transform, a finite 4×4 matrix, must be finite numbers, not 'x'"),
        ({"transform": np.eye(3)}, r"4×4 matrix, not of shape \(3, 3\)"),
        ({"transform": np.full((4, 4), NAN)}, "an actor's transform"),
        ({"tint": None}, "tint"),
        ({"tint": "red"}, "a tint must be finite numbers, not 'red'"),
        ({"tint": (1, 2)}, "three or four"),
        ({"tint": 5}, "three or four"),
        ({"root_motion": 3}, "root_motion 3 is unknown"),
        ({"speed": None}, "speed"),
        ({"time_s": "x"}, "time_s"),
        ({"clip": "nope"}, "no clip 'nope'"),
    ],
)
def test_an_actor_that_cannot_be_made_takes_no_row(scene: Scene, how: dict[str, Any], message: str) -> None:
    rows = scene.model.mixer.num_rows
    refused(lambda: scene.model.actor(**{"clip": 0, **how}), message)
    assert scene.model.mixer.num_rows == rows


def test_joints_that_are_none_and_things_that_hang_on_themselves(scene: Scene, actor: runtime.Actor) -> None:
    for joint in (None, 1.5, 5000, -1, True):
        refused(lambda joint=joint: actor.joint_transform(joint), "no joint")  # type: ignore[misc]
    name = scene.model.asset.skeleton.names[1]
    refused(lambda: actor.joint_transform(name.swapcase()), f"did you mean '{name}'")
    refused(lambda: actor.set_joints("x"), "array of numbers")  # type: ignore[arg-type]
    refused(lambda: actor.set_joint_rotations(np.zeros(3)), "shape")
    other, third = scene.model.actor(), scene.model.actor()
    refused(lambda: actor.attach(None, 0), "only what has a transform")  # type: ignore[arg-type]
    refused(lambda: actor.attach(actor, 0), "hang on itself")
    refused(lambda: actor.attach(other, 0, np.eye(3)), "an offset must be a 4×4 matrix")
    actor.attach(other, 0)
    other.attach(third, 0)
    refused(lambda: third.attach(actor, 0), "by way of others")
    actor.detach(other)
    third.attach(actor, 0)


@pytest.mark.parametrize("count", [None, -1, 1.5, "3", True, 10**12, NAN])
def test_a_crowd_is_a_number_of_actors(scene: Scene, count: Any) -> None:
    refused(lambda: runtime.Crowd(scene.ctx, scene.model, count), "a crowd has 0 to 10,000,000 actors, not")


def test_a_crowd_needs_a_model_and_its_context(scene: Scene) -> None:
    for arguments in ((scene.model, scene.ctx, 3), (scene.ctx, None, 3), (scene.ctx, scene.model.asset, 3)):
        refused(lambda arguments=arguments: runtime.Crowd(*arguments), "a crowd is made of", RenderError)  # type: ignore[misc]
    refused(lambda: runtime.Crowd(scene.ctx, scene.model, 3, clips="bend"), "clips must be a list")
    refused(lambda: runtime.Crowd(scene.ctx, scene.model, 3, clips=["bond"]), "did you mean 'bend'")
    refused(lambda: runtime.Crowd(scene.ctx, scene.model, 3, vertex_animation_bytes=-1), "vertex_animation_bytes")


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (lambda crowd: crowd.play("Bend"), "no clip 'Bend'; did you mean 'bend'"),
        (lambda crowd: crowd.play(None), "no clip None"),
        (lambda crowd: crowd.play(99), "no clip 99"),
        (lambda crowd: crowd.play(1.5), "no clip 1.5"),
        (lambda crowd: crowd.play([0, 0]), "5 actors need one of clips each"),
        (lambda crowd: crowd.play(0, phases_s="x"), "phases_s must be finite"),
        (lambda crowd: crowd.play(0, phases_s=[1, 2]), "one of phases_s each"),
        (lambda crowd: crowd.play(0, speeds=None), "speeds"),
        (lambda crowd: crowd.play(0, speeds=INF), "speeds"),
        (lambda crowd: crowd.play(0, which=99), "numbers 0 to 4"),
        (lambda crowd: crowd.play(0, which="x"), "which must be|`which` must be"),
        (lambda crowd: crowd.play(0, which=1.5), "which"),
        (lambda crowd: crowd.play(0, which=[True, False]), "a mask of 5"),
        (lambda crowd: crowd.place("x"), "4×4 matrices"),
        (lambda crowd: crowd.place(np.full((4, 4), NAN)), "not finite"),
        (lambda crowd: crowd.place(np.zeros((4, 4, 4))), r"\(4, 4, 4\)"),
        (lambda crowd: crowd.place_on_ground("x"), "positions must be finite"),
        (lambda crowd: crowd.place_on_ground(np.zeros((5, 3)), "x"), "headings must be finite"),
        (lambda crowd: crowd.place_on_ground((1, 2)), "positions"),
        (lambda crowd: crowd.tint("red"), "tints"),
        (lambda crowd: crowd.tint(np.zeros((4, 3))), "5 actors need tints"),
        (lambda crowd: crowd.show("x"), "True or False"),
        (lambda crowd: crowd.show([True, False]), "True or False"),
    ],
)
def test_what_a_crowd_cannot_do_is_told_and_changes_nothing(
    scene: Scene, crowd: runtime.Crowd, work: Callable[[runtime.Crowd], None], message: str
) -> None:
    crowd.play("bend", phases_s=np.arange(5.0))
    names = ("clips", "phases_s", "speeds", "visible", "tints", "_rows", "_positions")
    before = [getattr(crowd.state, name).copy() for name in names]
    refused(lambda: work(crowd), message)
    for name, value in zip(names, before):
        np.testing.assert_array_equal(getattr(crowd.state, name), value)


def test_a_crowd_plays_names_numbers_and_clips(crowd: runtime.Crowd) -> None:
    bend, rest = 0, len(crowd.clip_names) - 1
    crowd.play(["bend", crowd.clip_names[rest]] * 2 + ["bend"])
    assert crowd.state.clips.tolist() == [bend, rest, bend, rest, bend]
    crowd.play(crowd.model.mixer.clips[0], which=[1])
    assert crowd.state.clips.tolist() == [bend, bend, bend, rest, bend]
    crowd.play(0, which=np.array([], dtype=int))


def test_crowds_of_none_and_one(scene: Scene) -> None:
    for count in (0, 1):
        crowd = runtime.Crowd(scene.ctx, scene.model, count)
        crowd.place(np.eye(4))
        crowd.play(0, phases_s=0.1)
        crowd.tint((1, 0.5, 0.5))
        crowd.show(True)
        crowd.update(0.1)
        assert bool(scene.picture([crowd], view="mask")[..., 0].any()) == bool(count)  # type: ignore[list-item]
        crowd.release()


@pytest.mark.parametrize(
    "camera",
    [
        runtime.Camera(None),  # type: ignore[arg-type]
        runtime.Camera("abc"),  # type: ignore[arg-type]
        runtime.Camera((0, 0, 1), fovy_deg=None),  # type: ignore[arg-type]
        runtime.Camera((0, 0, 1), fovy_deg="x"),  # type: ignore[arg-type]
        runtime.Camera((0, 0, 1), near_m="x"),  # type: ignore[arg-type]
    ],
)
def test_cameras_are_numbers(camera: runtime.Camera) -> None:
    refused(lambda: camera.matrices(64, 64), "the camera's", RenderError)


@pytest.mark.parametrize(
    "arguments",
    [("x",), (np.full((2, 3), NAN),), (np.zeros(3),), (np.eye(3)[:2], 0.0), (np.eye(3)[:2], 1.0, 35.0, (0, 0, 0))],
)
def test_framing_needs_a_box(arguments: Any) -> None:
    refused(lambda: runtime.framing(*arguments), "a box|framing")


def test_a_path_is_told_from_what_is_none(tmp_path: Path) -> None:
    for path in (None, 3, b"folder"):
        refused(lambda path=path: runtime.load(path), "loaded from the path", AssetError)  # type: ignore[misc]
    loading = runtime.Loading(None, None)  # type: ignore[arg-type]
    with pytest.raises(AssetError, match="loaded from the path"):
        while loading.step() is None:
            time.sleep(0.001)
    model = tmp_path / "human.glb"
    model.touch()
    refused(lambda: runtime.load(model), "is a file, not a built character", AssetError)


def test_names_are_suggested_and_lists_kept_short() -> None:
    names = [f"Walk_{index}" for index in range(40)]
    assert str(validation.unknown_name("clip", "walk_7", names, "character")).startswith(
        "no clip 'walk_7'; did you mean 'Walk_7'"
    )
    assert str(validation.unknown_name("clip", "qqq", names, "character")).endswith("'Walk_11' and 28 more")
    assert str(validation.unknown_name("clip", "qqq", [], "character")) == "no clip 'qqq'; the character has none"
    assert "Walking_A" in str(validation.unknown_name("clip", "walk", ["Idle", "Walking_A"], "character"))


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"camera": None}, "pictures need a Camera"),
        ({"camera": (1, 2, 3)}, "pictures need a Camera"),
        ({"view": ["lit"]}, "no view"),
        ({"view": None}, "no view None"),
        ({"lod": "x"}, "no level of detail 'x'"),
        ({"lod": None}, "no level of detail None"),
        ({"lod": 1.5}, "no level of detail 1.5"),
        ({"lod": True}, "no level of detail True"),
        ({"tessellation": True}, "not between 1 and 64"),
        ({"uniforms": 3}, "uniforms must be a mapping"),
    ],
)
@pytest.mark.parametrize("who", ["actor", "crowd", "nobody"])
def test_how_to_draw_is_checked_whoever_is_drawn(
    scene: Scene, actor: runtime.Actor, crowd: runtime.Crowd, who: str, how: dict[str, Any], message: str
) -> None:
    things: dict[str, list[Any]] = {"actor": [actor], "crowd": [crowd], "nobody": []}
    arguments = {"camera": scene.camera, **how}
    refused(lambda: scene.renderer.draw(things[who], **arguments), message, RenderError)


def test_one_actor_or_crowd_is_drawn_without_a_list(scene: Scene, actor: runtime.Actor, crowd: runtime.Crowd) -> None:
    for thing in (actor, crowd):
        assert (scene.picture(thing) == scene.picture([thing])).all()
    for thing in (None, 5, "abc", [None], [scene.model]):
        refused(lambda thing=thing: scene.renderer.draw(thing, scene.camera), "only actors and crowds", RenderError)  # type: ignore[misc]


def test_far_too_large_is_told_not_drawn(scene: Scene, actor: runtime.Actor) -> None:
    actor.transform[:] = 1e200
    refused(lambda: scene.picture([actor]), "actor 0 of those to draw is not finite, or far too large")
    actor.transform = np.eye(4)
    camera = runtime.Camera((1e300, 0, 0))
    refused(lambda: scene.picture([actor], camera=camera), "the camera's eye", RenderError)
    actor.transform[:] = 0  # shrunk to nothing
    assert not scene.picture([actor], view="mask").any()


@pytest.mark.parametrize(
    "how",
    [
        {"sun_direction": "x"},
        {"sun_direction": (1, 2)},
        {"sun_direction": (NAN, 0, 0)},
        {"sun_color": None},
        {"exposure": "x"},
        {"exposure": NAN},
        {"exposure": -1.0},
        {"environment": 3},
    ],
)
def test_light_is_numbers(how: dict[str, Any]) -> None:
    refused(lambda: runtime.Lighting(**how), f"lighting: {next(iter(how))}", RenderError)


def test_settings_of_a_renderer_are_of_their_kind(scene: Scene) -> None:
    renderer = scene.renderer
    for name in ("lighting", "quality"):
        for value in (None, 3):
            refused(
                lambda name=name, value=value: setattr(renderer, name, value), f"a renderer's {name} is", RenderError
            )  # type: ignore[misc]
    refused(lambda: runtime.Renderer(scene.ctx, lighting=3), "a renderer's lighting is", RenderError)  # type: ignore[arg-type]
    refused(lambda: runtime.Renderer(scene.ctx, quality=3), "a renderer's quality is", RenderError)  # type: ignore[arg-type]
    for value in ("x", None, 0, INF):
        refused(lambda value=value: runtime.Quality(threshold_px=value), "quality: threshold_px", RenderError)  # type: ignore[misc]
    for arguments in ((None, "void main() {}"), ("own", None), ("own", 3)):
        refused(lambda arguments=arguments: renderer.add_view(*arguments), "a view is a name", RenderError)  # type: ignore[misc]
    refused(lambda: renderer.add_view("own", "toon.frag"), r"pathlib\.Path of its file", RenderError)
    assert scene.picture([scene.model.actor()]).any()


def test_things_are_shown_in_one_short_line(scene: Scene, actor: runtime.Actor, crowd: runtime.Crowd) -> None:
    asset = scene.model.asset
    assert repr(asset) == "<Asset 'ball': 1,728 faces, 3 levels, 4 joints, 1 clips>"
    assert asset.clip_names == ("bend",) and asset.joint_names[1] == "joint1"
    assert repr(asset.clips[0]) == "<Clip 'bend': 1 s, 3 tracks>"
    actor.time_s, actor.transform[0, 3] = 0.25, 1.5
    assert repr(actor) == "<Actor at (1.5, 0, 0) playing 'bend' at 0.25 s>"
    assert repr(scene.model.actor()) == "<Actor at (0, 0, 0) at rest>"
    actor.release()
    assert repr(actor) == "<Actor, released>"
    assert repr(crowd) == "<Crowd of 5 'ball'>"
