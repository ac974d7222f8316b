"""Vectorised grouping: equal rows, nearly equal points, connected components."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from preprocess.arrays import Indices


def group_rows(*columns: NDArray[np.generic]) -> tuple[Indices, Indices]:
    """Number the distinct rows of a table, in the order in which they first occur.

    Parameters
    ----------
    columns : one or more (N,) arrays

    Returns
    -------
    groups : (N,) int64
        Group of each row.
    firsts : (G,) int64
        First row of each group, rising.
    """
    num_rows = len(columns[0])
    if not num_rows:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order = np.lexsort(columns[::-1])
    new = np.ones(num_rows, bool)
    new[1:] = np.any([column[order[1:]] != column[order[:-1]] for column in columns], axis=0)
    sorted_groups = np.cumsum(new) - 1
    firsts = order[new]  # lexsort is stable: the first of a run is the first of the table
    rank = np.argsort(np.argsort(firsts))
    groups = np.empty(num_rows, np.int64)
    groups[order] = rank[sorted_groups]
    return groups, np.sort(firsts)


def connected_groups(num_items: int, left: NDArray[np.integer], right: NDArray[np.integer]) -> tuple[int, Indices]:
    """Connected components of items 0 .. n - 1 under the links left[i] - right[i], numbered by first occurrence.

    Returns
    -------
    num_components : int
    labels : (n,) int64
    """
    graph = coo_array((np.ones(len(left), np.int8), (left, right)), shape=(num_items, num_items))
    _, components = connected_components(graph, directed=False)
    labels, firsts = group_rows(components)
    return len(firsts), labels


def connected_faces(faces: NDArray[np.integer], num_vertices: int) -> Indices:
    """Component of each face over shared vertices, (F,) int64, numbered by first occurrence."""
    _, labels = connected_groups(num_vertices, faces[:, :2].ravel(), faces[:, 1:].ravel())
    return group_rows(labels[faces[:, 0]])[0]


def cluster_points(points: NDArray[np.float64], tolerance: float) -> tuple[Indices, Indices]:
    """Join points that are equal or nearly so, in time linear in their number (sorting aside).

    Points closer than half the tolerance along every axis always join; points that differ by more than the tolerance
    along an axis join only through others between them. Done with 2^D grids of that cell size, each shifted by half a
    cell along some axes.

    Parameters
    ----------
    points : (N, D) float64, finite
    tolerance : float, not negative

    Returns
    -------
    clusters : (N,) int64
    firsts : (K,) int64
        First point of each cluster, rising; it stands for the others.
    """
    exact, exact_firsts = group_rows(*(points + 0.0).T)  # + 0.0: minus zero is zero
    distinct = points[exact_firsts]
    if tolerance <= 0 or len(distinct) < 2:
        return exact, exact_firsts
    scaled = (distinct - distinct.min(axis=0)) / tolerance
    left, right = [], []
    for shift in itertools.product((0.0, 0.5), repeat=points.shape[1]):
        cells = np.floor(scaled + shift)
        groups, firsts = group_rows(*cells.T)
        if len(firsts) < len(distinct):
            left.append(np.arange(len(distinct)))
            right.append(firsts[groups])
    if not left:
        return exact, exact_firsts
    _, joined = connected_groups(len(distinct), np.concatenate(left), np.concatenate(right))
    return group_rows(joined[exact])


def expand_ranges(starts: Indices, counts: Indices) -> tuple[Indices, Indices]:
    """Owner and value of the ranges [start, start + count), one after the other."""
    owner = np.repeat(np.arange(len(counts)), counts)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, starts[owner] + offset
