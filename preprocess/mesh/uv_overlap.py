"""Whether an atlas is one-to-one: no two uv triangles share an inner point. Exact, in near-linear time.

Two triangles are apart when some edge of one has the other on its outer side or on its line (separating axes), so the
answer needs nothing but exact signs of orientations (`predicates`). A uniform grid finds the pairs to test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.mesh.predicates import face_orientation, orient
from preprocess.numerics.jit import entry, helper

CELLS_PER_FACE = 12
"""Grid cells that faces may touch on average; the grid is coarsened until they do."""

MAX_PAIRS_PER_FACE = 4
"""Overlapping pairs are counted no further than this: an answer of "far too many" needs no exact number."""


@dataclass(frozen=True)
class Overlap:
    """What keeps uvs from being one-to-one.

    Attributes
    ----------
    num_pairs : int
        Pairs of faces whose uv triangles share an inner point; counting stops at four a face.
    num_flat : int
        Faces whose uv triangle has no area.
    faces : (F,) bool
        Faces known to overlap another, or flat.
    """

    num_pairs: int
    num_flat: int
    faces: np.ndarray

    @property
    def one_to_one(self) -> bool:
        """Whether no two points of the surface share a uv."""
        return self.num_pairs == 0 and self.num_flat == 0


def find_overlap(uvs: Floats, face_uvs: Ints) -> Overlap:
    """Test exactly whether uv triangles overlap.

    Parameters
    ----------
    uvs : (T, 2) float64, finite
    face_uvs : (F, 3) int32

    Returns
    -------
    Overlap
    """
    turn = face_orientation(uvs, face_uvs)
    flat = turn == 0
    bad = flat.copy()
    real = np.flatnonzero(~flat)
    if len(real) < 2:
        return Overlap(0, int(flat.sum()), bad)
    triangles = uvs[face_uvs[real]]
    triangles = np.where((turn[real] > 0)[:, None, None], triangles, triangles[:, ::-1])  # all counter-clockwise
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    origin, extent = low.min(axis=0), np.ptp(np.concatenate([low, high]), axis=0)
    cells = max(int(np.sqrt(len(real))), 1)
    while True:
        size = np.maximum(extent / cells, 1e-300)
        first = np.minimum(((low - origin) / size).astype(np.int64), cells - 1)
        last = np.minimum(((high - origin) / size).astype(np.int64), cells - 1)
        touched = (last - first + 1).prod(axis=1)
        if cells == 1 or touched.sum() <= CELLS_PER_FACE * len(real):
            break
        cells = (cells + 1) // 2
    triangles = np.ascontiguousarray(triangles)
    start = np.zeros(cells * cells + 1, np.int64)
    items = np.empty(int(touched.sum()), np.int64)
    hit = np.zeros(len(real), bool)
    limit = MAX_PAIRS_PER_FACE * len(real)
    pairs = _count_pairs(triangles, low, high, first, last, cells, limit, start, items, hit)
    bad[real[hit]] = True
    return Overlap(int(pairs), int(flat.sum()), bad)


@helper
def _apart(triangles, f, g, terms):  # type: ignore[no-untyped-def]
    """Whether an edge of triangle f (counter-clockwise) has all of g on its right or on its line."""
    for k in range(3):
        m = (k + 1) % 3
        outside = True
        for n in range(3):
            turn = orient(
                triangles[f, k, 0], triangles[f, k, 1], triangles[f, m, 0], triangles[f, m, 1], triangles[g, n, 0],
                triangles[g, n, 1], terms,
            )  # fmt: skip
            if turn > 0:
                outside = False
                break
        if outside:
            return True
    return False


@entry
def _count_pairs(triangles, low, high, first, last, cells, limit, start, items, hit):  # type: ignore[no-untyped-def]
    """Overlapping pairs of counter-clockwise triangles, and which are in any."""
    num = len(triangles)
    for f in range(num):
        for y in range(first[f, 1], last[f, 1] + 1):
            for x in range(first[f, 0], last[f, 0] + 1):
                start[y * cells + x] += 1
    for c in range(cells * cells):
        start[c + 1] += start[c]
    for f in range(num):
        for y in range(first[f, 1], last[f, 1] + 1):
            for x in range(first[f, 0], last[f, 0] + 1):
                start[y * cells + x] -= 1  # the cells are filled from their ends, and start where they should
                items[start[y * cells + x]] = f
    terms = np.empty(16)
    pairs = 0
    for c in range(cells * cells):
        cx, cy = c % cells, c // cells
        for i in range(start[c], start[c + 1]):
            f = items[i]
            for j in range(i + 1, start[c + 1]):
                g = items[j]
                # each pair once: in the first cell that both touch
                if max(first[f, 0], first[g, 0]) != cx or max(first[f, 1], first[g, 1]) != cy:
                    continue
                if high[f, 0] <= low[g, 0] or high[g, 0] <= low[f, 0]:
                    continue
                if high[f, 1] <= low[g, 1] or high[g, 1] <= low[f, 1]:
                    continue
                if not _apart(triangles, f, g, terms) and not _apart(triangles, g, f, terms):
                    pairs += 1
                    hit[f] = True
                    hit[g] = True
                    if pairs >= limit:
                        return pairs
    return pairs
