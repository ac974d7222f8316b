"""The base mesh of a set of charts: corners, boundary paths, polygons (docs/method.md, section 4; Sander et al. 2003).

A corner is a vertex where other than two cut edges meet, or one added so that the polygons form a valid base mesh:
every path between two corners becomes one straight side of the polygons on both of its sides, two corners are
joined by one path at most, and a closed path has three corners or more. A polygon of k sides keeps k - 2 faces at
the decimation floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.mesh.edges import Bools, MeshEdges, label_corners, label_faces
from preprocess.numerics.jit import entry


@dataclass(frozen=True)
class Layout:
    """Charts as polygons. C charts, P paths, N sides (two for a seam path, one for a boundary path).

    Attributes
    ----------
    cut : (E,) bool
    face_charts : (F,) int32
    face_uvs : (F, 3) int32
        Texture vertices, T of them.
    uv_vertices : (T,) int32
        Surface vertex of each texture vertex.
    path_first : (P + 1,) int32
        Start of each path in `path_vertices`.
    path_vertices : (N',) int32
        Surface vertices along the paths, both ends included.
    path_edges : (N',) int32
        Edge from each of them to the next, -1 at a path's last vertex.
    path_fractions : (N',) float64
        Fraction of the 3D arc length, 0 at the first vertex and 1 at the last.
    chart_first : (C + 1,) int32
        Start of each chart in `side_*`.
    side_paths : (N,) int32
        Path of each side, charts in order, counter-clockwise in the chart's faces.
    side_forward : (N,) bool
        Whether the chart walks the path in its direction.
    side_uvs : (N,) int32
        Texture vertex at the side's start.
    boundary_uvs, boundary_sides, boundary_slots : (B,) int32
        Texture vertices on chart boundaries (sides' starts included), the side of each, and its entry in
        `path_vertices` along that side.
    """

    cut: Bools
    face_charts: Ints
    face_uvs: Ints
    uv_vertices: Ints
    path_first: Ints
    path_vertices: Ints
    path_edges: Ints
    path_fractions: Floats
    chart_first: Ints
    side_paths: Ints
    side_forward: Bools
    side_uvs: Ints
    boundary_uvs: Ints
    boundary_sides: Ints
    boundary_slots: Ints

    @property
    def num_charts(self) -> int:
        """Number of charts."""
        return len(self.chart_first) - 1

    @property
    def num_sides(self) -> Ints:
        """Sides of each chart's polygon, (C,)."""
        return np.diff(self.chart_first).astype(np.int32)

    @property
    def side_ends(self) -> Ints:
        """The side that follows each side around its polygon, (N,)."""
        ends = np.arange(1, len(self.side_paths) + 1, dtype=np.int32)
        ends[self.chart_first[1:] - 1] = self.chart_first[:-1]
        return ends

    @property
    def floor_faces(self) -> int:
        """Faces left when every polygon is triangulated without inner vertices."""
        return int((self.num_sides - 2).sum())


def chart_characteristics(faces: Ints, edges: MeshEdges, cut: Bools) -> tuple[Ints, NDArray[np.int64]]:
    """Charts of a cut mesh and the Euler characteristic of each: 1 for a disk.

    Returns
    -------
    face_charts : (F,) int32
    characteristic : (C,) int64
    """
    num_charts, face_charts = label_faces(edges, cut)
    num_uvs, face_uvs = label_corners(faces, edges, cut)
    uv_chart = np.empty(num_uvs, np.int32)
    uv_chart[face_uvs] = face_charts[:, None]
    inner = edges.halves[edges.glued & ~cut, 0] // 3
    num_vertices = np.bincount(uv_chart, minlength=num_charts)
    num_faces = np.bincount(face_charts, minlength=num_charts)
    num_edges = 3 * num_faces - np.bincount(face_charts[inner], minlength=num_charts)
    return face_charts, num_vertices - num_edges + num_faces


def build_layout(
    positions: Floats,
    faces: Ints,
    edges: MeshEdges,
    cut: Bools,
    *,
    extra: Bools | None = None,
    triangular: Bools | None = None,
) -> Layout:
    """Corners, paths and polygons of charts that are all disks.

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int32
    edges : MeshEdges
    cut : (E,) bool
        Every edge that is not glued is cut.
    extra : (V,) bool, optional
        Vertices to make corners besides those that must be.
    triangular : (V,) bool, optional
        Boundary loops through these vertices get three corners where others get four: a face less at the floor.

    Returns
    -------
    Layout
    """
    _, face_charts = label_faces(edges, cut)
    num_uvs, face_uvs = label_corners(faces, edges, cut)
    cut_ids = np.flatnonzero(cut).astype(np.int32)
    cut_vertices = edges.vertices[cut_ids]
    degree = np.bincount(cut_vertices.ravel(), minlength=len(positions))
    corner = (degree > 0) & (degree != 2)
    if extra is not None:
        corner |= extra & (degree > 0)
    ring_corners = np.full(len(positions), 4)
    if triangular is not None:
        border = np.zeros(len(positions), bool)
        border[edges.vertices[~edges.glued]] = True
        ring_corners[triangular & border] = 3
    while True:
        path_first, path_vertices, path_edges = _trace_paths(cut_vertices, corner)
        added = _missing_corners(positions, path_first, path_vertices, corner, ring_corners)
        if not len(added):
            break
        corner[added] = True

    fractions = _fractions(positions, path_first, path_vertices)
    edge_path = np.full(len(cut), -1, np.int32)
    path_of_step = np.repeat(np.arange(len(path_first) - 1), np.diff(path_first))
    real = path_edges >= 0
    edge_path[cut_ids[path_edges[real]]] = path_of_step[real]
    edge_slot = np.full(len(cut), -1, np.int32)
    edge_slot[cut_ids[path_edges[real]]] = np.flatnonzero(real)

    # Boundary half-edges of the charts, chained by texture vertex.
    flat_edges = edges.face_edges.reshape(-1)
    halves = np.flatnonzero(cut[flat_edges]).astype(np.int32)
    start = faces.reshape(-1)[halves]
    start_uv = face_uvs.reshape(-1)[halves]
    end_uv = np.roll(face_uvs, -1, axis=1).reshape(-1)[halves]
    charts = face_charts[halves // 3]
    slot = edge_slot[flat_edges[halves]]
    forward = path_vertices[slot] == start
    following = np.full(num_uvs, -1, np.int32)
    following[start_uv] = np.arange(len(halves))
    is_start = corner[start]
    num_charts = int(face_charts.max()) + 1 if len(faces) else 0
    first_half = np.full(num_charts, -1, np.int32)
    starts = np.flatnonzero(is_start)[::-1]
    first_half[charts[starts]] = starts
    chart_first, side_halves, half_sides = _walk_charts(first_half, following, end_uv, is_start)
    uv_vertices = np.empty(num_uvs, np.int32)
    uv_vertices[face_uvs] = faces
    return Layout(
        cut=cut,
        face_charts=face_charts,
        face_uvs=face_uvs,
        uv_vertices=uv_vertices,
        path_first=path_first,
        path_vertices=path_vertices,
        path_edges=np.where(real, cut_ids[path_edges], -1).astype(np.int32),
        path_fractions=fractions,
        chart_first=chart_first,
        side_paths=edge_path[flat_edges[halves[side_halves]]],
        side_forward=forward[side_halves],
        side_uvs=start_uv[side_halves],
        boundary_uvs=start_uv,
        boundary_sides=half_sides,
        boundary_slots=np.where(forward, slot, slot + 1).astype(np.int32),
    )


def _fractions(positions: Floats, path_first: Ints, path_vertices: Ints) -> Floats:
    """Fraction of the arc length at every vertex of every path, exactly 0 and 1 at the ends, strictly increasing."""
    if not len(path_vertices):
        return np.zeros(0)
    points = positions[path_vertices]
    step = np.r_[0.0, np.linalg.norm(np.diff(points, axis=0), axis=1)]
    step[path_first[:-1]] = 0.0
    path = np.repeat(np.arange(len(path_first) - 1), np.diff(path_first))
    total = np.bincount(path, step)
    even = 1.0 / np.maximum(np.diff(path_first) - 1, 1)
    tiny = 1e-6 * even[path] * np.where(total > 0, total, 1)[path]  # coincident vertices stay apart in uv
    step = np.maximum(step, tiny)
    step[path_first[:-1]] = 0.0
    along = np.cumsum(step)
    along -= along[path_first[:-1]][path]
    fractions = along / along[path_first[1:] - 1][path]
    fractions[path_first[:-1]] = 0.0
    fractions[path_first[1:] - 1] = 1.0
    return fractions


def _missing_corners(
    positions: Floats, path_first: Ints, path_vertices: Ints, corner: Bools, ring_corners: NDArray[np.int64]
) -> Ints:
    """Vertices that must become corners for the paths to form a valid base mesh."""
    if not len(path_vertices):
        return np.zeros(0, np.int32)
    a, b = path_vertices[path_first[:-1]], path_vertices[path_first[1:] - 1]
    inner = np.diff(path_first) - 2
    added: list[int] = []
    closed = a == b
    for p in np.flatnonzero(closed):
        ring = path_vertices[path_first[p] : path_first[p + 1] - 1]
        wanted = int(ring_corners[ring[0]]) if not corner[ring[0]] else 3
        added += [int(ring[i]) for i in _spread_on_ring(positions[ring], min(wanted, len(ring)), corner[ring[0]])]
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
    order = np.lexsort((inner, high, low))
    order = order[~closed[order]]
    again = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    for p in order[1:][again]:
        if inner[p] > 0:
            line = path_vertices[path_first[p] : path_first[p + 1]]
            added.append(int(line[_farthest_from_chord(positions[line])]))
    return np.asarray(sorted(set(added)), np.int32)


def _spread_on_ring(points: Floats, count: int, keep_first: np.bool_) -> list[int]:
    """Corners of a closed path: the two ends of its longest extent, then whatever is farthest from the polygon."""
    n = len(points)
    first = 0 if keep_first else int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    chosen = [first]
    while len(chosen) < count:
        distance = np.full(n, np.inf)
        for i, c in enumerate(chosen):
            start, end = points[c], points[chosen[(i + 1) % len(chosen)]]
            axis = end - start
            length_sq = float(axis @ axis)
            t = np.clip((points - start) @ axis / length_sq, 0, 1) if length_sq > 0 else np.zeros(n)
            distance = np.minimum(distance, ((points - start - t[:, None] * axis) ** 2).sum(axis=1))
        distance[chosen] = -1
        chosen = sorted([*chosen, int(np.argmax(distance))])
    return chosen


def _farthest_from_chord(points: Floats) -> int:
    """Index of the inner vertex of a path that is farthest from the line between its ends."""
    axis = points[-1] - points[0]
    offset = points[1:-1] - points[0]
    length_sq = float(axis @ axis)
    if length_sq > 0:
        offset = offset - (offset @ axis / length_sq)[:, None] * axis
    distance = (offset**2).sum(axis=1)
    if distance.max() <= 1e-12 * max(length_sq, 1e-300):
        return len(points) // 2
    return 1 + int(np.argmax(distance))


@entry
def _trace_paths(cut_vertices, corner):  # type: ignore[no-untyped-def]
    """Chains of cut edges between corners, and the closed chains without one."""
    num_edges, num_vertices = len(cut_vertices), len(corner)
    first = np.zeros(num_vertices + 1, np.int32)
    for e in range(num_edges):
        first[cut_vertices[e, 0] + 1] += 1
        first[cut_vertices[e, 1] + 1] += 1
    for v in range(num_vertices):
        first[v + 1] += first[v]
    fill = first[:-1].copy()
    incident = np.empty(2 * num_edges, np.int32)
    for e in range(num_edges):
        for k in range(2):
            v = cut_vertices[e, k]
            incident[fill[v]] = e
            fill[v] += 1
    done = np.zeros(num_edges, np.bool_)
    path_first = np.empty(num_edges + 1, np.int32)
    path_vertices = np.empty(2 * num_edges, np.int32)
    path_edges = np.full(2 * num_edges, -1, np.int32)
    paths, size = 0, 0
    path_first[0] = 0
    for closed in range(2):
        for v in range(num_vertices):
            if closed == 0 and not corner[v]:
                continue
            for i in range(first[v], first[v + 1]):
                e = incident[i]
                if done[e]:
                    continue
                at = v
                while True:
                    done[e] = True
                    path_vertices[size] = at
                    path_edges[size] = e
                    size += 1
                    at = cut_vertices[e, 0] + cut_vertices[e, 1] - at
                    if corner[at] or at == v:
                        break
                    e = incident[first[at]] if incident[first[at]] != e else incident[first[at] + 1]
                path_vertices[size] = at
                size += 1
                paths += 1
                path_first[paths] = size
    return path_first[: paths + 1].copy(), path_vertices[:size].copy(), path_edges[:size].copy()


@entry
def _walk_charts(first_half, following, end_uv, is_start):  # type: ignore[no-untyped-def]
    """Sides of every chart in boundary order, and the side of every boundary half-edge."""
    num_charts = len(first_half)
    chart_first = np.zeros(num_charts + 1, np.int32)
    side_halves = np.empty(len(is_start), np.int32)
    half_sides = np.full(len(is_start), -1, np.int32)
    sides = 0
    for c in range(num_charts):
        half = first_half[c]
        while half >= 0 and half_sides[half] < 0:
            if is_start[half]:
                side_halves[sides] = half
                sides += 1
            half_sides[half] = sides - 1
            half = following[end_uv[half]]
        chart_first[c + 1] = sides
    return chart_first, side_halves[:sides].copy(), half_sides
