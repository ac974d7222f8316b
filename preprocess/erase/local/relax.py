"""Erasure near seams, solved in place: the compiled part (see `band` for the system, `closing` for the order of steps).

Two methods that need neither a matrix nor a factor, and whose cost is linear in the texels beside seams:

1. Relaxation (Gauss-Seidel with over-relaxation): texel by texel the energy is minimised within the texel's range.
   While the penalty of jumps is of the order of the other energies this settles within a few sweeps; as it grows, what
   both sides of a seam have in common has settled already.
2. Projection (Agmon 1954; Motzkin and Schoenberg 1954, "The relaxation method for linear inequalities"): each sample
   that jumps too far is reflected into its limits, the texels that it reads moving as little as possible. Only samples
   beyond their limits cost anything, and reflections carry what is left along the seam to where there is room for it.
"""

from __future__ import annotations

from preprocess.numerics.jit import fixed_memory_entry

AIM = 0.6  # of its limit: where a sample is brought that exceeds it
REFLECTION = 1.9  # of the way to the aim; 1 would be a projection, 2 a reflection


@fixed_memory_entry
def relax(  # type: ignore[no-untyped-def]
    order, values, given, pull, mass, neighbours, stiffness, starts, samples, shares, jumps, penalties, limit, beyond,
    low, high,
):  # fmt: skip
    """Visit texels in an order; `values` (N, C) and `jumps` (P, C) change in place.

    `pull` (N, C) holds the differences that are to stay, times their stiffness; `penalties` (P,) what a squared jump
    beyond the limit costs; steps go `beyond` times as far as the minimum of a texel's energy.
    """
    for i in range(len(order)):
        t = order[i]
        bend = mass[t] + stiffness[t, 0] + stiffness[t, 1] + stiffness[t, 2] + stiffness[t, 3]
        for c in range(values.shape[1]):
            value = values[t, c]
            slope = mass[t] * (value - given[t, c]) - pull[t, c]
            for k in range(4):
                slope += stiffness[t, k] * (value - values[neighbours[t, k], c])
            curvature = bend
            for k in range(starts[t], starts[t + 1]):
                jump = jumps[samples[k], c]
                over = jump - min(max(jump, -limit), limit)
                if over != 0.0:
                    force = penalties[samples[k]] * shares[k]
                    slope += force * over
                    curvature += force * shares[k]
            step = min(max(value - beyond * slope / curvature, low), high) - value
            if step != 0.0:
                values[t, c] = value + step
                for k in range(starts[t], starts[t + 1]):
                    jumps[samples[k], c] += shares[k] * step


@fixed_memory_entry
def project(  # type: ignore[no-untyped-def]
    values, jumps, texels, weights, starts, samples, shares, limits, low, high, sweeps, queue, waits
):
    """Bring samples into their limits (P,); `values` (N, C) and `jumps` (P, C) change in place.

    `queue` (P,) and `waits` (P,) are room to work in. Returns how many samples were beyond their limits at the end.
    """
    channels = values.shape[1]
    waiting = 0
    for s in range(len(limits)):
        waits[s] = False
        for c in range(channels):
            waits[s] |= abs(jumps[s, c]) > limits[s]
        if waits[s]:
            queue[waiting] = s
            waiting += 1
    for _ in range(sweeps):
        if waiting == 0:
            break
        for q in range(waiting):
            s = queue[q]
            square = 0.0
            for k in range(8):
                square += weights[s, k] * weights[s, k]
            for c in range(channels):
                jump = jumps[s, c]
                if abs(jump) <= limits[s]:
                    continue
                aim = AIM * limits[s] if jump > 0.0 else -AIM * limits[s]
                factor = REFLECTION * (jump - aim) / square
                for k in range(8):
                    if weights[s, k] == 0.0:
                        continue
                    t = texels[s, k]
                    step = min(max(values[t, c] - factor * weights[s, k], low), high) - values[t, c]
                    if step != 0.0:
                        values[t, c] += step
                        for e in range(starts[t], starts[t + 1]):
                            jumps[samples[e], c] += shares[e] * step
        # Who is out of limits now reads a texel that has moved: samples that share one with those just treated.
        treated = waiting
        for q in range(treated):
            s = queue[q]
            for k in range(8):
                if weights[s, k] == 0.0:
                    continue
                t = texels[s, k]
                for e in range(starts[t], starts[t + 1]):
                    other = samples[e]
                    if waits[other]:
                        continue
                    for c in range(channels):
                        if abs(jumps[other, c]) > limits[other]:
                            waits[other] = True
                    if waits[other]:
                        queue[waiting] = other
                        waiting += 1
        kept = 0
        for q in range(waiting):
            s = queue[q]
            waits[s] = False
            for c in range(channels):
                waits[s] |= abs(jumps[s, c]) > limits[s]
            if waits[s]:
                queue[kept] = s
                kept += 1
        waiting = kept
    return waiting
