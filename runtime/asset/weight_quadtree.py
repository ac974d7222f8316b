"""Joint weights finer than their texture, where a 2 x 2 cell of it is too coarse: a quadtree of cells of their own.

A leaf is a square of the atlas with weights at its four corners, blended as a cell's four texels are. Leaves of depth
0 replace a cell, those of depth 1 a quarter of one, and so on; the leaves in a cell cover it. docs/format.md has the
file.
Letters in shapes: L leaves, K joints a corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.asset.weight_stack import WEIGHT_STEPS, stored_step, unpack_steps
from runtime.errors import AssetError

LEAVES_PER_ROW = 64  # of the image, two texels each
MAX_DEPTH = 8


@dataclass(frozen=True)
class WeightDetails:
    """Leaves of the quadtrees.

    Attributes
    ----------
    depths : (L,) int64
    places : (L, 2) int64
        Column and row in the grid of all squares of that depth: cells of the weight map, times two to the depth.
    joints, weights : (L, 4, K) int64
        At the corners (0,0), (1,0), (0,1), (1,1). Weights count to 255.
    """

    depths: NDArray[np.int64]
    places: NDArray[np.int64]
    joints: NDArray[np.int64]
    weights: NDArray[np.int64]


def no_details(slots: int = 1) -> WeightDetails:
    """No leaves at all."""
    corners = np.zeros((0, 4, slots), np.int64)
    return WeightDetails(np.zeros(0, np.int64), np.zeros((0, 2), np.int64), corners, corners)


def details_size(num_leaves: int, slots: int) -> tuple[int, int]:
    """Width and height of the image that holds them."""
    return 2 * LEAVES_PER_ROW, 2 * _leaf_rows(num_leaves) * (2 * -(-slots // 4) + 1)


def _leaf_rows(num_leaves: int) -> int:
    return -(-num_leaves // LEAVES_PER_ROW)


def _blocks(image: NDArray[Any], num_leaves: int) -> NDArray[np.int64]:
    """The four texels of each leaf: (L, 4, 4)."""
    rows = image.shape[0] // 2
    blocks = image.reshape(rows, 2, LEAVES_PER_ROW, 2, 4).transpose(0, 2, 1, 3, 4).reshape(-1, 4, 4)
    return blocks[:num_leaves].astype(np.int64)


def pack_details(details: WeightDetails, wide: bool) -> NDArray[Any]:
    """The image of the leaves: joints and weights as a weight map's stack has them, then a plane of places.

    Parameters
    ----------
    details : WeightDetails
    wide : bool
        Whether joints take 16 bits.

    Returns
    -------
    (H, W, 4) uint8 or uint16
    """
    num_leaves, _, slots = details.joints.shape
    num_lists = -(-slots // 4)
    width, height = details_size(num_leaves, slots)
    rows = _leaf_rows(num_leaves)
    planes = np.zeros((2 * num_lists + 1, rows * LEAVES_PER_ROW, 4, 4), np.int64)
    missing = ((0, 0), (0, 0), (0, 4 * num_lists - slots))
    steps = details.weights * stored_step(np.uint16 if wide else np.uint8)
    lists = [np.pad(values, missing) for values in (details.joints, steps)]
    for number in range(num_lists):
        for kind in range(2):
            planes[2 * number + kind, :num_leaves] = lists[kind][:, :, 4 * number : 4 * number + 4]
    x, y = details.places.T
    planes[-1, :num_leaves, 0] = np.stack([x & 255, x >> 8, y & 255, y >> 8], axis=1)
    planes[-1, :num_leaves, 1, 0] = details.depths
    texels = planes.reshape(-1, rows, LEAVES_PER_ROW, 2, 2, 4).transpose(0, 1, 3, 2, 4, 5)
    return np.ascontiguousarray(texels.reshape(height, width, 4).astype(np.uint16 if wide else np.uint8))


def unpack_details(image: NDArray[Any], num_leaves: int, where: str) -> WeightDetails:
    """Leaves from their image, the inverse of `pack_details`.

    Raises
    ------
    AssetError
        If an address is none.
    """
    planes = image.reshape(-1, 2 * _leaf_rows(num_leaves), 2 * LEAVES_PER_ROW, 4)
    blocks = [_blocks(plane, num_leaves) for plane in planes]
    joints = np.concatenate(blocks[:-1:2], axis=-1)
    weights = unpack_steps(np.concatenate(blocks[1:-1:2], axis=-1).astype(image.dtype))
    address = blocks[-1]
    places = np.stack([address[:, 0, 0] + 256 * address[:, 0, 1], address[:, 0, 2] + 256 * address[:, 0, 3]], axis=1)
    depths = address[:, 1, 0]
    if (depths > MAX_DEPTH).any() or (weights.sum(axis=-1) != WEIGHT_STEPS).any():
        raise AssetError(f"{where} is damaged: build the character again with python -m preprocess")
    return WeightDetails(depths, places, joints, weights)


@dataclass(frozen=True)
class Quadtree:
    """Squares that are divided, by depth, and what lies in them.

    Attributes
    ----------
    cells : (C, 2) int64
        Column and row of the map's cells that have leaves.
    cell_nodes : (C,) int64
        What each of them is: leaf n is n, divided square m is L + m.
    children : (M, 4) int64
        The quarters of every divided square, likewise, (0,0), (1,0), (0,1), (1,1).
    """

    cells: NDArray[np.int64]
    cell_nodes: NDArray[np.int64]
    children: NDArray[np.int64]


def build_quadtree(details: WeightDetails, where: str = "weight details") -> Quadtree:
    """Find the divided squares above the leaves.

    Raises
    ------
    AssetError
        If a square has some quarters and not all, or two leaves are in one place.
    """
    num_leaves = len(details.depths)
    children: list[NDArray[np.int64]] = []
    num_divided = 0
    places, nodes = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    for depth in range(int(details.depths.max(initial=0)), -1, -1):
        here = np.flatnonzero(details.depths == depth)
        places, nodes = np.concatenate([places, details.places[here]]), np.concatenate([nodes, here])
        order = np.lexsort((places[:, 0], places[:, 1]))
        places, nodes = places[order], nodes[order]
        if len(places) and (np.diff(places, axis=0) == 0).all(axis=1).any():
            raise AssetError(f"{where} have two squares in one place: build the character again")
        if depth == 0:
            break
        parents = places // 2
        order = np.lexsort((places[:, 0], places[:, 1], parents[:, 0], parents[:, 1]))
        if len(order) % 4 or (parents[order].reshape(-1, 4, 2) != parents[order][::4, None]).any():
            raise AssetError(f"{where} have squares without all their quarters: build the character again")
        children.append(nodes[order].reshape(-1, 4))
        places = parents[order][::4]
        nodes = num_leaves + num_divided + np.arange(len(places))
        num_divided += len(places)
    return Quadtree(places, nodes, np.concatenate(children) if children else np.zeros((0, 4), np.int64))
