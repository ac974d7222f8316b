"""The atlas stage: every point of a character gets its own texel region, with the least change that works.

Charts of the source that are sound are kept in shape. If all are, and lie apart in the square, they stay where they are
(`keep`); else they are packed anew, each with the texels that its detail needs (`repack`). What is folded, flat, crushed
or has no texture coordinates gets charts of its own (`unwrap`).

sound charts > new charts for the rest > straight seams > packing > uvs that bear storing.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.atlas.chart_scales import MIN_SIZE_PX, chart_densities, texture_side, wanted_side
from preprocess.atlas.crowding import measure_crowding
from preprocess.atlas.detail import largest_needs
from preprocess.atlas.distortion import turned_areas
from preprocess.atlas.flatten import local_triangles
from preprocess.atlas.measure import (
    PICTURE_PX,
    measure_coverage,
    measure_stretch,
    measure_texels,
    straight_share,
)
from preprocess.atlas.pack import pack_charts
from preprocess.atlas.snap import bear_snapping
from preprocess.atlas.source_charts import (
    find_charts,
    find_sound_charts,
    in_parts_with_little,
    relax_crushed_charts,
)
from preprocess.atlas.unwrap import unwrap
from preprocess.errors import InputError
from preprocess.mesh.edges import cut_edges, face_frames, find_edges, label_faces
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.split_edges import apply_split
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import snap_owner_uvs
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.straighten import Straightened, straighten

log = logging.getLogger(__name__)

MODES = ("auto", "keep", "repack", "unwrap")

TOLERANCES_REL = (0.01, 0.02)
"""Straightening tolerances that `auto` tries, of the diagonal of a seam's bounding box; the first is the paper's."""

MOST_DISTORTION = 2.0
"""Of straightening: |J|² / (2 det J). With 4 the human character has 120 faces that are stretched more than 4 : 1, with 2
the 52 of the source; 1.25 leaves half as many faces more at the floor."""

MAX_CROWDED = 0.0005
"""Share of the used texels that two charts may claim before `auto` packs them anew."""

MAX_SPARSE = 0.001
"""Share of the surface that may have under a quarter of the median texels a metre before `auto` packs anew."""

GUTTER_SIZE_PX, GUTTER_PX = 1024, 8.0
"""Charts stay this many texels of a texture of that size apart: two, where geometry and weights have 256 …"""

GUTTER_SHARE, LEAST_GUTTER_PX = 0.15, 2.0
"""… or fewer, where gutters would take more of the square than this; two texels of the largest texture at least."""

LEAST_CHART_PX = 2.0
"""Side of the square, in texels at `GUTTER_SIZE_PX`, that a chart covers at least."""

NORMAL_SIZE_PX = 1024
"""Side of the normal texture of a character without normal maps: all have one of this size at least."""

FILL = 0.65  # of the square, by charts: what packing usually comes to

ATTEMPTS = 3  # at packing without overlaps once uvs are rounded


@dataclass(frozen=True)
class Atlas:
    """A character with one-to-one uvs in the unit square.

    Attributes
    ----------
    mesh : SkinnedMesh
        Its surface holds the atlas. Faces may have been split and reordered against the source.
    mode : str
        "keep", "repack" or "unwrap": what was done with most of the surface.
    kept_share : float
        Of the surface's area, in charts whose shape is the source's.
    num_charts : int
    overlap : int
        Pairs of faces that overlap in uv as stored, and faces without area there; 0 unless `keep` or `repack` was asked
        for.
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
    needs : dict of str to (F,) float64
        Texels a metre that the faces need of each kind of texture.
    texels : dict
        `measure_texels`.
    warnings : tuple of str
    report : dict
    """

    mesh: SkinnedMesh
    mode: str
    kept_share: float
    num_charts: int
    overlap: int
    stretch_l2: float
    stretch_linf: float
    coverage: float
    straightened: float
    resampled: bool
    floor_faces: int
    made_seams: NDArray[np.bool_]
    needs: Mapping[str, Floats] = field(default_factory=dict)
    texels: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)


def build_atlas(
    mesh: SkinnedMesh,
    *,
    mode: str = "auto",
    floor: int = 0,
    straighten_rel: float | None = TOLERANCES_REL[0],
    needs: Mapping[str, Floats] | None = None,
    image_sizes: Floats | None = None,
) -> Atlas:
    """Give every surface point its own place in one texture.

    Parameters
    ----------
    mesh : SkinnedMesh
        One welded, edge-manifold mesh.
    mode : str
        "auto", "keep", "repack" or "unwrap".
    floor : int
        Faces that the coarsest exact level should have: a wish. `auto` straightens more for it, within its limits.
    straighten_rel : float, optional
        Tolerance of straightening, of the diagonal of a seam's bounding box; None: leave seams as they are.
    needs : dict of str to (F,) float64, optional
        Texels a metre that the faces need of each kind of texture (`detail.find_needs`); all alike unless given.
    image_sizes : (F, 2) float64, optional
        Width and height of the images that the uvs point into (`detail.image_sizes`); square unless given.

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
    needs = {} if needs is None else needs
    sizes = np.ones((mesh.num_faces, 2)) if image_sizes is None else image_sizes
    flat = local_triangles(mesh.surface.positions, mesh.surface.faces)
    if mode in ("keep", "repack"):
        reason = _why_not_usable(mesh) or (_why_not_inside(mesh) if mode == "keep" else _why_not_flat(mesh))
        if reason:
            raise InputError(f"--atlas {mode}: {reason}: use --atlas auto or unwrap")
        charts = find_charts(mesh.surface)
    elif mode == "unwrap":
        charts = np.full(mesh.num_faces, -1, np.int64)
    else:
        charts = find_sound_charts(mesh.surface, flat, sizes)
    reasons = []
    if mode in ("auto", "keep"):
        why_not = _why_not_keep(mesh, charts) if mode == "auto" else ""
        atlas = None if why_not else _keep(mesh, straighten_rel, floor, needs)
        if atlas is not None and (mode == "keep" or not atlas.overlap):
            return atlas
        reasons.append("keep: " + (why_not or "its uvs overlap once they are rounded to be stored"))
        log.info("atlas: not kept as it is: %s", reasons[-1])
    if mode == "auto":
        charts = np.where(_on_plain_parts(mesh, flat, needs), -1, charts)
    made = _pack_anew(mesh, charts, flat, sizes, straighten_rel, needs)
    return dataclasses.replace(made, report={"not_chosen": reasons})


def _why_not_usable(mesh: SkinnedMesh) -> str:
    """Why the source's charts are of no use; empty if they may be."""
    if not mesh.has_uvs or not len(mesh.surface.uvs):
        return "parts have no texture coordinates"
    return "" if np.isfinite(mesh.surface.uvs).all() else "texture coordinates are not finite"


def _why_not_inside(mesh: SkinnedMesh) -> str:
    uvs = mesh.surface.uvs
    return "texture coordinates leave the unit square" if uvs.min() < 0 or uvs.max() > 1 else ""


def _why_not_flat(mesh: SkinnedMesh) -> str:
    flat = int((face_orientation(mesh.surface.uvs, mesh.surface.face_uvs) == 0).sum())
    return f"{flat} faces have no area in uv" if flat else ""


def _why_not_keep(mesh: SkinnedMesh, charts: NDArray[np.int64]) -> str:
    """Why the source's uvs cannot stay as they are; empty if they can."""
    reason = _why_not_usable(mesh)
    if not reason and (charts < 0).any():
        reason = f"{100 * (charts < 0).mean():.1f} % of the faces are folded, flat or crushed"
    reason = reason or _why_not_inside(mesh)
    if reason:
        return reason
    surface = mesh.surface
    overlap = find_overlap(surface.uvs, surface.face_uvs)
    if not overlap.one_to_one:
        return f"{100 * overlap.faces.mean():.1f} % of the faces overlap others"
    crowded = measure_crowding(surface, GUTTER_SIZE_PX // 2)
    if crowded > MAX_CROWDED:
        return f"charts are so near that they share {100 * crowded:.2f} % of the texels at 512 x 512"
    sparse = measure_texels(surface, GUTTER_SIZE_PX)["sparse_area"]
    return f"{100 * sparse:.1f} % of the surface has few texels" if sparse > MAX_SPARSE else ""


def _on_plain_parts(mesh: SkinnedMesh, flat: Floats, needs: Mapping[str, Floats]) -> NDArray[np.bool_]:
    """Faces of parts on which little is painted, (F,): new charts are fewer than the source's, and lose nothing.

    Little is what the smallest texture shows at half of its density.
    """
    areas = turned_areas(flat)
    shown = MIN_SIZE_PX * np.sqrt(FILL / areas.sum())
    painted = largest_needs(needs, mesh.num_faces) > 0.5 * shown
    return in_parts_with_little(mesh.surface.faces, areas, painted)


def _keep(mesh: SkinnedMesh, straighten_rel: float | None, floor: int, needs: Mapping[str, Floats]) -> Atlas:
    """The source's layout with straighter seams."""
    straight = _straighten(mesh.surface, straighten_rel, floor, keep_packing=True)
    kept = apply_split(mesh, straight.split).with_surface(straight.surface) if straighten_rel is not None else mesh
    sources = straight.split.face_source if straighten_rel is not None else np.arange(mesh.num_faces)
    return _finish(kept, "keep", 1.0, straighten_rel is not None, straight.floor_faces, _of_faces(needs, sources))


def _straighten(
    surface: TexturedSurface, tolerance_rel: float | None, floor: int, *, keep_packing: bool
) -> Straightened:
    """Seams as straight as the tolerance makes them, or a higher one where that leaves too many faces."""
    if tolerance_rel is None:
        return straighten(surface, 0.0, keep_packing=keep_packing)
    tolerances = (tolerance_rel, *(t for t in TOLERANCES_REL if t > tolerance_rel))
    for tolerance in tolerances:
        result = straighten(surface, tolerance, keep_packing=keep_packing, most_distortion=MOST_DISTORTION)
        if result.floor_faces <= floor:
            break
    return result


def _pack_anew(
    mesh: SkinnedMesh,
    charts: NDArray[np.int64],
    flat: Floats,
    sizes: Floats,
    straighten_rel: float | None,
    needs: Mapping[str, Floats],
) -> Atlas:
    """Kept charts and new ones for faces of chart -1, straightened and packed."""
    areas = turned_areas(flat)
    kept_share = float(areas[charts >= 0].sum() / areas.sum())
    for _ in range(ATTEMPTS):
        apart = _lay_out(mesh, charts, sizes, flat)
        # Once: a higher tolerance saves a tenth of the faces at the floor and costs as much as all the rest.
        straight = _straighten(apart, straighten_rel, mesh.num_faces, keep_packing=False)
        made, sources = apply_split(mesh, straight.split), straight.split.face_source
        made_needs = _of_faces(needs, sources)
        packed = _pack(straight.surface, largest_needs(made_needs, len(sources)))
        uvs = bear_snapping(packed.uvs, packed.face_uvs)
        packed = dataclasses.replace(packed, uvs=uvs)
        overlapping = find_overlap(snap_owner_uvs(uvs), packed.face_uvs).faces
        if not overlapping.any():
            break
        log.info("atlas: %d faces overlap once rounded, and are cut off", overlapping.sum())
        charts = charts.copy()
        charts[np.unique(sources[overlapping])] = -1
    mode = "repack" if kept_share > 0.5 else "unwrap"
    return _finish(made.with_surface(packed), mode, kept_share, True, straight.floor_faces, made_needs)


def _lay_out(mesh: SkinnedMesh, charts: NDArray[np.int64], sizes: Floats, flat: Floats) -> TexturedSurface:
    """All charts in frames of their own, at the surface's scale over the square root of its area."""
    surface, areas = mesh.surface, turned_areas(flat)
    face_uvs = np.zeros_like(surface.face_uvs)
    unit = 1.0 / np.sqrt(areas.sum())
    uvs = np.zeros((0, 2))
    kept = charts >= 0
    if kept.any():
        corners = surface.uvs[surface.face_uvs[kept]] * sizes[kept][:, None]
        keys = np.repeat(charts[kept], 3) * len(surface.uvs) + surface.face_uvs[kept].ravel()
        _, first, index = np.unique(keys, return_index=True, return_inverse=True)
        face_uvs[kept] = index.reshape(-1, 3)
        number = np.unique(charts[kept], return_inverse=True)[1].reshape(-1)
        scale = np.sqrt(np.bincount(number, areas[kept]) / np.bincount(number, np.abs(turned_areas(corners))))
        low = np.full((len(scale), 2), np.inf)
        np.minimum.at(low, number, corners.min(axis=1))
        own = ((corners - low[number][:, None]) * scale[number][:, None, None]).reshape(-1, 2)
        pixel_m = float(np.ptp(surface.positions[surface.faces.ravel()], axis=0).max()) / PICTURE_PX
        own = relax_crushed_charts(own[first], face_uvs[kept], flat[kept], number, areas[kept], pixel_m**2)
        uvs = unit * own
    if not kept.all():
        rows = np.flatnonzero(~kept)
        own_ids, own = unwrap(surface.positions, surface.faces[rows], mesh.face_materials[rows])
        face_uvs[rows] = own_ids + len(uvs)
        uvs = np.concatenate([uvs, unit * own])
    return TexturedSurface(surface.positions, surface.faces, uvs, face_uvs)


def _pack(surface: TexturedSurface, needs: Floats) -> TexturedSurface:
    """Place all charts in the unit square, each with the texels that it needs."""
    edges = find_edges(surface.faces)
    cut = cut_edges(edges, surface.face_uvs)
    num_charts, charts = label_faces(edges, cut)
    areas_m2 = face_frames(surface.positions, surface.faces)[0]
    corners = surface.uvs[surface.face_uvs]
    uv_areas = np.bincount(charts, np.abs(turned_areas(corners)), num_charts)
    density = chart_densities(needs, areas_m2, charts, num_charts)
    true_m = np.sqrt(np.bincount(charts, areas_m2, num_charts) / np.maximum(uv_areas, 1e-300))
    true_m = np.where(true_m > 0, true_m, np.median(true_m))
    factor = density * true_m  # texels for one uv of a chart as it comes
    halves = edges.halves[cut]
    halves = halves[halves >= 0]
    ends = halves - halves % 3 + (halves + 1) % 3
    points = corners.reshape(-1, 2)
    segments = np.stack([points[halves], points[ends]], axis=1) * factor[charts[halves // 3]][:, None, None]
    areas = uv_areas * factor**2
    gutter = _choose_gutter(segments, float(areas.sum()))
    packing = pack_charts(segments, charts[halves // 3], num_charts, areas, GUTTER_SIZE_PX, gutter, LEAST_CHART_PX)
    uv_charts = np.zeros(len(surface.uvs), np.int64)
    uv_charts[surface.face_uvs] = charts[:, None]
    uvs = packing.apply(surface.uvs * factor[uv_charts][:, None], uv_charts)
    return TexturedSurface(surface.positions, surface.faces, uvs, surface.face_uvs)


def _choose_gutter(segments: Floats, area: float) -> float:
    """Least distance of charts in texels at `GUTTER_SIZE_PX`, from all outlines and the area in texels."""
    side = np.sqrt(area / FILL)  # of the square, texels
    outline = float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()) / side
    widest = 2.0 * GUTTER_SHARE / max(outline, 1e-300) * GUTTER_SIZE_PX
    least = LEAST_GUTTER_PX * min(GUTTER_SIZE_PX / texture_side(side), 1.0)
    return float(np.clip(widest, least, GUTTER_PX))


def _of_faces(needs: Mapping[str, Floats], sources: NDArray[np.integer]) -> dict[str, Floats]:
    return {kind: need[sources] for kind, need in needs.items()}


def _finish(
    mesh: SkinnedMesh, mode: str, kept_share: float, resampled: bool, floor_faces: int, needs: Mapping[str, Floats]
) -> Atlas:
    """Measure what was made, as it will be stored."""
    surface = mesh.surface
    if mode == "keep":
        surface = dataclasses.replace(surface, uvs=bear_snapping(surface.uvs, surface.face_uvs))
        mesh = mesh.with_surface(surface)
    stored = dataclasses.replace(surface, uvs=snap_owner_uvs(surface.uvs))
    edges = find_edges(surface.faces)
    cut = cut_edges(edges, surface.face_uvs)
    overlap = find_overlap(stored.uvs, surface.face_uvs)
    size_px = max(texture_side(wanted_side(stored, largest_needs(needs, mesh.num_faces))), NORMAL_SIZE_PX)
    texels = measure_texels(stored, size_px)
    l2, linf = measure_stretch(stored)
    atlas = Atlas(
        mesh=mesh,
        mode=mode,
        kept_share=kept_share,
        num_charts=label_faces(edges, cut)[0],
        overlap=overlap.num_pairs + overlap.num_flat,
        stretch_l2=l2,
        stretch_linf=linf,
        coverage=measure_coverage(stored),
        straightened=straight_share(surface),
        resampled=resampled,
        floor_faces=floor_faces,
        made_seams=_made_seams(mesh, cut[edges.face_edges]),
        needs=needs,
        texels=texels,
        warnings=_warn(overlap, texels),
    )
    log.info("atlas: %s, %d charts, stretch %.2f, coverage %.0f %%", mode, atlas.num_charts, l2, 100 * atlas.coverage)
    return atlas


def _warn(overlap: Any, texels: Mapping[str, Any]) -> tuple[str, ...]:
    """What a person should know before looking."""
    warnings = []
    if not overlap.one_to_one:
        share = 100 * float(overlap.faces.mean())
        warnings.append(f"{share:.1f} % of the faces overlap others in uv or have no area there: expect wrong textures")
    if texels["sparse_faces"] or texels["stretched_faces"]:
        warnings.append(
            f"{texels['sparse_faces']} faces that can be seen have under a quarter of the usual texels, "
            f"{texels['stretched_faces']} are stretched more than 4 : 1"
        )
    if texels["thin_faces"]:
        warnings.append(f"{texels['thin_faces']} faces are narrower than a texel at {texels['size_px']} texels a side")
    return tuple(warnings)


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
