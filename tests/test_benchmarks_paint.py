"""Points along seams, and that detail is lost in the order that is claimed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.paint import POINTS_PER_TEXEL, measure, seam_points


def test_points_of_both_sides_belong_together() -> None:
    lines = np.array([[[[0.1, 0.1], [0.3, 0.1]], [[0.9, 0.9], [0.9, 0.5]]], [[[0.2, 0.8], [0.2, 0.8]]] * 2])
    first, second = seam_points(lines, 64)
    share = (first[:, 0] - 0.1) / 0.2
    long = first[:, 1] < 0.5
    assert long.sum() == np.ceil(0.4 * 64 * POINTS_PER_TEXEL) + 1 and (~long).sum() == 1
    np.testing.assert_allclose(second[long], np.stack([0.9 + 0 * share, 0.9 - 0.4 * share], axis=1)[long])
    assert ((share[long] > 0) & (share[long] < 1)).all() and (np.diff(share[long]) > 0).all()


@pytest.mark.slow
def test_limited_jumps_keep_more_paint_than_closed_seams(asset_path: object) -> None:
    assert callable(asset_path)
    model: Path = asset_path("Fox.glb")
    half, exact, priced, limited = measure(model, 512)
    assert half["rms"] < limited["rms"] < priced["rms"] < exact["rms"]
    assert max(row["largest jump as stored"] for row in (exact, priced, limited)) <= 0.5
