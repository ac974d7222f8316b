"""Regions that a projection onto their mean plane lays out: connected faces whose normals lie in a cone.

They are where an unwrap starts; `merge` joins them into charts, so their borders need not be good ones.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.numerics.jit import entry

CONE_COSINE = 0.8
"""Of the angle between a face's normal and its region's mean, and its seed's. From 0.6 to 0.9 the charts that come out
of merging hardly differ in number, stretch or seams; below, some regions fold."""

MOST_FACES = 150
"""In a region: merging, not growing, finds the larger charts, and knows what they cost."""


def grow_regions(neighbors: Ints, normals: Floats, areas: Floats, groups: Ints) -> tuple[int, Ints]:
    """Flood regions from the largest faces on.

    Parameters
    ----------
    neighbors : (F, 3) int32
        Face across each edge, -1 where there is none.
    normals : (F, 3) float64
        Unit normals; zero for faces without area, which end up alone.
    areas : (F,) float64
    groups : (F,) int32
        A region keeps to one.

    Returns
    -------
    count : int
    regions : (F,) int32
    """
    order = np.argsort(-areas, kind="stable")
    regions = np.full(len(neighbors), -1, np.int32)
    queue = np.empty(MOST_FACES, np.int64)
    return _flood(neighbors, normals, areas, groups, order, CONE_COSINE, regions, queue), regions


@entry
def _flood(neighbors, normals, areas, groups, order, cosine, regions, queue):  # type: ignore[no-untyped-def]
    """Breadth first from each face that is still free; returns the number of regions."""
    count = 0
    for seed in order:
        if regions[seed] >= 0:
            continue
        regions[seed] = count
        sx, sy, sz = normals[seed]
        mx, my, mz = areas[seed] * sx, areas[seed] * sy, areas[seed] * sz  # area times mean normal
        queue[0] = seed
        head, tail = 0, 1
        while head < tail:
            f = queue[head]
            head += 1
            for k in range(3):
                g = neighbors[f, k]
                if g < 0 or regions[g] >= 0 or groups[g] != groups[seed] or tail == len(queue):
                    continue
                x, y, z = normals[g]
                length = np.sqrt(mx * mx + my * my + mz * mz)
                if x * mx + y * my + z * mz <= cosine * length or x * sx + y * sy + z * sz <= cosine:
                    continue
                regions[g] = count
                mx, my, mz = mx + areas[g] * x, my + areas[g] * y, mz + areas[g] * z
                queue[tail] = g
                tail += 1
        count += 1
    return count
