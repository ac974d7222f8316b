"""Contexts: which is current, and that nothing is made, drawn, freed or copied in one that is not a thing's own."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Callable
from typing import Any

import moderngl
import pytest
from builders_scene import Scene
from test_misuse import refused

import runtime
from runtime.errors import RenderError
from runtime.gpu.context import current_context, require_current


def test_actors_and_crowds_are_not_copied(actor: runtime.Actor, crowd: runtime.Crowd) -> None:
    for thing in (actor, crowd):
        for way in (copy.copy, copy.deepcopy, pickle.dumps):
            refused(lambda way=way, thing=thing: way(thing), "cannot be copied or pickled", RenderError)  # type: ignore[misc]


def test_the_current_context_is_known(ctx: moderngl.Context) -> None:
    if current_context() is None:
        pytest.skip("this platform cannot be asked")
    require_current(ctx, "renderer")
    told: list[Exception] = []

    def elsewhere() -> None:
        try:
            require_current(ctx, "renderer")
        except RenderError as error:
            told.append(error)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert len(told) == 1 and "no OpenGL context is current in this thread" in str(told[0])
    other = moderngl.create_context(standalone=True, backend="egl")
    try:
        refused(lambda: require_current(ctx, "renderer"), "another context than", RenderError)
        require_current(other, "renderer")
        with ctx:
            require_current(ctx, "renderer")
            refused(lambda: require_current(other, "renderer"), "another context than", RenderError)
    finally:
        other.release()


def test_only_a_context_is_one(scene: Scene) -> None:
    for wrong in (None, scene.model, "egl"):
        refused(lambda wrong=wrong: runtime.Renderer(wrong), "a renderer needs a moderngl context", RenderError)  # type: ignore[misc]
        refused(lambda wrong=wrong: runtime.Model(wrong, scene.model.asset), "needs a moderngl context", RenderError)  # type: ignore[misc]


def test_models_and_renderers_are_not_copied(scene: Scene) -> None:
    for thing in (scene.model, scene.renderer):
        for way in (copy.copy, copy.deepcopy, pickle.dumps):
            refused(lambda way=way, thing=thing: way(thing), "cannot be copied or pickled", RenderError)  # type: ignore[misc]


def test_nothing_is_drawn_or_made_without_its_context(scene: Scene, actor: runtime.Actor, crowd: runtime.Crowd) -> None:
    """In another thread, and while another context is current; the picture after is as before."""
    if current_context() is None:
        pytest.skip("this platform cannot be asked")
    picture = scene.picture([actor, crowd])
    works: list[Callable[[], Any]] = [
        lambda: scene.renderer.draw([actor], scene.camera),
        lambda: scene.renderer.draw([crowd], scene.camera),
        lambda: runtime.Model(scene.ctx, scene.model.asset),
        lambda: runtime.Renderer(scene.ctx),
        lambda: runtime.Crowd(scene.ctx, scene.model, 2),
        lambda: runtime.pick(scene.renderer, [actor], scene.camera, (5, 5), (10, 10)),
    ]
    told: list[str] = []

    def elsewhere() -> None:
        for work in works:
            try:
                work()
            except RenderError as error:
                told.append(str(error))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert len(told) == len(works) and all("no OpenGL context is current" in text for text in told)
    other = moderngl.create_context(standalone=True, backend="egl")
    try:
        for work in works:
            refused(work, "another context than", RenderError)
        assert other.error == "GL_NO_ERROR"
    finally:
        other.release()
        scene.ctx.__enter__()
    assert (scene.picture([actor, crowd]) == picture).all()


def test_nothing_is_freed_in_another_context(scene: Scene) -> None:
    """Objects are numbers: 'texture 3' of a model is somebody else's texture in another context."""
    if current_context() is None:
        pytest.skip("this platform cannot be asked")
    things = [runtime.Crowd(scene.ctx, scene.model, 2), scene.model, scene.renderer]
    other = moderngl.create_context(standalone=True, backend="egl")
    textures = [other.texture((1, 1), 4, bytes([number] * 4)) for number in range(12)]
    try:
        for thing in things:
            refused(thing.release, "another context than", RenderError)
        assert [texture.read()[0] for texture in textures] == list(range(12))
    finally:
        other.release()
        scene.ctx.__enter__()
    assert scene.picture([scene.model.actor(), things[0]]).any()
    things[0].release()


def test_what_outlives_its_window_is_released_without_a_word(ball: Any) -> None:
    """A window that is gone leaves no context current; the objects went with it."""
    context = moderngl.create_context(standalone=True, backend="egl")
    model = runtime.Model(context, ball)
    things = [runtime.Crowd(context, model, 2), runtime.Renderer(context), model]

    def elsewhere() -> None:
        for thing in things:
            thing.release()

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    for thing in things:
        thing.release()
    context.release()
