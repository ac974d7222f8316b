"""Light by direction on half spheres, and material channels in alphas: other places, the same light and pictures."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import moderngl
import numpy as np
import pytest
from builders_scene import Scene

from runtime.asset.asset import Asset, MaterialData, TextureData
from runtime.gpu.material_packing import arrange_channels
from runtime.scene.lighting import NUM_LEVELS, REACH, Environment, map_directions


@pytest.mark.parametrize("size", [5, 40, 160])
def test_half_spheres_overlap_at_the_horizon(size: int) -> None:
    """A filter's four texels lie in one square for every direction of its half, and mean directions around it."""
    directions = map_directions(size)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1.0)
    rng = np.random.default_rng(5)
    wanted = rng.normal(size=(500, 3))
    wanted[::2, 1] *= 1e-3
    wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
    place = wanted[:, [0, 2]] / (1 + np.abs(wanted[:, 1:2])) * REACH  # as map_location() in lighting.glsl
    px = (place + 1) / 2 * size - 0.5
    assert px.min() > -1e-9 and px.max() < size - 1 + 1e-9
    corner = np.clip(np.floor(px).astype(int), 0, size - 2)
    fraction = px - corner
    columns = corner[:, 0] + np.where(wanted[:, 1] < 0, size, 0)
    blended = sum(
        directions[corner[:, 1] + j, columns + i]
        * (np.where(i, fraction[:, 0], 1 - fraction[:, 0]) * np.where(j, fraction[:, 1], 1 - fraction[:, 1]))[:, None]
        for i in (0, 1) for j in (0, 1)
    )  # fmt: skip
    assert np.abs(blended - wanted).max() < 8 / size**2


def test_levels_hold_the_panorama_by_direction() -> None:
    """A panorama of directions themselves comes back: sharp at the first level, shorter on average at rough ones."""
    rows, columns = 128, 256
    polar = (np.arange(rows)[:, None] + 0.5) / rows * np.pi
    around = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    flat = np.ones((rows, columns))
    panorama = np.stack(
        [np.sin(polar) * np.sin(around), np.cos(polar) * flat, -np.sin(polar) * np.cos(around)], axis=-1
    )
    environment = Environment.from_image(panorama + 2.0)
    assert len(environment.levels) == NUM_LEVELS
    for level, radiance in enumerate(environment.levels):
        wanted = map_directions(160 >> level)
        assert radiance.shape == wanted.shape
        if level < 2:
            assert np.abs(radiance - 2.0 - wanted).max() < 0.03
        assert (((radiance - 2.0) * wanted).sum(axis=-1) > 0.5).all()
    # a linear field's irradiance is two thirds of it
    directions = map_directions(8)
    assert np.abs(environment.diffuse_light(directions) - 2.0 - directions * 2 / 3).max() < 0.01


# Channels


def with_channels(asset: Asset, red: bool, green: bool, blue: bool, **factors: float) -> Asset:
    """An asset with a texture of occlusion, roughness and metallic of which these vary; colours of the same size."""
    size = asset.textures["base_color"].size
    u, v = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    orm = np.stack([0.4 + 0.6 * u, 0.3 + 0.5 * v, 0.5 + 0.5 * np.cos(9 * u)], axis=-1)
    for channel, (varies, value) in enumerate(zip((red, green, blue), (1.0, 0.6, 0.0))):
        if not varies:
            orm[:, :, channel] = value
    levels = [orm]
    while min(levels[-1].shape[:2]) > 1:
        rows, columns = levels[-1].shape[:2]
        levels.append(levels[-1].reshape(rows // 2, 2, columns // 2, 2, 3).mean(axis=(1, 3)))
    bytes_ = tuple(np.rint(level * 255).astype(np.uint8) for level in levels)
    textures = {**asset.textures, "orm": TextureData("orm", bytes_)}
    materials = tuple(replace(material, **factors) for material in asset.materials or (MaterialData(),))
    return replace(asset, textures=textures, materials=materials)


@pytest.mark.parametrize("varying", list(product([False, True], repeat=3)))
def test_channels_elsewhere_give_the_same_picture(
    ctx: moderngl.Context, ball: Asset, varying: tuple[bool, bool, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    asset = with_channels(ball, *varying, roughness_factor=0.9, metallic_factor=0.8, occlusion_strength=0.7)
    channels = arrange_channels(asset)
    arranged = Scene(ctx, asset)
    picture = arranged.picture([arranged.model.actor()]).astype(int)
    arranged.release()
    assert ("orm" in channels.textures) == ("NO_ORM" not in channels.defines)

    def leave(asset: Asset) -> object:
        kept = {name: texture.levels for name, texture in asset.textures.items()}
        return replace(channels, textures=kept, materials=asset.materials, defines=())

    monkeypatch.setattr("runtime.gpu.textures.arrange_channels", leave)
    plain = Scene(ctx, asset)
    expected = plain.picture([plain.model.actor()]).astype(int)
    plain.release()
    assert np.abs(picture - expected).max() <= 2  # the plain way multiplies a rounded 8-bit texel, filtered by itself
    assert picture.any()


def test_an_alpha_that_is_needed_stays(ball: Asset) -> None:
    asset = with_channels(ball, False, True, False)
    assert "ROUGHNESS_IN_COLOR" in arrange_channels(asset).defines
    for mode in ("MASK", "BLEND"):
        clear = replace(asset, materials=tuple(replace(one, alpha_mode=mode) for one in asset.materials))
        channels = arrange_channels(clear)
        assert "ROUGHNESS_IN_COLOR" not in channels.defines
        assert channels.textures["base_color"] is clear.textures["base_color"].levels
        assert "orm" in channels.textures


def test_constants_become_factors(ball: Asset) -> None:
    asset = with_channels(ball, False, False, False, roughness_factor=0.5, metallic_factor=1.0)
    channels = arrange_channels(asset)
    assert "orm" not in channels.textures and {"NO_ORM", "NO_OCCLUSION"} <= set(channels.defines)
    assert channels.materials[0].roughness_factor == pytest.approx(0.5 * round(0.6 * 255) / 255)
    assert channels.materials[0].metallic_factor == 0.0
