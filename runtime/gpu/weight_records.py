"""Stored joint weights rearranged for the vertex shader: one record a 2 x 2 cell of the weight map.

A bilinear sample reads one cell. Its record holds a palette, the joints that any of its four texels has, and the four
texels' weights for them, in one fetch of 16 bytes: four joints, and 8-bit weights at four texels for the first three of
them; the fourth gets what these leave of one. Where more than four joints meet, further records follow, three joints
each. Equal cells are stored once; a rigid part of a character is a single record. Cells that no triangle reads have
none of their own. Where the map is too coarse, a cell is a quadtree (asset/weight_quadtree.py): its number is that of
a record of four further numbers, one a quarter. docs/drawing.md has the measurements against dense layers and against
joint lists a texel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.asset.weight_quadtree import WeightDetails, build_quadtree, no_details
from runtime.asset.weight_stack import unpack_pairs

RECORDS_WIDTH = 64  # records lie in rows of this many (shaders/include/skinning.glsl: RECORDS_WIDTH_LOG2)
MORE_RECORDS = 255  # in place of a record's fourth joint: the next record belongs to the cell too
NARROW_JOINTS = 255  # up to so many joints are numbered by bytes inside the records
JOINTS_PER_RECORD = 3  # with weights of their own


@dataclass(frozen=True)
class WeightCells:
    """Joint weights as the shaders read them. R rows of records.

    Attributes
    ----------
    first_record : (H - 1, W - 1) uint16 or uint32
        Of each cell (at least 1 x 1).
    first_divided : int
        Records from this number on are divided squares: four numbers of records, one a quarter.
    records : (R, 64, 4) uint32
        Four bytes of joints, then for each of the first three its weights at the texels (0,0), (1,0), (0,1), (1,1), a
        byte each, the first lowest.
    joints : (R, 64, 4) uint16 or None
        The joints, where there are more than bytes can number.
    max_records : int
        Most records that a cell has.
    """

    first_record: NDArray[Any]
    first_divided: int
    records: NDArray[np.uint32]
    joints: NDArray[np.uint16] | None
    max_records: int

    @property
    def nbytes(self) -> int:
        """Bytes of the textures."""
        return self.first_record.nbytes + self.records.nbytes + (0 if self.joints is None else self.joints.nbytes)


def _unique_rows(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct rows of small non-negative numbers, and which one each row is."""
    keys = np.zeros(len(rows), np.int64)
    for column in rows.T:  # fold columns into one number, kept small by ranking after each step
        keys = keys * (int(column.max(initial=0)) + 1) + column
        if keys.max(initial=0) > 1 << 40:
            keys = np.unique(keys, return_inverse=True)[1].astype(np.int64)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return rows[first], inverse.astype(np.int64)


def _cell_corners(
    stack: NDArray[Any], size: tuple[int, int], details: WeightDetails
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct texels (joints, then weights) of map and leaves, and which four each cell, then each leaf, blends."""
    joints, weights = unpack_pairs(stack, size)
    height, width, slots = joints.shape
    most = max(slots, details.joints.shape[-1])
    texels = np.zeros((height * width + 4 * len(details.depths), 2 * most), np.int64)
    for first, of_map, of_leaves in ((0, joints, details.joints), (most, weights, details.weights)):
        texels[: height * width, first : first + slots] = of_map.reshape(-1, slots)
        texels[height * width :, first : first + of_leaves.shape[-1]] = of_leaves.reshape(-1, of_leaves.shape[-1])
    kinds, kind_of = _unique_rows(texels)
    in_map = kind_of[: height * width].reshape(height, width)
    in_map = np.pad(in_map, ((0, int(height == 1)), (0, int(width == 1))), mode="edge")
    cells = np.stack([in_map[:-1, :-1], in_map[:-1, 1:], in_map[1:, :-1], in_map[1:, 1:]], axis=-1)
    return kinds, np.concatenate([cells.reshape(-1, 4), kind_of[height * width :].reshape(-1, 4)])


@dataclass(frozen=True)
class _Palettes:
    """Records of C distinct cells one after the other: joints (R, 4), words (R, 4, 4) bytes, first record (C + 1,)."""

    joints: NDArray[np.int64]
    packed: NDArray[np.uint8]
    starts: NDArray[np.int64]


def _write_records(cells: NDArray[np.int64], kinds: NDArray[np.int64]) -> _Palettes:
    """Each cell's palette in records of three joints and one more."""
    slots = kinds.shape[1] // 2
    cell_joints = kinds[cells][:, :, :slots].reshape(len(cells), 4 * slots)
    cell_weights = kinds[cells][:, :, slots:].reshape(len(cells), 4 * slots)
    unused = int(kinds[:, :slots].max()) + 1
    cell_joints = np.where(cell_weights > 0, cell_joints, unused)
    order = np.argsort(cell_joints, axis=1, kind="stable")
    sorted_joints = np.take_along_axis(cell_joints, order, axis=1)
    is_new = np.ones(sorted_joints.shape, bool)
    is_new[:, 1:] = sorted_joints[:, 1:] != sorted_joints[:, :-1]
    is_new &= sorted_joints < unused
    slot = np.cumsum(is_new, axis=1) - 1
    palette_size = is_new.sum(axis=1)
    num_records = np.maximum(-(-(palette_size - 1) // JOINTS_PER_RECORD), 1)
    starts = np.concatenate([[0], np.cumsum(num_records)])
    total = int(starts[-1])

    palettes = np.zeros((total, 4), np.int64)
    packed = np.zeros((total, 4, 4), np.uint8)  # record, word, texel; word 0 is for the joints
    cell_rows = np.broadcast_to(np.arange(len(cells))[:, None], order.shape)
    is_last = slot == (palette_size - 1)[:, None]  # the joint that gets what the others leave
    record = starts[cell_rows] + np.where(is_last, num_records[:, None] - 1, slot // JOINTS_PER_RECORD)
    place = np.where(is_last, 3, slot % JOINTS_PER_RECORD)
    own = (sorted_joints < unused) & ~is_last
    entry_weights = np.take_along_axis(cell_weights, order, axis=1)
    packed[record[own], 1 + place[own], (order // slots)[own]] = entry_weights[own]
    palettes[record[is_new], place[is_new]] = sorted_joints[is_new]
    followed = np.ones(total, bool)
    followed[starts[1:] - 1] = False
    packed[:, 0] = palettes & 255
    packed[:, 0, 3] = np.where(followed, MORE_RECORDS, np.minimum(palettes[:, 3], MORE_RECORDS - 1))
    return _Palettes(palettes, packed, starts)


def build_weight_cells(
    stack: NDArray[Any],
    size: tuple[int, int],
    num_joints: int,
    details: WeightDetails | None = None,
    touched: NDArray[np.bool_] | None = None,
) -> WeightCells:
    """Make the records of all cells.

    Parameters
    ----------
    stack : (2 * N * H, W, 4) uint8 or uint16
        As `runtime.asset.weight_stack` packs it.
    size : (W, H)
    num_joints : int
    details : WeightDetails, optional
        Where the map is too coarse.
    touched : (H - 1, W - 1) bool, optional
        Cells that are read at all; the others may hold anything.

    Returns
    -------
    WeightCells
    """
    details = no_details() if details is None else details
    kinds, corners = _cell_corners(stack, size, details)
    columns, rows = max(size[0] - 1, 1), max(size[1] - 1, 1)
    tree = build_quadtree(details)
    divided_cells = tree.cells[:, 1] * columns + tree.cells[:, 0]
    wanted = np.ones(rows * columns, bool) if touched is None else touched.ravel().copy()
    wanted[divided_cells] = False
    wanted[0] |= not wanted.any()
    wanted = np.concatenate([wanted, np.ones(len(details.depths), bool)])
    distinct, of_wanted = _unique_rows(corners[wanted])
    palettes = _write_records(distinct, kinds)
    total = int(palettes.starts[-1])

    record_of = np.zeros(len(corners), np.int64)
    record_of[wanted] = palettes.starts[of_wanted]
    record_of_node = np.concatenate([record_of[rows * columns :], total + np.arange(len(tree.children))])
    first = record_of[: rows * columns]
    first[divided_cells] = record_of_node[tree.cell_nodes]

    height = -(-(total + len(tree.children)) // RECORDS_WIDTH)
    records = np.zeros((height * RECORDS_WIDTH, 4), np.uint32)
    records[:total] = palettes.packed.reshape(total, 16).view("<u4")
    records[total : total + len(tree.children)] = record_of_node[tree.children]
    joints = np.zeros((height * RECORDS_WIDTH, 4), np.uint16)
    joints[:total] = palettes.joints
    return WeightCells(
        first_record=first.reshape(rows, columns).astype(np.uint16 if first.max(initial=0) <= 0xFFFF else np.uint32),
        first_divided=total,
        records=records.reshape(height, RECORDS_WIDTH, 4),
        joints=joints.reshape(height, RECORDS_WIDTH, 4) if num_joints > NARROW_JOINTS else None,
        max_records=int(np.diff(palettes.starts).max()),
    )
