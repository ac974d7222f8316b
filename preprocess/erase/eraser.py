"""Seam erasure of textures with a prepared system (paper, section 4; docs/method.md, sections 2 and 3): the driver.

Gather the texels that may change, form the right-hand side, solve for their change, carry it out to the texels between
them; for integer formats, round such that the stored texels are seamless. See `plan` for the preparation.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.arrays import Floats
from preprocess.erase.energies import lerp_targets
from preprocess.erase.grid import Grid
from preprocess.erase.intervals import Intervals
from preprocess.erase.matrix import GRADIENT_MASS, outside_force
from preprocess.erase.options import EraseOptions
from preprocess.erase.prolongation import spread_far, spread_near
from preprocess.erase.quantise import round_strip
from preprocess.erase.region import Region, silhouette_ends
from preprocess.erase.seam_samples import SeamMeasure, SeamStrip, build_strip, measure_intervals
from preprocess.erase.solve import (
    BOUND_TOLERANCE_REL,
    LIMIT_REPEATS,
    Factor,
    factorise_bounded,
    keep_by_contrast,
    solve_bounded,
    solve_change,
    solve_limited,
)
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import bilinear_stencil
from preprocess.numerics import cholesky

logger = logging.getLogger(__name__)

# Mean squared jump of the solution, relative to the squared range of each channel's values. Nearly always met at the
# first solution, which then does not depend on what other channels are solved with it.
TOLERANCE_REL = 2e-12

# Jump of stored integers, in steps, above which the solution is sought within the range from the start: rounding a
# solution that was cut off at its ends costs less but does not always succeed.
MAX_STORED_JUMP = 0.48

# Change below this fraction of the values' range is not carried out to the squares' texels.
NEGLIGIBLE_REL = 1e-7


@dataclass(frozen=True)
class Erased:
    """A texture without seams.

    Attributes
    ----------
    texels : (H, W, C)
        float64 from `Eraser.erase` (float32 where that was given), the given integer type from `Eraser.erase_stored`.
    before, after : (C,) float64
        D_total, the mean squared jump across the joined seams, of the texels given and of the solution.
    repeats : int
        Repetitions of the method of multipliers.
    """

    texels: NDArray[Any]
    before: Floats
    after: Floats
    repeats: int


@dataclass(frozen=True)
class Solution:
    """The change of the grid's nodes. N nodes, C channels.

    Attributes
    ----------
    values, change : (N, C) float64
        Values given, and what is to be added to them.
    before, after : (C,) float64
        D_total.
    repeats : int
    negligible : float
        Change that need not be carried out.
    """

    values: Floats
    change: Floats
    before: Floats
    after: Floats
    repeats: int
    negligible: float


@dataclass(frozen=True)
class Eraser:
    """Everything that erasure needs and that does not depend on the texels. Made by `plan_erasure`."""

    surface: TexturedSurface
    seams: Seams
    options: EraseOptions
    region: Region
    grid: Grid
    intervals: Intervals
    lengths_m: Floats
    silhouette: Intervals
    factor: Factor | None
    rows: dict[str, sparse.csr_array] = field(default_factory=dict)
    value_scale: Floats | None = None

    def erase(
        self,
        texels: Floats,
        *,
        sample_values: Floats | None = None,
        end_values: Floats | None = None,
        bounds: tuple[float, float] | None = None,
        jump_limit: float | None = None,
    ) -> Erased:
        """Erase the seams of one texture.

        Parameters
        ----------
        texels : (H, W, C) float
        sample_values : (N, C) float, optional
            Values at the sample uvs that the eraser was planned with.
        end_values : (E, 2, C) float, optional
            With seam_value "lerp": values at the ends of every silhouette edge (seam sides, boundaries, foldovers);
            by default the texture's own there, the mean over a surface vertex's uv images.
        bounds : (float, float), optional
            Range to stay in. Texels that seams read are solved for within it (to 1e-5 of the values' range).
        jump_limit : float, optional
            Instead of that of the options.

        Returns
        -------
        Erased

        Raises
        ------
        ValueError
            If the size is not the planned one or a texel is not finite.
        """
        limit = self.options.jump_limit if jump_limit is None else jump_limit
        solution = self._solve(texels, 1.0, sample_values, end_values, bounds, limit)
        result = np.array(texels, np.float32 if texels.dtype == np.float32 else np.float64, order="C", copy=True)
        flat = result.reshape(-1, result.shape[2])
        source = texels.reshape(flat.shape)
        for where, change in self._spread(solution, solution.negligible):
            flat[where] = source[where] + change
        if bounds is not None and self.factor is not None:
            np.clip(flat, *bounds, out=flat)
            on_seam = self.grid.node_of(self.strip.texels)
            flat[self.strip.texels] = solution.values[on_seam] + solution.change[on_seam]
        return Erased(result, solution.before, solution.after, solution.repeats)

    def erase_stored(self, stored: NDArray[Any], *, end_values: Floats | None = None) -> Erased:
        """Erase the seams of a texture of 8- or 16-bit integers, such that the integers themselves are seamless.

        Needs little more memory than the texture: only texels that change become real numbers on the way.

        Parameters
        ----------
        stored : (H, W, C) uint8 or uint16
        end_values : (E, 2, C) float, optional
            See `erase`; in [0, 1].

        Returns
        -------
        Erased
            `before` and `after` are of the values in [0, 1] that the integers stand for.
        """
        erased, worst = self._store(stored, end_values, None)
        if worst > MAX_STORED_JUMP:
            logger.info("erase: rounding leaves a jump of %.2f steps: solving again within the range", worst)
            erased, worst = self._store(stored, end_values, (0.0, 1.0))
        return erased

    def _store(
        self, stored: NDArray[Any], end_values: Floats | None, bounds: tuple[float, float] | None
    ) -> tuple[Erased, float]:
        """Erased integers, and their largest jump in steps."""
        levels = int(np.iinfo(stored.dtype).max)
        solution = self._solve(stored, 1.0 / levels, None, end_values, bounds, self.options.jump_limit)
        result = np.array(stored, order="C", copy=True)
        flat = result.reshape(-1, result.shape[2])
        source = stored.reshape(flat.shape)
        for where, change in self._spread(solution, max(solution.negligible, 0.25 / levels)):
            flat[where] = np.clip(np.rint(source[where] + change * levels), 0, levels)
        worst = 0.0
        if self.factor is not None:
            strip = self.strip
            on_seam = self.grid.node_of(strip.texels)
            rounded = round_strip(solution.values[on_seam] + solution.change[on_seam], strip, levels)
            worst = float(np.abs(strip.rows @ rounded).max(initial=0.0))
            flat[strip.texels] = rounded
        return Erased(result, solution.before, solution.after, solution.repeats), worst

    def _spread(self, solution: Solution, negligible: float) -> Iterator[tuple[NDArray[np.int64], Floats]]:
        """Texels and their change: first those of the larger squares, then the nodes and all that is near them."""
        if self.factor is None:
            return
        yield from spread_far(self.grid, solution.change, negligible)
        weights, num_inside = self.options.weights, max(self.region.num_inside, 1)
        stiffness = weights.inside_gradient * GRADIENT_MASS
        attenuation = stiffness / max(4 * stiffness + weights.change / num_inside, 1e-300)
        yield spread_near(self.grid, self.region, solution.change, negligible, attenuation)

    @property
    def is_large(self) -> bool:
        """Whether its system is solved once, neither within a range nor with tighter limits."""
        return self.factor is not None and self.factor.is_large

    @cached_property
    def strip(self) -> SeamStrip:
        """Samples along the joined seams, for rounding."""
        return build_strip(self.intervals, self.lengths_m)

    @cached_property
    def _bounded(self) -> tuple[NDArray[np.int32], cholesky.Factor]:
        """Unknowns that stay in a range where one is given, and the system for them: needed seldom, or often."""
        assert self.factor is not None
        unknowns = self.grid.unknown_of(self.strip.texels)
        return unknowns, factorise_bounded(self.factor, unknowns)

    def measure(self, texels: NDArray[Any], unit: float = 1.0) -> SeamMeasure:
        """Jump of a texture of the planned size across the joined seams, in a unit of the texture."""
        found = measure_intervals(texels, self.intervals, self.lengths_m)
        return SeamMeasure(found.rms / unit, found.max / unit, found.total / unit**2, found.seam_rms / unit)

    def _solve(
        self,
        texels: NDArray[Any],
        scale: float,
        sample_values: Floats | None,
        end_values: Floats | None,
        bounds: tuple[float, float] | None,
        jump_limit: float | None,
    ) -> Solution:
        """Change of the nodes for texels times scale."""
        height, width, channels = texels.shape
        if (width, height) != self.grid.size_px:
            raise ValueError(f"planned for {self.grid.size_px} texels, got {(width, height)}")
        if texels.dtype.kind == "f" and not np.isfinite(texels).all():
            raise ValueError("texels must be finite")
        values = texels.reshape(-1, channels)[self.grid.nodes].astype(np.float64) * scale
        if self.factor is None:
            zero = np.zeros(channels)
            return Solution(values, np.zeros_like(values), zero, zero, 0, 0.0)
        span = np.maximum(np.abs(values).max(axis=0), 1e-30)
        interpolation, weights = self.grid.interpolation, self.options.weights
        force = interpolation.T @ outside_force(self.grid, values, weights.outside_gradient * GRADIENT_MASS)
        free_values = values[self.grid.free]
        for name, weight, target in self._targets(values, sample_values, end_values):
            force += weight * (self.rows[name].T @ (target - self.rows[name] @ free_values))
        jump = self.factor.jump @ free_values
        tolerance = TOLERANCE_REL if self.options.seam_weight is None else np.inf
        goal, repeats = np.zeros_like(jump), LIMIT_REPEATS
        if jump_limit is None:
            free, after, repeats = solve_change(self.factor, force / span, jump / span, tolerance)
        else:
            free, after, goal = solve_limited(self.factor, force / span, jump / span, jump_limit / span)
        if bounds is not None:
            free, after = self._keep_range(force / span, jump / span, goal, free, after, values / span, bounds, span)
        return Solution(
            values=values,
            change=interpolation @ (free * span),
            before=np.einsum("rc,rc->c", jump, jump),
            after=after * span**2,
            repeats=repeats,
            negligible=NEGLIGIBLE_REL * float(span.max()),
        )

    def _keep_range(
        self,
        force: Floats,
        jump: Floats,
        goal: Floats,
        free: Floats,
        after: Floats,
        values: Floats,
        bounds: tuple[float, float],
        span: Floats,
    ) -> tuple[Floats, Floats]:
        """Solve again within the range where a texel that seams read has left it."""
        assert self.factor is not None
        on_seam = self.grid.node_of(self.strip.texels)
        unknowns = self.grid.unknown_of(self.strip.texels)
        lower, upper = bounds[0] / span - values[on_seam], bounds[1] / span - values[on_seam]
        start = free[unknowns]
        worst = max((lower - start).max(initial=0.0), (start - upper).max(initial=0.0))
        if worst <= BOUND_TOLERANCE_REL or self.factor.is_large:  # then rounding cuts off what is out of range
            return free, after
        unknowns, pulled = self._bounded
        free, excess = solve_bounded(self.factor, pulled, force, jump - goal, free, unknowns, lower, upper)
        if excess > BOUND_TOLERANCE_REL:
            logger.info("erase: the solution leaves its range by %.1e near seams: contrast is lowered there", excess)
            free[unknowns] = (
                keep_by_contrast(values[on_seam] + free[unknowns], self.strip, bounds[0] / span, bounds[1] / span)
                - values[on_seam]
            )
        left = jump + self.factor.jump @ free
        return free, np.einsum("rc,rc->c", left, left)

    def _targets(
        self, values: Floats, sample_values: Floats | None, end_values: Floats | None
    ) -> Iterator[tuple[str, float, Floats | float]]:
        """Name, weight and target of every energy along edges that the texels are held against."""
        weights = self.options.weights
        yield "slope", weights.slope, 0.0
        if "value" in self.rows:
            if self.options.seam_value == "texture":
                yield "value", weights.value, self.rows["value"] @ values[self.grid.free]
            else:
                assert self.value_scale is not None
                if end_values is None:
                    end_values = self._own_end_values(values)
                yield "value", weights.value, lerp_targets(self.silhouette, self.value_scale, end_values)
        if "samples" in self.rows:
            if sample_values is None:
                raise ValueError("planned with samples: their values are needed")
            yield "samples", weights.samples, np.asarray(sample_values) / np.sqrt(max(len(sample_values), 1))

    def _own_end_values(self, values: Floats) -> Floats:
        """Values of the texture at the ends of every silhouette edge, one a surface vertex, (E, 2, C)."""
        ends = silhouette_ends(self.seams)
        vertices = surface_vertices(self.surface)[ends]
        texels, weights = bilinear_stencil(self.surface.uvs[ends.ravel()], *self.grid.size_px)
        samples = np.einsum("nk,nkc->nc", weights, values[self.grid.node_of(texels)])
        num = len(self.surface.positions)
        count = np.bincount(vertices.ravel(), minlength=num)
        total = np.stack(
            [np.bincount(vertices.ravel(), samples[:, c], num) for c in range(values.shape[1])],
            axis=1,
        )
        return (total / np.maximum(count, 1)[:, None])[vertices]


def surface_vertices(surface: TexturedSurface) -> NDArray[np.int64]:
    """Surface vertex of every texture vertex, (T,)."""
    vertices = np.zeros(len(surface.uvs), np.int64)
    vertices[surface.face_uvs.ravel()] = surface.faces.ravel()
    return vertices
