"""Mip chains: every level is seamless; what is used stays what it was."""

from __future__ import annotations

import weakref

import numpy as np
import pytest

from preprocess.erase import Eraser, erase_mips, mips, plan_erasure
from preprocess.erase.mips import mip_sizes, shrink
from preprocess.files.srgb import linear_to_srgb, srgb_to_linear
from preprocess.mesh.seams import find_seams
from tests.builders_erase import MESHES, paint


@pytest.mark.parametrize("size", [(64, 64), (48, 20)])
def test_every_mip_level_is_seamless(size):
    surface = MESHES["cube"]
    seams = find_seams(surface)
    plans: dict = {}
    chain = erase_mips(paint(*size), surface, seams, levels=255, srgb_channels=3, plans=plans)
    assert [level.texels.shape[1::-1] for level in chain] == mip_sizes(*size)
    for level in chain:
        assert level.stored.max.max() <= 0.5 / 255
        assert (level.after.total <= 1e-11).all()
    assert set(plans) == set(mip_sizes(*size))


def test_without_a_place_to_keep_them_one_eraser_lives_at_a_time(monkeypatch):
    surface = MESHES["cube"]
    seams = find_seams(surface)
    made: list[weakref.ref[Eraser]] = []
    alive: list[int] = []

    def plan(*arguments, **options):
        alive.append(sum(eraser() is not None for eraser in made))
        eraser = plan_erasure(*arguments, **options)
        made.append(weakref.ref(eraser))
        return eraser

    monkeypatch.setattr(mips, "plan_erasure", plan)
    chain = erase_mips(paint(32, 32), surface, seams, levels=255)
    assert alive == [0] * len(chain)
    kept = erase_mips(paint(32, 32), surface, seams, levels=255, plans={})
    assert alive[len(chain) :] == list(range(len(kept)))
    assert all((one.texels == other.texels).all() for one, other in zip(chain, kept, strict=True))


def test_a_chain_may_end_where_closing_would_cost_the_colours():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    image = paint(64, 64)
    whole = erase_mips(image, surface, seams, levels=255)
    short = erase_mips(image, surface, seams, levels=255, most_change=0.1)
    assert 1 < len(short) < len(whole)
    for one, other in zip(short, whole):
        assert (one.texels == other.texels).all()
    assert len(erase_mips(image, surface, seams, levels=255, most_change=0.0)) == 1  # the full size always is
    assert len(erase_mips(image, surface, seams, levels=255, most_change=1.0)) == len(whole)


def test_mips_do_not_bleed_across_the_outline():
    surface = MESHES["cube"]
    seams = find_seams(surface)
    plan = plan_erasure(surface, seams, 64, 64)
    image = np.where(plan.region.used[:, :, None], 0.25, 1.0)
    chain = erase_mips(image, surface, seams)
    for level in chain[:-1]:
        height, width = level.texels.shape[:2]
        used = plan_erasure(surface, seams, width, height).region.used
        np.testing.assert_allclose(level.texels[used], 0.25, atol=1e-6)


def test_shrink_is_the_mean_of_used_texels():
    image = paint(7, 6, channels=2)
    used = np.ones((6, 7), bool)
    small = shrink(image, used, 3, 3)
    np.testing.assert_allclose(small.mean(axis=(0, 1)), image.mean(axis=(0, 1)))
    used[:, :4] = False
    right = shrink(image[:, :6], used[:, :6], 3, 3)[:, 2]
    np.testing.assert_allclose(right, image[:, 4:6].reshape(3, 2, 2, 2).mean(axis=(1, 2)))


def test_srgb_round_trip():
    values = np.linspace(-0.5, 1.5, 101)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-12)
    assert srgb_to_linear(np.array([0.5]))[0] == pytest.approx(0.21404114)
