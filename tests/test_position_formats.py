"""Positions on the GPU: words, 16 bits a channel and floats are the same places; words take a quarter of the bytes."""

from __future__ import annotations

import copy
import dataclasses

import moderngl
import numpy as np
import pytest

from preprocess.mesh.texels import sample_bilinear
from runtime.asset.asset import Asset, TextureData
from runtime.asset.packed_positions import choose_words
from runtime.crowd.lod_buffers import expand_levels
from runtime.errors import AssetError, RenderError
from runtime.gpu.model import Model
from runtime.gpu.textures import prepare


def in_words(asset: Asset) -> Asset:
    """The character with its positions rounded to words, and a manifest that says so."""
    texels = asset.textures["position"].levels[0][:, :, :3].astype(np.float64)
    words = choose_words(texels.min(axis=(0, 1)), texels.max(axis=(0, 1)))
    stored = words.metres(words.numbers(texels)).astype(np.float32)
    manifest = copy.deepcopy(asset.manifest.json)
    manifest["textures"]["position"]["words"] = {
        "bits": words.bits.tolist(), "low": words.low.tolist(), "high": words.high.tolist()
    }  # fmt: skip
    return dataclasses.replace(
        asset,
        manifest=dataclasses.replace(asset.manifest, json=manifest),
        textures={**asset.textures, "position": TextureData("position", (stored,))},
    )


def test_all_formats_are_the_same_places(ctx: moderngl.Context, ball: Asset) -> None:
    asset = in_words(ball)
    expected = sample_bilinear(asset.textures["position"].levels[0], asset.lods[0].canonical_uvs.astype(np.float64))
    size, nbytes = float(np.ptp(expected, axis=0).max()), {}
    for form, allowed in {"words": 1e-6, "unorm16": 2.0 / 65535, "float32": 1e-6}.items():
        model = Model(ctx, asset, position_format=form)
        try:
            nbytes[form] = model.gpu_bytes["position"]
            drawn = expand_levels(ctx, model)[0][0]
        finally:
            model.release()
        assert np.abs(drawn - expected).max() <= allowed * size, form
        metres = prepare(asset, form).positions.metres
        assert np.abs(metres - asset.textures["position"].levels[0][:, :, :3]).max() <= allowed * size
    assert nbytes["float32"] == 2 * nbytes["unorm16"] == 4 * nbytes["words"]


def test_auto_is_words_where_the_folder_has_them(ball: Asset) -> None:
    assert prepare(in_words(ball)).positions.texels.dtype == np.uint32
    assert prepare(ball).positions.texels.dtype == np.uint16
    with pytest.raises(RenderError, match="build it again"):
        prepare(ball, "words")
    with pytest.raises(RenderError, match="no position format 'half'"):
        prepare(ball, "half")


def test_damaged_words_are_named(ball: Asset) -> None:
    asset = in_words(ball)
    asset.manifest.json["textures"]["position"]["words"]["bits"] = [40, 1, 1]
    with pytest.raises(AssetError, match=r"textures\.position\.words"):
        prepare(asset)
