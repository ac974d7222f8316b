"""Straightenable components of the uv silhouette (paper, section 6: "identify straightenable components").

A surface vertex is a *corner* unless the silhouette passes through it cleanly: exactly two silhouette edges of the
same kind, whose uv copies continue one another. Corners are the ends of darts, junctions of three or more seams,
places where a seam meets the mesh's boundary, and pinched uv vertices. The paths between corners are the *chains*,
with two uv copies (seams) or one (boundaries). A closed loop without a corner is a chain that ends where it starts.

Unlike the authors' rule, ears (triangles with two silhouette edges) and their neighbours are no corners: the edge that
would lie on a straight run with its whole triangle is split instead (see `preprocess.mesh.split_edges`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from preprocess.arrays import Bools, Floats, Indices, Ints
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.numerics.jit import entry


@dataclass(frozen=True)
class Chains:
    """Silhouette paths between corners. C chains with P points in all; chain c has points offsets[c]:offsets[c + 1].

    Attributes
    ----------
    offsets : (C + 1,) int32
    vertices : (P,) int32
        Surface vertices along the chains. A closed loop repeats its first point at its end.
    uv_ids : (P, 2) int32
        Texture vertices of both sides; -1 on the missing side of a boundary.
    is_seam : (C,) bool
        Two sides, or one.
    is_loop : (C,) bool
        Closed without a corner.
    """

    offsets: Ints
    vertices: Ints
    uv_ids: Ints
    is_seam: Bools
    is_loop: Bools

    @property
    def num_chains(self) -> int:
        """Number of chains."""
        return len(self.is_seam)

    @property
    def point_chains(self) -> Indices:
        """Chain of every point, (P,) int64."""
        return np.repeat(np.arange(self.num_chains), np.diff(self.offsets))


def find_chains(surface: TexturedSurface) -> Chains:
    """Cut the silhouette of a surface into chains.

    Parameters
    ----------
    surface : TexturedSurface
        Edge-manifold, open or closed, orientable or not.

    Returns
    -------
    Chains

    Raises
    ------
    InputError
        If an edge has three or more faces.
    """
    seams = find_seams(surface)
    num_seams = len(seams.vertices)
    vertices = np.concatenate([seams.vertices, seams.boundary_vertices]).astype(np.int64)
    uv_ids = np.full((len(vertices), 2, 2), -1, np.int64)
    uv_ids[:num_seams] = seams.uv_pairs
    uv_ids[num_seams:, 0] = seams.boundary_uvs
    ends = vertices.reshape(-1)
    incident = np.argsort(ends, kind="stable")
    first = np.searchsorted(ends[incident], np.arange(len(surface.positions) + 1))
    regular = _find_regular_vertices(uv_ids, first, incident)
    points, uv_points, offsets, is_loop = _walk_chains(vertices, uv_ids, first, incident, regular)
    order = _start_loops_at_corners(surface.uvs[uv_points].reshape(-1, 4), uv_points, offsets, is_loop)
    points, uv_points = points[order], uv_points[order]
    return Chains(
        offsets=offsets.astype(np.int32),
        vertices=points.astype(np.int32),
        uv_ids=uv_points.astype(np.int32),
        is_seam=uv_points[offsets[:-1], 1] >= 0,
        is_loop=is_loop,
    )


def _find_regular_vertices(uv_ids: Indices, first: Indices, incident: Indices) -> Bools:
    """Which surface vertices the silhouette passes through cleanly, (V,) bool.

    `first` and `incident` list, a vertex, the ends of silhouette edges there: end h is end h % 2 of edge h // 2.
    """
    regular: Bools = np.diff(first) == 2
    at = np.flatnonzero(regular)
    h, g = incident[first[at]], incident[first[at] + 1]
    mine, other = uv_ids[h // 2, :, h % 2], uv_ids[g // 2, :, g % 2]
    same = (np.sort(mine, axis=1) == np.sort(other, axis=1)).all(axis=1)
    regular[at] = same & (mine[:, 0] != mine[:, 1]) & (h // 2 != g // 2)
    return regular


def _start_loops_at_corners(joint: Floats, uv_points: Indices, offsets: Indices, is_loop: Bools) -> Indices:
    """Order of the points in which every loop starts, and so keeps a point, where it is farthest from its middle."""
    order = np.arange(len(joint))
    low, size = offsets[:-1], np.diff(offsets)
    turns = is_loop & (uv_points[low] == uv_points[offsets[1:] - 1]).all(axis=1)  # a Moebius loop swaps its sides
    if not turns.any():
        return order
    chain = np.repeat(np.arange(len(low)), size)
    middle = np.add.reduceat(joint, low) / size[:, None]
    distance = np.linalg.norm(joint - middle[chain], axis=1)
    farthest = np.lexsort((order, -distance, chain))[low] - low
    k = order - low[chain]
    turned = low[chain] + (farthest[chain] + k) % np.maximum(size - 1, 1)[chain]
    return np.where(turns[chain], turned, order)


@entry
def _walk_chains(vertices, uv_ids, first, incident, regular):  # type: ignore[no-untyped-def]
    """Follow the silhouette from corner to corner, then round the loops that have none.

    Returns points (P,), their texture vertices (P, 2), offsets (C + 1,) and which chains are loops (C,).
    """
    num_edges = len(vertices)
    points = np.empty(2 * num_edges, np.int64)
    uv_points = np.empty((2 * num_edges, 2), np.int64)
    offsets = np.zeros(num_edges + 1, np.int64)
    is_loop = np.zeros(num_edges, np.bool_)
    used = np.zeros(num_edges, np.bool_)
    num_points = 0
    num_chains = 0
    for loops in range(2):
        for start in range(2 * num_edges):
            edge, end = start // 2, start % 2
            if used[edge] or (loops == 0 and regular[vertices[edge, end]]):
                continue
            origin = vertices[edge, end]
            side = 0  # which of the edge's sides is the chain's first
            points[num_points] = origin
            uv_points[num_points, 0] = uv_ids[edge, 0, end]
            uv_points[num_points, 1] = uv_ids[edge, 1, end]
            num_points += 1
            while True:
                used[edge] = True
                end = 1 - end
                vertex = vertices[edge, end]
                points[num_points] = vertex
                uv_points[num_points, 0] = uv_ids[edge, side, end]
                uv_points[num_points, 1] = uv_ids[edge, 1 - side, end]
                num_points += 1
                if not regular[vertex] or vertex == origin:
                    break
                half = incident[first[vertex]]
                if half == 2 * edge + end:
                    half = incident[first[vertex] + 1]
                edge, end = half // 2, half % 2
                side = 0 if uv_ids[edge, 0, end] == uv_points[num_points - 1, 0] else 1
            is_loop[num_chains] = loops == 1
            num_chains += 1
            offsets[num_chains] = num_points
    return points[:num_points], uv_points[:num_points], offsets[: num_chains + 1], is_loop[:num_chains]
