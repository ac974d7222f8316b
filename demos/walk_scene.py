"""An evening square: somebody to steer, a crowd that strolls around, shadows, a lantern in a hand.

The windowing examples (embed_glfw, embed_pygame, embed_moderngl_window) differ only in where their context and their
keys come from; this is what they share, and all of it is made with the runtime's public parts.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray

import runtime
from demos.gait import model_skin, pace
from demos.surroundings import EVENING, Surroundings, write_uniforms
from runtime.gpu.programs import build_program

TURN_RAD_S = 2.4
FADE_S = 0.25
FIRST_RING, RING_WIDTH, WALKER_ROOM = 2.5, 0.9, 2.0  # of a character's size: the walkers' circles
AT_REST = runtime.Clip("at rest", 0.0, ())
LEAST_PACE = 0.35  # of a character's size a second: slower walks are played faster


@dataclass
class Lantern:
    """Something to hold: all that an attached thing needs is a transform."""

    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


def find_clip(names: list[str], *words: str) -> str | None:
    """The first clip whose name holds one of the words, the first word counting most."""
    for word in words:
        for name in names:
            if re.search(word, name, re.IGNORECASE):
                return name
    return None


def find_hand(names: tuple[str, ...]) -> str:
    """A joint to hang a lantern from: a right hand if there is one."""
    for pattern in (
        r"hand.*(right|[._ -]r\b|r$)",
        r"(right|^r[._ ]|[._ ]r[._ ]).*hand",
        r"hand",
        r"wrist|fist|head",
        r".",
    ):
        for name in names:
            if re.search(pattern, name, re.IGNORECASE):
                return name
    return names[0]


def character_size(box: NDArray[np.float64]) -> float:
    """How much room a character takes, metres: its height, or most of its length. `box` is (2, 3)."""
    extent = box[1] - box[0]
    return float(max(extent[1], 0.75 * max(extent[0], extent[2])))


class WalkScene:
    """Everything of the example but the window.

    Parameters
    ----------
    ctx : moderngl.Context
        The caller's.
    folder : Path
        A built character.
    num_walkers : int
        Size of the crowd.
    """

    def __init__(self, ctx: moderngl.Context, folder: Path, num_walkers: int = 150) -> None:
        self.ctx = ctx
        self.model = runtime.Model(ctx, runtime.load(folder))
        box = self.model.asset.manifest.bind_bounds
        self.unit_m = character_size(box)
        self.sole_m = float(box[0, 1])
        self._choose_clips()
        lighting = runtime.Lighting(sun_direction=EVENING.sun, sun_color=(0.91, 0.60, 0.41), exposure=1.4)
        self.renderer = runtime.Renderer(ctx, lighting=lighting)
        self.hero = self.model.actor(clip=self.idle, root_motion="turn")
        self.hero_place, self.heading = np.zeros(3), 0.0
        self.walking = False
        self.forward = self.turn = 0.0
        self.lantern = Lantern()
        self.hero.attach(self.lantern, find_hand(self.model.asset.skeleton.names))
        self._make_crowd(num_walkers)
        self.surroundings = Surroundings(ctx, EVENING, self.unit_m)
        self.glass = build_program(ctx, ("lantern.vert", "lantern.frag"))
        self.glass_array = ctx.vertex_array(self.glass, [])
        self.update(0.0)

    def _choose_clips(self) -> None:
        """Clips to stand and to walk with, and the pace at which the feet of the latter do not slide."""
        clips = self.model.asset.clips
        names = [clip.name for clip in clips]
        self.walk = find_clip(names, "walk", "run", ".")
        self.idle = find_clip(names, "idle", "survey", "stand", "breath")
        self.pace_m_s, self.walk_speed = 0.75 * self.unit_m, 1.0
        if self.walk is not None:
            skin = model_skin(self.ctx, self.model)
            found = pace(self.model.asset.skeleton, clips[names.index(self.walk)], self.unit_m, skin)
            if abs(found) > 0.02 * self.unit_m:
                faster = max(1.0, min(LEAST_PACE * self.unit_m / abs(found), 2.0))
                self.pace_m_s, self.walk_speed = abs(found) * faster, float(np.sign(found)) * faster

    def _make_crowd(self, num_walkers: int) -> None:
        """People on circles around the square; those of a circle share a pace, so that nobody walks through another."""
        draw = np.random.default_rng(5)
        self.crowd = runtime.Crowd(self.ctx, self.model, num_walkers)
        rings = FIRST_RING + RING_WIDTH * np.arange(num_walkers + 1)
        room = np.maximum((2 * np.pi * rings / WALKER_ROOM).astype(int), 1)
        ring = np.repeat(np.arange(len(room)), room)[:num_walkers]
        self.radii = self.unit_m * rings[ring]
        place = np.arange(num_walkers) - np.searchsorted(ring, ring)  # in its ring
        self.angles = 2 * np.pi * (place + draw.uniform(-0.15, 0.15, num_walkers)) / room[ring] + ring
        self.paces = (draw.uniform(0.8, 1.25, len(rings)) * np.where(np.arange(len(rings)) % 2, 1, -1))[ring]
        if self.walk is not None:
            speeds = np.abs(self.paces) * self.walk_speed
            self.crowd.play(self.walk, phases_s=draw.uniform(0, 9, num_walkers), speeds=speeds)
        self.crowd.tint(various_tints(num_walkers))

    def steer(self, forward: float, turn: float) -> None:
        """What the keys say: forward −1 to 1, turn −1 (right) to 1 (left)."""
        self.forward, self.turn = float(np.clip(forward, -1, 1)), float(np.clip(turn, -1, 1))

    def update(self, dt_s: float) -> None:
        """Let time run on."""
        if (self.forward != 0 or self.turn != 0) != self.walking:
            self.walking = not self.walking
            clip = self.walk if self.walking else self.idle
            self.hero.play(clip or AT_REST, fade_s=FADE_S)
        if self.walking:  # turning on the spot takes small steps
            self.hero.set_speed(self.walk_speed * (self.forward or 0.6))
        self.heading += self.turn * TURN_RAD_S * dt_s
        ahead = np.array([np.sin(self.heading), 0.0, np.cos(self.heading)])
        self.hero_place = self.hero_place + ahead * self.forward * self.pace_m_s * dt_s
        self.hero.transform = turned(self.heading, self.hero_place - [0.0, self.sole_m, 0.0])
        self.hero.update(dt_s)
        carried = self.hero.transform  # a clip may move its root: that counts as well
        self.hero_place = carried[:3, 3] + [0.0, self.sole_m, 0.0]
        self.heading = float(np.arctan2(carried[0, 2], carried[0, 0]))

        self.angles += self.paces * self.pace_m_s * dt_s / self.radii
        places = np.stack([np.sin(self.angles), np.zeros_like(self.angles), np.cos(self.angles)], axis=1)
        places = places * self.radii[:, None] - [0.0, self.sole_m, 0.0]
        self.crowd.place_on_ground(places, self.angles + np.sign(self.paces) * np.pi / 2)
        self.crowd.update(dt_s)

    def camera(self) -> runtime.Camera:
        """From behind the one who is steered, a little above."""
        ahead = np.array([np.sin(self.heading), 0.0, np.cos(self.heading)])
        right = np.array([-ahead[2], 0.0, ahead[0]])
        eye = self.hero_place + self.unit_m * (-2.3 * ahead + 0.9 * right + [0.0, 1.15, 0.0])
        target = self.hero_place + self.unit_m * (0.9 * ahead + [0.0, 0.55, 0.0])
        near, far = 0.05 * self.unit_m, 200 * self.unit_m
        return runtime.Camera(tuple(eye), tuple(target), fovy_deg=45, near_m=near, far_m=far)  # type: ignore[arg-type]

    def draw(self, target: moderngl.Framebuffer) -> None:
        """One picture into a framebuffer of the caller's."""
        things: list[runtime.Actor | runtime.Crowd] = [self.hero, self.crowd]
        balls = [(self.hero_place, 4 * self.unit_m), (self.hero_place, 18 * self.unit_m)]
        self.surroundings.draw_shadows(self.renderer, things, balls)
        target.use()
        target.clear(depth=1.0)
        camera, held = self.camera(), self.lantern.transform[:3, 3]
        values = self.surroundings.draw(camera, target, 150 * self.unit_m, held)
        write_uniforms(self.glass, {**values, "lantern_size": 0.16 * self.unit_m})
        self.glass_array.render(moderngl.TRIANGLES, vertices=4 * 36)
        self.renderer.draw(things, camera)

    def release(self) -> None:
        """Free everything on the GPU. May be called more than once."""
        self.surroundings.release()
        for thing in (self.crowd, self.renderer, self.model, self.glass_array, self.glass):
            thing.release()


def various_tints(count: int, seed: int = 7) -> NDArray[np.float64]:
    """Factors of the base colour, (A, 3): lighter and darker, warmer and cooler, as people differ."""
    draw = np.random.default_rng(seed)
    light = draw.uniform(0.45, 1.0, count)[:, None]
    warm = draw.uniform(-0.08, 0.08, count)[:, None] * np.array([1.0, 0.1, -1.0])
    result: NDArray[np.float64] = np.clip(light * (1.0 + warm), 0.0, 1.0)
    return result


def turned(heading: float, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """A transform that turns by `heading` radians about +Y and moves to `place`, (4, 4)."""
    matrix = np.eye(4)
    matrix[0, 0] = matrix[2, 2] = np.cos(heading)
    matrix[0, 2], matrix[2, 0] = np.sin(heading), -np.sin(heading)
    matrix[:3, 3] = place
    return matrix
