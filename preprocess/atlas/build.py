"""The atlas stage: every point of a character gets its own texel region, with the least change that works.

Charts of the source that are sound are kept in shape. If all are, and lie apart in the square, they stay where they are
(`keep`); else they are packed anew, each with the texels that its detail needs (`repack`). What is folded, flat,
crushed or has no texture coordinates gets charts of its own (`unwrap`).

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
from preprocess.atlas.chart_scales import MIN_SIZE_PX, NORMAL_SIZE_PX, texture_side, wanted_side
from preprocess.atlas.crowding import measure_crowding
from preprocess.atlas.detail import Detail, find_detail, no_detail
from preprocess.atlas.distortion import turned_areas
from preprocess.atlas.flatten import local_triangles
from preprocess.atlas.measure import (
    PICTURE_PX,
    measure_coverage,
    measure_stretch,
    measure_texels,
    straight_share,
)
from preprocess.atlas.part_overlaps import part_overlaps
from preprocess.atlas.placement import FILL, place_charts
from preprocess.atlas.snap import bear_snapping
from preprocess.atlas.source_charts import (
    find_charts,
    find_sound_charts,
    in_parts_with_little,
    relax_crushed_charts,
)
from preprocess.atlas.unwrap import unwrap
from preprocess.errors import InputError
from preprocess.load import Character
from preprocess.mesh.edges import cut_edges, find_edges, label_faces
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.split_edges import apply_split
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import snap_canonical_uvs
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.settings import Settings, floor_faces
from preprocess.straighten import Straightened, straighten

log = logging.getLogger(__name__)

MODES = ("auto", "keep", "repack", "unwrap")

TOLERANCES_REL = (0.01, 0.02)
"""Straightening tolerances that `auto` tries, of the diagonal of a seam's bounding box; the first is the paper's."""

MOST_DISTORTION = 2.0
"""Of straightening: |J|² / (2 det J). With 4 the human character has 120 faces that are stretched more than 4 : 1, with
2 the 52 of the source; 1.25 leaves half as many faces more at the floor."""

MOST_ROUNDS = 8
"""Of straightening: what then still folds stays as it was. With 40 a large character takes half as long again, for less
than one face in a hundred at the floor."""

MAX_CROWDED = 0.0005
"""Share of the used texels that two charts may claim before `auto` packs them anew."""

MAX_SPARSE = 0.001
"""Share of the surface that may have under a quarter of the median texels a metre before `auto` packs anew."""

CROWDED_PX = 512
"""Side of the texture in which charts that are kept in place must not share texels: about what geometry has."""

ALMOST = 1.1  # times a texture's side: what is wanted beyond it is reported

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
    sides : dict of str to int
        Sides of the textures, by kind, in which every part keeps the detail that its source has.
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
    sides: Mapping[str, int] = field(default_factory=dict)
    texels: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)


def build_atlas(
    mesh: SkinnedMesh,
    *,
    mode: str = "auto",
    floor: int = 0,
    straighten_rel: float | None = TOLERANCES_REL[0],
    detail: Detail | None = None,
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
    detail : Detail, optional
        What the textures need; all parts of the surface are alike unless given.

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
    detail = no_detail(mesh.num_faces) if detail is None else detail
    flat = local_triangles(mesh.surface.positions, mesh.surface.faces)
    parted = _part_overlaps(mesh) if mode == "auto" else None
    mesh = parted or mesh
    if mode in ("keep", "repack"):
        reason = _why_not_usable(mesh) or (_why_not_inside(mesh) if mode == "keep" else _why_not_flat(mesh))
        if reason:
            raise InputError(f"--atlas {mode}: {reason}: use --atlas auto or unwrap")
        charts = find_charts(mesh.surface)
    elif mode == "unwrap":
        charts = np.full(mesh.num_faces, -1, np.int64)
    else:
        charts = find_sound_charts(mesh.surface, flat, detail.image_sizes)
    reasons = []
    if mode in ("auto", "keep"):
        why_not = _why_not_keep(mesh, charts) if mode == "auto" else ""
        atlas = None if why_not else _keep(mesh, straighten_rel, floor, detail)
        if atlas is not None and (mode == "keep" or not atlas.overlap):
            return dataclasses.replace(atlas, resampled=atlas.resampled or parted is not None)
        reasons.append("keep: " + (why_not or "its uvs overlap once they are rounded to be stored"))
        log.info("atlas: not kept as it is: %s", reasons[-1])
    if mode == "auto":
        charts = np.where(_on_plain_parts(mesh, flat, detail), -1, charts)
    made = _pack_anew(mesh, charts, flat, straighten_rel, detail)
    return dataclasses.replace(made, report={"not_chosen": reasons})


def _part_overlaps(mesh: SkinnedMesh) -> SkinnedMesh | None:
    """The mesh with uvs moved where a few faces overlap; None where there is nothing, or too much, to move."""
    if _why_not_usable(mesh) or _why_not_inside(mesh):
        return None
    surface = mesh.surface
    uvs = part_overlaps(surface.uvs, surface.face_uvs)
    if uvs is None or (uvs == surface.uvs).all() or uvs.min() < 0 or uvs.max() > 1:
        return None
    return mesh.with_surface(dataclasses.replace(surface, uvs=uvs))


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
    crowded = measure_crowding(surface, CROWDED_PX)
    if crowded > MAX_CROWDED:
        return f"charts are so near that they share {100 * crowded:.2f} % of the texels at {CROWDED_PX} x {CROWDED_PX}"
    sparse = measure_texels(surface, CROWDED_PX)["sparse_area"]
    return f"{100 * sparse:.1f} % of the surface has few texels" if sparse > MAX_SPARSE else ""


def _on_plain_parts(mesh: SkinnedMesh, flat: Floats, detail: Detail) -> NDArray[np.bool_]:
    """Faces of parts on which little is painted, (F,): new charts are fewer than the source's, and lose nothing.

    Little is what the smallest texture shows at half of its density.
    """
    areas = turned_areas(flat)
    shown = MIN_SIZE_PX * np.sqrt(FILL / areas.sum())
    painted = detail.finest() > 0.5 * shown
    return in_parts_with_little(mesh.surface.faces, areas, painted)


def _keep(mesh: SkinnedMesh, straighten_rel: float | None, floor: int, detail: Detail) -> Atlas:
    """The source's layout with straighter seams."""
    straight = _straighten(mesh.surface, straighten_rel, floor, keep_packing=True)
    kept = apply_split(mesh, straight.split).with_surface(straight.surface) if straighten_rel is not None else mesh
    sources = straight.split.face_source if straighten_rel is not None else np.arange(mesh.num_faces)
    return _finish(kept, "keep", 1.0, straighten_rel is not None, straight.floor_faces, detail.of_faces(sources))


def _straighten(
    surface: TexturedSurface, tolerance_rel: float | None, floor: int, *, keep_packing: bool
) -> Straightened:
    """Seams as straight as the tolerance makes them, or a higher one where that leaves too many faces."""
    if tolerance_rel is None:
        return straighten(surface, 0.0, keep_packing=keep_packing)
    tolerances = (tolerance_rel, *(t for t in TOLERANCES_REL if t > tolerance_rel))
    for tolerance in tolerances:
        result = straighten(
            surface, tolerance, keep_packing=keep_packing, most_distortion=MOST_DISTORTION, most_rounds=MOST_ROUNDS
        )
        if result.floor_faces <= floor:
            break
    return result


def _pack_anew(
    mesh: SkinnedMesh,
    charts: NDArray[np.int64],
    flat: Floats,
    straighten_rel: float | None,
    detail: Detail,
) -> Atlas:
    """Kept charts and new ones for faces of chart -1, straightened and packed."""
    areas = turned_areas(flat)
    kept_share = float(areas[charts >= 0].sum() / areas.sum())
    apart = _lay_out(mesh, charts, detail.image_sizes, flat)
    # Once: a higher tolerance saves a tenth of the faces at the floor and costs as much as all the rest.
    straight = _straighten(apart, straighten_rel, mesh.num_faces, keep_packing=False)
    made, sources = apply_split(mesh, straight.split), straight.split.face_source
    made_detail = detail.of_faces(sources)
    loose = straight.surface
    for _ in range(ATTEMPTS):
        packed = place_charts(loose, made_detail.finest())
        packed = dataclasses.replace(packed, uvs=bear_snapping(packed.uvs, packed.face_uvs))
        overlapping = find_overlap(snap_canonical_uvs(packed.uvs), packed.face_uvs).faces
        if not overlapping.any():
            break
        log.info("atlas: %d faces overlap once rounded, and are cut off", overlapping.sum())
        loose = _cut_off(loose, overlapping)
    mode = "repack" if kept_share > 0.5 else "unwrap"
    return _finish(made.with_surface(packed), mode, kept_share, True, straight.floor_faces, made_detail)


def _cut_off(surface: TexturedSurface, chosen: NDArray[np.bool_]) -> TexturedSurface:
    """Give faces texture vertices of their own."""
    face_uvs = surface.face_uvs.copy()
    face_uvs[chosen] = len(surface.uvs) + np.arange(3 * int(chosen.sum())).reshape(-1, 3)
    uvs = np.concatenate([surface.uvs, surface.uvs[surface.face_uvs[chosen]].reshape(-1, 2)])
    return TexturedSurface(surface.positions, surface.faces, uvs, face_uvs)


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
        uvs = np.concatenate([uvs, unit * own * (1.0, -1.0)])  # v runs down
    return TexturedSurface(surface.positions, surface.faces, uvs, face_uvs)


def _finish(
    mesh: SkinnedMesh, mode: str, kept_share: float, resampled: bool, floor_faces: int, detail: Detail
) -> Atlas:
    """Measure what was made, as it will be stored."""
    surface = mesh.surface
    if mode == "keep":
        surface = dataclasses.replace(surface, uvs=bear_snapping(surface.uvs, surface.face_uvs))
        mesh = mesh.with_surface(surface)
    stored = dataclasses.replace(surface, uvs=snap_canonical_uvs(surface.uvs))
    wanted = {kind: wanted_side(stored, need) for kind, need in detail.needs.items() if detail.sides[kind]}
    if mode == "keep":  # what straightening takes from a chart is no reason for a larger texture
        wanted = {kind: min(side, float(detail.sides[kind])) for kind, side in wanted.items()}
    edges = find_edges(surface.faces)
    cut = cut_edges(edges, surface.face_uvs)
    overlap = find_overlap(stored.uvs, surface.face_uvs)
    sides = {kind: texture_side(side) for kind, side in wanted.items()}
    texels = measure_texels(stored, max([NORMAL_SIZE_PX, *sides.values()]))
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
        sides=sides,
        texels=texels,
        warnings=(*_warn(overlap, texels), *_warn_of_sizes(mesh, wanted, sides)),
    )
    log.info("atlas: %s, %d charts, stretch %.2f, coverage %.0f %%", mode, atlas.num_charts, l2, 100 * atlas.coverage)
    return atlas


def _warn(overlap: Any, texels: Mapping[str, Any]) -> tuple[str, ...]:
    """What a person should know before looking."""
    warnings = []
    if not overlap.one_to_one:
        share = 100 * float(overlap.faces.mean())
        warnings.append(f"{share:.1f} % of the faces overlap others in uv or have no area there: expect wrong textures")
    if texels["sparse_faces"]:
        warnings.append(f"{texels['sparse_faces']} faces that can be seen have under a quarter of the usual texels")
    if texels["stretched_faces"]:
        warnings.append(f"{texels['stretched_faces']} faces that can be seen are stretched more than 4 : 1")
    if texels["thin_faces"]:
        warnings.append(f"{texels['thin_faces']} faces are narrower than a texel at {texels['size_px']} texels a side")
    return tuple(warnings)


def _warn_of_sizes(mesh: SkinnedMesh, wanted: Mapping[str, float], sides: Mapping[str, int]) -> tuple[str, ...]:
    """What does not fit into the largest texture that is made."""
    return tuple(
        f"{kind} is {sides[kind]} x {sides[kind]}: {int(np.ceil(side))} x {int(np.ceil(side))} would keep every texel "
        f"of the source; --color-size {2 * sides[kind]} makes it so, at the cost of time and memory"
        for kind, side in wanted.items()
        if side > ALMOST * sides[kind]
    )


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


def character_atlas(character: Character, settings: Settings) -> Atlas:
    """The atlas of a character with the settings of its build."""
    return build_atlas(
        character.mesh,
        mode=settings.atlas,
        floor=floor_faces(character.mesh.num_faces, settings.floor_rel),
        straighten_rel=settings.straighten_rel,
        detail=find_detail(character),
    )
