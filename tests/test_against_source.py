"""Built characters at full detail against a plain vertex-attribute render of the same file."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import moderngl
import numpy as np
import pytest
from conftest import ROOT, asset
from source_renderer import look_at, render_source, source_primitives

from preprocess.files.images import read_image

SIZE = (1024, 1024)
FOVY_DEG = 35.0
# Character -> (clip, time): one moment of one clip besides the rest pose.
MOMENTS: dict[str, tuple[int, float]] = {
    "human.glb": (0, 0.35),
    "Fox.glb": (2, 0.4),
    "Knight.glb": (30, 0.3),
    "robot.glb": (2, 0.3),
    "mannequiny.glb": (2, 0.4),
}
# What the looks of each may cost: silhouettes (share of the character's pixels) and mean FLIP of unlit base colour.
MAX_SILHOUETTE = {"human.glb": 0.002, "Fox.glb": 0.002}
MAX_FLIP = {"human.glb": 0.03, "Fox.glb": 0.03, "Knight.glb": 0.006, "robot.glb": 0.004, "mannequiny.glb": 0.002}


def camera_for(path: Path, clip: int | None, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target that frame the character."""
    points = np.concatenate([p.positions[p.triangles.ravel()] for p in source_primitives(path, clip, time)[1]])
    low, high = points.min(axis=0), points.max(axis=0)
    target = (low + high) / 2
    return target + np.array([0.45, 0.15, 1.0]) * 1.75 * np.linalg.norm(high - low) * 0.75, target


def draw_built(
    folder: Path, out: Path, eye: np.ndarray, target: np.ndarray, clip: int | None, time: float
) -> np.ndarray:
    """The viewer's own picture, (H, W, 4) in [0, 1]."""
    command = [sys.executable, "-m", "demos.viewer", str(folder), "--headless", "--out", str(out)]
    command += ["--size", f"{SIZE[0]}x{SIZE[1]}", "--view", "base_color", "--lod", "0", "--tessellation", "off"]
    command += [
        "--eye",
        *(f"{x:.9f}" for x in eye),
        "--target",
        *(f"{x:.9f}" for x in target),
        "--fovy",
        repr(FOVY_DEG),
    ]
    if clip is not None:
        command += ["--clip", str(clip), "--time", repr(time)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return read_image(out).texels


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True], ids=["rest", "clip"])
@pytest.mark.parametrize("name", list(MOMENTS))
def test_looks_are_kept(
    name: str, moving: bool, built: Callable[[str], Path], ctx: moderngl.Context, tmp_path: Path
) -> None:
    import flip_evaluator

    folder = built(name)
    clip, time = MOMENTS[name] if moving else (None, 0.0)
    eye, target = camera_for(asset(name), clip, time)
    expected = render_source(ctx, asset(name), look_at(eye, target, FOVY_DEG, SIZE), SIZE, clip, time) / 255.0
    got = draw_built(folder, tmp_path / "got.png", eye, target, clip, time)
    shape, wanted_shape = got[..., 3] > 0.5, expected[..., 3] > 0.5
    assert wanted_shape.mean() > 0.02, "the camera misses the character"
    silhouette = (shape != wanted_shape).sum() / wanted_shape.sum()
    background = np.array([0.5, 0.5, 0.5])
    pictures = [
        np.ascontiguousarray(np.where(mask[..., None], image[..., :3], background), np.float32)
        for image, mask in ((expected, wanted_shape), (got, shape))
    ]
    _, flip, _ = flip_evaluator.evaluate(pictures[0], pictures[1], "LDR")
    # Over the character's own pixels: the empty background would flatter the mean.
    flip_on_character = flip * wanted_shape.size / wanted_shape.sum()
    print(
        f"{name} {'clip' if moving else 'rest'}: silhouette {silhouette:.3%}, FLIP {flip:.4f} ({flip_on_character:.4f})"
    )
    assert silhouette < MAX_SILHOUETTE.get(name, 0.005)
    assert flip < MAX_FLIP.get(name, 0.05)
