"""How far the surface departs from its witnesses where a few of its faces change (see deviation_samples.py).

The faces that will be there are written into the rows of `Mesh.fan`, the witnesses over those that are there into
`Mesh.gathered`. Each witness is then found in the new faces by its uv, once for all poses.
"""

from __future__ import annotations

import math

import numpy as np

from preprocess.decimate.deviation_samples import FIRST_POSE, POSE_STRIDE, SLIP_COLUMN, WEIGHT_COLUMN
from preprocess.decimate.placement import pose_position
from preprocess.decimate.rules import (
    APEX_ROW,
    CHART,
    FIRST_WITNESS,
    FOLLOWING,
    GATHERED,
    ITS_CHART,
    POSE_ROTATION,
    WEIGHTS_ROW,
)
from preprocess.decimate.topology import TAIL, TWIN, WEDGE, next_of, previous_of
from preprocess.numerics.jit import fixed_memory_helper as helper

# Columns of a row of the fan: the face, its chart, uv of its first corner, the two sides there, one over their
# determinant, then the three corners in each pose. The first corner is the one that moves.
FACE, FACE_CHART, ORIGIN, SIDES, INVERSE, CORNERS, CORNERS_STRIDE = 0, 1, 2, 4, 8, 9, 9
NONE = np.int64(0)  # faces or witnesses so far (a NumPy integer: see quadrics.py)


@helper
def num_poses(m):
    """Poses in which witnesses are followed, the bind pose among them."""
    return (m.points.shape[1] - FIRST_POSE) // POSE_STRIDE


@helper
def set_apex(m, v):
    """Write a vertex's position in each pose into the apex rows."""
    for i in range(3):
        m.work[APEX_ROW, i] = m.xyz[v, i]
        for q in range(1, num_poses(m)):
            m.work[APEX_ROW + q, i] = m.pose[v, q - 1, i]


@helper
def place_apex(m, a, b, x, y, z):
    """Write a point near the edge a-b in each pose into the apex rows."""
    for q in range(1, num_poses(m)):
        pose_position(m.pose, m.xyz, a, b, x, y, z, q - 1, m.work[APEX_ROW + q])
    m.work[APEX_ROW, 0], m.work[APEX_ROW, 1], m.work[APEX_ROW, 2] = x, y, z


@helper
def write_face(m, n, f, u, v, second, third):
    """Row n of the fan: the face f with the apex at (u, v), and the corners of two half-edges."""
    row = m.fan[n]
    b, c = m.links[second, WEDGE], m.links[third, WEDGE]
    row[FACE], row[FACE_CHART] = f, m.faces[f, CHART]
    row[ORIGIN], row[ORIGIN + 1] = u, v
    row[SIDES], row[SIDES + 1] = m.uv[b, 0] - u, m.uv[b, 1] - v
    row[SIDES + 2], row[SIDES + 3] = m.uv[c, 0] - u, m.uv[c, 1] - v
    area = row[SIDES] * row[SIDES + 3] - row[SIDES + 1] * row[SIDES + 2]
    row[INVERSE] = 1.0 / area if area != 0.0 else 0.0
    b, c = m.links[second, TAIL], m.links[third, TAIL]
    for q in range(num_poses(m)):
        o = CORNERS + CORNERS_STRIDE * q
        for i in range(3):
            row[o + i] = m.work[APEX_ROW + q, i]
            if q == 0:
                row[o + 3 + i] = m.xyz[b, i]
                row[o + 6 + i] = m.xyz[c, i]
            else:
                row[o + 3 + i] = m.pose[b, q - 1, i]
                row[o + 6 + i] = m.pose[c, q - 1, i]


@helper
def gather(m, f, count):
    """Append the witnesses over a face and its chart; returns how many there are now."""
    k = m.faces[f, FIRST_WITNESS]
    while k >= 0:
        m.witnesses[count, GATHERED] = k
        m.witnesses[count, ITS_CHART] = m.faces[f, CHART]
        count += 1
        k = m.witnesses[k, FOLLOWING]
    return count


@helper
def find_face(m, k, chart, num_rows, guess):
    """The row of the fan whose uv triangle holds witness k, or comes nearest to; its weights go into the scratch.

    Returns
    -------
    int
        -1 where no row is of that chart.
    """
    weights = m.work[WEIGHTS_ROW]
    u, v = m.points[k, 0], m.points[k, 1]
    largest, found = -math.inf, -1
    i, step = guess, 0
    while step <= num_rows:
        row = m.fan[i]
        if row[FACE_CHART] == chart:
            x, y = u - row[ORIGIN], v - row[ORIGIN + 1]
            b = (x * row[SIDES + 3] - y * row[SIDES + 2]) * row[INVERSE]
            c = (y * row[SIDES] - x * row[SIDES + 1]) * row[INVERSE]
            least = min(1.0 - b - c, b, c)
            if least > largest:
                largest, found = least, i
                weights[0], weights[1], weights[2] = 1.0 - b - c, b, c
                if least >= 0.0:
                    return found
        i = step
        step += 1
    if found >= 0:
        total = 0.0
        for i in range(3):
            weights[i] = max(weights[i], 0.0)
            total += weights[i]
        for i in range(3):
            weights[i] /= total
    return found


@helper
def departure_in_pose(row, point, weights, q):
    """How far a sample is in pose q from the point of a row of the fan: along its normal, and squared in all."""
    o, p = CORNERS + CORNERS_STRIDE * q, FIRST_POSE + POSE_STRIDE * q
    along, square = 0.0, 0.0
    for i in range(3):
        away = weights[0] * row[o + i] + weights[1] * row[o + 3 + i] + weights[2] * row[o + 6 + i] - point[p + i]
        along += away * point[p + 3 + i]
        square += away * away
    return along, square


@helper
def rotation_at(m, v, q, row, column):
    """An entry of the matrix that turns steps of a vertex from bind pose into pose q of the samples."""
    if q == 0:
        return 1.0 if row == column else 0.0
    return m.pose[v, q - 1, POSE_ROTATION + 3 * row + column]


@helper
def posed_column_dot(m, v, q, column, point, o):
    """How far a unit step of a vertex along one axis goes in pose q along the direction at point[o]."""
    value = 0.0
    for row in range(3):
        value += rotation_at(m, v, q, row, column) * point[o + row]
    return value


@helper
def square_departure(m, k, found):
    """Largest square over the poses of witness k's distance from the point of a row that `find_face` has found, times
    its weight."""
    row, point, weights = m.fan[found], m.points[k], m.work[WEIGHTS_ROW]
    largest = 0.0
    for q in range(num_poses(m)):
        along, square = departure_in_pose(row, point, weights, q)
        largest = max(largest, along * along + point[SLIP_COLUMN] * (square - along * along))
    return largest * point[WEIGHT_COLUMN]


@helper
def _write_collapse(m, h, candidate):
    """Gather what an edge's collapse onto a candidate would change.

    Returns
    -------
    rows, count : int
        Faces after it, witnesses; no faces where they are too many for the fan.
    """
    t = m.links[h, TWIN]
    a, b = m.links[h, TAIL], m.links[t, TAIL]
    a0, a1, b0, b1 = m.links[h, WEDGE], m.links[next_of(t), WEDGE], m.links[next_of(h), WEDGE], m.links[t, WEDGE]
    place_apex(m, a, b, candidate[1], candidate[2], candidate[3])
    rows, count = NONE, NONE
    for start in (h, t):
        g = start
        while True:
            f, w, after, before = g // 3, m.links[g, WEDGE], next_of(g), previous_of(g)
            goes = f == h // 3 or f == t // 3
            if w >= 0 and not (goes and start == t):
                count = gather(m, f, count)
            if w >= 0 and not goes:
                if rows == len(m.fan):
                    return NONE, NONE
                u, v = m.uv[w, 0], m.uv[w, 1]
                if w in (a0, b0):
                    u, v = candidate[4], candidate[5]
                elif w in (a1, b1):
                    u, v = candidate[6], candidate[7]
                write_face(m, rows, f, u, v, after, before)
                rows += 1
            g = m.links[before, TWIN]
            if g == start:
                break
    return rows, count


@helper
def largest_departure(m, h, candidate):
    """Largest squared departure from the witnesses around an edge if it collapses onto a candidate; 0 for none."""
    rows, count = _write_collapse(m, h, candidate)
    largest, guess = 0.0, NONE
    if rows > 0:
        for j in range(count):
            k = m.witnesses[j, GATHERED]
            found = find_face(m, k, m.witnesses[j, ITS_CHART], rows, guess)
            if found >= 0:
                guess = found
                largest = max(largest, square_departure(m, k, found))
    return largest


@helper
def hand_over(m, rows, count):
    """Put the gathered witnesses over the faces of the fan."""
    guess = NONE
    for j in range(count):
        k = m.witnesses[j, GATHERED]
        found = find_face(m, k, m.witnesses[j, ITS_CHART], rows, guess)
        if found >= 0:
            guess = found
            f = int(m.fan[found, FACE])
            m.witnesses[k, FOLLOWING] = m.faces[f, FIRST_WITNESS]
            m.faces[f, FIRST_WITNESS] = k


@helper
def hand_over_collapse(m, h, candidate):
    """Put the witnesses around an edge over the faces that will be there; call it before the collapse."""
    rows, count = _write_collapse(m, h, candidate)
    for f in (h // 3, m.links[h, TWIN] // 3):
        if f < len(m.faces):
            m.faces[f, FIRST_WITNESS] = -1
    for i in range(rows):
        m.faces[int(m.fan[i, FACE]), FIRST_WITNESS] = -1
    hand_over(m, rows, count)
