"""Straighter boundary paths: a path between two corners becomes the shortest one through its two charts.

A region's raw border zigzags along the triangles. Once it is one straight segment in uv its teeth are squashed, and a
triangle with all corners on it has no area left; the shortest path has no such triangle, because its chord would be
shorter. A path keeps its corners and touches no other path, so two disks stay two disks. Edges along creases count
as shorter, so that borders follow them.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.atlas.layout import Layout
from preprocess.atlas.priority_queue import pop, push
from preprocess.mesh.edges import Bools, MeshEdges
from preprocess.mesh.surface import TexturedSurface
from preprocess.numerics.jit import entry

CREASE_DISCOUNT = 0.5
"""Part of its length that an edge loses where its faces meet at 90° or more."""

SWEEPS = 3


def relax_paths(surface: TexturedSurface, edges: MeshEdges, normals: Floats, layout: Layout) -> Bools:
    """Shorten all seam paths of a layout.

    Parameters
    ----------
    surface : TexturedSurface
        Its uvs are not read.
    edges : MeshEdges
    normals : (F, 3) float64
    layout : Layout

    Returns
    -------
    (E,) bool
        The new cut. Charts are as many as before, each still a disk.
    """
    ends = surface.positions[edges.vertices]
    weights = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    left, right = normals[edges.halves[:, 0] // 3], normals[edges.halves[:, 1] // 3]
    crease = np.clip(1 - (left * right).sum(axis=1), 0, 1)
    weights = weights * np.where(edges.glued, 1 - CREASE_DISCOUNT * crease, 1) + 1e-7 * float(weights.mean())
    incident = np.argsort(edges.vertices.ravel(), kind="stable").astype(np.int32) // 2
    first = np.r_[0, np.cumsum(np.bincount(edges.vertices.ravel(), minlength=len(surface.positions)))]
    cut = layout.cut.copy()
    degree = np.bincount(edges.vertices[cut].ravel(), minlength=len(surface.positions))
    return _shorten(
        edges.vertices,
        edges.halves,
        edges.glued,
        edges.face_edges,
        edges.neighbors,
        weights,
        first,
        incident,
        cut,
        degree,
        layout.face_charts.copy(),
        layout.path_first,
        layout.path_vertices,
        layout.path_edges,
        SWEEPS,
    )


@entry
def _shorten(  # type: ignore[no-untyped-def]
    vertices, halves, glued, face_edges, neighbors, weights, first, incident,
    cut, degree, labels, path_first, path_vertices, path_edges, sweeps,
):  # fmt: skip
    """Dijkstra through the two charts of each path, path by path."""
    num_paths = len(path_first) - 1
    num_vertices, num_edges = len(degree), len(vertices)
    lengths = np.empty(num_paths, np.int32)
    # Current edges of each path, as chains in one array: no path grows beyond its charts, so a ring of lists suffices.
    head = np.empty(num_paths, np.int32)
    chain = np.empty(num_edges, np.int32)  # the next edge of the same path
    for p in range(num_paths):
        head[p] = -1
        lengths[p] = path_first[p + 1] - path_first[p] - 1
        for i in range(path_first[p + 1] - 2, path_first[p] - 1, -1):
            chain[path_edges[i]] = head[p]
            head[p] = path_edges[i]
    distance = np.empty(num_vertices)
    via = np.empty(num_vertices, np.int32)
    for v in range(num_vertices):
        distance[v] = np.inf
    touched = np.empty(num_vertices, np.int32)
    keys = np.empty(2 * num_edges + 1)
    items = np.empty(len(keys), np.int64)
    stack = np.empty(3 * len(labels) + 1, np.int32)
    for _sweep in range(sweeps):
        changed = False
        for p in range(num_paths):
            start, end = path_vertices[path_first[p]], path_vertices[path_first[p + 1] - 1]
            e = head[p]
            if lengths[p] < 2 or start == end or not glued[e]:
                continue
            one, two = labels[halves[e, 0] // 3], labels[halves[e, 1] // 3]
            if one == two:
                continue
            old = 0.0
            while e >= 0:
                old += weights[e]
                cut[e] = False
                degree[vertices[e, 0]] -= 1
                degree[vertices[e, 1]] -= 1
                e = chain[e]
            num_touched, size = 0, 0
            distance[start] = 0.0
            touched[0] = start
            num_touched = 1
            size = push(keys, items, size, 0.0, np.int64(start))
            while size > 0:
                d, v = keys[0], items[0]
                size = pop(keys, items, size)
                if d > distance[v]:
                    continue
                if v == end:
                    break
                for i in range(first[v], first[v + 1]):
                    e = incident[i]
                    if cut[e] or not glued[e]:
                        continue
                    side = labels[halves[e, 0] // 3]
                    if side != one and side != two:
                        continue
                    w = vertices[e, 0] + vertices[e, 1] - v
                    if degree[w] > 0 and w != end:
                        continue
                    far = d + weights[e]
                    if far < distance[w]:
                        if distance[w] == np.inf:
                            touched[num_touched] = w
                            num_touched += 1
                        distance[w] = far
                        via[w] = e
                        size = push(keys, items, size, far, np.int64(w))
            shorter = distance[end] < old * (1 - 1e-9)
            if shorter:
                changed = True
                head[p] = -1
                lengths[p] = 0
                v = end
                while v != start:
                    e = via[v]
                    chain[e] = head[p]
                    head[p] = e
                    lengths[p] += 1
                    v = vertices[e, 0] + vertices[e, 1] - v
            e = head[p]
            while e >= 0:
                cut[e] = True
                degree[vertices[e, 0]] += 1
                degree[vertices[e, 1]] += 1
                e = chain[e]
            for i in range(num_touched):
                distance[touched[i]] = np.inf
            if shorter:  # faces on one side of the new path are one chart, all others the other
                e = head[p]
                for side in range(2):
                    mark = -2 - side
                    f = halves[e, side] // 3
                    if labels[f] < 0:
                        continue
                    labels[f] = mark
                    stack[0] = f
                    size = 1
                    while size > 0:
                        size -= 1
                        f = stack[size]
                        for k in range(3):
                            g = neighbors[f, k]
                            if g >= 0 and labels[g] >= 0 and not cut[face_edges[f, k]]:
                                labels[g] = mark
                                stack[size] = g
                                size += 1
                for f in range(len(labels)):
                    if labels[f] == -2:
                        labels[f] = one
                    elif labels[f] == -3:
                        labels[f] = two
        if not changed:
            break
    return cut
