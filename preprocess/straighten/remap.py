"""Moves the interior of the charts after their boundary, without folds (paper, section 6, "internal warping").

1. The boundary's displacement is spread harmonically over the interior.
2. Where that folds or squeezes triangles, a patch around them is relaxed with its border and the chart's boundary
   fixed. The energy grows without bound as a triangle loses its area, and is regularised so that it can start from a
   folded state (Garanzha, Kaporin, Kudryavtseva, Protais, Ray, Sokolov 2021: Foldover-free maps in 50 lines of code,
   equations 3 to 6); minimised with L-BFGS.

The orientation test at the end is exact: a triangle counts as sound only where its signed area, relative to its rest
shape, clears rounding by many orders of magnitude.

Rest shape of a triangle: its own uvs before, so that nothing moves that does not have to. Triangles that are folded or
without area in them have none to keep: they follow their neighbours.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from preprocess.arrays import Bools, Floats
from preprocess.mesh.edges import chart_of_faces
from preprocess.mesh.surface import TexturedSurface
from preprocess.numerics.jit import entry

LEAST_AREA = 1e-4  # of its rest area: a triangle below counts as folded (rounding is near 1e-12)
SQUEEZED_AREA = 0.3  # of its rest area: a triangle below is relaxed
SQUEEZED_SHAPE = 2.0  # |J|² / (2 det J), 1 where angles are kept: a triangle above is relaxed
PATCH_RINGS = 4  # faces around a squeezed one that may move with it
OUTER_STEPS = 12  # regularisation steps; the energy is nearly the barrier itself after a few
INNER_STEPS = 80  # L-BFGS iterations a step
HISTORY = 10  # of L-BFGS
MOST_HALVINGS = 12  # of a step that does not lower the energy
MOST_CG_STEPS = 1000
CG_RESIDUAL = 1e-4  # relative: the harmonic map is a smooth start, so exactness is idle
AREA_WEIGHT = 0.25  # of keeping areas against keeping angles


@dataclass(frozen=True)
class RestShapes:
    """What the triangles should look like in uv.

    Attributes
    ----------
    inverse : (F, 2, 2) float64
        Inverse of the matrix whose columns are the rest shape's two edges from its first corner; with the chart's
        orientation, so that a sound triangle has a positive determinant in either kind of chart.
    areas_uv : (F,) float64
        Twice the rest area.
    charts : (F,) int64
        Chart of every face.
    was_folded : (F,) bool
        The uvs are folded against their chart, or have no area: of the rest shape only the orientation counts.
    """

    inverse: Floats
    areas_uv: Floats
    charts: NDArray[np.int64]
    was_folded: Bools


def _edge_matrices(points: Floats, faces: NDArray[np.integer]) -> Floats:
    """Edges from the first corner as columns, (F, 2, 2) float64."""
    corner = points[faces]
    return np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)


def _det(matrices: Floats) -> Floats:
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]


def find_rest_shapes(surface: TexturedSurface) -> RestShapes:
    """Rest shapes of all faces from their present uvs."""
    charts = chart_of_faces(surface)
    edges = _edge_matrices(surface.uvs, surface.face_uvs)
    area = _det(edges)
    num_charts = int(charts.max(initial=-1)) + 1
    sign = np.where(np.bincount(charts, weights=area, minlength=num_charts) < 0.0, -1.0, 1.0)
    size = np.abs(edges).sum(axis=(1, 2))
    was_folded = sign[charts] * area <= 1e-9 * size**2
    if was_folded.any():
        stand_in = np.zeros((int(was_folded.sum()), 2, 2))  # only its orientation counts
        stand_in[:, 0, 0], stand_in[:, 1, 1] = 1.0, sign[charts[was_folded]]
        edges[was_folded] = stand_in
        area = _det(edges)
    a, b, c, d = edges[:, 0, 0], edges[:, 0, 1], edges[:, 1, 0], edges[:, 1, 1]
    inverse = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1) / area[:, None, None]
    return RestShapes(inverse, np.abs(area), charts, was_folded)


def relative_areas(surface: TexturedSurface, uvs: Floats, rest: RestShapes) -> Floats:
    """Signed area of every face over that of its rest shape, (F,) float64; positive where it is not folded."""
    return _det(_edge_matrices(uvs, surface.face_uvs) @ rest.inverse)


def shape_distortions(surface: TexturedSurface, uvs: Floats, rest: RestShapes) -> Floats:
    """|J|² / (2 |det J|) of every face against its rest shape, (F,) float64; 1 where angles are kept."""
    jacobian = _edge_matrices(uvs, surface.face_uvs) @ rest.inverse
    square = (jacobian**2).sum(axis=(1, 2))
    result: Floats = square / np.maximum(2.0 * np.abs(_det(jacobian)), 1e-100 * np.maximum(square, 1e-100))
    return result


@entry
def _energy(points, faces, inverse, areas, epsilon, gradient):  # type: ignore[no-untyped-def]
    """Regularised distortion of all faces; adds its derivative by the points to `gradient` (N, 2)."""
    total = 0.0
    for f in range(len(faces)):
        i, j, k = faces[f]
        ax, ay = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        bx, by = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
        r00, r01, r10, r11 = inverse[f, 0, 0], inverse[f, 0, 1], inverse[f, 1, 0], inverse[f, 1, 1]
        m00, m01 = ax * r00 + bx * r10, ax * r01 + bx * r11
        m10, m11 = ay * r00 + by * r10, ay * r01 + by * r11
        det = m00 * m11 - m01 * m10
        root = np.sqrt(epsilon * epsilon + det * det)
        if det > 0.0:
            chi = 0.5 * (det + root)
        else:
            chi = 0.5 * epsilon * epsilon / (root - det)
        slope = chi / root
        square = m00 * m00 + m01 * m01 + m10 * m10 + m11 * m11
        shape, size = 0.5 * square / chi, 0.5 * (det * det + 1.0) / chi
        total += areas[f] * (shape + AREA_WEIGHT * size)
        by_square = areas[f] / chi
        by_det = areas[f] * (AREA_WEIGHT * det / chi - (shape + AREA_WEIGHT * size) * slope / chi)
        g00 = by_square * m00 + by_det * m11
        g01 = by_square * m01 - by_det * m10
        g10 = by_square * m10 - by_det * m01
        g11 = by_square * m11 + by_det * m00
        gax, gay = g00 * r00 + g01 * r01, g10 * r00 + g11 * r01
        gbx, gby = g00 * r10 + g01 * r11, g10 * r10 + g11 * r11
        gradient[j, 0] += gax
        gradient[j, 1] += gay
        gradient[k, 0] += gbx
        gradient[k, 1] += gby
        gradient[i, 0] -= gax + gbx
        gradient[i, 1] -= gay + gby
    return total


def _solve_cg(system: Any, right: Floats, start: Floats) -> Floats:
    """Conjugate gradients from a start, to `CG_RESIDUAL` of the right side.

    NumPy's own sums, here and below, give the same bits whatever the number of threads; BLAS does not.
    """
    solution = start.copy()
    residual = right - system @ start
    direction, square = residual.copy(), float((residual * residual).sum())
    goal = CG_RESIDUAL**2 * float((right * right).sum())
    for _ in range(MOST_CG_STEPS):
        if square <= goal:
            break
        image = system @ direction
        step = square / float((direction * image).sum())
        solution += step * direction
        residual -= step * image
        before, square = square, float((residual * residual).sum())
        direction = residual + (square / before) * direction
    return solution


def _minimise(evaluate: Callable[[Floats], tuple[float, Floats]], x: Floats, steps: int) -> tuple[Floats, float]:
    """L-BFGS with backtracking (Nocedal 1980): the point reached and its value, never above the start's."""
    value, gradient = evaluate(x)
    history: deque[tuple[Floats, Floats, float]] = deque(maxlen=HISTORY)
    for _ in range(steps):
        direction = -gradient
        pending = []
        for move, change, product in reversed(history):
            factor = float((move * direction).sum()) / product
            direction -= factor * change
            pending.append(factor)
        if history:
            move, change, product = history[-1]
            direction *= product / float((change * change).sum())
        for (move, change, product), factor in zip(history, reversed(pending), strict=True):
            direction += (factor - float((change * direction).sum()) / product) * move
        slope = float((direction * gradient).sum())
        if slope >= 0.0:
            if not history:
                break
            history.clear()
            continue
        length = 1.0 if history else min(1.0, 0.1 / max(float(np.abs(direction).max()), 1e-300))
        for _ in range(MOST_HALVINGS):
            trial = x + length * direction
            trial_value, trial_gradient = evaluate(trial)
            if trial_value <= value + 1e-4 * length * slope:
                break
            # The minimum of the parabola through what is known, within bounds that cannot stall or overshoot.
            curve = trial_value - value - length * slope
            length *= min(max(-0.5 * length * slope / curve, 0.1), 0.5) if np.isfinite(curve) else 0.1
        else:
            if not history:
                break
            history.clear()
            continue
        move, change = trial - x, trial_gradient - gradient
        product = float((move * change).sum())
        if product > 1e-12 * float((change * change).sum()):
            history.append((move, change, product))
        done = value - trial_value <= 1e-6 * abs(value)
        x, value, gradient = trial, trial_value, trial_gradient
        if done:
            break
    return x, value


def _spread_harmonically(surface: TexturedSurface, displacement: Floats, fixed: Bools) -> Floats:
    """Harmonic extension of the fixed vertices' displacement into the interior, (T, 2) float64.

    Solves L_ii d_i = -L_if d_f with the cotangent Laplacian of the present uvs, clipped to positive weights, from the
    displacements given for the interior.
    """
    if not displacement[fixed].any() or fixed.all():
        return np.where(fixed[:, None], displacement, 0.0)
    ids = surface.face_uvs.astype(np.int64)
    corner = surface.uvs[ids]
    rows, columns, weights = [], [], []
    for k in range(3):
        a, b = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        cot = (a * b).sum(axis=1) / np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1e-30)
        rows.append(ids[:, (k + 1) % 3])
        columns.append(ids[:, (k + 2) % 3])
        weights.append(np.clip(cot, 0.02, 50.0))
    row, column, weight = np.concatenate(rows), np.concatenate(columns), np.concatenate(weights)
    num = len(surface.uvs)
    links = csr_array(coo_array((np.r_[weight, weight], (np.r_[row, column], np.r_[column, row])), (num, num)))
    degree = np.asarray(links.sum(axis=1)).ravel()
    free = np.flatnonzero(~fixed & (degree > 0.0))
    inner = links[free][:, free]
    right = links[free] @ np.where(fixed[:, None], displacement, 0.0)
    # Scaled to a unit diagonal, which is Jacobi's preconditioner.
    scale = 1.0 / np.sqrt(degree[free])
    entries = coo_array(inner)
    scaled = -entries.data * scale[entries.row] * scale[entries.col]
    system = csr_array((scaled, (entries.row, entries.col)), shape=inner.shape)
    system.setdiag(1.0)
    result = displacement.copy()
    for axis in range(2):
        result[free, axis] = scale * _solve_cg(system, scale * right[:, axis], displacement[free, axis] / scale)
    return result


def _relax(surface: TexturedSurface, uvs: Floats, faces: NDArray[np.int64], free: Bools, rest: RestShapes) -> Floats:
    """Minimise the distortion of some faces over their free vertices, from folded to barrier, (T, 2) float64."""
    local, ids = np.unique(surface.face_uvs[faces], return_inverse=True)
    ids = ids.reshape(-1, 3)
    points = uvs[local].copy()
    moves = free[local]
    inverse, areas = rest.inverse[faces], rest.areas_uv[faces]
    # One unit of length and energy for the solver: the mean rest triangle's. A floor keeps slivers from being ignored.
    unit = np.sqrt(areas.mean())
    points, inverse, areas = points / unit, inverse * unit, np.maximum(areas / areas.mean(), 0.1)

    x, previous = points[moves].ravel(), np.inf
    for _ in range(OUTER_STEPS):
        points[moves] = x.reshape(-1, 2)
        least = float(_det(_edge_matrices(points, ids) @ inverse).min())
        epsilon = float(np.sqrt(1e-10 + 0.04 * min(least, 0.0) ** 2))

        def evaluate(x: Floats, epsilon: float = epsilon) -> tuple[float, Floats]:
            points[moves] = x.reshape(-1, 2)
            gradient = np.zeros_like(points)
            return _energy(points, ids, inverse, areas, epsilon, gradient), gradient[moves].ravel()

        x, value = _minimise(evaluate, x, INNER_STEPS)
        if least > LEAST_AREA and value > 0.999 * previous:
            break
        previous = value if least > LEAST_AREA else np.inf
    points[moves] = x.reshape(-1, 2)
    result = uvs.copy()
    result[local[moves]] = points[moves] * unit
    return result


def remap_interior(surface: TexturedSurface, goal_uvs: Floats, fixed: Bools, rest: RestShapes) -> Floats:
    """Move interior texture vertices after the boundary.

    Parameters
    ----------
    surface : TexturedSurface
        With its uvs as they were.
    goal_uvs : (T, 2) float64
        Where the fixed vertices go, and a guess for the others.
    fixed : (T,) bool
        Texture vertices on the silhouette.
    rest : RestShapes

    Returns
    -------
    (T, 2) float64
        Without folds where the solver found such a map: see `relative_areas` and `LEAST_AREA`.
    """
    uvs = surface.uvs + _spread_harmonically(surface, goal_uvs - surface.uvs, fixed)
    uvs[fixed] = goal_uvs[fixed]
    used = np.zeros(len(uvs), bool)
    for _ in range(2):  # a second time with what the first one squeezed outside its patch
        area = relative_areas(surface, uvs, rest)
        squeezed = (area < SQUEEZED_AREA) | (shape_distortions(surface, uvs, rest) > SQUEEZED_SHAPE)
        squeezed = squeezed & ~fixed[surface.face_uvs].all(axis=1) & ~rest.was_folded
        if not squeezed.any():
            break
        patch: Bools = squeezed.copy()
        for _ in range(PATCH_RINGS):
            used[:] = False
            used[surface.face_uvs[patch].ravel()] = True
            patch = np.asarray(used[surface.face_uvs].any(axis=1))
        free = used & ~fixed
        uvs = _relax(surface, uvs, np.flatnonzero(patch & ~rest.was_folded), free, rest)
    return uvs
