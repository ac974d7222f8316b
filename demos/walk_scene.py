"""An evening square: somebody to steer, a crowd that strolls around, shadows, a lantern in a hand.

The windowing examples (embed_glfw, embed_pygame, embed_moderngl_window) differ only in where their context and their
keys come from; this is what they share, and all of it is made with the runtime's public parts.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

import runtime
from demos.sun_camera import sun_camera
from runtime.gl_state import functions
from runtime.programs import build_program

SHADOW_PX = 1024
SUN = np.array([-0.55, 0.42, -0.72])
HORIZON = (0.30, 0.27, 0.37)
LANTERN_LIGHT = np.array([1.5, 0.85, 0.32])
TURN_RAD_S = 2.4
FADE_S = 0.25


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
        names = [clip.name for clip in self.model.asset.clips]
        self.walk = find_clip(names, "walk", "run", ".")
        self.idle = find_clip(names, "idle", "survey", "stand", "breath")
        lighting = runtime.Lighting(sun_direction=tuple(SUN), sun_color=(1.9, 1.25, 0.85), exposure=0.75)
        self.renderer = runtime.Renderer(ctx, lighting=lighting)
        self.hero = self.model.actor(clip=self.idle)
        self.hero_place, self.heading = np.zeros(3), 0.0
        self.walking = False
        self.forward = self.turn = 0.0
        self.lantern = Lantern()
        self.hero.attach(self.lantern, find_hand(self.model.asset.skeleton.names))
        self._make_crowd(num_walkers)
        self._make_surroundings()
        self.update(0.0)

    def _make_crowd(self, num_walkers: int) -> None:
        """People on circles around the square, each with a pace and a colour of their own."""
        draw = np.random.default_rng(5)
        self.crowd = runtime.Crowd(self.ctx, self.model, num_walkers)
        self.radii = self.unit_m * draw.uniform(2.5, 14, num_walkers)
        self.angles = draw.uniform(0, 2 * np.pi, num_walkers)
        self.paces = draw.uniform(0.8, 1.25, num_walkers) * draw.choice([-1, 1], num_walkers)
        if self.walk is not None:
            self.crowd.play(self.walk, phases_s=draw.uniform(0, 9, num_walkers), speeds=np.abs(self.paces))
        self.crowd.tint(draw.uniform(0.65, 1.0, (num_walkers, 3)))

    def _make_surroundings(self) -> None:
        """Ground, lantern and shadow map."""
        self.ground = build_program(self.ctx, ("ground.vert", "ground.frag"))
        self.glass = build_program(self.ctx, ("lantern.vert", "lantern.frag"))
        self.ground_array = self.ctx.vertex_array(self.ground, [])
        self.glass_array = self.ctx.vertex_array(self.glass, [])
        self.shadow = self.ctx.depth_texture((SHADOW_PX, SHADOW_PX))
        self.shadow.compare_func = ""
        self.shadow.repeat_x = self.shadow.repeat_y = False
        self.shadow_target = self.ctx.framebuffer(depth_attachment=self.shadow)

    @property
    def pace_m_s(self) -> float:
        """How fast somebody of this size walks, metres a second."""
        return 0.75 * self.unit_m

    def steer(self, forward: float, turn: float) -> None:
        """What the keys say: forward −1 to 1, turn −1 (right) to 1 (left)."""
        self.forward, self.turn = float(np.clip(forward, -1, 1)), float(np.clip(turn, -1, 1))

    def update(self, dt_s: float) -> None:
        """Let time run on."""
        if (self.forward != 0) != self.walking:
            self.walking = self.forward != 0
            clip = self.walk if self.walking else self.idle
            if clip is None:
                clip_at_rest = runtime.Clip("at rest", 0.0, ())
                self.hero.play(clip_at_rest, fade_s=FADE_S)
            else:
                self.hero.play(clip, fade_s=FADE_S, speed=float(np.sign(self.forward)) if self.walking else 1.0)
        self.heading += self.turn * TURN_RAD_S * dt_s
        ahead = np.array([np.sin(self.heading), 0.0, np.cos(self.heading)])
        self.hero_place += ahead * self.forward * self.pace_m_s * dt_s
        self.hero.transform = turned(self.heading, self.hero_place - [0.0, self.sole_m, 0.0])
        self.hero.update(dt_s)

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
        sun = sun_camera(SUN, self.hero_place, 9 * self.unit_m)
        self.shadow_target.use()
        self.shadow_target.clear(depth=1.0)
        self.renderer.draw(things, sun, view="depth", tessellation="off")

        target.use()
        target.clear(*HORIZON, 1.0, depth=1.0)
        camera = self.camera()
        self._draw_surroundings(camera, sun, target)
        self.renderer.draw(things, camera)

    def _draw_surroundings(
        self, camera: runtime.Camera, sun: runtime.MatrixCamera, target: moderngl.Framebuffer
    ) -> None:
        """Ground and lantern."""
        matrices = camera.matrices(*target.size)
        from_sun = sun.matrices(SHADOW_PX, SHADOW_PX)
        moved = np.eye(4)
        moved[:3, 3] = matrices.eye - from_sun.eye
        held = self.lantern.transform[:3, 3] - matrices.eye
        common: dict[str, Any] = {"clip_from_world": matrices.clip_from_world, "lantern_position": held}
        write_uniforms(
            self.ground,
            {
                **common,
                "ground_centre": np.array([self.hero_place[0], 0.0, self.hero_place[2]]) - matrices.eye,
                "ground_size": 150 * self.unit_m,
                "sun_from_world": from_sun.clip_from_world @ moved,
                "eye": matrices.eye,
                "unit_m": self.unit_m,
                "sun_light": np.array([0.62, 0.38, 0.25]),
                "sky_light": np.array([0.13, 0.14, 0.22]),
                "lantern_light": LANTERN_LIGHT,
                "horizon_color": np.array(HORIZON),
                "sun_depth": 0,
            },
        )
        write_uniforms(self.glass, {**common, "lantern_size": 0.16 * self.unit_m})
        self.shadow.use(0)
        self.ctx.enable_only(moderngl.DEPTH_TEST)
        self.ground_array.render(moderngl.TRIANGLE_STRIP, vertices=4)
        self.glass_array.render(moderngl.TRIANGLES, vertices=4 * 36)

    def release(self) -> None:
        """Free everything on the GPU. May be called more than once."""
        functions().glUseProgram(0)  # OpenGL keeps a program that is in use, deleted or not
        for thing in (
            *(self.crowd, self.renderer, self.model, self.ground_array, self.glass_array),
            *(self.ground, self.glass, self.shadow_target, self.shadow),
        ):
            thing.release()


def turned(heading: float, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """A transform that turns by `heading` radians about +Y and moves to `place`, (4, 4)."""
    matrix = np.eye(4)
    matrix[0, 0] = matrix[2, 2] = np.cos(heading)
    matrix[0, 2], matrix[2, 0] = np.sin(heading), -np.sin(heading)
    matrix[:3, 3] = place
    return matrix


def write_uniforms(program: moderngl.Program, values: dict[str, Any]) -> None:
    """Set the uniforms that a program has; matrices are given as mathematics writes them."""
    for name, value in values.items():
        if name not in program:
            continue
        if isinstance(value, np.ndarray):
            data = value.T if value.ndim == 2 else value
            program[name].write(np.ascontiguousarray(data, dtype=np.float32).tobytes())  # type: ignore[union-attr]
        else:
            program[name].value = value  # type: ignore[union-attr]
