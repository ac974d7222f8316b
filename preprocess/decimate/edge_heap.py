"""A binary heap of edges that knows where each edge is, so that a changed cost moves it instead of leaving a stale one.

`cost` and `item` are in heap order; an edge's place in them is column PLACE of its row in `links`, -1 when it is not
in. Ties are broken by the edge's number, so two runs agree.
"""

from __future__ import annotations

from preprocess.decimate.rules import HEAP_SIZE, PLACE
from preprocess.numerics.jit import fixed_memory_helper as helper


@helper
def _sift(costs, items, links, size, i, cost, item):
    """Put an entry at position i or wherever it belongs above or below."""
    while i > 0:
        parent = (i - 1) >> 1
        other = costs[parent]
        if other < cost or (other == cost and items[parent] <= item):
            break
        costs[i] = other
        items[i] = items[parent]
        links[items[i], PLACE] = i
        i = parent
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        if child + 1 < size:
            left, right = costs[child], costs[child + 1]
            if right < left or (right == left and items[child + 1] < items[child]):
                child += 1
        other = costs[child]
        if cost < other or (cost == other and item <= items[child]):
            break
        costs[i] = other
        items[i] = items[child]
        links[items[i], PLACE] = i
        i = child
    costs[i] = cost
    items[i] = item
    links[item, PLACE] = i


@helper
def heap_set(costs, items, links, counter, item, cost):
    """Insert an edge or change its cost."""
    i = links[item, PLACE]
    if i < 0:
        i = counter[HEAP_SIZE]
        counter[HEAP_SIZE] += 1
    _sift(costs, items, links, counter[HEAP_SIZE], i, cost, item)


@helper
def heap_remove(costs, items, links, counter, item):
    """Take an edge out; does nothing where it is not in."""
    i = links[item, PLACE]
    if i < 0:
        return
    links[item, PLACE] = -1
    counter[HEAP_SIZE] -= 1
    last = counter[HEAP_SIZE]
    if i != last:
        _sift(costs, items, links, last, i, costs[last], items[last])
