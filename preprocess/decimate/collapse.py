"""One edge collapse on half-edges, and the greedy run that does the cheapest first."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from preprocess.decimate.deviation import hand_over_collapse, largest_departure
from preprocess.decimate.edge_heap import heap_remove, heap_set
from preprocess.decimate.placement import best_cost, joint_line, pose_position, propose
from preprocess.decimate.quadrics import add_rows
from preprocess.decimate.rules import (
    ALL,
    ALLOWED,
    BEST,
    BLOCKED,
    COLLAPSES,
    FACES_LEFT,
    FLIP,
    FORGET,
    HEAP_SIZE,
    LINK,
    NUM_BLOCKED,
    OUT,
    PEAK,
    POINT_ROW,
    POSE_QUADRIC,
    POSE_ROTATION,
    POSE_SIZE,
    PRICED,
    RELAXED,
    RETRY,
    SEAM_TOLERANCE,
    SILHOUETTES,
    VERSION,
    WEIGHED,
    corner_deviation,
    is_silhouette,
    orient,
    other_silhouette,
    removal_deviation,
)
from preprocess.decimate.topology import TAIL, TWIN, WEDGE, next_of, previous_of
from preprocess.decimate.validity import link_holds, placement_holds
from preprocess.numerics.jit import digest_sources
from preprocess.numerics.jit import fixed_memory_entry as entry
from preprocess.numerics.jit import fixed_memory_helper as helper


@helper
def price(m, h):
    """Put an edge into the heap at its cost, or take it out where the table forbids it."""
    item = min(h, m.links[h, TWIN])
    m.links[item, WEIGHED] = 0
    rule, kept, free_ends = orient(m, item)
    if rule != ALLOWED:
        heap_remove(m.heap_cost, m.heap_item, m.links, m.counter, item)
        return
    cost = best_cost(m, propose(m, kept, free_ends, BEST))
    if cost < math.inf:
        heap_set(m.heap_cost, m.heap_item, m.links, m.counter, item, cost)
    else:
        heap_remove(m.heap_cost, m.heap_item, m.links, m.counter, item)


@helper
def block(m, h):
    """Remember that an edge cannot collapse until something around it changes."""
    item = min(h, m.links[h, TWIN])
    if m.links[item, BLOCKED] == 0:
        m.links[item, BLOCKED] = 1
        m.vertices[m.links[item, TAIL], NUM_BLOCKED] += 1
        m.vertices[m.links[m.links[item, TWIN], TAIL], NUM_BLOCKED] += 1


@helper
def unblock_around(m, v, again):
    """Forget that about all edges at a vertex; with RETRY, put them back into the heap."""
    if m.vertices[v, NUM_BLOCKED] == 0:
        return
    start = m.vertices[v, OUT]
    g = start
    while True:
        item = min(g, m.links[g, TWIN])
        if m.links[item, BLOCKED] != 0:
            m.links[item, BLOCKED] = 0
            m.vertices[m.links[item, TAIL], NUM_BLOCKED] -= 1
            m.vertices[m.links[m.links[item, TWIN], TAIL], NUM_BLOCKED] -= 1
            if again != FORGET:
                price(m, item)
        g = m.links[previous_of(g), TWIN]
        if g == start:
            return


@helper
def _join(m, x, y):
    """Make twins of two half-edges whose faces between them are gone."""
    m.links[x, TWIN] = y
    m.links[y, TWIN] = x
    deviation = max(m.deviation[x], m.deviation[y])
    m.deviation[x] = deviation
    m.deviation[y] = deviation


@helper
def _count_silhouettes(m, v):
    """Count the seam and boundary edges at a vertex anew; the virtual vertex has none."""
    if v == len(m.vertices) - 1:
        return
    count = 0
    start = m.vertices[v, OUT]
    g = start
    while True:
        count += 1 if is_silhouette(m.links, g) else 0
        g = m.links[previous_of(g), TWIN]
        if g == start:
            break
    m.vertices[v, SILHOUETTES] = count


@helper
def _spread_deviation(m, h, free_ends):
    """Charge the silhouette edges that replace an edge and its neighbours with how far they stray."""
    t = m.links[h, TWIN]
    if free_ends == 2:
        _, _, _, _, _, _, deviation = joint_line(m, h)
        if deviation <= m.settings[SEAM_TOLERANCE]:
            k, g = other_silhouette(m.links, h), other_silhouette(m.links, t)
            for e in (k, m.links[k, TWIN], g, m.links[g, TWIN]):
                m.deviation[e] = deviation
            return
    deviation, g = removal_deviation(m, h)
    if deviation <= m.settings[SEAM_TOLERANCE] and is_silhouette(m.links, h):
        m.deviation[g] = deviation
        m.deviation[m.links[g, TWIN]] = deviation
        return
    deviation = corner_deviation(m, h)
    g = m.links[previous_of(t), TWIN]
    while g != t:
        if is_silhouette(m.links, g):
            m.deviation[g] = deviation
            m.deviation[m.links[g, TWIN]] = deviation
        g = m.links[previous_of(g), TWIN]


@helper
def _merge_poses(pose, xyz, a, b, x, y, z, point):
    """Move a to the new point in every pose, with both ends' quadrics and the nearer one's rotation."""
    to_a = (x - xyz[a, 0]) ** 2 + (y - xyz[a, 1]) ** 2 + (z - xyz[a, 2]) ** 2
    to_b = (x - xyz[b, 0]) ** 2 + (y - xyz[b, 1]) ** 2 + (z - xyz[b, 2]) ** 2
    for p in range(pose.shape[1]):
        pose_position(pose, xyz, a, b, x, y, z, p, point)
        for i in range(3):
            pose[a, p, i] = point[i]
        for i in range(POSE_ROTATION, POSE_QUADRIC):
            if to_b < to_a:
                pose[a, p, i] = pose[b, p, i]
        for i in range(POSE_QUADRIC, POSE_SIZE):
            pose[a, p, i] += pose[b, p, i]


@helper
def collapse(m, h, row, free_ends):
    """Merge the end of h into its start at a placement; see `placement.propose` for the row.

    The start keeps its number and its wedges; two faces (or one, and a virtual one) go.
    """
    x, y, z, u0, v0, u1, v1 = row[1], row[2], row[3], row[4], row[5], row[6], row[7]
    t = m.links[h, TWIN]
    a, b = m.links[h, TAIL], m.links[t, TAIL]
    hn, hp, tn, tp = next_of(h), previous_of(h), next_of(t), previous_of(t)
    a0, a1, b0, b1 = m.links[h, WEDGE], m.links[tn, WEDGE], m.links[hn, WEDGE], m.links[t, WEDGE]
    if is_silhouette(m.links, h) or m.vertices[b, SILHOUETTES] > 0:
        _spread_deviation(m, h, free_ends)
    if m.settings[PEAK] > 0.0:
        hand_over_collapse(m, h, row)
    unblock_around(m, a, FORGET)
    unblock_around(m, b, FORGET)
    for e in (h, hn, hp, tn, tp):
        heap_remove(m.heap_cost, m.heap_item, m.links, m.counter, min(e, m.links[e, TWIN]))

    if m.pose.shape[1] > 0:
        _merge_poses(m.pose, m.xyz, a, b, x, y, z, m.work[POINT_ROW])
    if b0 >= 0:
        add_rows(m.quadric, a0, b0)
    if b1 >= 0 and b1 != b0:
        add_rows(m.quadric, a1, b1)
    m.xyz[a, 0], m.xyz[a, 1], m.xyz[a, 2] = x, y, z
    if free_ends == 2:
        if a0 >= 0:
            m.uv[a0, 0], m.uv[a0, 1] = u0, v0
        if a1 >= 0 and a1 != a0:
            m.uv[a1, 0], m.uv[a1, 1] = u1, v1

    g = t
    while True:
        m.links[g, TAIL] = a
        if m.links[g, WEDGE] >= 0 and m.links[g, WEDGE] == b0:
            m.links[g, WEDGE] = a0
        elif m.links[g, WEDGE] >= 0 and m.links[g, WEDGE] == b1:
            m.links[g, WEDGE] = a1
        g = m.links[previous_of(g), TWIN]
        if g == t:
            break
    from_c, to_c, from_d, to_d = m.links[hn, TWIN], m.links[hp, TWIN], m.links[tn, TWIN], m.links[tp, TWIN]
    _join(m, from_c, to_c)
    _join(m, from_d, to_d)
    m.vertices[a, OUT] = to_c
    m.vertices[m.links[from_c, TAIL], OUT] = from_c
    m.vertices[m.links[from_d, TAIL], OUT] = from_d
    for v in (a, m.links[from_c, TAIL], m.links[from_d, TAIL]):
        _count_silhouettes(m, v)
    if m.settings[RELAXED] > 0.0:  # where a chart closes up, its seams end for the vertices around, too
        g = to_c
        while True:
            _count_silhouettes(m, m.links[next_of(g), TAIL])
            g = m.links[previous_of(g), TWIN]
            if g == to_c:
                break
    num_faces = len(m.faces)
    for e in (h, hn, hp, t, tn, tp):
        m.links[e, TWIN] = -1
        m.links[e, TAIL] = -1
    m.counter[FACES_LEFT] -= (1 if h < 3 * num_faces else 0) + (1 if t < 3 * num_faces else 0)
    m.counter[COLLAPSES] += 1

    g = to_c
    while True:
        price(m, g)
        g = m.links[previous_of(g), TWIN]
        if g == to_c:
            break
    infinity = len(m.vertices) - 1
    g = to_c
    while True:
        c = m.links[next_of(g), TAIL]
        if c != infinity:
            unblock_around(m, c, RETRY)
        g = m.links[previous_of(g), TWIN]
        if g == to_c:
            break


@helper
def _pick(m, h, count):
    """Number of the cheapest sound candidate, -1 for none; tried ones are struck out."""
    while True:
        best, cost = -1, math.inf
        for n in range(count):
            if m.work[n, 0] < cost:
                best, cost = n, m.work[n, 0]
        if best < 0 or placement_holds(m, h, m.work[best]):
            return best
        m.work[best, 0] = math.inf


@helper
def attempt(m, h, free_ends):
    """Candidates of an oriented edge, checked: number of the best, or minus the rule that stands against it."""
    if not link_holds(m.links, m.vertices, m.counter, m.settings[RELAXED], h):
        return -LINK
    best = _pick(m, h, propose(m, h, free_ends, ALL))
    return best if best >= 0 else -FLIP


@helper
def _weigh(m, item, h, candidate):
    """Cost of an edge that is the cheapest by quadrics: no less than its largest departure over an average star.

    An edge whose cost says so already costs nothing more.
    """
    if not m.settings[PEAK] > 0.0:
        return candidate[0]
    if m.links[item, WEIGHED] != 0:
        return 0.0
    m.links[item, WEIGHED] = 1
    return max(candidate[0], m.settings[PEAK] / m.counter[FACES_LEFT] * largest_departure(m, h, candidate))


@helper
def _census(m, counts):
    """Count the edges that are left by what stands against their collapse."""
    for h in range(len(m.links)):
        if m.links[h, TAIL] < 0 or h > m.links[h, TWIN]:
            continue
        rule, kept, free_ends = orient(m, h)
        if rule == ALLOWED:
            best = attempt(m, kept, free_ends)
            rule = -best if best < 0 else ALLOWED
        counts[rule] += 1


def _make_run(sources: int) -> Any:
    """The entry for one version of the kernels' sources (see jit.py)."""

    @entry
    def run(m, target, max_cost, counts):
        """Collapse the cheapest edges until `target` faces are left, the next costs too much, or none is legal.

        An edge whose cheapest placement folds the mesh, or departs far from a witness, goes back into the heap at
        the cost of the cheapest sound one; one with none waits until a collapse nearby.

        Parameters
        ----------
        m : rules.Mesh
        target : int
        max_cost : float
        counts : (8,) int64, or (0,) not to count
            Gets the number of edges that are left by rule (index: rules.ALLOWED and after).
        """
        m.counter[VERSION] = sources
        if m.counter[PRICED] == 0:
            m.counter[PRICED] = 1
            for h in range(len(m.links)):
                if m.links[h, TAIL] >= 0 and h < m.links[h, TWIN]:
                    price(m, h)
        while m.counter[FACES_LEFT] > target and m.counter[HEAP_SIZE] > 0 and m.heap_cost[0] <= max_cost:
            item = m.heap_item[0]
            heap_remove(m.heap_cost, m.heap_item, m.links, m.counter, item)
            rule, h, free_ends = orient(m, item)
            if rule != ALLOWED:
                continue
            best = attempt(m, h, free_ends)
            if best < 0:
                block(m, item)
                continue
            cost = _weigh(m, item, h, m.work[best])
            if m.counter[HEAP_SIZE] > 0 and cost > m.heap_cost[0]:
                heap_set(m.heap_cost, m.heap_item, m.links, m.counter, item, cost)
            else:
                collapse(m, h, m.work[best], free_ends)
        if len(counts) > 0:
            _census(m, counts)

    return run


run = _make_run(digest_sources(Path(__file__).parent))
