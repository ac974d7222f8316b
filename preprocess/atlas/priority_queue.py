"""A binary heap in two plain arrays, for compiled kernels.

Equal keys leave in the order of their items, so that the result never depends on the order of insertion.
"""

from __future__ import annotations

from preprocess.numerics.jit import helper


@helper
def push(keys, items, size, key, item):  # type: ignore[no-untyped-def]
    """Add an item; returns the new size."""
    i = size
    while i > 0:
        p = (i - 1) // 2
        if key > keys[p] or (key == keys[p] and item >= items[p]):
            break
        keys[i] = keys[p]
        items[i] = items[p]
        i = p
    keys[i] = key
    items[i] = item
    return size + 1


@helper
def pop(keys, items, size):  # type: ignore[no-untyped-def]
    """Remove the first item; returns the new size."""
    size -= 1
    key, item = keys[size], items[size]
    i = 0
    while True:
        c = 2 * i + 1
        if c >= size:
            break
        if c + 1 < size and (keys[c + 1] < keys[c] or (keys[c + 1] == keys[c] and items[c + 1] < items[c])):
            c += 1
        if keys[c] > key or (keys[c] == key and items[c] >= item):
            break
        keys[i] = keys[c]
        items[i] = items[c]
        i = c
    keys[i] = key
    items[i] = item
    return size
