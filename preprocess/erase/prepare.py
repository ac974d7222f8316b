"""Preparation of seam erasure for one surface and one image size (paper, section 4): everything but the texels.

Cut the seams into intervals, find the used texels, lay the quadtree, write the energies as sparse rows, add them up and
factor the matrix. The `Eraser` that comes out solves any number of textures.
"""

from __future__ import annotations

import logging

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from preprocess.arrays import Floats
from preprocess.erase.energies import inward_normals, jump_elements, sample_rows, slope_elements, to_rows, value_rows
from preprocess.erase.eraser import Erased, Eraser, surface_vertices
from preprocess.erase.grid import Grid, build_grid
from preprocess.erase.intervals import cut_into_intervals
from preprocess.erase.matrix import GRADIENT_MASS, grid_matrix, rows_matrix
from preprocess.erase.options import DEFAULT_OPTIONS, EraseOptions, Weights
from preprocess.erase.region import find_region, silhouette_ends, silhouette_lines
from preprocess.erase.solve import factorise
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import uv_to_px

logger = logging.getLogger(__name__)

# Penalty of the method of multipliers. Larger needs fewer repetitions, smaller keeps more digits: with this one the
# gradient of the other energies still vanishes to 1e-6.
PENALTY = 1e13


def _silhouette_lengths(surface: TexturedSurface, seams: Seams) -> Floats:
    """3D lengths of the silhouette's edges, in the order of `silhouette_lines`."""
    points = surface.positions[surface_vertices(surface)[silhouette_ends(seams)]]
    result: Floats = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    return result


def _on_unknowns(rows: sparse.csr_array, grid: Grid) -> sparse.csr_array:
    """The same rows over the unknowns instead of all texels."""
    columns = grid.unknown_of(rows.indices)
    rows = sparse.csr_array((rows.data, columns, rows.indptr), shape=(rows.shape[0], len(grid.free)))
    rows.sum_duplicates()
    return rows


def _reaches(weights: Weights, num_inside: int) -> tuple[int, int]:
    """Fineness of the grid (`fine_reach`, `reach`) for the distance over which the change fades.

    The further it reaches, the more the squares far from the seams count; where it is short, the texels near them are
    relaxed in the end (see `spread`). Measured on Fox, whose texels change by up to 0.7, from 256² to 1024²: no texel
    inside differs from the full grid's by more than 0.5/255, local or global.
    """
    fading_px = np.sqrt(weights.inside_gradient * GRADIENT_MASS * max(num_inside, 1) / max(weights.change, 1e-12))
    return 2, 2 + int(fading_px >= 6) + int(fading_px >= 12) + int(fading_px >= 20)


def plan_erasure(
    surface: TexturedSurface,
    seams: Seams,
    width: int,
    height: int,
    options: EraseOptions = DEFAULT_OPTIONS,
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
    intervals = cut_into_intervals(surface.uvs[seams.uv_pairs[joined]], width, height, repeat=options.repeat)
    silhouette = cut_into_intervals(silhouette_lines(surface, seams), width, height, repeat=options.repeat)
    region = find_region(
        surface,
        seams,
        width,
        height,
        repeat=options.repeat,
        silhouette=silhouette,
        sample_uvs=sample_uvs,
        seam_cells=intervals.texels[:, :, 0],
    )
    fine_reach, reach = _reaches(options.weights, region.num_inside)
    grid = build_grid(region, fine_reach=fine_reach, reach=reach)

    lengths = seams.lengths_m[joined]
    rows: dict[str, sparse.csr_array] = {}
    scale = None
    if options.seam_value != "none":
        rows["value"], scale = value_rows(silhouette, _silhouette_lengths(surface, seams))
    if sample_uvs is not None:
        rows["samples"] = sample_rows(sample_uvs, width, height)
    rows = {name: _on_unknowns(matrix, grid) for name, matrix in rows.items()}

    factor = None
    if len(intervals) and len(grid.nodes):
        unknowns = grid.unknown_of(intervals.texels.reshape(-1, 8))
        normals = inward_normals(surface, seams, width, height)[joined]
        rows["slope"] = to_rows(unknowns, slope_elements(intervals, lengths, normals), len(grid.free))
        penalty = PENALTY if options.seam_weight is None else options.seam_weight

        def assemble() -> sparse.csr_array:
            elements = np.concatenate(
                [
                    np.sqrt(penalty) * jump_elements(intervals, lengths),
                    np.sqrt(options.weights.slope) * slope_elements(intervals, lengths, normals),
                ],
                axis=1,
            )
            matrix = rows_matrix(unknowns, elements, len(grid.free))
            del elements
            matrix = matrix + _assemble_grid(grid, options.weights, region.num_inside)
            for name, weight in (("value", options.weights.value), ("samples", options.weights.samples)):
                if name in rows:
                    matrix = matrix + weight * (rows[name].T @ rows[name])
            return sparse.csr_array(matrix)

        jump = jump_elements(intervals, lengths)
        row_scales = jump[:, :, :4].sum(axis=2).reshape(-1)  # one side's weights sum to one before they are scaled
        seam_rows = to_rows(unknowns, jump, len(grid.free))
        del jump
        factor = factorise(assemble, seam_rows, row_scales, penalty, lambda: _locate_unknowns(surface, grid))
        logger.debug("erase: %d unknowns at %d x %d", len(grid.free), width, height)
    return Eraser(surface, seams, options, region, grid, intervals, lengths, silhouette, factor, rows, scale)


def _locate_unknowns(surface: TexturedSurface, grid: Grid) -> Floats:
    """Where the unknowns lie on the surface, about: the position of the nearest texture vertex, (U, 3)."""
    row, column = np.divmod(grid.nodes[grid.free], grid.size_px[0])
    tree = cKDTree(uv_to_px(surface.uvs, *grid.size_px))
    nearest = tree.query(np.stack([column, row], axis=1))[1]
    return np.asarray(surface.positions[surface_vertices(surface)[nearest]], np.float64)


def _assemble_grid(grid: Grid, weights: Weights, num_inside: int) -> sparse.csr_array:
    """Matrix of the change and gradient energies on the unknowns, (U, U)."""
    matrix = grid_matrix(
        grid,
        weights.change / max(num_inside, 1),
        weights.inside_gradient * GRADIENT_MASS,
        weights.outside_gradient * GRADIENT_MASS,
    )
    return sparse.csr_array(grid.interpolation.T @ matrix @ grid.interpolation)


def erase(
    texels: Floats,
    surface: TexturedSurface,
    seams: Seams,
    options: EraseOptions = DEFAULT_OPTIONS,
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
