"""A binary heap of edges that knows where each edge is, so that a changed cost moves it instead of leaving a stale one.

Arrays, all of one length: `cost` and `item` in heap order, `place` from an edge's number to its heap position (-1 when
it is not in). `size` is an array of one number. Ties are broken by the edge's number, so two runs agree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from preprocess.decimate.jit import helper


class Heap(NamedTuple):
    """Storage; see the module's text."""

    cost: NDArray[np.float64]
    item: NDArray[np.int64]
    place: NDArray[np.int64]
    size: NDArray[np.int64]


def make_heap(capacity: int) -> Heap:
    """An empty heap for edges numbered below `capacity`."""
    return Heap(
        np.empty(capacity), np.empty(capacity, np.int64), np.full(capacity, -1, np.int64), np.zeros(1, np.int64)
    )


@helper
def _sift(heap, i, cost, item):
    """Put an entry at position i or wherever it belongs above or below."""
    while i > 0:
        parent = (i - 1) >> 1
        other = heap.cost[parent]
        if other < cost or (other == cost and heap.item[parent] <= item):
            break
        heap.cost[i] = other
        heap.item[i] = heap.item[parent]
        heap.place[heap.item[i]] = i
        i = parent
    size = heap.size[0]
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        if child + 1 < size:
            left, right = heap.cost[child], heap.cost[child + 1]
            if right < left or (right == left and heap.item[child + 1] < heap.item[child]):
                child += 1
        other = heap.cost[child]
        if cost < other or (cost == other and item <= heap.item[child]):
            break
        heap.cost[i] = other
        heap.item[i] = heap.item[child]
        heap.place[heap.item[i]] = i
        i = child
    heap.cost[i] = cost
    heap.item[i] = item
    heap.place[item] = i


@helper
def heap_set(heap, item, cost):
    """Insert an edge or change its cost."""
    i = heap.place[item]
    if i < 0:
        i = heap.size[0]
        heap.size[0] += 1
    _sift(heap, i, cost, item)


@helper
def heap_remove(heap, item):
    """Take an edge out; does nothing where it is not in."""
    i = heap.place[item]
    if i < 0:
        return
    heap.place[item] = -1
    heap.size[0] -= 1
    last = heap.size[0]
    if i != last:
        _sift(heap, i, heap.cost[last], heap.item[last])
