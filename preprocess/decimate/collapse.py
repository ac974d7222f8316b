"""One edge collapse on half-edges, and the greedy run that does the cheapest first."""

from __future__ import annotations

import math

from preprocess.decimate.heap import heap_remove, heap_set
from preprocess.decimate.jit import entry, helper
from preprocess.decimate.placement import best_cost, joint_line, pose_position, propose
from preprocess.decimate.quadrics import add_rows
from preprocess.decimate.rules import (
    ALLOWED,
    COLLAPSES,
    FACES_LEFT,
    FLIP,
    LINK,
    SEAM_TOLERANCE,
    is_silhouette,
    orient,
    other_silhouette,
    removal_deviation,
)
from preprocess.decimate.topology import next_of, previous_of
from preprocess.decimate.validity import link_holds, placement_holds


@helper
def price(m, h):
    """Put an edge into the heap at its cost, or take it out where the table forbids it."""
    item = min(h, m.twin[h])
    rule, kept, free_ends = orient(m, item)
    if rule != ALLOWED:
        heap_remove(m.heap, item)
        return
    cost = best_cost(m, propose(m, kept, free_ends, False))
    if cost < math.inf:
        heap_set(m.heap, item, cost)
    else:
        heap_remove(m.heap, item)


@entry
def price_all(m):
    """Fill the heap."""
    for h in range(len(m.tail)):
        m.blocked[h] = 0
    for v in range(len(m.num_blocked)):
        m.num_blocked[v] = 0
    for h in range(len(m.tail)):
        if m.tail[h] >= 0 and h < m.twin[h]:
            price(m, h)


@helper
def block(m, h):
    """Remember that an edge cannot collapse until something around it changes."""
    item = min(h, m.twin[h])
    if m.blocked[item] == 0:
        m.blocked[item] = 1
        m.num_blocked[m.tail[item]] += 1
        m.num_blocked[m.tail[m.twin[item]]] += 1


@helper
def unblock_around(m, v, again):
    """Forget that about all edges at a vertex; with `again`, put them back into the heap."""
    if m.num_blocked[v] == 0:
        return
    start = m.out[v]
    g = start
    while True:
        item = min(g, m.twin[g])
        if m.blocked[item] != 0:
            m.blocked[item] = 0
            m.num_blocked[m.tail[item]] -= 1
            m.num_blocked[m.tail[m.twin[item]]] -= 1
            if again:
                price(m, item)
        g = m.twin[previous_of(g)]
        if g == start:
            return


@helper
def _join(m, x, y):
    """Make twins of two half-edges whose faces between them are gone."""
    m.twin[x] = y
    m.twin[y] = x
    deviation = max(m.deviation[x], m.deviation[y])
    m.deviation[x] = deviation
    m.deviation[y] = deviation


@helper
def _spread_deviation(m, h, free_ends):
    """Charge the silhouette edges that replace an edge and its neighbours with how far they stray."""
    t = m.twin[h]
    if free_ends == 2:
        _, _, _, _, deviation = joint_line(m, h)
        if deviation <= m.settings[SEAM_TOLERANCE]:
            k, g = other_silhouette(m, h), other_silhouette(m, t)
            for e in (k, m.twin[k], g, m.twin[g]):
                m.deviation[e] = deviation
            return
    deviation, g = removal_deviation(m, h)
    m.deviation[g] = deviation
    m.deviation[m.twin[g]] = deviation


@helper
def collapse(m, h, row, free_ends):
    """Merge the end of h into its start at a placement; see `placement.propose` for the row.

    The start keeps its number and its wedges; two faces (or one, and a virtual one) go.
    """
    x, y, z, u0, v0, u1, v1 = row[1], row[2], row[3], row[4], row[5], row[6], row[7]
    t = m.twin[h]
    a, b = m.tail[h], m.tail[t]
    hn, hp, tn, tp = next_of(h), previous_of(h), next_of(t), previous_of(t)
    a0, a1, b0, b1 = m.wedge[h], m.wedge[tn], m.wedge[hn], m.wedge[t]
    if is_silhouette(m, h):
        _spread_deviation(m, h, free_ends)
    unblock_around(m, a, False)
    unblock_around(m, b, False)
    for e in (h, hn, hp, tn, tp):
        heap_remove(m.heap, min(e, m.twin[e]))

    for p in range(m.pose_xyz.shape[1]):
        px = pose_position(m, a, b, x, y, z, p, 0)
        py = pose_position(m, a, b, x, y, z, p, 1)
        m.pose_xyz[a, p, 2] = pose_position(m, a, b, x, y, z, p, 2)
        m.pose_xyz[a, p, 0], m.pose_xyz[a, p, 1] = px, py
        add_rows(m.pose_quadric[:, p], a, b)
    if m.pose_xyz.shape[1] > 0:
        to_a = (x - m.xyz[a, 0]) ** 2 + (y - m.xyz[a, 1]) ** 2 + (z - m.xyz[a, 2]) ** 2
        to_b = (x - m.xyz[b, 0]) ** 2 + (y - m.xyz[b, 1]) ** 2 + (z - m.xyz[b, 2]) ** 2
        if to_b < to_a:
            for p in range(m.pose_xyz.shape[1]):
                for i in range(9):
                    m.pose_rotation[a, p, i // 3, i % 3] = m.pose_rotation[b, p, i // 3, i % 3]

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
        m.tail[g] = a
        if m.wedge[g] >= 0:
            m.wedge[g] = a0 if m.wedge[g] == b0 else a1
        g = m.twin[previous_of(g)]
        if g == t:
            break
    from_c, to_c, from_d, to_d = m.twin[hn], m.twin[hp], m.twin[tn], m.twin[tp]
    _join(m, from_c, to_c)
    _join(m, from_d, to_d)
    m.out[a] = to_c
    m.out[m.tail[from_c]] = from_c
    m.out[m.tail[from_d]] = from_d
    num_faces = len(m.orientation)
    for e in (h, hn, hp, t, tn, tp):
        m.twin[e] = -1
        m.tail[e] = -1
    m.counter[FACES_LEFT] -= (1 if h < 3 * num_faces else 0) + (1 if t < 3 * num_faces else 0)
    m.counter[COLLAPSES] += 1

    g = to_c
    while True:
        price(m, g)
        g = m.twin[previous_of(g)]
        if g == to_c:
            break
    infinity = len(m.out) - 1
    g = to_c
    while True:
        c = m.tail[next_of(g)]
        if c != infinity:
            unblock_around(m, c, True)
        g = m.twin[previous_of(g)]
        if g == to_c:
            break


@helper
def _pick(m, h, count):
    """Number of the cheapest sound candidate, -1 for none; tried ones are struck out."""
    while True:
        best, cost = -1, math.inf
        for n in range(count):
            if m.candidates[n, 0] < cost:
                best, cost = n, m.candidates[n, 0]
        if best < 0 or placement_holds(m, h, m.candidates[best]):
            return best
        m.candidates[best, 0] = math.inf


@helper
def attempt(m, h, free_ends):
    """Candidates of an oriented edge, checked: number of the best, or minus the rule that stands against it."""
    if not link_holds(m, h):
        return -LINK
    best = _pick(m, h, propose(m, h, free_ends, True))
    return best if best >= 0 else -FLIP


@entry
def run(m, target, max_cost):
    """Collapse the cheapest edges until `target` faces are left, the next costs too much, or none is legal.

    An edge whose cheapest placement folds the mesh goes back into the heap at the cost of the cheapest sound one; one
    with none waits until a collapse nearby.
    """
    while m.counter[FACES_LEFT] > target and m.heap.size[0] > 0 and m.heap.cost[0] <= max_cost:
        item = m.heap.item[0]
        heap_remove(m.heap, item)
        rule, h, free_ends = orient(m, item)
        if rule != ALLOWED:
            continue
        best = attempt(m, h, free_ends)
        if best < 0:
            block(m, item)
        elif m.heap.size[0] > 0 and m.candidates[best, 0] > m.heap.cost[0]:
            heap_set(m.heap, item, m.candidates[best, 0])
        else:
            collapse(m, h, m.candidates[best], free_ends)


@entry
def census(m, counts):
    """Count the edges that are left by what stands against their collapse (index: rules.ALLOWED and after)."""
    for h in range(len(m.tail)):
        if m.tail[h] < 0 or h > m.twin[h]:
            continue
        rule, kept, free_ends = orient(m, h)
        if rule == ALLOWED:
            best = attempt(m, kept, free_ends)
            rule = -best if best < 0 else ALLOWED
        counts[rule] += 1
