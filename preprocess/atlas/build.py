"""The atlas stage: every point of a character gets its own texel region, with the least change that works.

keep    the source's uvs, where they are one-to-one and inside the square;
repack  the source's charts, packed anew, where each is sound;
unwrap  charts made for decimation (`unwrap`);
auto    the first of these that is one-to-one and reaches the floor asked for.

Seams of kept charts are straightened; under `auto` the tolerance rises step by step while that may reach the floor.
"""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.atlas.crowding import measure_crowding
from preprocess.atlas.measure import measure_coverage, measure_stretch, straight_share
from preprocess.atlas.repack import find_charts, repack_charts
from preprocess.atlas.unwrap import unwrap
from preprocess.decimate import decimate_to
from preprocess.errors import InputError
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.split_edges import apply_split
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.straighten import straighten

log = logging.getLogger(__name__)

MODES = ("auto", "keep", "repack", "unwrap")


TOLERANCES_REL = (0.01, 0.02, 0.03, 0.05)
"""Straightening tolerances that `auto` tries, of the diagonal of a seam's bounding box; the first is the paper's."""

SURE_SHARE = 0.8
"""Decimation gets to within about 10 % of the faces that the chart outlines leave; nearer than this it is tried."""

ATTEMPTS = 4
"""Unwraps, each for a lower floor, until decimation reaches the one asked for."""

MAX_CROWDED = 0.0005
"""Share of the used texels that two charts may claim before `auto` packs them anew."""


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
        Pairs of faces that overlap in uv and faces without area there; 0 unless `keep` or `repack` was asked for.
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
    straighten_rel: float | None = TOLERANCES_REL[0],
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
    straighten_rel : float, optional
        Tolerance of straightening kept charts, of the diagonal of a seam's bounding box; None: leave seams as they
        are. `auto` may go above it to reach the floor.
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
        If the mode is not one there is.
    """
    if mode not in MODES:
        raise ValueError(f"atlas mode {mode!r} is none of {', '.join(MODES)}")
    if not mesh.num_faces:
        raise InputError("the mesh has no faces: there is no atlas to build")
    floor = default_floor(mesh.num_faces) if floor is None else floor
    packing = _Packing(size_px, gutter_px, min_chart_px)
    if mode == "unwrap":
        return _unwrap(mesh, floor, packing)
    if mode != "auto":
        reason = _why_not_kept_charts(mesh) or (_why_not_inside(mesh) if mode == "keep" else _why_not_flat(mesh))
        if reason:
            raise InputError(f"--atlas {mode}: {reason}: use --atlas auto or unwrap")
        kept, floor_faces = _straighten(mesh, straighten_rel, keep_packing=mode == "keep")
        if mode == "repack":
            kept = _repack(kept, packing)
        return _finish(kept, mode, mode == "repack" or straighten_rel is not None, floor_faces, ())

    reasons: list[str] = []
    for attempt, why_not in (("keep", _why_not_keep(mesh, floor, size_px)), ("repack", _why_not_repack(mesh, floor))):
        atlas = None
        if not why_not:
            atlas, why_not = _try_kept_charts(mesh, attempt, floor, straighten_rel, packing)
        if atlas is not None:
            return dataclasses.replace(atlas, report={"not_chosen": reasons})
        reasons.append(f"{attempt}: {why_not}")
        log.info("atlas: not %s: %s", attempt, why_not)
    return dataclasses.replace(_unwrap(mesh, floor, packing), report={"not_chosen": reasons})


@dataclass(frozen=True)
class _Packing:
    size_px: int
    gutter_px: float
    min_chart_px: float


def _why_not_kept_charts(mesh: SkinnedMesh) -> str:
    """Why the source's charts are of no use; empty if they may be."""
    if not mesh.has_uvs or not len(mesh.surface.uvs):
        return "parts have no texture coordinates"
    if not np.isfinite(mesh.surface.uvs).all():
        return "texture coordinates are not finite"
    return ""


def _why_not_inside(mesh: SkinnedMesh) -> str:
    uvs = mesh.surface.uvs
    return "texture coordinates leave the unit square" if uvs.min() < 0 or uvs.max() > 1 else ""


def _why_not_flat(mesh: SkinnedMesh) -> str:
    flat = int((face_orientation(mesh.surface.uvs, mesh.surface.face_uvs) == 0).sum())
    return f"{flat} faces have no area in uv" if flat else ""


def _why_not_few(mesh: SkinnedMesh, floor: int) -> str:
    charts = int(find_charts(mesh.surface).max()) + 1
    return f"{charts} charts keep a face each, {floor} are asked for" if charts > floor else ""


def _why_not_keep(mesh: SkinnedMesh, floor: int, size_px: int) -> str:
    """Why the source's uvs cannot stay; empty as far as one can tell without trying."""
    reason = _why_not_kept_charts(mesh) or _why_not_inside(mesh)
    if reason:
        return reason
    overlap = find_overlap(mesh.surface.uvs, mesh.surface.face_uvs)
    if not overlap.one_to_one:
        return f"{100 * overlap.faces.mean():.1f} % of the faces overlap or have no area in uv"
    crowded = measure_crowding(mesh.surface, size_px)
    if crowded > MAX_CROWDED:
        return f"charts are so near that they share {100 * crowded:.2f} % of the texels at {size_px} x {size_px}"
    return _why_not_few(mesh, floor)


def _why_not_repack(mesh: SkinnedMesh, floor: int) -> str:
    """Why the source's charts cannot stay; empty as far as one can tell without trying."""
    return _why_not_kept_charts(mesh) or _why_not_flat(mesh) or _why_not_few(mesh, floor)


def _try_kept_charts(
    mesh: SkinnedMesh, mode: str, floor: int, straighten_rel: float | None, packing: _Packing
) -> tuple[Atlas | None, str]:
    """The source's charts with seams as straight as the floor needs, or why that does not do."""
    tolerances: tuple[float | None, ...] = (None,)
    if straighten_rel is not None:
        tolerances = (straighten_rel, *(t for t in TOLERANCES_REL if t > straighten_rel))
    why_not = ""
    for tolerance in tolerances:
        kept, floor_faces = _straighten(mesh, tolerance, keep_packing=mode == "keep")
        if floor_faces > floor or (floor_faces > SURE_SHARE * floor and not _reaches(kept, floor)):
            why_not = f"its seams leave {floor_faces} faces or some more, {floor} are asked for"
            continue
        if mode == "repack":
            try:
                kept = _repack(kept, packing)
            except InputError as error:
                return None, str(error)
        atlas = _finish(kept, mode, mode == "repack" or tolerance is not None, floor_faces, ())
        if atlas.overlap:
            return None, f"{atlas.overlap} pairs of faces overlap in their own charts"
        return atlas, ""
    return None, why_not


def _repack(mesh: SkinnedMesh, packing: _Packing) -> SkinnedMesh:
    try:
        return mesh.with_surface(repack_charts(mesh.surface, packing.size_px, packing.gutter_px).surface)
    except ValueError as error:
        raise InputError(f"--atlas repack: {error}: use --atlas unwrap") from error


def _unwrap(mesh: SkinnedMesh, floor: int, packing: _Packing) -> Atlas:
    share = 1.0
    for _ in range(ATTEMPTS):
        made = unwrap(mesh, int(share * floor), packing.size_px, packing.gutter_px, packing.min_chart_px)
        if made.layout.floor_faces > floor or _reaches(made.mesh, floor):
            break
        share *= 0.85
    warnings: tuple[str, ...] = (f"{made.num_split} edges split so that seams are straight",) if made.num_split else ()
    if made.layout.floor_faces > floor:
        warnings += (f"the parts of the mesh need {made.layout.floor_faces} faces at least, {floor} were asked for",)
    return _finish(made.mesh, "unwrap", True, made.layout.floor_faces, warnings)


def _reaches(mesh: SkinnedMesh, floor: int) -> bool:
    """Whether decimation gets down to a number of faces with all seams intact."""
    if mesh.num_faces <= floor:
        return True
    return len(decimate_to(mesh.surface, floor).lods[0].faces) <= floor


def _straighten(mesh: SkinnedMesh, tolerance_rel: float | None, *, keep_packing: bool) -> tuple[SkinnedMesh, int]:
    """A mesh with straighter seams, and the faces that its chart outlines then leave."""
    result = straighten(mesh.surface, 0.0 if tolerance_rel is None else tolerance_rel, keep_packing=keep_packing)
    if tolerance_rel is None:
        return mesh, result.floor_faces
    return apply_split(mesh, result.split).with_surface(result.surface), result.floor_faces


def _finish(mesh: SkinnedMesh, mode: str, resampled: bool, floor_faces: int, warnings: tuple[str, ...]) -> Atlas:
    """Measure what was made."""
    edges = find_edges(mesh.surface.faces)
    cut = cut_edges(edges, mesh.surface.face_uvs)
    num_charts, _ = label_faces(edges, cut)
    overlap = find_overlap(mesh.surface.uvs, mesh.surface.face_uvs)
    if not overlap.one_to_one:
        share = 100 * float(overlap.faces.mean())
        warnings += (f"{share:.1f} % of the faces overlap others in uv or have no area there: expect wrong textures",)
    l2, linf = measure_stretch(mesh.surface)
    atlas = Atlas(
        mesh=mesh,
        mode=mode,
        num_charts=num_charts,
        overlap=overlap.num_pairs + overlap.num_flat,
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
