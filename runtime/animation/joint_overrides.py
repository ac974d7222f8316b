"""Joints that code sets (physics, IK), for the rows of a mixer. Most crowds never do: arrays appear at the first use.

Letters in shapes: R rows, A rows asked for, J joints, N nodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.skeleton import Skeleton
from runtime.validation import describe

Floats = NDArray[np.floating[Any]]
Rows = NDArray[np.int64]


class JointsFromCode:
    """Object-space matrices and local rotations by row; NaN where a node keeps its own."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        self._matrices: Floats | None = None
        self._rotations: Floats | None = None

    def clear(self, row: int) -> None:
        """Leave a row to its clips."""
        for array in (self._matrices, self._rotations):
            if array is not None:
                array[row] = np.nan

    def grow(self, capacity: int) -> None:
        """Make room for more rows."""
        for name in ("_matrices", "_rotations"):
            array = getattr(self, name)
            if array is not None:
                longer = np.full((capacity, *array.shape[1:]), np.nan, dtype=array.dtype)
                longer[: len(array)] = array
                setattr(self, name, longer)

    def set_matrices(self, row: int, capacity: int, matrices: ArrayLike | None) -> None:
        """Object-space matrices (J, 4, 4) of one row's joints, NaN where a joint keeps its own; None undoes."""
        given = self._checked(matrices, (self._skeleton.num_joints, 4, 4))
        if given is None:
            if self._matrices is not None:
                self._matrices[row] = np.nan
            return
        if self._matrices is None:
            self._matrices = np.full((capacity, self._skeleton.num_nodes, 3, 4), np.nan, dtype=np.float32)
        self._matrices[row] = np.nan
        self._matrices[row, self._skeleton.joint_nodes] = given[:, :3]

    def set_rotations(self, row: int, capacity: int, rotations: ArrayLike | None) -> None:
        """Local rotations (J, 4) of one row's joints, NaN where a joint keeps its own; None undoes."""
        given = self._checked(rotations, (self._skeleton.num_joints, 4))
        if given is None:
            if self._rotations is not None:
                self._rotations[row] = np.nan
            return
        if self._rotations is None:
            self._rotations = np.full((capacity, self._skeleton.num_nodes, 4), np.nan, dtype=np.float32)
        lengths = np.linalg.norm(given, axis=1, keepdims=True)
        self._rotations[row] = np.nan
        self._rotations[row, self._skeleton.joint_nodes] = given / np.where(lengths > 0, lengths, np.nan)

    def matrices(self, rows: Rows) -> Floats | None:
        """Matrices of some rows' nodes, (A, N, 3, 4); None when none were ever set."""
        return None if self._matrices is None else self._matrices[rows]

    def rotations(self, rows: Rows) -> Floats | None:
        """Rotations of some rows' nodes, (A, N, 4); None when none were ever set."""
        return None if self._rotations is None else self._rotations[rows]

    @staticmethod
    def _checked(values: ArrayLike | None, shape: tuple[int, ...]) -> Floats | None:
        """What a caller gave, checked."""
        if values is None:
            return None
        try:
            given = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"joints must be an array of numbers, not {describe(values)}") from None
        if given.shape != shape:
            raise ValueError(f"joints need shape {shape}, not {given.shape}: one entry a joint, NaN to leave one alone")
        if np.isinf(given).any():
            raise ValueError("a joint is infinite; use NaN to leave one alone")
        return given
