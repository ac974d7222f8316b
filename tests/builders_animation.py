"""Random skeletons and clips with a fixed seed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from runtime.animation.clip import Clip, Track
from runtime.animation.skeleton import Skeleton, read_skeleton


def random_quaternions(count: int, rng: np.random.Generator) -> np.ndarray:
    quaternions = rng.normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def random_skeleton(num_nodes: int, seed: int = 0, scaled: bool = True) -> Skeleton:
    """A random tree in depth order, read through the same door as a file."""
    rng = np.random.default_rng(seed)
    nodes: list[dict[str, Any]] = []
    for index in range(num_nodes):
        nodes.append(
            {
                "name": f"bone{index}",
                "translation": rng.normal(size=3).tolist(),
                "rotation": random_quaternions(1, rng)[0].tolist(),
                "scale": (rng.uniform(0.5, 2, size=3) if scaled else np.ones(3)).tolist(),
            }
        )
        if index:
            nodes[int(rng.integers(index))].setdefault("children", []).append(index)
    document: Any = SimpleNamespace(json={"nodes": nodes}, path=Path("random.gltf"))
    joints = list(range(0, num_nodes, 2))
    return read_skeleton(document, joints, rng.normal(size=(len(joints), 4, 4)) * [[1], [1], [1], [0]] + np.eye(4))


def random_clip(skeleton: Skeleton, seed: int, modes: tuple[str, ...] = ("LINEAR", "STEP", "CUBICSPLINE")) -> Clip:
    """Tracks of every property and interpolation, with key times of their own."""
    rng = np.random.default_rng(seed)
    tracks = []
    for node in range(skeleton.num_nodes):
        for path, width in (("translation", 3), ("rotation", 4), ("scale", 3)):
            mode = modes[int(rng.integers(len(modes)))]
            times = np.cumsum(rng.uniform(0.05, 0.4, size=int(rng.integers(1, 7)))) - 0.05
            shape = (len(times), 3, width) if mode == "CUBICSPLINE" else (len(times), width)
            values = rng.normal(size=shape)
            if path == "rotation" and mode != "CUBICSPLINE":
                values /= np.linalg.norm(values, axis=-1, keepdims=True)
            tracks.append(Track(node, path, mode, times, values))
    return Clip("random", max(float(track.times[-1]) for track in tracks), tuple(tracks))
