"""Limited jumps: detail that crosses a straight seam stays, as far as a jump that nobody sees allows."""

from __future__ import annotations

import numpy as np
import pytest

from preprocess.arrays import Floats
from preprocess.erase import EraseOptions
from preprocess.erase.mips import erase_mips
from preprocess.erase.prepare import plan_erasure
from preprocess.mesh.seams import find_seams
from preprocess.mesh.texels import sample_bilinear
from tests.builders_erase import make_pair

SIZE = 96
LIMIT = 0.2 / 255
SURFACE = make_pair(turn_rad=0.5)
SEAMS = find_seams(SURFACE)
LINES = SURFACE.uvs[SEAMS.uv_pairs[0]]  # [side, end, axis]: the one seam's two sides
WAVES = 4  # across the seam, 8 texels long


def waves(t: Floats) -> Floats:
    return 0.5 + 0.2 * np.sin(2 * np.pi * WAVES * t)


def striped() -> Floats:
    """Stripes across the seam, the same on both sides but for where the texels fall: (H, W, 1)."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE
    texels = np.stack([x, y], axis=-1)
    start, line = LINES[:, 0], LINES[:, 1] - LINES[:, 0]
    t = np.einsum("hwsa,sa->hws", texels[:, :, None] - start, line) / (line**2).sum(axis=1)
    away = np.linalg.norm(texels[:, :, None] - start - np.clip(t, 0, 1)[..., None] * line, axis=-1)
    return waves(np.take_along_axis(t, away.argmin(axis=2)[..., None], axis=2))


def fault(texels: Floats) -> float:
    """How far the two sides' mean is from the stripes along the seam, root mean square."""
    t = np.linspace(0.05, 0.95, 500)[:, None]
    sides = [sample_bilinear(texels, (1 - t) * line[0] + t * line[1]) for line in LINES]
    return float(np.sqrt(np.mean((sum(sides) / 2 - waves(t)) ** 2)))


def erased(weight: float | None, limit: float | None) -> tuple[Floats, float]:
    """Texels and largest jump."""
    plan = plan_erasure(SURFACE, SEAMS, SIZE, SIZE, EraseOptions(seam_weight=weight, jump_limit=limit))
    texels = plan.erase(striped(), bounds=(0.0, 1.0)).texels
    return texels, float(plan.measure(texels).max.max())


def test_detail_stays_where_a_small_jump_allows_it() -> None:
    """The seam is one straight line on grids that do not match: closed exactly, it can carry no wave at all."""
    exact, closed = erased(None, None)
    limited, left = erased(3e9, LIMIT)
    assert closed < 1e-4 and fault(exact) > 0.08  # waves of 0.2 are 0.14 root mean square
    assert left < 2.0 * LIMIT
    assert fault(limited) < 0.8 * fault(erased(1e10, None)[0]) < 0.8 * fault(exact)


@pytest.mark.parametrize("weight", [1e8, 3e9, 1e10])
def test_a_higher_limit_keeps_more(weight: float) -> None:
    faults = [fault(erased(weight, limit / 255)[0]) for limit in (0.0, 0.02, 0.1, 0.5)]
    assert faults[0] > faults[1] > faults[2] >= faults[3]


def test_what_is_below_the_limit_stays() -> None:
    """A limit above every jump of the texture, and a light pull: nothing calls for a change."""
    changed, _ = erased(1e4, 1.0)
    assert fault(changed) < 0.25 * fault(erased(1e8, None)[0])


def test_stored_levels_are_closed_to_half_a_step() -> None:
    options = EraseOptions(seam_weight=3e9, jump_limit=LIMIT)
    chain = erase_mips(np.repeat(striped(), 3, axis=2), SURFACE, SEAMS, options, levels=255, srgb_channels=3)
    assert len(chain) > 4
    assert max(float(level.stored.max.max()) for level in chain) <= 0.55 / 255
