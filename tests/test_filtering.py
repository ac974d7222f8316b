"""Which textures are filtered anisotropically: where the atlas squeezes the surface, unless somebody says how."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_asset import build_ball

import runtime
from runtime.asset.asset import Asset, TextureData, load
from runtime.asset.lod_mesh import DrawRange, LodMesh
from runtime.gpu.textures import MATERIAL_TEXTURES, is_software, squeezed_share


def sheet(asset: Asset, width_m: float, height_m: float) -> Asset:
    """A flat sheet over the whole of a square atlas."""
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    texels = np.stack([u * width_m, v * height_m, 0 * u], axis=-1).astype(np.float32)
    uvs = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]], np.float32)
    mesh = LodMesh(uvs, uvs, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), (DrawRange(0, 2, 0),), 0.0)
    return replace(asset, lods=(mesh,), textures={**asset.textures, "position": TextureData("position", (texels,))})


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return load(build_ball(tmp_path_factory.mktemp("filter") / "ball.seamless"))


@pytest.mark.parametrize(
    ("width_m", "height_m", "share"), [(1.0, 1.0, 0.0), (1.9, 1.0, 0.0), (2.1, 1.0, 1.0), (1.0, 3.0, 1.0)]
)
def test_a_sheet_is_squeezed_beyond_two_to_one(square: Asset, width_m: float, height_m: float, share: float) -> None:
    assert squeezed_share(sheet(square, width_m, height_m)) == share


def test_base_colours_alone_and_only_where_it_shows(ctx: moderngl.Context, square: Asset) -> None:
    if not is_software(ctx) or ctx.max_anisotropy < 8:
        pytest.skip("for software renderers that can filter anisotropically")

    def found(asset: Asset, **how: Any) -> list[float]:
        model = runtime.Model(ctx, asset, **how)
        values = [max(model.textures[name].anisotropy, 1.0) for name in MATERIAL_TEXTURES]  # 0: never set
        model.release()
        return values

    at = MATERIAL_TEXTURES.index("base_color_texture")
    assert found(sheet(square, 1.0, 1.0)) == [1.0] * 4
    assert found(sheet(square, 3.0, 1.0)) == [8.0 if index == at else 1.0 for index in range(4)]
    assert found(sheet(square, 3.0, 1.0), anisotropy=1) == [1.0] * 4
    assert found(sheet(square, 1.0, 1.0), anisotropy=4) == [4.0] * 4
    with pytest.raises(runtime.RenderError, match="anisotropy is a number"):
        found(square, anisotropy=0)


def test_blended_faces_keep_the_files_order_and_clips_their_numbers(tmp_path: Path) -> None:
    from builders_gltf import GltfBuilder, grid

    from preprocess.export.glb import _drawing_order, _with_channel
    from preprocess.load.character import Character
    from preprocess.load.character_file import load_character
    from runtime.animation.clip import Clip

    source, draws = np.array([5, 2, 9, 0, 7]), np.array([0, 1, 1, 0, 1])
    order = _drawing_order(source, draws, [{"alphaMode": "BLEND"}, {}])
    assert [face for face in order.tolist() if draws[face] == 0] == [3, 0]  # the file's faces 0 and 5
    assert [face for face in order.tolist() if draws[face] == 1] == [1, 2, 4]  # as they were
    builder, shape = GltfBuilder(), grid(1, 1)
    mesh = builder.mesh(builder.primitive(shape["positions"], shape["faces"], TEXCOORD_0=shape["uvs"]))
    builder.node(name="box", mesh=mesh)
    character: Character = load_character(builder.write(tmp_path / "a.glb"))
    (track,) = _with_channel(Clip("still", 1.0, ()), character.skeleton).tracks
    assert track.times.tolist() == [0.0, 1.0] and (track.values == character.skeleton.scale[track.node]).all()
