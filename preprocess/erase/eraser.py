"""Seam erasure (paper, section 4; method, sections 2 and 3): the driver.

`Eraser` lays the grid, assembles the energies and factors them once for a surface and an image size; its `erase`
solves any number of textures of that size. `erase` does both for one texture.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from preprocess.erase.grid import Grid, apply_change, build_grid
from preprocess.erase.intervals import Intervals, split_edges
from preprocess.erase.region import Region, find_region, silhouette_lines
from preprocess.erase.solve import GRADIENT_MASS, Factor, factorise, grid_matrix, outside_force, solve_change
from preprocess.erase.terms import (
    inward_normals,
    jump_rows,
    lerp_targets,
    sample_rows,
    slope_rows,
    value_rows,
)
from preprocess.mesh import Floats, TexturedSurface
from preprocess.seams import Seams

logger = logging.getLogger(__name__)

# Penalty of the method of multipliers. Larger needs fewer repetitions, smaller keeps more digits.
PENALTY = 1e12

# Mean squared jump of the solution, relative to the squared range of each channel's values.
TOLERANCE_REL = 1e-12

# Change below this fraction of the values' range is not carried out to the squares' texels.
NEGLIGIBLE_REL = 1e-7


@dataclass(frozen=True)
class Weights:
    """Weights of the energies (paper, section 4; method, section 3). Dimensionless.

    Attributes
    ----------
    change : float
        Squared change of inside texels, divided by their number: 1e4 local, 1e2 global.
    inside_gradient, outside_gradient : float
        Squared change of the gradient between inside texels; squared gradient where a texel is outside.
    slope : float
        C1 discontinuity across seams.
    value : float
        Deviation along the silhouette from known values (lerp) or from the original texture.
    samples : float
        Mean squared deviation at sample points.
    """

    change: float = 1e4
    inside_gradient: float = 1.0
    outside_gradient: float = 1.0
    slope: float = 1e2
    value: float = 1e2
    samples: float = 1e4


LOCAL = Weights()
GLOBAL = Weights(change=1e2)


@dataclass(frozen=True)
class EraseOptions:
    """How to erase.

    Attributes
    ----------
    weights : Weights
        `LOCAL` changes texels near seams only; `GLOBAL` spreads the difference ten times as far.
    seam_value : str
        "none", "texture" (stay near the original texture along the silhouette: texels outside are reliable) or
        "lerp" (stay near values that run linearly between those at the edges' ends).
    joined : (S,) bool or None
        Seams that are erased; the others are left as they are. None: all.
    repeat : bool
        Whether the sampler repeats beyond the image (it clamps otherwise).
    """

    weights: Weights = LOCAL
    seam_value: str = "none"
    joined: NDArray[np.bool_] | None = None
    repeat: bool = False
    seam_weight: float | None = None


@dataclass(frozen=True)
class Erased:
    """A texture without seams.

    Attributes
    ----------
    texels : (H, W, C) float64
    before, after : (C,) float64
        D_total, the mean squared jump across the joined seams.
    repeats : int
        Repetitions of the method of multipliers.
    """

    texels: Floats
    before: Floats
    after: Floats
    repeats: int


@dataclass(frozen=True)
class Eraser:
    """Everything that erasure needs and that does not depend on the texels.

    Make one with `plan_erasure`.
    """

    surface: TexturedSurface
    seams: Seams
    options: EraseOptions
    region: Region
    grid: Grid
    intervals: Intervals
    lengths_m: Floats
    silhouette: Intervals
    jump: sparse.csr_array
    factor: Factor | None
    rows: dict[str, sparse.csr_array] = field(default_factory=dict)
    value_scale: Floats | None = None

    def erase(self, texels: Floats, *, sample_values: Floats | None = None, end_values: Floats | None = None) -> Erased:
        """Erase the seams of one texture.

        Parameters
        ----------
        texels : (H, W, C) float
        sample_values : (N, C) float, optional
            Values at the sample uvs that the eraser was planned with.
        end_values : (E, 2, C) float, optional
            With seam_value "lerp": values at the ends of every silhouette edge (seam sides, boundaries, foldovers);
            by default the texture's own there, the mean over a surface vertex's uv images.

        Returns
        -------
        Erased

        Raises
        ------
        ValueError
            If the size is not the planned one or a texel is not finite.
        """
        height, width, channels = texels.shape
        if (width, height) != self.grid.size_px:
            raise ValueError(f"planned for {self.grid.size_px} texels, got {(width, height)}")
        if not np.isfinite(texels).all():
            raise ValueError("texels must be finite")
        flat = np.asarray(texels).reshape(-1, channels)
        if self.factor is None:
            return Erased(np.array(texels, np.float64), np.zeros(channels), np.zeros(channels), 0)
        nodes = self.grid.nodes
        values = np.asarray(flat[nodes], np.float64)
        span = np.maximum(np.abs(values).max(axis=0), 1e-30)
        interpolation, weights = self.grid.interpolation, self.options.weights
        force = interpolation.T @ outside_force(self.grid, values, weights.outside_gradient * GRADIENT_MASS)
        for name, weight, target in self._targets(flat, sample_values, end_values):
            deviation = target - self.rows[name] @ values
            force += weight * (interpolation.T @ (self.rows[name].T @ deviation))
        jump_before = self.jump @ values
        tolerance = TOLERANCE_REL if self.options.seam_weight is None else np.inf
        change, after, repeats = solve_change(self.factor, force / span, jump_before / span, tolerance)
        result = apply_change(self.grid, texels, change * span, negligible=NEGLIGIBLE_REL * float(span.max()))
        before = np.einsum("rc,rc->c", jump_before, jump_before)
        return Erased(result, before, after * span**2, repeats)

    def _targets(self, flat: Floats, sample_values: Floats | None, end_values: Floats | None):
        """Name, weight and target of every energy along edges that the texels are held against."""
        weights = self.options.weights
        yield "slope", weights.slope, 0.0
        if "value" in self.rows:
            if self.options.seam_value == "texture":
                yield "value", weights.value, self.rows["value"] @ np.asarray(flat[self.grid.nodes], np.float64)
            else:
                assert self.value_scale is not None
                if end_values is None:
                    end_values = self._own_end_values(flat)
                yield "value", weights.value, lerp_targets(self.silhouette, self.value_scale, end_values)
        if "samples" in self.rows:
            if sample_values is None:
                raise ValueError("planned with samples: their values are needed")
            yield "samples", weights.samples, np.asarray(sample_values) / np.sqrt(max(len(sample_values), 1))

    def _own_end_values(self, flat: Floats) -> Floats:
        """Values of the texture at the ends of every silhouette edge, one a surface vertex."""
        from preprocess.texels import bilinear_stencil

        seams, surface = self.seams, self.surface
        uv_ends = np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs, seams.foldover_uvs])
        texture_to_surface = np.zeros(len(surface.uvs), np.int64)
        texture_to_surface[surface.face_uvs.ravel()] = surface.faces.ravel()
        vertices = texture_to_surface[uv_ends]
        width, height = self.grid.size_px
        texels, weights = bilinear_stencil(surface.uvs[uv_ends.ravel()], width, height)
        samples = np.einsum("nk,nkc->nc", weights, np.asarray(flat[texels], np.float64))
        num = len(surface.positions)
        count = np.bincount(vertices.ravel(), minlength=num)
        total = np.stack([np.bincount(vertices.ravel(), samples[:, c], num) for c in range(flat.shape[1])], axis=1)
        return (total / np.maximum(count, 1)[:, None])[vertices]


def plan_erasure(
    surface: TexturedSurface,
    seams: Seams,
    width: int,
    height: int,
    options: EraseOptions = EraseOptions(),
    *,
    sample_uvs: Floats | None = None,
) -> Eraser:
    """Prepare erasure of textures of one size: intervals, region, grid, energies, factorisation.

    Parameters
    ----------
    surface : TexturedSurface
    seams : Seams
        `find_seams(surface)`.
    width, height : int
        Size of the images in texels.
    options : EraseOptions
    sample_uvs : (N, 2) float64, optional
        Points at which the textures' values are known.

    Returns
    -------
    Eraser
    """
    joined = slice(None) if options.joined is None else options.joined
    intervals = split_edges(surface.uvs[seams.uv_pairs[joined]], width, height, repeat=options.repeat)
    silhouette = split_edges(silhouette_lines(surface, seams), width, height, repeat=options.repeat)
    region = find_region(
        surface, seams, width, height, repeat=options.repeat, silhouette=silhouette, sample_uvs=sample_uvs
    )
    grid = build_grid(region)
    lengths = seams.lengths_m[joined]
    jump = jump_rows(intervals, lengths)
    rows = {}
    normals = inward_normals(surface, seams, width, height)[joined]
    rows["slope"] = slope_rows(intervals, lengths, normals)
    scale = None
    if options.seam_value != "none":
        ends = np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs, seams.foldover_uvs])
        rows["value"], scale = value_rows(silhouette, _silhouette_lengths(surface, seams, ends))
    if sample_uvs is not None:
        rows["samples"] = sample_rows(sample_uvs, width, height)
    jump = _on_nodes(jump, grid)
    rows = {name: _on_nodes(matrix, grid) for name, matrix in rows.items()}
    if jump.shape[0] == 0 or not len(grid.nodes):
        return Eraser(surface, seams, options, region, grid, intervals, lengths, silhouette, jump, None, rows, scale)

    weights = options.weights
    matrix = grid_matrix(
        grid,
        weights.change / max(region.num_inside, 1),
        weights.inside_gradient * GRADIENT_MASS,
        weights.outside_gradient * GRADIENT_MASS,
    )
    for name, weight in (("slope", weights.slope), ("value", weights.value), ("samples", weights.samples)):
        if name in rows:
            matrix = matrix + weight * (rows[name].T @ rows[name])
    interpolation = grid.interpolation
    matrix = sparse.csr_matrix(interpolation.T @ matrix @ interpolation)
    penalty = PENALTY if options.seam_weight is None else options.seam_weight
    factor = factorise(matrix, sparse.csr_matrix(jump @ interpolation), penalty)
    logger.debug("erase: %d nodes, %d unknowns at %d x %d", len(grid.nodes), matrix.shape[0], width, height)
    return Eraser(surface, seams, options, region, grid, intervals, lengths, silhouette, jump, factor, rows, scale)


def _silhouette_lengths(surface: TexturedSurface, seams: Seams, ends: NDArray[np.int32]) -> Floats:
    """3D lengths of the silhouette's edges, in the order of `silhouette_lines`."""
    texture_to_surface = np.zeros(len(surface.uvs), np.int64)
    texture_to_surface[surface.face_uvs.ravel()] = surface.faces.ravel()
    points = surface.positions[texture_to_surface[ends]]
    return np.linalg.norm(points[:, 1] - points[:, 0], axis=1)


def _on_nodes(matrix: sparse.csr_array, grid: Grid) -> sparse.csr_array:
    """The same rows over the grid's nodes instead of all texels."""
    columns = grid.node_of(matrix.indices.astype(np.int64)) if matrix.nnz else matrix.indices
    rows = sparse.csr_array((matrix.data, columns, matrix.indptr), shape=(matrix.shape[0], len(grid.nodes)))
    rows.sum_duplicates()
    return rows


def erase(
    texels: Floats,
    surface: TexturedSurface,
    seams: Seams,
    options: EraseOptions = EraseOptions(),
    *,
    sample_uvs: Floats | None = None,
    sample_values: Floats | None = None,
    end_values: Floats | None = None,
) -> Erased:
    """Erase the seams of one texture.

    Parameters
    ----------
    texels : (H, W, C) float
    surface : TexturedSurface
    seams : Seams
    options : EraseOptions
    sample_uvs, sample_values : (N, 2) and (N, C) float64, optional
        Points at which the texture's values are known.
    end_values : (E, 2, C) float64, optional
        See `Eraser.erase`.

    Returns
    -------
    Erased
    """
    height, width = texels.shape[:2]
    plan = plan_erasure(surface, seams, width, height, options, sample_uvs=sample_uvs)
    return plan.erase(texels, sample_values=sample_values, end_values=end_values)
