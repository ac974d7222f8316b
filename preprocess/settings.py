"""Every option of a build: what it means, its unit, its range, its default and the reason for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from runtime.gltf.limits import LIMITS, Limits

AtlasMode = Literal["auto", "keep", "repack", "unwrap"]
SeamMode = Literal["local", "global"]


@dataclass(frozen=True)
class Settings:
    """Options of `python -m preprocess MODEL`.

    Attributes
    ----------
    atlas : str
        "auto" takes the least change of the source's uvs that is one-to-one and gives every part its texels.
    straighten_rel : float or None
        Tolerance of seam straightening, a fraction of a chart's bounding box (0.01 is the paper's). None: off.
    seams : str
        "local" changes a band of a few texels along seams; "global" spreads the change ten times further, for
        textures whose two sides differ in tone.
    geometry_size_px, weight_size_px, color_size_px : int or None
        Sides of the square textures. None (auto): geometry and weights as small as the accuracy goals allow,
        colours as large as every part of the source's detail needs, up to 4096.
    lod_ratios : tuple of float or None
        Faces of each level below the full mesh as a fraction of it; the full mesh is always there. None (auto): each
        about half the one before, to the floor.
    floor_rel : float
        Fraction of the faces (or 200, whichever is larger) that the coarsest exact level should reach: a wish. Seams
        that stay in place are straightened more for it, as far as nothing is stretched.
    exact : bool
        Leave out levels near and below the exact floor whose seams are relaxed, by half a texel of their mip at most.
    influences : int
        Joint influences per vertex in model.glb: 4 or 8.
    separate_lods : bool
        Also write each level as a file of its own, model_LOD0.glb …: for engines that pair files, not nodes.
    ktx2 : bool
        Also write colours, normals and positions with all their mip levels as ktx2/NAME.ktx2, for other engines.
    keep_borders : float or None
        Colours whose two sides differ by more than this (rms, 0 to 1) along a seam of the artist's own are taken for
        a painted border and left: what is meant to agree seldom differs by a sixth of the range. None: all are joined.
    report : bool
        Write report.html.
    limits : Limits
        The most that the file may say or ask for.
    """

    atlas: AtlasMode = "auto"
    straighten_rel: float | None = 0.01
    seams: SeamMode = "local"
    geometry_size_px: int | None = None
    weight_size_px: int | None = None
    color_size_px: int | None = None
    lod_ratios: tuple[float, ...] | None = None
    floor_rel: float = 0.03
    exact: bool = False
    influences: int = 4
    separate_lods: bool = False
    ktx2: bool = False
    keep_borders: float | None = 0.15
    report: bool = False
    limits: Limits = LIMITS


# Accuracy that automatic sizes must reach at the vertices of the full mesh, as fractions of the bounding diagonal.
GEOMETRY_RMS_REL = 2e-4
PARK_REL = 5e-4  # vertices that the position texture misses by more fetch elsewhere (parking.py)
MIN_FLOOR_FACES = 200


def floor_faces(num_faces: int, floor_rel: float) -> int:
    """Faces that the coarsest exact level may have."""
    return min(num_faces, max(MIN_FLOOR_FACES, int(floor_rel * num_faces)))
