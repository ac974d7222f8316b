"""Small animated models: a chain of nodes along +Y, clips that turn one, and a model that only mixes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from builders_animation import random_skeleton

from runtime.animation.bounds import JointBoxes
from runtime.animation.clip import Clip, Track
from runtime.animation.mixer import Mixer
from runtime.animation.skeleton import Skeleton


def straight_skeleton(num_nodes: int = 3) -> Skeleton:
    """A chain along +Y, one metre a link, nothing turned."""
    skeleton = random_skeleton(num_nodes, 0)
    skeleton.parents[:] = np.arange(num_nodes) - 1
    skeleton.translation[:] = [0, 1, 0]
    skeleton.rotation[:], skeleton.scale[:] = [0, 0, 0, 1], 1
    skeleton.inverse_bind[:] = np.eye(4)
    skeleton.__dict__.pop("levels", None)
    return skeleton


def turn_clip(name: str, node: int, angle: float, duration_s: float = 1.0) -> Clip:
    """A node turns about +X at constant speed."""
    quaternions = np.array([[0, 0, 0, 1], [np.sin(angle / 2), 0, 0, np.cos(angle / 2)]])
    return Clip(name, duration_s, (Track(node, "rotation", "LINEAR", np.array([0, duration_s]), quaternions),))


def angle_about_x(quaternion: np.ndarray) -> float:
    return float(2 * np.arctan2(quaternion[0], quaternion[3]))


def model_of(skeleton: Skeleton, clips: list[Clip]) -> Any:
    boxes = np.tile([[-1.0] * 3, [1.0] * 3], (skeleton.num_joints, 1, 1)).reshape(-1, 2, 3)
    return SimpleNamespace(mixer=Mixer(skeleton, clips), joint_boxes=JointBoxes(boxes))


def make_walker() -> Any:
    """A model whose clips turn nodes, and one that walks: the root moves 2 m along +X and bobs."""
    skeleton = straight_skeleton()
    times = np.array([0.0, 0.5, 1.0])
    way = Track(0, "translation", "LINEAR", times, np.array([[0, 1, 0], [1, 1.2, 0], [2, 1, 0.0]]))
    clips = [turn_clip("bend", 1, 0.8), turn_clip("nod", 2, 0.6), Clip("walk", 1.0, (way,)), turn_clip("bow", 1, 0.4)]
    return model_of(skeleton, clips)
