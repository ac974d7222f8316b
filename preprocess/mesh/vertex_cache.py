"""Order faces so that a GPU's post-transform cache meets each vertex again soon (Sander, Nehab and Barczak 2007).

Their "tipsify": fan out around one vertex after another, next the one whose remaining faces still find it in the
cache, else the last fanning vertex with faces left. Linear in the faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Ints
from preprocess.numerics.jit import fixed_memory_entry as entry

CACHE_SIZE = 16


@entry
def _tipsify(corners, start, incident, live, stamp, dead_ends, cache_size, order):
    """Fill `order` with face numbers; `start` and `incident` list each vertex's faces, the others are scratch."""
    num_faces = len(order)
    emitted, dead_end, time, cursor, fan = 0, 0, cache_size + 1, 0, -1
    while emitted < num_faces:
        if fan < 0:
            while dead_end > 0 and fan < 0:
                dead_end -= 1
                if live[dead_ends[dead_end]] > 0:
                    fan = dead_ends[dead_end]
            while fan < 0:
                if live[cursor] > 0:
                    fan = cursor
                cursor += 1
        first_new = dead_end
        for i in range(start[fan], start[fan + 1]):
            f = incident[i]
            if corners[f, 0] < 0:
                continue
            order[emitted] = f
            emitted += 1
            for k in range(3):
                v = corners[f, k]
                dead_ends[dead_end] = v
                dead_end += 1
                live[v] -= 1
                if time - stamp[v] > cache_size:
                    stamp[v] = time
                    time += 1
            corners[f, 0] = -1
        best, fan = -1, -1
        for i in range(first_new, dead_end):
            v = dead_ends[i]
            if live[v] > 0:
                priority = 0
                if time - stamp[v] + 2 * live[v] <= cache_size:
                    priority = time - stamp[v]
                if priority > best:
                    best, fan = priority, v


def cache_order(faces: Ints, num_vertices: int) -> NDArray[np.int64]:
    """An order of faces with few cache misses.

    Parameters
    ----------
    faces : (F, 3) int32
        Into the vertices as they are drawn (texture vertices).
    num_vertices : int

    Returns
    -------
    (F,) int64
    """
    corners = faces.astype(np.int64)
    count = np.bincount(corners.ravel(), minlength=num_vertices)
    incident = np.argsort(corners.ravel(), kind="stable") // 3
    order = np.zeros(len(faces), np.int64)
    _tipsify(
        corners,
        np.r_[0, np.cumsum(count)],
        incident,
        count.copy(),
        np.zeros(num_vertices, np.int64),
        np.zeros(3 * len(faces) + 1, np.int64),
        CACHE_SIZE,
        order,
    )
    return order


def miss_ratio(faces: Ints, cache_size: int = CACHE_SIZE) -> float:
    """Vertices transformed per face with a first-in first-out cache: 3 at worst, about 0.5 at best."""
    cache: list[int] = []
    misses = 0
    for vertex in faces.ravel().tolist():
        if vertex not in cache:
            misses += 1
            cache = [*cache[-(cache_size - 1) :], vertex]
    return misses / max(len(faces), 1)


def reorder(faces: Ints, face_uvs: Ints) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Orders of faces, surface vertices and texture vertices: the latter two by first use, for the fetch cache.

    Returns
    -------
    face_order : (F,) int64
    vertex_order : (V,) int64
    uv_order : (T,) int64
    """
    order = cache_order(face_uvs, int(face_uvs.max()) + 1)
    return order, _by_first_use(faces[order]), _by_first_use(face_uvs[order])


def _by_first_use(corners: Ints) -> NDArray[np.int64]:
    vertices, first = np.unique(corners.ravel(), return_index=True)
    return vertices[np.argsort(first, kind="stable")].astype(np.int64)
