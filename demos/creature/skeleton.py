"""The dragon's joints: names, parents and where they stand in bind pose.

Every joint's frame is aligned with the world in bind pose, so a clip's rotation turns about the world's axes:
x to the dragon's left, y up, z forwards. Names end in .L and .R for the two sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# name, parent, position in metres. A name that ends in .L is repeated, mirrored, as .R.
_PLAN: tuple[tuple[str, str | None, tuple[float, float, float]], ...] = (
    ("root", None, (0.0, 0.0, 0.0)),
    ("hips", "root", (0.0, 0.335, -0.20)),
    ("spine", "hips", (0.0, 0.36, -0.05)),
    ("belly", "spine", (0.0, 0.27, -0.02)),
    ("chest", "spine", (0.0, 0.385, 0.10)),
    ("neck", "chest", (0.0, 0.45, 0.215)),
    ("head", "neck", (0.0, 0.575, 0.315)),
    ("jaw", "head", (0.0, 0.575, 0.385)),
    ("ear.L", "head", (0.150, 0.715, 0.305)),
    ("ear_tip.L", "ear.L", (0.245, 0.79, 0.235)),
    ("tail_1", "hips", (0.0, 0.315, -0.34)),
    ("tail_2", "tail_1", (0.0, 0.265, -0.49)),
    ("tail_3", "tail_2", (0.0, 0.23, -0.63)),
    ("tail_4", "tail_3", (0.0, 0.225, -0.76)),
    ("tail_5", "tail_4", (0.0, 0.265, -0.88)),
    ("upper_arm.L", "chest", (0.120, 0.315, 0.165)),
    ("forearm.L", "upper_arm.L", (0.148, 0.18, 0.135)),
    ("hand.L", "forearm.L", (0.148, 0.062, 0.160)),
    ("thigh.L", "hips", (0.125, 0.30, -0.205)),
    ("shin.L", "thigh.L", (0.165, 0.185, -0.145)),
    ("foot.L", "shin.L", (0.158, 0.075, -0.255)),
    ("wing.L", "chest", (0.085, 0.475, 0.045)),
    ("wing_tip.L", "wing.L", (0.218, 0.578, -0.013)),
)

# Where the last bone of a chain ends; the other bones end at their child.
_TIPS = {
    "belly": (0.0, 0.20, -0.02),
    "head": (0.0, 0.70, 0.42),
    "jaw": (0.0, 0.535, 0.56),
    "ear_tip.L": (0.345, 0.845, 0.150),
    "tail_5": (0.0, 0.40, -1.03),
    "hand.L": (0.150, 0.03, 0.275),
    "foot.L": (0.160, 0.03, -0.125),
    "wing_tip.L": (0.355, 0.66, -0.12),
}


@dataclass(frozen=True)
class Joints:
    """The skeleton in bind pose. J joints, parents before children.

    Attributes
    ----------
    names : tuple of str
    parents : (J,) int, -1 for the root
    positions : (J, 3) float64, metres
    tips : (J, 3) float64, metres: where each bone ends
    """

    names: tuple[str, ...]
    parents: NDArray[np.int64]
    positions: Floats
    tips: Floats

    def index(self, name: str) -> int:
        """Index of a joint by its name."""
        return self.names.index(name)

    def offsets(self) -> Floats:
        """Translation of each joint relative to its parent, (J, 3)."""
        offsets = self.positions.copy()
        child = self.parents >= 0
        offsets[child] -= self.positions[self.parents[child]]
        return offsets


def build_joints() -> Joints:
    """The dragon's 33 joints."""
    plan = list(_PLAN)
    tips = dict(_TIPS)
    for side, other in ((".L", ".R"),):
        for name, parent, (x, y, z) in _PLAN:
            if name.endswith(side):
                mirrored_parent = parent.replace(side, other) if parent else parent
                plan.append((name.replace(side, other), mirrored_parent, (-x, y, z)))
        tips |= {name.replace(side, other): (-x, y, z) for name, (x, y, z) in _TIPS.items() if name.endswith(side)}
    names = tuple(name for name, _, _ in plan)
    parents = np.array([-1 if parent is None else names.index(parent) for _, parent, _ in plan])
    positions = np.array([position for _, _, position in plan])
    ends = positions.copy()
    for joint in range(len(names) - 1, -1, -1):  # the first child wins
        if parents[joint] >= 0:
            ends[parents[joint]] = positions[joint]
    for name, tip in tips.items():
        ends[names.index(name)] = tip
    return Joints(names, parents, positions, ends)
