"""How actors come, end and go: ends of clips are told once, and whoever is dropped leaves the mixer."""

from __future__ import annotations

import gc
from typing import Any

import pytest
from builders_mixer import make_walker

from runtime.scene.actor import Actor


@pytest.fixture
def walker() -> Any:
    return make_walker()


def test_thousands_come_and_go_without_growth(walker: Any) -> None:
    for _ in range(3000):
        actor = Actor(walker, "bend")
        actor.update(0.1)
        actor.release()
    assert walker.mixer._capacity == 8
    many = [Actor(walker, "bend") for _ in range(100)]
    assert walker.mixer.num_rows == 100
    for actor in many:
        actor.release()
    assert walker.mixer.num_rows == 0


def test_a_clip_played_once_tells_its_end(walker: Any) -> None:
    actor = Actor(walker, 0, loop=False)
    told: list[str] = []
    length = walker.mixer.clips[0].duration_s
    assert not actor.finished
    actor.play(0, loop=False, on_end=lambda: told.append("first"))
    actor.update(0.5 * length)
    assert not actor.finished and not told
    actor.update(0.6 * length)
    assert actor.finished and told == ["first"]
    actor.update(length)
    assert told == ["first"]  # once
    actor.play(0, loop=False, speed=-2.0, time_s=length, on_end=lambda: actor.play(1, fade_s=0.1))
    actor.update(0.4 * length)
    assert actor.clip == walker.mixer.clips[0].name
    actor.update(0.2 * length)
    assert actor.clip == walker.mixer.clips[1].name and not actor.finished  # it loops
    actor.update(10 * length)
    assert not actor.finished
    actor.play(0, loop=False, on_end=lambda: told.append("never"))
    actor.play(1)
    actor.update(10 * length)
    actor.play(0, loop=False, on_end=lambda: told.append("never"))
    actor.stop(0)
    actor.update(10 * length)
    assert told == ["first"] and not actor.finished
    actor.play(0, loop=False, on_end=lambda: actor.release())  # to go with the last frame
    actor.update(2 * length)
    assert actor.released
    other = Actor(walker)
    assert not other.finished
    with pytest.raises(ValueError, match="a clip that loops has no end"):
        other.play(0, on_end=print)
    with pytest.raises(ValueError, match="on_end needs"):
        other.play(0, loop=False, on_end="idle")  # type: ignore[arg-type]


def test_layers_tell_their_ends_each(walker: Any) -> None:
    told: list[str] = []
    walker.mixer.add_layer("upper")
    actor = Actor(walker, 0)
    for layer in ("base", "upper"):
        actor.play(0, loop=False, layer=layer, on_end=lambda layer=layer: told.append(layer))  # type: ignore[misc]
    actor.stop("upper")
    actor.update(100.0)
    assert told == ["base"]


def test_an_actor_that_nobody_holds_leaves(walker: Any) -> None:
    kept = Actor(walker, 0)
    for _ in range(3):
        crowd = [Actor(walker, 0) for _ in range(20)]
        assert walker.mixer.num_rows == 21
        del crowd
        gc.collect()
        assert walker.mixer.num_rows == 1
    assert not kept.released
