"""The shading model in GLSL against the same in NumPy: light by direction from the map, the share that is mirrored."""

from __future__ import annotations

from collections.abc import Mapping

import moderngl
import numpy as np
import pytest

from runtime.gpu.environment_map import (
    DIFFUSE_CORNER,
    DIFFUSE_TILE,
    FIRST_STEP,
    LAST_STEP,
    MAP_HEIGHT,
    MAP_WIDTH,
    STEPS_PER_LEVEL,
    prefiltered_map,
    specular_radiance,
    tile_corner,
)
from runtime.gpu.frame_uniforms import FrameBlock
from runtime.gpu.programs import build_program, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.scene.camera import Camera
from runtime.scene.lighting import MAP_SIZE, NUM_LEVELS, REACH, Environment, Lighting
from runtime.scene.lod_selection import Quality

SIDE = 64
LIGHT_PROBE = """
#include "lighting.glsl"
in vec2 picture_place;
uniform float roughness;
uniform bool diffuse;
out vec4 result;
void main() {  // directions by height and angle: an even share of the sphere a pixel
    float angle = picture_place.x * 3.14159265;
    float y = picture_place.y;
    vec3 direction = vec3(vec2(cos(angle), sin(angle)) * sqrt(1.0 - y * y), y).xzy;
    result = vec4(diffuse ? environment_diffuse(direction) : environment_reflection(direction, roughness), 1.0);
}
"""
SHARE_PROBE = """
#include "lighting.glsl"
in vec2 picture_place;
out vec4 result;
void main() { result = vec4(environment_brdf(picture_place.x * 0.5 + 0.5, picture_place.y * 0.5 + 0.5), 0.0, 1.0); }
"""
TONE_PROBE = """
#include "lighting.glsl"
in vec2 picture_place;
uniform float exponent;  // of the brightest light
out vec4 result;
void main() {
    float hue = picture_place.x * 0.5 + 0.5;
    vec3 color = vec3(1.0, hue, hue * hue) * pow(10.0, mix(-3.0, exponent, picture_place.y * 0.5 + 0.5));
    result = vec4(tone_map(color / exposure), 1.0);
}
"""


def probe(ctx: moderngl.Context, text: str, uniforms: Mapping[str, float], **defines: int) -> np.ndarray:
    """What a fragment shader gives over the whole picture, (64, 64, 4) float32; the first row is the lowest."""
    program = build_program(ctx, ("stage.vert",), defines, text)
    set_uniforms(program, {**TEXTURE_UNITS, **uniforms})
    color = ctx.texture((SIDE, SIDE), 4, dtype="f4")
    framebuffer, array = ctx.framebuffer([color]), ctx.vertex_array(program, [])
    framebuffer.use()
    array.render(moderngl.TRIANGLES, vertices=3)
    result = np.frombuffer(framebuffer.read(components=4, dtype="f4"), np.float32).reshape(SIDE, SIDE, 4)
    for thing in (framebuffer, array, color, program):
        thing.release()
    return result


def probed_directions() -> np.ndarray:
    place = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    angle, y = np.meshgrid(place * np.pi, place)
    across = np.sqrt(1 - y * y)
    return np.stack([np.cos(angle) * across, y, np.sin(angle) * across], axis=-1)


def sampled(level: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """An environment's level, blended between its four texels."""
    size = len(level)
    px = (directions[..., [0, 2]] / (1 + np.abs(directions[..., 1:2])) * REACH + 1) / 2 * size - 0.5
    corner = np.clip(np.floor(px).astype(int), 0, size - 2)
    x, y = np.moveaxis(px - corner, -1, 0)[..., None]
    column, row = corner[..., 0] + np.where(directions[..., 1] < 0, size, 0), corner[..., 1]
    above = level[row, column] * (1 - x) + level[row, column + 1] * x
    below = level[row + 1, column] * (1 - x) + level[row + 1, column + 1] * x
    return above * (1 - y) + below * y


def between_levels(environment: Environment, directions: np.ndarray, roughness: float) -> np.ndarray:
    level = np.sqrt(roughness) * (NUM_LEVELS - 1)
    first = min(int(level), NUM_LEVELS - 2)
    sharp, rough = (sampled(environment.levels[k], directions) for k in (first, first + 1))
    return sharp + (rough - sharp) * (level - first)


@pytest.fixture(scope="module")
def studio() -> Environment:
    return Environment.studio()


@pytest.fixture
def frame(ctx: moderngl.Context, studio: Environment) -> object:
    lighting = Lighting(environment=studio)
    made = FrameBlock(ctx, lighting)
    made.write(Camera((0, 0, 3)).matrices(SIDE, SIDE), (SIDE, SIDE), lighting, Quality(), 0.0)
    made.bind()
    yield made
    made.release()


def test_tiles_lie_apart_in_the_map() -> None:
    taken = np.zeros((MAP_HEIGHT, MAP_WIDTH), int)
    for step in range(FIRST_STEP, LAST_STEP + 1):
        row, column, size = tile_corner(step)
        assert row + size <= MAP_HEIGHT and column + 2 * size <= MAP_WIDTH
        taken[row : row + size, column : column + 2 * size] += 1
    row, column = DIFFUSE_CORNER
    taken[row : row + DIFFUSE_TILE, column : column + 2 * DIFFUSE_TILE] += 1
    assert taken.max() == 1


def test_steps_at_a_level_are_that_level(studio: Environment) -> None:
    tiles = dict(specular_radiance(studio))
    assert list(tiles) == list(range(FIRST_STEP, LAST_STEP + 1))
    for level in (1, 2, 3):
        assert np.array_equal(tiles[level * STEPS_PER_LEVEL], studio.levels[level])
    row, column, size = tile_corner(STEPS_PER_LEVEL)
    assert size == MAP_SIZE >> 1 and prefiltered_map(studio)[row, column] == pytest.approx(studio.levels[1][0, 0])


# The map's texels have nine bits: a value lies up to 1/512 of its largest channel beside the stored one, and llvmpipe
# cuts instead of rounding.
TEXEL_REL = 1 / 256


@pytest.mark.parametrize("roughness", [0.0, 0.045, 0.1, 0.16, 0.25, 0.36, 0.5, 0.7, 0.9, 1.0])
def test_mirrored_light_is_blended_between_levels(
    ctx: moderngl.Context, frame: FrameBlock, studio: Environment, roughness: float
) -> None:
    """Metal blends exactly, but for tiles that hold a level enlarged; what is no metal is off by half a step."""
    directions = probed_directions()
    expected = between_levels(studio, directions, max(roughness, 0.04))  # nothing is drawn smoother
    largest = expected.max(axis=-1, keepdims=True)
    metal = probe(ctx, LIGHT_PROBE, {"roughness": roughness, "diffuse": False})[..., :3]
    enlarged = 0.06 if roughness > 0.36 else 0.0
    assert (np.abs(metal - expected) <= largest * TEXEL_REL + enlarged + 1e-3).all()
    nearest = probe(ctx, LIGHT_PROBE, {"roughness": roughness, "diffuse": False}, NO_METAL=1)[..., :3]
    lower, upper = (np.clip(np.sqrt(roughness) + side / (2 * LAST_STEP), 0.2, 1.0) ** 2 for side in (-1, 1))
    half_a_step = np.abs(between_levels(studio, directions, upper) - between_levels(studio, directions, lower))
    assert (np.abs(nearest - expected) <= half_a_step + largest * TEXEL_REL + max(enlarged, 0.02)).all()
    assert np.abs(nearest - expected).mean() < 0.006


def test_light_on_a_sheet_is_that_of_the_harmonics(
    ctx: moderngl.Context, frame: FrameBlock, studio: Environment
) -> None:
    expected = studio.diffuse_light(probed_directions())
    found = probe(ctx, LIGHT_PROBE, {"roughness": 0.5, "diffuse": True})[..., :3]
    assert (np.abs(found - expected) <= expected.max(axis=-1, keepdims=True) * (TEXEL_REL + 0.005)).all()


def integrated_share(n_dot_v: np.ndarray, roughness: float, num_samples: int = 2048) -> tuple[np.ndarray, np.ndarray]:
    """Scale and bias of the reflectance under an even environment, by importance sampling (Karis 2013)."""
    even = (np.arange(num_samples) + 0.5) / num_samples
    radical = np.array([int(f"{k:011b}"[::-1], 2) / 2048 for k in range(num_samples)])
    alpha_sq = roughness**4
    cosine = np.sqrt((1 - radical) / (1 + (alpha_sq - 1) * radical))
    sine = np.sqrt(1 - cosine**2)
    half = np.stack([sine * np.cos(2 * np.pi * even), sine * np.sin(2 * np.pi * even), cosine], axis=-1)
    views = np.stack([np.sqrt(1 - n_dot_v**2), np.zeros_like(n_dot_v), n_dot_v], axis=-1)
    v_dot_h = np.maximum(views @ half.T, 0)
    n_dot_l = np.maximum(2 * v_dot_h * cosine - n_dot_v[:, None], 0)
    masking = n_dot_l * np.sqrt(n_dot_v[:, None] ** 2 * (1 - alpha_sq) + alpha_sq)
    masking += n_dot_v[:, None] * np.sqrt(n_dot_l**2 * (1 - alpha_sq) + alpha_sq)
    weight = 2 * n_dot_l * v_dot_h / np.maximum(masking * cosine, 1e-9)
    fresnel = (1 - v_dot_h) ** 5
    return (weight * (1 - fresnel)).mean(axis=1), (weight * fresnel).mean(axis=1)


def test_the_mirrored_share_is_near_its_integral(ctx: moderngl.Context, frame: FrameBlock) -> None:
    share = probe(ctx, SHARE_PROBE, {})
    places = (np.arange(SIDE) + 0.5) / SIDE
    rows = [k for k in range(0, SIDE, 3) if places[k] > 0.045]
    wanted = np.array([integrated_share(places, places[k]) for k in rows]).transpose(0, 2, 1)
    off = np.abs(share[rows, :, :2] - wanted)
    assert off[..., 0].max() < 0.11 and off[..., 1].max() < 0.06
    assert off[:, SIDE // 4 :].max() < 0.07  # but for grazing angles
    assert off.mean() < 0.015


@pytest.mark.parametrize("exponent", [1.0, 7.0])
def test_tones_are_mapped_as_one_would_without_sharing_a_division(
    ctx: moderngl.Context, frame: FrameBlock, exponent: float
) -> None:
    found = probe(ctx, TONE_PROBE, {"exponent": exponent})[..., :3]
    places = (np.arange(SIDE) + 0.5) / SIDE
    hue, power = np.meshgrid(places, -3 + (exponent + 3) * places)
    color = np.stack([np.ones_like(hue), hue, hue * hue], axis=-1) * 10.0 ** power[..., None]
    peak = color.max(axis=-1, keepdims=True)
    over = np.maximum(peak - 0.72, 0)
    mapped = np.minimum(peak, 0.72) + 0.28 * over / (over + 0.28)
    lost = 0.15 * (peak - mapped)
    shown = (color * mapped / peak + mapped * lost) / (1 + lost)
    encoded = np.where(shown <= 0.0031308, shown * 12.92, 1.055 * shown ** (1 / 2.4) - 0.055)
    assert np.abs(found - encoded).max() < 0.15 / 255


def test_the_brightest_light_is_white(ctx: moderngl.Context, frame: FrameBlock) -> None:
    found = probe(ctx, TONE_PROBE, {"exponent": 30.0})[SIDE // 2 :, :, :3]
    assert np.isfinite(found).all() and found.min() > 0.99
