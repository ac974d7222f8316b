"""Which seams are faults (docs/method.md, section 3: not every uv seam is one).

| signal | joined | left |
|---|---|---|
| positions, weights, displacement | all | none: a gap there is a crack |
| normals | where the source's corner normals agree | hard edges: they differ by more than `crease_rad` |
| colours and other materials | all by default | with a threshold: seams whose sides differ by more, a painted border |

Nothing in a colour texture says whether a difference was meant, so nothing is left unless a person asks for it with a
threshold; a seam that our own unwrap made is joined in any case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.erase.seam_samples import measure_seams
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import uv_to_px

JOINED_COLOR = (0.1, 0.8, 0.2)
LEFT_COLOR = (0.95, 0.15, 0.1)
LINE_STEP_PX = 0.5
LINE_WIDTH_REL = 1 / 400  # of the picture's longer side


@dataclass(frozen=True)
class Decision:
    """What was decided for each seam, and why.

    Attributes
    ----------
    joined : (S,) bool
    difference : (S,) float64
        What was compared with the threshold: the angle between the sides' normals in radians, or the largest
        channel's root mean square difference along the seam.
    threshold : float
        Seams that differ by more are left; infinite where all are joined.
    """

    joined: NDArray[np.bool_]
    difference: Floats
    threshold: float

    @property
    def num_left(self) -> int:
        """Number of seams left open."""
        return int(np.count_nonzero(~self.joined))


def choose_color_seams(
    texels: Floats,
    surface: TexturedSurface,
    seams: Seams,
    threshold: float = np.inf,
    *,
    made_here: NDArray[np.bool_] | None = None,
    repeat: bool = False,
) -> Decision:
    """Leave painted borders: seams whose two sides differ by more than a threshold.

    Parameters
    ----------
    texels : (H, W, C) float
    surface : TexturedSurface
    seams : Seams
    threshold : float
        In the texture's unit. Infinite: all seams are joined.
    made_here : (S,) bool, optional
        Seams that an unwrap of ours made: joined in any case.
    repeat : bool
        Whether the sampler repeats.

    Returns
    -------
    Decision
    """
    difference = measure_seams(texels, surface, seams, repeat=repeat).seam_rms.max(axis=1, initial=0.0)
    joined = difference <= threshold
    if made_here is not None:
        joined |= made_here
    return Decision(joined, difference, threshold)


def choose_normal_seams(
    surface: TexturedSurface, seams: Seams, corner_normals: Floats, crease_rad: float = np.radians(5.0)
) -> Decision:
    """Leave hard edges: seams whose two faces have different corner normals.

    Parameters
    ----------
    surface : TexturedSurface
    seams : Seams
    corner_normals : (F, 3, 3) float64
        Unit normals a corner.
    crease_rad : float
        Angle above which a difference is meant.

    Returns
    -------
    Decision
    """
    angle = np.zeros(len(seams.vertices))
    for end in range(2):
        corners = surface.faces[seams.faces] == seams.vertices[:, None, None, end]  # (S, 2, 3)
        normals = corner_normals[seams.faces, corners.argmax(axis=2)]  # (S, 2, 3)
        gap = np.linalg.norm(normals[:, 0] - normals[:, 1], axis=1)
        angle = np.maximum(angle, 2 * np.arcsin(np.clip(gap / 2, 0, 1)))
    return Decision(angle <= crease_rad, angle, crease_rad)


def draw_decision(texels: Floats, surface: TexturedSurface, seams: Seams, decision: Decision) -> Floats:
    """Picture of a decision: the texture in faint grey, joined seams green, seams left red.

    Parameters
    ----------
    texels : (H, W, C) float
        In [0, 1].
    surface : TexturedSurface
    seams : Seams
    decision : Decision

    Returns
    -------
    (H, W, 3) float64
    """
    height, width = texels.shape[:2]
    grey = 0.75 + 0.25 * np.clip(texels[:, :, : min(texels.shape[2], 3)].mean(axis=2), 0, 1)
    picture = np.repeat(grey[:, :, None], 3, axis=2)
    thick = max(1, round(LINE_WIDTH_REL * max(width, height)))
    for chosen, color in ((decision.joined, JOINED_COLOR), (~decision.joined, LEFT_COLOR)):
        lines = uv_to_px(surface.uvs[seams.uv_pairs[chosen]], width, height).reshape(-1, 2, 2)
        length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
        count = np.ceil(length / LINE_STEP_PX).astype(np.int64) + 1
        line = np.repeat(np.arange(len(lines)), count)
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        along = (step / np.maximum(count[line] - 1, 1))[:, None]
        points = np.rint((1 - along) * lines[line, 0] + along * lines[line, 1]).astype(np.int64)
        brush = range(-(thick // 2), thick - thick // 2)
        for dy in brush:
            for dx in brush:
                picture[(points[:, 1] + dy) % height, (points[:, 0] + dx) % width] = color
    return picture
