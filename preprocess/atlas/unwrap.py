"""An atlas made for decimation: charts are convex polygons of a coarse base mesh (docs/method.md, section 4).

Regions → disks → relaxed boundaries → corners and paths → convex polygons → maps without folds → packing. Every
boundary path is one straight segment in both of its charts, each vertex at the same fraction of it on both sides, so
that every seam edge can collapse, down to the base mesh itself: two faces a base vertex, whatever the source looked
like (multi-chart geometry images, Sander et al. 2003; seamless texture atlases, Purnomo et al. 2004).
"""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.atlas.flatten import flatten_fixed, flatten_free
from preprocess.atlas.layout import Layout, build_layout, chart_characteristics
from preprocess.atlas.pack import pack_charts
from preprocess.atlas.polygons import convex_polygons
from preprocess.atlas.relax import relax_paths
from preprocess.atlas.segment import grow_regions
from preprocess.atlas.smooth import face_energies, smooth_charts
from preprocess.errors import InputError
from preprocess.mesh.edges import Bools, MeshEdges, face_frames, find_edges, label_faces
from preprocess.mesh.split_edges import apply_split, split_edges
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface

log = logging.getLogger(__name__)

BUDGET_SHARE = 0.35
"""Share of the floor that the first layout may take. Fewer charts mean shorter seams and a lower floor; charts that
turn out to be stretched are split later, where it pays."""

FACES_PER_REGION = 4
"""Faces at the floor that one more region costs: two more corners, each in two faces more."""


SMALL_MESH_SHARE = 0.4
"""A mesh with little more faces than the floor is not cut into single triangles: charts keep a few faces each."""

REFINED_SHARE = 0.95
"""Up to this share of the floor, charts that are stretched too far are split again."""

REFINEMENTS = 6
TRIAL_SWEEPS = 12
FINAL_SWEEPS = 40
"""Smoothing sweeps while charts are still being split, and at the end: L2 stretch falls by 1 % from 40 to 80."""

MAX_STRETCH = 1.6
"""L2 stretch beyond which a chart is split: an open tube with a cap, an ear, a fist."""

MAX_GAIN = 1.5
"""A stretched chart is enlarged up to this factor."""

SMALL_PART_FACES = 3.0
"""An open part that fairly gets fewer faces than this at the floor may end as one triangle."""

BULGE = 3.0
"""Area over the area of a flat disk with the same boundary, above which a part gets two regions (a hemisphere: 2)."""

HALVING_COMPACTNESS = 0.1
"""Nearly all of a split is left to the normals: a tube is cut lengthwise, which needs no further cut."""

Frames = tuple[Floats, Floats, Floats]


@dataclass(frozen=True)
class Unwrapped:
    """A mesh with an atlas of straight, matched seams.

    Attributes
    ----------
    mesh : SkinnedMesh
        Faces may have been split.
    layout : Layout
    num_split : int
        Edges split at their middle, because they joined two vertices of one straight side.
    """

    mesh: SkinnedMesh
    layout: Layout
    num_split: int


def unwrap(mesh: SkinnedMesh, floor_faces: int, size_px: int, gutter_px: float, min_chart_px: float) -> Unwrapped:
    """Cut a mesh into a base mesh of charts and lay them out.

    Parameters
    ----------
    mesh : SkinnedMesh
        Its uvs are ignored.
    floor_faces : int
        Faces that the coarsest level may have.
    size_px : int
        Side of the square texture that the gutter is measured in.
    gutter_px, min_chart_px : float
        Least distance of two charts; a chart's area is at least `min_chart_px`².

    Returns
    -------
    Unwrapped

    Raises
    ------
    InputError
        If there is nothing to unwrap.
    """
    if not mesh.num_faces:
        raise InputError("the mesh has no faces: there is nothing to unwrap")
    # Work at a size near 1; a power of two changes no bit of any mantissa.
    extent = float(np.ptp(mesh.surface.positions[mesh.surface.faces.ravel()], axis=0).max())
    size = float(2.0 ** np.round(np.log2(extent))) if extent > 0 else 1.0
    mesh = mesh.with_surface(dataclasses.replace(mesh.surface, positions=mesh.surface.positions / size))
    surface = mesh.surface
    edges = find_edges(surface.faces)
    frames = face_frames(surface.positions, surface.faces)
    triangular = _find_small_parts(surface, edges, frames[0], floor_faces)
    budget = BUDGET_SHARE * min(floor_faces, SMALL_MESH_SHARE * mesh.num_faces)
    regions = _fit_regions(surface, edges, frames, triangular, budget)
    made = current = _lay_out(mesh, edges, regions, triangular)
    limit = mesh.num_faces
    for _ in range(REFINEMENTS):
        spare = int((REFINED_SHARE * floor_faces - current.layout.floor_faces) / FACES_PER_REGION)
        worst = _most_stretched(current.charts, min(spare, limit))
        if not len(worst):
            break
        log.debug("%d of %d charts split, energy %g", len(worst), current.layout.num_charts, current.energy)
        # A split face's first part has its place, so the charts of the source's faces are these.
        regions = current.layout.face_charts[: mesh.num_faces]
        halved = _lay_out(mesh, edges, _halve_regions(surface, edges, frames, triangular, regions, worst), triangular)
        if halved.layout.floor_faces > REFINED_SHARE * floor_faces:
            limit = len(worst) // 2
            continue
        current = halved  # even where some new chart is worse than the old one: it is split next
        if current.energy < made.energy:
            made = current
    charts = _smooth(made.mesh.surface, made.layout, made.charts, FINAL_SWEEPS)
    uvs = _place_charts(charts, made.layout, size_px, gutter_px, min_chart_px)
    surface = TexturedSurface(made.mesh.surface.positions * size, made.mesh.surface.faces, uvs, made.layout.face_uvs)
    return Unwrapped(made.mesh.with_surface(surface), made.layout, made.num_split)


@dataclass(frozen=True)
class _Charts:
    """Charts in the plane before they are packed.

    corners (N, 2) are the polygons', uvs (T, 2) all texture vertices at the surface's scale, fractions (N',) where
    vertices lie on their paths; areas_m2 (C,) on the surface, stretch (C,) the L2 stretch of each chart, folds (C,)
    its faces that could not be unfolded.
    """

    corners: Floats
    uvs: Floats
    fractions: Floats
    areas_m2: NDArray[np.floating]
    stretch: NDArray[np.floating]
    folds: Ints


@dataclass(frozen=True)
class _LaidOut:
    """A segmentation as charts, before they are packed; energy is the sum of area times squared stretch."""

    mesh: SkinnedMesh
    layout: Layout
    charts: _Charts
    num_split: int
    energy: float


def _lay_out(mesh: SkinnedMesh, edges: MeshEdges, regions: Ints, triangular: Bools) -> _LaidOut:
    borders = _region_borders(edges, regions)
    layout = build_layout(mesh.surface.positions, mesh.surface.faces, edges, borders, triangular=triangular)
    mesh, layout, num_split = _split_chords(mesh, edges, layout)
    charts = _map_charts(mesh.surface, layout)
    return _LaidOut(mesh, layout, charts, num_split, float((charts.areas_m2 * charts.stretch**2).sum()))


def _find_small_parts(surface: TexturedSurface, edges: MeshEdges, areas: Floats, floor_faces: int) -> Bools:
    """Vertices of connected parts to which an even share of the floor's faces gives fewer than three, (V,)."""
    num_parts, parts = label_faces(edges, ~edges.glued)
    part_area = np.bincount(parts, areas, minlength=num_parts)
    small = part_area * floor_faces < SMALL_PART_FACES * part_area.sum()
    vertices = np.zeros(len(surface.positions), bool)
    vertices[surface.faces[small[parts]]] = True
    return vertices


def _fit_regions(surface: TexturedSurface, edges: MeshEdges, frames: Frames, triangular: Bools, budget: float) -> Ints:
    """The segmentation with the most regions whose base mesh is within the budget, (F,)."""
    num_parts, parts = label_faces(edges, ~edges.glued)
    part_area = np.bincount(parts, frames[0], minlength=num_parts).astype(np.float64)
    share = part_area / max(part_area.sum(), 1e-300)
    least = _least_regions(surface, edges, parts, part_area, budget)
    wanted = budget
    best: tuple[int, Ints] | None = None
    for _ in range(5):
        counts = np.maximum(np.rint((wanted * share + 4) / FACES_PER_REGION).astype(np.int32), least)
        count, regions = grow_regions(edges.neighbors, *frames, parts, counts)
        regions = _make_disks(surface, edges, frames, regions, count)
        regions, floor = _relax(surface, edges, frames, triangular, regions)
        log.debug("%d regions wanted: %d grown, floor %d", counts.sum(), regions.max() + 1, floor)
        fits = floor <= budget
        if best is None or (floor > best[0] if fits and best[0] <= budget else floor < best[0]):
            best = floor, regions
        if (counts == least).all() or (fits and floor >= 0.93 * budget):
            break
        wanted *= np.clip(0.97 * budget / floor, 0.2, 1.5)
    assert best is not None
    return best[1]


def _least_regions(
    surface: TexturedSurface, edges: MeshEdges, parts: Ints, part_area: NDArray[np.floating], budget: float
) -> Ints:
    """Regions that every part needs: 2 where its area is far more than its boundary can enclose in a plane, (C,).

    Small parts must do with one.
    """
    border = np.flatnonzero(~edges.glued)
    ends = surface.positions[edges.vertices[border]]
    length = np.bincount(
        parts[edges.halves[border, 0] // 3], np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), len(part_area)
    )
    bulges = 4 * np.pi * part_area > BULGE * length**2
    large = part_area * budget >= SMALL_PART_FACES * part_area.sum()
    return np.where(bulges & large, 2, 1).astype(np.int32)


def _halve_regions(
    surface: TexturedSurface, edges: MeshEdges, frames: Frames, triangular: Bools, regions: Ints, chosen: Ints
) -> Ints:
    """Split the chosen regions in two and straighten the borders anew."""
    count = int(regions.max()) + 1
    number = np.full(count, -1, np.int32)
    number[chosen] = np.arange(len(chosen))
    domains = number[regions]
    _, halves = grow_regions(edges.neighbors, *frames, domains, np.full(len(chosen), 2, np.int32), HALVING_COMPACTNESS)
    regions = np.where(domains >= 0, count + halves, regions).astype(np.int32)
    regions = _make_disks(surface, edges, frames, regions, count + 2 * len(chosen))
    return _relax(surface, edges, frames, triangular, regions)[0]


def _make_disks(surface: TexturedSurface, edges: MeshEdges, frames: Frames, regions: Ints, count: int) -> Ints:
    """Split every region that is not a disk until all are."""
    while True:
        charts, characteristic = chart_characteristics(surface.faces, edges, _region_borders(edges, regions))
        bad = characteristic != 1
        if not bad.any():
            return regions
        number = np.where(bad, np.cumsum(bad) - 1, -1)
        domains = number[charts].astype(np.int32)
        added, halves = grow_regions(
            edges.neighbors, *frames, domains, np.full(int(bad.sum()), 2, np.int32), HALVING_COMPACTNESS
        )
        regions = np.where(domains >= 0, count + halves, regions).astype(np.int32)
        count += added


def _relax(
    surface: TexturedSurface, edges: MeshEdges, frames: Frames, triangular: Bools, regions: Ints
) -> tuple[Ints, int]:
    """Straighter borders; also the faces of the base mesh before that (its corners hardly change)."""
    layout = build_layout(
        surface.positions, surface.faces, edges, _region_borders(edges, regions), triangular=triangular
    )
    cut = relax_paths(surface, edges, frames[1], layout)
    return label_faces(edges, cut)[1], layout.floor_faces


def _region_borders(edges: MeshEdges, regions: Ints) -> Bools:
    halves = edges.halves
    return ~edges.glued | (regions[halves[:, 0] // 3] != regions[halves[:, 1] // 3])


def _split_chords(mesh: SkinnedMesh, edges: MeshEdges, layout: Layout) -> tuple[SkinnedMesh, Layout, int]:
    """Split every inner edge that joins two vertices of one straight side: it would map onto that side."""
    chords = find_chords(edges, layout)
    if not len(chords):
        return mesh, layout, 0
    cut_pairs = edges.vertices[layout.cut]
    corner = np.zeros(len(mesh.surface.positions), bool)
    corner[layout.path_vertices[layout.path_first[:-1]]] = True
    corner[layout.path_vertices[layout.path_first[1:] - 1]] = True
    old = mesh.surface  # its uvs do not matter; it may have none
    bare = TexturedSurface(old.positions, old.faces, np.zeros((1, 2)), np.zeros_like(old.face_uvs))
    split = apply_split(mesh, split_edges(bare, edges.vertices[chords]))
    new_edges = find_edges(split.surface.faces)
    stride = len(split.surface.positions)
    old_keys = cut_pairs[:, 0].astype(np.int64) * stride + cut_pairs[:, 1]
    cut = np.isin(new_edges.vertices[:, 0].astype(np.int64) * stride + new_edges.vertices[:, 1], old_keys)
    cut |= ~new_edges.glued
    extra = np.zeros(stride, bool)
    extra[: len(corner)] = corner
    return split, build_layout(split.surface.positions, split.surface.faces, new_edges, cut, extra=extra), len(chords)


def find_chords(edges: MeshEdges, layout: Layout) -> Ints:
    """Inner edges whose two ends lie on one side of their chart's polygon, edge ids."""
    num_uvs = len(layout.uv_vertices)
    side = np.full(num_uvs, -1, np.int32)
    side[layout.boundary_uvs] = layout.boundary_sides
    is_start = np.zeros(num_uvs, bool)
    is_start[layout.side_uvs] = True
    previous = np.arange(len(layout.side_paths)) - 1
    previous[layout.chart_first[:-1]] = layout.chart_first[1:] - 1
    before = np.where(is_start, previous[np.maximum(side, 0)], side)  # a corner ends one side and starts another
    inner = np.flatnonzero(~layout.cut)
    half = edges.halves[inner, 0]
    flat = layout.face_uvs.reshape(-1)
    a, b = flat[half], flat[half - half % 3 + (half + 1) % 3]
    both = (side[a] >= 0) & (side[b] >= 0)
    shared = (side[a] == side[b]) | (before[a] == side[b]) | (side[a] == before[b]) | (before[a] == before[b])
    return inner[both & shared].astype(np.int32)


def _map_charts(surface: TexturedSurface, layout: Layout) -> _Charts:
    """Each chart in its convex polygon, of the chart's own area."""
    points = surface.positions[layout.uv_vertices]
    num_charts = layout.num_charts
    side_charts = np.repeat(np.arange(num_charts, dtype=np.int32), layout.num_sides)
    areas: Any = np.bincount(layout.face_charts, face_frames(surface.positions, surface.faces)[0], num_charts)
    areas_m2 = np.maximum(areas, max(1e-9 * float(areas.sum()), 1e-9))
    free = flatten_free(points, layout.face_uvs, layout.face_charts, num_charts)
    path_lengths = _path_lengths(surface.positions, layout)
    corners = convex_polygons(free[layout.side_uvs], layout.chart_first, path_lengths[layout.side_paths])
    corners *= np.sqrt(areas_m2 / _polygon_areas(corners, layout))[side_charts][:, None]

    boundary = np.zeros(len(points), bool)
    boundary[layout.boundary_uvs] = True
    uvs = np.zeros((len(points), 2))
    uvs[layout.boundary_uvs] = _along_sides(layout, corners, layout.path_fractions)
    uvs, folds = flatten_fixed(points, layout.face_uvs, layout.face_charts, num_charts, boundary, uvs)
    if folds.any():
        log.warning("%d of %d charts have folded faces", int((folds > 0).sum()), num_charts)
    start = _Charts(corners, uvs, layout.path_fractions, areas_m2, areas_m2, folds)
    return _smooth(surface, layout, start, TRIAL_SWEEPS)


def _smooth(surface: TexturedSurface, layout: Layout, charts: _Charts, sweeps: int) -> _Charts:
    """Charts with less stretch, and their stretch measured."""
    uvs, fractions = smooth_charts(
        surface.positions, surface.faces, layout, charts.corners, charts.uvs, charts.fractions, charts.folds, sweeps
    )
    energy = np.bincount(layout.face_charts, face_energies(surface, uvs, layout.face_uvs), layout.num_charts)
    stretch = np.sqrt(energy / charts.areas_m2)
    return dataclasses.replace(charts, uvs=uvs, fractions=fractions, stretch=stretch)


def _most_stretched(charts: _Charts, limit: int) -> Ints:
    """The charts that are stretched too far, those that cost most first, at most `limit` of them."""
    order = np.argsort(-charts.areas_m2 * charts.stretch**2, kind="stable")
    return order[charts.stretch[order] > MAX_STRETCH][: max(limit, 0)].astype(np.int32)


def _place_charts(charts: _Charts, layout: Layout, size_px: int, gutter_px: float, min_chart_px: float) -> Floats:
    """uvs of all texture vertices in the packed atlas, (T, 2)."""
    side_charts = np.repeat(np.arange(layout.num_charts, dtype=np.int32), layout.num_sides)
    # Of all ways to share out the square, this one has the least L2 stretch overall.
    gain = np.clip(np.sqrt(charts.stretch), 1.0, MAX_GAIN)
    corners = charts.corners * gain[side_charts][:, None]
    mirror = np.array([1.0, -1.0])  # v runs down: seen as an image, no chart is mirrored
    segments = np.stack([corners, corners[layout.side_ends]], axis=1) * mirror
    areas = charts.areas_m2 * gain**2
    packing = pack_charts(segments, side_charts, layout.num_charts, areas, size_px, gutter_px, min_chart_px)
    uv_charts = np.zeros(len(charts.uvs), np.int32)
    uv_charts[layout.face_uvs] = layout.face_charts[:, None]
    placed = packing.apply(charts.uvs * gain[uv_charts][:, None] * mirror, uv_charts)
    placed[layout.boundary_uvs] = _along_sides(layout, packing.apply(corners * mirror, side_charts), charts.fractions)
    return placed


def _polygon_areas(corners: Floats, layout: Layout) -> Floats:
    """Area of each chart's polygon, (C,)."""
    following = corners[layout.side_ends]
    double = corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]
    return np.add.reduceat(0.5 * double, layout.chart_first[:-1])


def _along_sides(layout: Layout, corners: Floats, fractions: Floats) -> Floats:
    """Boundary vertices at their fractions, the same expression on both sides of a seam, (B, 2)."""
    ends = layout.side_ends
    start = np.where(layout.side_forward[:, None], corners, corners[ends])
    stop = np.where(layout.side_forward[:, None], corners[ends], corners)
    side = layout.boundary_sides
    t = fractions[layout.boundary_slots][:, None]
    return start[side] + t * (stop[side] - start[side])


def _path_lengths(positions: Floats, layout: Layout) -> Floats:
    """Arc length of each path, metres, (P,)."""
    step = np.linalg.norm(np.diff(positions[layout.path_vertices], axis=0), axis=1)
    step = np.r_[step, 0.0]
    step[layout.path_first[1:] - 1] = 0.0
    path = np.repeat(np.arange(len(layout.path_first) - 1), np.diff(layout.path_first))
    return np.maximum(np.bincount(path, step, minlength=len(layout.path_first) - 1), 1e-12)
