"""Morph targets (blend shapes) of a mesh: where each moves the vertices, and how it turns the normals there.

A morph of weight w moves a vertex by w times its shift and turns a normal n there into n + w T n, a turn T a vertex.
Files say how each corner's normal changes; the corners of a vertex on a hard edge have several normals, and T is the
matrix that does to each what the file says, the smallest one: one answer for a vertex, whatever its corners.
Letters in shapes: V vertices, N touched vertices, M morphs, S shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from preprocess.arrays import Floats, Indices

# Directions in which a vertex's corners disagree less than this (squares of lengths, of the longest) are one normal.
SAME_DIRECTION = 0.01
SHAPES = 8  # in which levels are costed and measured, beside the poses


@dataclass(frozen=True)
class Morph:
    """One target.

    Attributes
    ----------
    name : str
    default : float
        Its weight at rest.
    vertices : (N,) int64, rising
        Those that it moves or turns.
    shifts : (N, 3) float64, metres, object space
    turns : (N, 3, 3) float64
    """

    name: str
    default: float
    vertices: Indices
    shifts: Floats
    turns: Floats

    def dense_shifts(self, num_vertices: int) -> Floats:
        """Shift of every vertex, (V, 3)."""
        dense = np.zeros((num_vertices, 3))
        dense[self.vertices] = self.shifts
        return dense

    def dense_rows(self, num_vertices: int) -> Floats:
        """Of every vertex three rows of four, the turn and the shift, (V, 12)."""
        dense = np.zeros((num_vertices, 3, 4))
        dense[self.vertices, :, :3] = self.turns
        dense[self.vertices, :, 3] = self.shifts
        return dense.reshape(num_vertices, 12)


def shift_vertices(morphs: Sequence[Morph], weights: Floats, num_vertices: int) -> Floats:
    """Shifts of every vertex in shapes of these weights (S, M): (S, V, 3)."""
    shifts = np.zeros((len(weights), num_vertices, 3))
    for number, morph in enumerate(morphs):
        used = np.flatnonzero(weights[:, number])
        if len(used):
            shifts[np.ix_(used, morph.vertices)] += weights[used, number, None, None] * morph.shifts
    return shifts


def choose_shapes(morphs: Sequence[Morph], num_vertices: int, most: int = SHAPES) -> Floats:
    """Weights of a few shapes, (S, M), that between them show each morph wholly.

    Morphs that touch no vertex in common share a shape: the largest first, each goes where it overlaps least.
    """
    shapes = np.zeros((0, len(morphs)))
    touched = np.zeros((0, num_vertices), bool)
    for number in sorted(range(len(morphs)), key=lambda one: -len(morphs[one].vertices)):
        if not len(morphs[number].vertices):
            continue
        overlaps = touched[:, morphs[number].vertices].sum(axis=1)
        at = int(overlaps.argmin()) if len(overlaps) else -1
        if at < 0 or (overlaps[at] and len(shapes) < most):
            shapes = np.concatenate([shapes, np.zeros((1, len(morphs)))])
            touched = np.concatenate([touched, np.zeros((1, num_vertices), bool)])
            at = len(shapes) - 1
        shapes[at, number] = 1.0
        touched[at, morphs[number].vertices] = True
    return shapes


def shaped_matrices(rest: Floats, shifts: Floats) -> Floats:
    """Matrices that bring vertices (V, 3, 4) from their place at rest to where they stand in shapes, (S, V, 3, 4)."""
    moved = np.repeat(rest[None], len(shifts), axis=0)
    moved[..., 3] += np.einsum("vij,svj->svi", rest[:, :, :3], shifts)
    return moved


def vertex_turns(normals: Floats, changes: Floats, corner_vertices: Indices, vertices: Indices) -> Floats:
    """The smallest matrix a vertex that changes its corners' normals as they are to change.

    Parameters
    ----------
    normals : (C, 3) float64
        Of corners of these vertices.
    changes : (C, 3) float64
    corner_vertices : (C,) int64
    vertices : (N,) int64, rising

    Returns
    -------
    (N, 3, 3) float64
    """
    at = np.searchsorted(vertices, corner_vertices)
    squares = np.zeros((len(vertices), 3, 3))
    mixed = np.zeros((len(vertices), 3, 3))
    for row in range(3):
        for column in range(3):
            squares[:, row, column] = np.bincount(at, normals[:, row] * normals[:, column], len(vertices))
            mixed[:, row, column] = np.bincount(at, changes[:, row] * normals[:, column], len(vertices))
    return mixed @ np.linalg.pinv(squares, rcond=SAME_DIRECTION, hermitian=True)
