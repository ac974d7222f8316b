"""Which edge may collapse, onto which end, and what of the result is free: the rule table and the kernels that read it.

| edge                  | ends                | result                              | because                     |
|-----------------------|---------------------|-------------------------------------|-----------------------------|
| inside a chart        | both inside         | xyz and uv free                     | nothing but cost holds it   |
| inside a chart        | one on a silhouette | that end's uvs; xyz free            | the outline must stay       |
| inside a chart        | both on silhouettes | never (TWO_SILHOUETTES)             | it would pinch the chart    |
| seam                  | none unifiable      | never (NO_FREE_END)                 | a corner would be cut       |
| seam                  | one unifiable       | the other's uvs; xyz free           | the other end is a corner   |
| seam                  | both unifiable      | t along both joint lines; xyz free  | p, a, b, q are on one line  |
| any, relaxed          | none unifiable, or  | one end's uvs; xyz free             | it is shorter than allowed  |
|                       | both on silhouettes |                                     |                             |
| boundary              | as on a seam        | the same, with one side             |                             |
| to the virtual vertex |                     | never                               | it stands for a hole        |

An end b of a silhouette edge a-b is unifiable when exactly two silhouette edges meet there, both seams or both
boundaries, and the path a-b-q is one uniformly timed line: the point (b1, b2) of R4, b's uvs on the two sides, lies
on the segment from (a1, a2) to (q1, q2). That one test is both of the paper's, collinearity and equal length ratios.
It is kept with its error: each silhouette edge carries the largest uv distance by which the line that it replaces
strays from it, and a collapse that would bring the sum over the tolerance is refused. At the exact levels the
tolerance is rounding; at relaxed ones it is part of a texel. What is shorter than that may also pinch a chart, or close
one up: its faces go, and its neighbours meet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from preprocess.decimate.topology import TAIL, TWIN, WEDGE, next_of, previous_of
from preprocess.numerics.jit import fixed_memory_helper as helper
from preprocess.numerics.kernel_arguments import by_reference

# Why an edge does not collapse. The first four come from the table, the others from the state of the mesh.
ALLOWED, VIRTUAL, TWO_SILHOUETTES, NO_FREE_END, LINK, FLIP = 0, 1, 2, 3, 4, 5
RULE_NAMES = {
    TWO_SILHOUETTES: "joins two chart outlines",
    NO_FREE_END: "seam or boundary edge between two corners",
    LINK: "link condition",
    FLIP: "would fold or degenerate a triangle",
}

STRICT_NONE, STRICT_SHAPE, STRICT_SEAMLESS = 0, 1, 2

# Columns of Mesh.vertices, and those of Mesh.links after topology's.
OUT, SILHOUETTES, NUM_BLOCKED, MARK = 0, 1, 2, 3
PLACE, BLOCKED, WEIGHED = 3, 4, 5
POSE_ROTATION, POSE_QUADRIC, POSE_SIZE = 3, np.int64(12), 22
QUADRIC_ROW, POINT_ROW, WEIGHTS_ROW, APEX_ROW = 13, 14, 15, 16  # of Mesh.work
SIGN, CHART, FIRST_WITNESS = 0, 1, 2  # of Mesh.faces
FOLLOWING, GATHERED, ITS_CHART = 0, 1, 2  # of Mesh.witnesses

# Which placements to propose, and whether unblocked edges go back into the heap (NumPy integers: see quadrics.py).
BEST, ALL = np.int64(0), np.int64(1)
FORGET, RETRY = np.int64(0), np.int64(1)


@by_reference
class Mesh(NamedTuple):
    """Everything a run changes, in normalised units. V vertices, W wedges, F' faces with the virtual ones, P poses.

    Few arrays with named columns: every use of one in a kernel costs compile time.

    Attributes
    ----------
    links : (3 F', 6) int64
        Columns TAIL, WEDGE, TWIN (see topology.HalfEdges), PLACE (of an edge in the heap, -1 for none), BLOCKED
        (1 where an edge was tried, found invalid and waits for its surroundings to change) and WEIGHED (1 where its
        cost takes the witnesses into account).
    vertices : (V + 1, 4) int64
        Columns OUT, SILHOUETTES (see topology.HalfEdges), NUM_BLOCKED (such edges at the vertex), MARK (scratch of
        the link condition). The virtual vertex is the last.
    xyz : (V, 3) float64
    uv : (W, 2) float64
    quadric : (W, 21) float64
    deviation : (3 F',) float64
        uv distance by which the line that a silhouette edge stands for strays from it.
    faces : (F, 3) int64
        Of each real face: SIGN of its uv area, CHART, FIRST_WITNESS over it (-1 for none).
    texture : (H, W, 3) float64
        Positions drawn at a uv, or (0, 0, 3).
    pose : (V, P, 22) float64
        A vertex in each pose: position (3), rotation (9), position quadric (10).
    work : (24, 10) float64
        Scratch: candidates in the first 8 rows, the small linear system in rows 8 to 12, a position quadric in row
        13, a point in row 14, weights in row 15, a vertex in each pose of the witnesses from row 16 on.
    settings : (9,) float64
    counter : (8,) int64
        See the slots below.
    heap_cost : (3 F',) float64
    heap_item : (3 F',) int64
        See edge_heap.py.
    points : (S, 4 + 6 Q) float64
        See deviation_samples.py. Pose q > 0 of the witnesses is pose q - 1 of `pose`.
    witnesses : (S, 3) int64
        The one FOLLOWING over the same face (-1 for none); scratch: a list of those GATHERED, ITS_CHART of each.
    fan : (N, 9 + 9 Q) float64
        Scratch: see deviation.py.
    """

    links: NDArray[np.int64]
    vertices: NDArray[np.int64]
    xyz: NDArray[np.float64]
    uv: NDArray[np.float64]
    quadric: NDArray[np.float64]
    deviation: NDArray[np.float64]
    faces: NDArray[np.int64]
    texture: NDArray[np.float64]
    pose: NDArray[np.float64]
    work: NDArray[np.float64]
    settings: NDArray[np.float64]
    counter: NDArray[np.int64]
    heap_cost: NDArray[np.float64]
    heap_item: NDArray[np.int64]
    points: NDArray[np.float64]
    witnesses: NDArray[np.int64]
    fan: NDArray[np.float64]


# Slots of Mesh.settings and Mesh.counter.
UV_SCALE, SEAM_TOLERANCE, STRICT, MIN_NORMAL_DOT, MIN_UV_HEIGHT, MIN_SHAPE, PEAK, LIFT, RELAXED = range(9)
FACES_LEFT, STAMP, COLLAPSES, HEAP_SIZE, PRICED, VERSION = 0, 1, 2, 3, 4, 5


@helper
def is_silhouette(links, h):
    """Whether a half-edge lies on a seam or a boundary."""
    t = links[h, TWIN]
    return links[h, WEDGE] != links[next_of(t), WEDGE] or links[next_of(h), WEDGE] != links[t, WEDGE]


@helper
def other_silhouette(links, h):
    """The other silhouette half-edge that starts where h starts, when there are two."""
    g = links[previous_of(h), TWIN]
    while g != h:
        if is_silhouette(links, g):
            return g
        g = links[previous_of(g), TWIN]
    return h


@helper
def line_distance(uv, p0, p1, b0, b1, q0, q1, paired):
    """Distance in uv of the point (b0, b1) from the segment (p0, p1)-(q0, q1) of R4, and where on it.

    Wedges of NO_WEDGE take no part. With `paired` false each side is measured at its own nearest point, which is the
    test of shape alone.

    Returns
    -------
    distance : float, the larger of the two sides'; infinity where b does not lie between p and q
    t : float, fraction along the segment
    """
    dot, square = 0.0, 0.0
    for side in range(2):
        p, b, q = (p0, b0, q0) if side == 0 else (p1, b1, q1)
        if p < 0 or b < 0 or q < 0:
            continue
        dx, dy = uv[q, 0] - uv[p, 0], uv[q, 1] - uv[p, 1]
        dot += (uv[b, 0] - uv[p, 0]) * dx + (uv[b, 1] - uv[p, 1]) * dy
        square += dx * dx + dy * dy
    if not (dot > 0.0 and dot < square):
        return math.inf, 0.0
    joint = dot / square
    largest = 0.0
    for side in range(2):
        p, b, q = (p0, b0, q0) if side == 0 else (p1, b1, q1)
        if p < 0 or b < 0 or q < 0:
            continue
        dx, dy = uv[q, 0] - uv[p, 0], uv[q, 1] - uv[p, 1]
        ex, ey = uv[b, 0] - uv[p, 0], uv[b, 1] - uv[p, 1]
        t = joint
        if not paired:
            square = dx * dx + dy * dy
            if square == 0.0:
                return math.inf, 0.0
            t = (ex * dx + ey * dy) / square
            if not (t > 0.0 and t < 1.0):
                return math.inf, 0.0
        largest = max(largest, (ex - t * dx) ** 2 + (ey - t * dy) ** 2)
    return math.sqrt(largest), joint


@helper
def removal_deviation(m, h):
    """Deviation of the merged edge a-q if the end b of the silhouette edge h = a -> b is removed.

    Returns
    -------
    deviation : float, infinity where b is a corner
    g : the half-edge b -> q
    """
    t = m.links[h, TWIN]
    b = m.links[t, TAIL]
    if m.vertices[b, SILHOUETTES] != 2:
        return math.inf, -1
    g = other_silhouette(m.links, t)
    tg = m.links[g, TWIN]
    left, right = m.links[h, WEDGE] >= 0, m.links[t, WEDGE] >= 0
    if g == t or (left != (m.links[g, WEDGE] >= 0)) or (right != (m.links[tg, WEDGE] >= 0)):
        return math.inf, -1  # a seam that runs out into a boundary
    before = max(m.deviation[h], m.deviation[g])
    if m.settings[STRICT] == STRICT_NONE:
        return before, g
    distance, _ = line_distance(
        m.uv,
        m.links[h, WEDGE],
        m.links[next_of(t), WEDGE],
        m.links[next_of(h), WEDGE],
        m.links[t, WEDGE],
        m.links[next_of(g), WEDGE],
        m.links[tg, WEDGE],
        m.settings[STRICT] == STRICT_SEAMLESS and left and right,
    )
    return before + distance, g


@helper
def corner_deviation(m, h):
    """Deviation of the silhouette edges at the corner b of an edge h = a -> b if b moves onto a."""
    t = m.links[h, TWIN]
    a0, a1 = m.links[h, WEDGE], m.links[next_of(t), WEDGE]
    b0, b1 = m.links[next_of(h), WEDGE], m.links[t, WEDGE]
    if b0 == b1 and a0 != a1:
        return math.inf  # the end of a cut
    uv, left, right = m.uv, 0.0, 0.0
    if a0 >= 0:
        left = (uv[a0, 0] - uv[b0, 0]) ** 2 + (uv[a0, 1] - uv[b0, 1]) ** 2
    if a1 >= 0:
        right = (uv[a1, 0] - uv[b1, 0]) ** 2 + (uv[a1, 1] - uv[b1, 1]) ** 2
    before = m.deviation[h]
    g = m.links[previous_of(t), TWIN]
    while g != t:
        before = max(before, m.deviation[g])
        g = m.links[previous_of(g), TWIN]
    return before + math.sqrt(max(left, right))


@helper
def orient(m, h):
    """Apply the rule table to an edge.

    Returns
    -------
    rule : ALLOWED or the reason why not
    h : the edge's half-edge that starts at the end to keep
    free_ends : 2 where both ends may move, 1 where the kept one is fixed
    """
    t = m.links[h, TWIN]
    a, b = m.links[h, TAIL], m.links[t, TAIL]
    infinity = len(m.vertices) - 1
    if a == infinity or b == infinity:
        return VIRTUAL, h, 0
    if not is_silhouette(m.links, h):
        if m.vertices[a, SILHOUETTES] > 0 and m.vertices[b, SILHOUETTES] > 0:
            if m.settings[RELAXED] > 0.0:
                drop_b, drop_a = corner_deviation(m, h), corner_deviation(m, t)
                if min(drop_a, drop_b) <= m.settings[SEAM_TOLERANCE]:
                    return ALLOWED, h if drop_b <= drop_a else t, 1
            return TWO_SILHOUETTES, h, 0
        if m.vertices[b, SILHOUETTES] > 0:
            return ALLOWED, t, 1
        return ALLOWED, h, 1 if m.vertices[a, SILHOUETTES] > 0 else 2
    tolerance = m.settings[SEAM_TOLERANCE]
    drop_b, _ = removal_deviation(m, h)
    drop_a, _ = removal_deviation(m, t)
    if drop_b <= tolerance and drop_a <= tolerance:
        return ALLOWED, h, 2
    if drop_b <= tolerance:
        return ALLOWED, h, 1
    if drop_a <= tolerance:
        return ALLOWED, t, 1
    drop_b, drop_a = corner_deviation(m, h), corner_deviation(m, t)
    if m.settings[RELAXED] > 0.0 and min(drop_a, drop_b) <= tolerance:
        return ALLOWED, h if drop_b <= drop_a else t, 1
    return NO_FREE_END, h, 0
