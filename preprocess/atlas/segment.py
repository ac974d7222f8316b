"""Compact, nearly flat regions of a mesh: variational shape approximation.

Cohen-Steiner, Alliez and Desbrun 2004. A face is a point of six coordinates, its unit normal and its centroid scaled
by the size that a region should have; a region's proxy is the mean of its faces. Regions grow from their seeds, the
cheapest face first, proxies and seeds are refitted, and so on (Lloyd's iteration, their section 3). The centroid term
keeps regions compact where the mesh is flat. No randomness: seeds are the faces farthest from all earlier ones.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.atlas.priority_queue import pop, push
from preprocess.numerics.jit import entry, helper

COMPACTNESS = 0.25
"""Weight of a centroid's distance, in radii of a fair region, beside the distance of unit normals."""

ITERATIONS = 10
"""Lloyd iterations; the labels of the test characters change by under 1 % of the faces after eight."""


def grow_regions(
    neighbors: Ints,
    areas: Floats,
    normals: Floats,
    centroids: Floats,
    domains: Ints,
    counts: Ints,
    compactness: float = COMPACTNESS,
) -> tuple[int, Ints]:
    """Split every domain of faces into connected regions.

    Parameters
    ----------
    neighbors : (F, 3) int32
        Face across each edge, -1 for none. Regions never cross a domain's border.
    areas : (F,) float64
    normals, centroids : (F, 3) float64
    domains : (F,) int32
        Domain of each face; each is connected. -1: leave the face alone.
    counts : (D,) int32
        Regions wanted in each domain, at least 1 each; a domain gets no more than it has faces.

    compactness : float
        Weight of the distance from the region's centre.

    Returns
    -------
    count : int
    regions : (F,) int32
        -1 where the domain is -1.
    """
    num_domains = len(counts)
    inside = np.flatnonzero(domains >= 0)
    order = inside[np.argsort(domains[inside], kind="stable")].astype(np.int32)
    size = np.bincount(domains[inside], minlength=num_domains)
    first = np.r_[0, np.cumsum(size)].astype(np.int64)
    counts = np.minimum(np.maximum(counts, 1), size).astype(np.int32)
    domain_area = np.bincount(domains[inside], areas[inside], minlength=num_domains)
    radius = np.sqrt(domain_area / (np.pi * np.maximum(counts, 1)))
    scale = np.zeros(len(areas))
    scale[inside] = (np.sqrt(compactness) / np.where(radius > 0, radius, 1))[domains[inside]]
    points = np.ascontiguousarray(np.concatenate([normals, centroids * scale[:, None]], axis=1))
    seeds = np.empty(int(counts.sum()), np.int64)
    _spread_seeds(points, order, first, counts, np.full(len(points), np.inf), seeds)
    regions = np.full(len(areas), -1, np.int64)
    _grow(neighbors, areas, points, domains, seeds, regions, ITERATIONS)
    return len(seeds), regions.astype(np.int32)


@entry
def _spread_seeds(points, order, first, counts, distance, seeds):  # type: ignore[no-untyped-def]
    """Farthest-point sampling in every domain; the first seed is the face farthest from the domain's mean."""
    n = 0
    middle = np.empty(6)
    for d in range(len(counts)):
        low, high = first[d], first[d + 1]
        if high == low:
            continue
        for k in range(6):
            middle[k] = 0.0
            for i in range(low, high):
                middle[k] += points[order[i], k] / (high - low)
        for s in range(counts[d]):
            best, far = -1, -1.0
            for i in range(low, high):
                f = order[i]
                e = 0.0
                for k in range(6):
                    e += (points[f, k] - middle[k]) ** 2
                if s > 0:
                    e = min(e, distance[f])
                    distance[f] = e
                if e > far:
                    best, far = f, e
            seeds[n] = best
            distance[best] = -1.0  # never again, not even among coincident faces
            for k in range(6):
                middle[k] = points[best, k]
            n += 1


@entry
def _grow(neighbors, areas, points, domains, seeds, labels, iterations):  # type: ignore[no-untyped-def]
    """Lloyd's iteration: flood from the seeds with a heap, refit proxies and seeds. `seeds` is overwritten."""
    num_faces, num_regions = len(neighbors), len(seeds)
    proxies = np.empty((num_regions, 6))
    total = np.empty(num_regions)
    for r in range(num_regions):
        for k in range(6):
            proxies[r, k] = points[seeds[r], k]
    keys = np.empty(3 * num_faces + num_regions + 1)
    items = np.empty(len(keys), np.int64)  # face times the number of regions, plus the region
    for step in range(iterations):
        for f in range(num_faces):
            labels[f] = -1
        size = 0
        for r in range(num_regions):
            size = push(keys, items, size, -1.0, seeds[r] * num_regions + r)
        while size > 0:
            f, r = items[0] // num_regions, items[0] % num_regions
            size = pop(keys, items, size)
            if labels[f] >= 0:
                continue
            labels[f] = r
            for k in range(3):
                g = np.int64(neighbors[f, k])
                if g >= 0 and labels[g] < 0 and domains[g] == domains[f]:
                    size = push(keys, items, size, _distance_sq(points, g, proxies, r), g * num_regions + r)
        if step == iterations - 1:
            break
        for r in range(num_regions):
            total[r] = 0.0
            for k in range(6):
                proxies[r, k] = 0.0
        for f in range(num_faces):
            r = labels[f]
            if r >= 0:
                weight = max(areas[f], 1e-300)
                total[r] += weight
                for k in range(6):
                    proxies[r, k] += weight * points[f, k]
        for r in range(num_regions):
            length = 0.0
            for k in range(6):
                proxies[r, k] /= total[r]
            for k in range(3):
                length += proxies[r, k] ** 2
            if length > 0.0:
                for k in range(3):
                    proxies[r, k] /= np.sqrt(length)
            total[r] = np.inf  # from here on: the least error of a face, which becomes the seed
        for f in range(num_faces):
            r = labels[f]
            if r >= 0:
                e = _distance_sq(points, np.int64(f), proxies, r)
                if e < total[r]:
                    total[r] = e
                    seeds[r] = f


@helper
def _distance_sq(a, i, b, j):  # type: ignore[no-untyped-def]
    e = 0.0
    for k in range(6):
        e += (a[i, k] - b[j, k]) ** 2
    return e
