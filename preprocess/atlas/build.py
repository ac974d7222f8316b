"""The atlas stage: every point of a character gets its own texel region, with the least change that works.

keep    the source's uvs, when they are one-to-one and inside the square;
repack  the source's charts, packed anew;
unwrap  charts made for decimation (`unwrap`);
auto    the first of these that is one-to-one and reaches the floor.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.atlas.measure import measure_coverage, measure_stretch, straight_share
from preprocess.atlas.topology import cut_edges, find_edges, label_faces
from preprocess.atlas.unwrap import unwrap
from preprocess.errors import InputError
from preprocess.mesh import SkinnedMesh

log = logging.getLogger(__name__)

MODES = ("auto", "keep", "repack", "unwrap")


def default_floor(num_faces: int) -> int:
    """Faces that the coarsest level may have: 3 % of the faces or 200, whichever is more."""
    return max(int(0.03 * num_faces), 200)


@dataclass(frozen=True)
class Atlas:
    """A character with one-to-one uvs in the unit square.

    Attributes
    ----------
    mesh : SkinnedMesh
        Its surface holds the atlas. Faces may have been split and reordered against the source.
    mode : str
        "keep", "repack" or "unwrap": what was done.
    num_charts : int
    overlap : int
        Pairs of faces that overlap in uv; 0 unless `keep` was asked for.
    stretch_l2, stretch_linf : float
        1 for an isometry.
    coverage : float
        Share of the square inside charts.
    straightened : float
        Share of the seam length in edges that can collapse along the seam.
    resampled : bool
        Whether uvs moved, so that the source's colours must be resampled.
    floor_faces : int
        Faces at which decimation should arrive with its seams intact.
    made_seams : (F, 3) bool
        Half-edges (corner c to c + 1) that are seams in the atlas but were not in the source's uvs.
    warnings : tuple of str
    report : dict
    """

    mesh: SkinnedMesh
    mode: str
    num_charts: int
    overlap: int
    stretch_l2: float
    stretch_linf: float
    coverage: float
    straightened: float
    resampled: bool
    floor_faces: int
    made_seams: NDArray[np.bool_]
    warnings: tuple[str, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)


def build_atlas(
    mesh: SkinnedMesh,
    *,
    mode: str = "auto",
    floor: int | None = None,
    size_px: int = 1024,
    gutter_px: float = 4.0,
    min_chart_px: float = 4.0,
) -> Atlas:
    """Give every surface point its own place in one texture.

    Parameters
    ----------
    mesh : SkinnedMesh
        One welded, edge-manifold mesh.
    mode : str
        "auto", "keep", "repack" or "unwrap".
    floor : int, optional
        Faces that the coarsest level may have; `default_floor` unless given.
    size_px : int
        Side of the texture that gutters are measured in: the smallest of the character's textures that must keep
        its charts apart.
    gutter_px : float
        Least distance of two charts in texels of that texture.
    min_chart_px : float
        A chart covers at least the square of this many texels.

    Returns
    -------
    Atlas

    Raises
    ------
    InputError
        If the mesh has no faces, or `mode` is "keep" or "repack" and its uvs cannot be kept.
    ValueError
        If the mode or a size is not one there is.
    """
    if mode not in MODES:
        raise ValueError(f"atlas mode {mode!r} is none of {', '.join(MODES)}")
    if not mesh.num_faces:
        raise InputError("the mesh has no faces: there is no atlas to build")
    floor = default_floor(mesh.num_faces) if floor is None else floor
    if mode in ("keep", "repack"):
        if not mesh.has_uvs:
            raise InputError(f"--atlas {mode}: parts of the mesh have no texture coordinates: use --atlas unwrap")
        return _finish(mesh, mesh, "keep", False, 0, ())
    made = unwrap(mesh, floor, size_px, gutter_px, min_chart_px)
    warnings = (f"{made.num_split} edges split so that seams are straight",) if made.num_split else ()
    return _finish(mesh, made.mesh, "unwrap", True, made.layout.floor_faces, warnings)


def _finish(
    source: SkinnedMesh, mesh: SkinnedMesh, mode: str, resampled: bool, floor_faces: int, warnings: tuple[str, ...]
) -> Atlas:
    edges = find_edges(mesh.surface.faces)
    cut = cut_edges(edges, mesh.surface.face_uvs)
    num_charts, _ = label_faces(edges, cut)
    l2, linf = measure_stretch(mesh.surface)
    atlas = Atlas(
        mesh=mesh,
        mode=mode,
        num_charts=num_charts,
        overlap=0,
        stretch_l2=l2,
        stretch_linf=linf,
        coverage=measure_coverage(mesh.surface),
        straightened=straight_share(mesh.surface),
        resampled=resampled,
        floor_faces=floor_faces,
        made_seams=_made_seams(mesh, cut[edges.face_edges]),
        warnings=warnings,
    )
    log.info("atlas: %s, %d charts, stretch %.2f, coverage %.0f %%", mode, num_charts, l2, 100 * atlas.coverage)
    return atlas


def _made_seams(mesh: SkinnedMesh, cut: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cut half-edges along which the source's own texture coordinates are continuous, (F, 3)."""
    edges = find_edges(mesh.surface.faces)
    made = cut & edges.glued[edges.face_edges]
    if not mesh.corner_texcoords.shape[2]:
        return made
    texcoords = mesh.corner_texcoords[:, :, 0].reshape(-1, 2)
    left, right = edges.halves[edges.glued].T
    after_left, after_right = (h - h % 3 + (h + 1) % 3 for h in (left, right))
    differs = (texcoords[left] != texcoords[after_right]).any(axis=1)
    differs |= (texcoords[after_left] != texcoords[right]).any(axis=1)
    source_seam = np.zeros(len(edges.glued), bool)
    source_seam[edges.glued] = differs
    return made & ~source_seam[edges.face_edges]
