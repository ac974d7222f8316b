"""Stage "levels": where each level's vertices fetch their geometry, and weights that are right at all of them.

Textures come first, because levels are costed where they will be drawn; this stage then looks at the vertices that the
levels really have: positions that a small texture misses are parked, and the weight map gets its details.
"""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from preprocess.arrays import Floats
from preprocess.bake.geometry import vertex_values
from preprocess.decimate import Lod
from preprocess.decimate.measure import make_reference, measure
from preprocess.fit.morph_maps import store_morphs
from preprocess.fit.positions import fit_positions
from preprocess.fit.spare_texels import park_vertices
from preprocess.fit.stored_texture import StoredTexture, seam_report
from preprocess.fit.weight_map import store_weights
from preprocess.fit.weight_quadtree import (
    WeightPoints,
    detail_weights,
    measure_jump,
    pose_moves,
    sample_weights,
)
from preprocess.mesh.morphs import shaped_matrices, shift_vertices
from preprocess.mesh.raster import rasterise
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import SkinnedMesh
from preprocess.mesh.texels import px_to_uv, sample_bilinear
from preprocess.mesh.uv_lookup import locate_uvs, uv_tree
from runtime.asset.morphs import Morphs
from runtime.asset.weight_stack import unpack_weights

log = logging.getLogger(__name__)

SAME_UV = 1e-6  # vertices whose uvs are no further apart are told apart by where they are
OUTLINE_PX = 1024  # points for the length of a side, along charts' outlines
SAMPLES_PX = 128  # the surface between vertices is looked at in a grid at least so fine
VERTEX_REL = 5e-4  # error allowed at the full mesh's vertices, of the diagonal: a quarter of the goal
LEVEL_SHARE = 0.12  # at those of coarser levels, of the level's error
OUTSIDE_REL = 2e-2  # where triangles of coarse levels leave the charts: no more than that it does not stand out
INSIDE_RELS = (1.5e-3, 3e-3, 6e-3, 1.2e-2)  # errors allowed there, of the diagonal: the first that fits
LEAF_BYTES, BYTES_A_VERTEX = 20, 20  # details take no more than this for every vertex of every level


@dataclasses.dataclass(frozen=True)
class _OnFullMesh:
    """Where N points lie on the full mesh: corners (N, 3) of its faces, barycentric coordinates (N, 3)."""

    corners: NDArray[np.int64]
    barycentrics: Floats

    def blend(self, values: Floats) -> Floats:
        """Values of the full mesh's vertices, (V, C), at the points, (N, C)."""
        blended = self.barycentrics[:, :1] * values[self.corners[:, 0]]
        for k in (1, 2):
            blended += self.barycentrics[:, k : k + 1] * values[self.corners[:, k]]
        return blended


def _locate_canonical(mesh: SkinnedMesh, lods: Sequence[Lod]) -> list[_OnFullMesh]:
    """Where the canonical uvs of levels' vertices lie on the full mesh: at their uvs, where decimation takes their
    weights.

    Not near their positions, since vertices of coarse levels lie off the surface.
    """
    surface = mesh.surface
    tree = uv_tree(surface.uvs[surface.face_uvs])
    located = (locate_uvs(tree, lod.uvs[lod.canonical_uvs]) for lod in lods)
    return [_OnFullMesh(surface.faces[faces].astype(np.int64), barycentrics) for faces, barycentrics in located]


def _at_vertices(vertices: NDArray[np.int64]) -> _OnFullMesh:
    """Vertices of the full mesh as points on it."""
    return _OnFullMesh(vertices[:, None].repeat(3, axis=1), np.tile((1.0, 0.0, 0.0), (len(vertices), 1)))


def _vertices_of_uvs(mesh: SkinnedMesh) -> NDArray[np.int64]:
    """The surface vertex of each texture vertex, (T,)."""
    vertices = np.zeros(len(mesh.surface.uvs), np.int64)
    vertices[mesh.surface.face_uvs.ravel()] = mesh.surface.faces.ravel()
    return vertices


def _locate_full(mesh: SkinnedMesh, lod: Lod) -> _OnFullMesh:
    """The vertices of the full mesh that those of the finest level are: they have the same uvs."""
    surface, scale = mesh.surface, SAME_UV / max(mesh.surface.diagonal_m, 1e-30)
    known = cKDTree(np.c_[surface.uvs, scale * vertex_values(mesh, surface.positions)])
    _, nearest = known.query(np.c_[lod.uvs[lod.canonical_uvs], scale * lod.positions])
    return _at_vertices(_vertices_of_uvs(mesh)[nearest])


def _points_inside(mesh: SkinnedMesh, side: int) -> tuple[Floats, _OnFullMesh]:
    """A grid of points in the charts, `SAMPLES_PX` a side or finer, even in every cell: uvs (N, 2) and places."""
    grid = side * -(-SAMPLES_PX // side)
    coverage = rasterise(mesh.surface.uvs, mesh.surface.face_uvs, grid, grid, 0.0)
    row, column = np.nonzero(coverage.faces >= 0)
    uvs = px_to_uv(np.stack([column, row], axis=1), grid, grid)
    corners = mesh.surface.faces[coverage.faces[row, column]].astype(np.int64)
    return uvs, _OnFullMesh(corners, coverage.barycentrics[row, column].astype(np.float64))


def _points_on_outlines(mesh: SkinnedMesh) -> tuple[Floats, _OnFullMesh]:
    """Points along the charts' outlines, where cells of a coarse map blend neighbouring charts: uvs (N, 2), places."""
    seams = find_seams(mesh.surface)
    ends = np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs]).astype(np.int64)
    end_uvs = mesh.surface.uvs[ends]
    counts = np.ceil(np.linalg.norm(end_uvs[:, 1] - end_uvs[:, 0], axis=1) * OUTLINE_PX).astype(np.int64)
    edge = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (number + 0.5) / counts[edge]
    shares = np.stack([1.0 - share, share, np.zeros(len(edge))], axis=1)
    corners = _vertices_of_uvs(mesh)[ends[edge][:, [0, 1, 1]]]
    uvs = np.einsum("nk,nkc->nc", shares[:, :2], end_uvs[edge])
    return uvs, _OnFullMesh(corners, shares)


def _points_outside(lods: Sequence[Lod], side: int) -> tuple[list[Floats], list[tuple[NDArray[np.int64], Floats]]]:
    """Points of coarser exact levels' triangles outside all charts: uvs, vertices and their shares, a level each."""
    grid = side * -(-SAMPLES_PX // side)
    full = rasterise(lods[0].uvs, lods[0].face_uvs, grid, grid, 0.0).inside
    uvs, places = [], []
    for lod in itertools.takewhile(lambda lod: lod.exact, lods[1:]):
        coverage = rasterise(lod.uvs, lod.face_uvs, grid, grid, 0.0)
        row, column = np.nonzero((coverage.faces >= 0) & ~full)
        uvs.append(px_to_uv(np.stack([column, row], axis=1).astype(np.float64), grid, grid))
        shares = coverage.barycentrics[row, column].astype(np.float64)
        places.append((lod.faces[coverage.faces[row, column]].astype(np.int64), shares))
    return uvs, places


def _detail(
    weights: StoredTexture, mesh: SkinnedMesh, lods: Sequence[Lod], owners: Sequence[_OnFullMesh], poses: Floats
) -> StoredTexture:
    """The weight map with details where it is wrong for these levels."""
    num_joints, surface = poses.shape[1], mesh.surface
    stored = unpack_weights(_as_integers(weights), weights.size, num_joints)
    inside_uvs, inside = _points_inside(mesh, weights.size[0])
    outside_uvs, outside = _points_outside(lods, weights.size[0])
    vertex_uvs = [lod.fetch_uvs for lod in lods if lod.fetch_uvs is not None]
    outline_uvs, outline = _points_on_outlines(mesh)
    uvs = [*vertex_uvs, surface.uvs, inside_uvs, outline_uvs, *outside_uvs]
    counts = [len(part) for part in uvs]
    on_mesh = [*owners, _at_vertices(_vertices_of_uvs(mesh)), inside, outline]
    weights_of, positions_of = (
        [part.blend(values) for part in on_mesh] for values in (mesh.dense_weights(num_joints), surface.positions)
    )
    for values in (weights_of, positions_of):
        of_canonical = values[1 : len(lods)]
        values += [np.einsum("nk,nkc->nc", shares, part[at]) for part, (at, shares) in zip(of_canonical, outside)]
    errors_rel = [lod.error_m / surface.diagonal_m for lod in lods[1:]]
    allowed = [VERTEX_REL, *(max(VERTEX_REL, LEVEL_SHARE * error_rel) for error_rel in errors_rel)]
    points = WeightPoints(
        np.concatenate(uvs),
        np.concatenate(weights_of),
        np.concatenate(positions_of),
        np.arange(sum(counts)) < sum(counts[: len(lods)]),
        np.repeat([*allowed, 0.0, 0.0, 0.0, *[OUTSIDE_REL] * len(outside)], counts),
    )
    moves = pose_moves(poses, surface.diagonal_m)
    budget = BYTES_A_VERTEX * sum(len(lod.positions) for lod in lods)
    for inside_rel in INSIDE_RELS:
        allowed_rel = np.where(points.is_vertex, points.allowed_rel, np.maximum(points.allowed_rel, inside_rel))
        details = detail_weights(stored, dataclasses.replace(points, allowed_rel=allowed_rel), moves)
        if LEAF_BYTES * len(details.depths) <= budget:
            break
    log.info("weights: %d leaves over a map of %d x %d, inside to %.2g", len(details.depths), *weights.size, inside_rel)
    rms, largest = measure_jump(stored, details, surface, find_seams(surface))
    seam = {**weights.seam, "stored": [{"rms": rms, "max": largest}]}
    return dataclasses.replace(weights, details=details if len(details.depths) else None, seam=seam)


def _as_integers(texture: StoredTexture) -> NDArray[Any]:
    """The stored numbers of an integer texture."""
    kind = np.uint8 if texture.format == "uint8" else np.uint16
    result: NDArray[Any] = np.rint(texture.levels[0] * np.iinfo(kind).max).astype(kind)
    return result


def _measured(
    mesh: SkinnedMesh,
    weights: StoredTexture,
    lods: Sequence[Lod],
    allowed: Sequence[Lod],
    poses: Floats,
    morphs: Morphs | None,
    shapes: Floats,
) -> tuple[Lod, ...]:
    """Levels with the distances of what is drawn: positions, weights and morphs as they are fetched, in all poses.

    The finest has what its vertices are off. A relaxed level's error is no less than what hides its seams, which
    decimation has said (`allowed`); and no level's is less than a finer one's.
    """
    num_joints = poses.shape[1]
    stored = unpack_weights(_as_integers(weights), weights.size, num_joints)
    rows = poses[:, :, :3]
    blended = np.einsum("vj,pjik->pvik", mesh.dense_weights(num_joints), rows)
    shifts = shift_vertices(mesh.morphs, shapes, mesh.num_vertices)
    reference = make_reference(mesh.surface, np.concatenate([blended, shaped_matrices(blended[0], shifts)]))
    finished = [lods[0]]
    for lod, before in zip(lods[1:], allowed[1:], strict=True):
        uvs = lod.uvs[lod.canonical_uvs] if lod.fetch_uvs is None else lod.fetch_uvs
        drawn = (
            sample_bilinear(stored, uvs) if weights.details is None else sample_weights(stored, weights.details, uvs)
        )
        blended = np.einsum("vj,pjik->pvik", drawn, rows)
        shifts = np.zeros((len(shapes), len(uvs), 3))
        if morphs is not None:
            for number in np.flatnonzero(shapes.any(axis=0)).tolist():
                shifts += shapes[:, number, None, None] * morphs.rows_at(number, uvs)[None, :, :, 3]
        found = measure(reference, lod, np.concatenate([blended, shaped_matrices(blended[0], shifts)]))
        error_m = max(found.largest_m, finished[-1].error_m, 0.0 if lod.exact else before.error_m)
        if found.largest_m > (1.0 + LEVEL_SHARE) * max(before.error_m, lods[0].error_m):
            log.info("%d faces: %.3g m off as drawn, %.3g by decimation", lod.num_faces, error_m, before.error_m)
        finished.append(
            dataclasses.replace(lod, error_m=error_m, mean_error_m=found.mean_m, normal_error_rad=found.normal_rad)
        )
    return tuple(finished)


def fit_levels(
    mesh: SkinnedMesh,
    lods: Sequence[Lod],
    poses: Floats,
    position_side: int | None = None,
    weight_side: int | None = None,
    shapes: Floats | None = None,
) -> tuple[list[StoredTexture], tuple[Lod, ...]]:
    """Positions and joint weights as textures that are right at the vertices of all levels.

    Parameters
    ----------
    mesh : SkinnedMesh
        The full mesh with the atlas as its uvs.
    lods : sequence of Lod
        The finest first: the full mesh.
    poses : (P, J, 4, 4) float64
        Skinning matrices.
    position_side, weight_side : int, optional
        Texels; by default as few as are good enough.
    shapes : (S, M) float64, optional
        Morph weights of further shapes, in the first pose.

    Returns
    -------
    textures : list of StoredTexture
        "position" and "weights".
    lods : tuple of Lod
        With `fetch_uvs` and the distances of what is drawn.
    """
    surface, seams = mesh.surface, find_seams(mesh.surface)
    positions = fit_positions(mesh, seams, position_side)
    weights = store_weights(mesh, seams, poses.shape[1], weight_side)
    owners = [_locate_full(mesh, lods[0]), *_locate_canonical(mesh, lods[1:])]
    full = owners[0].blend(surface.positions)
    dense = mesh.dense_weights(poses.shape[1])
    at_owners = [owner.blend(dense) for owner in owners]
    texels, fitted = park_vertices(
        positions.fitted.astype(np.float32), lods, full, surface.diagonal_m, at_owners, weights.size
    )
    seam = seam_report(surface, seams, positions.baked, positions.fitted, texels)
    shapes = np.zeros((0, len(mesh.morphs))) if shapes is None else shapes
    located = [(owner.corners, owner.barycentrics) for owner in owners]
    morphs = store_morphs(mesh, fitted, located, texels.shape[1::-1])
    position = StoredTexture("position", (texels,), "float", texels.shape[1::-1], seam, morphs=morphs)
    weights = _detail(weights, mesh, fitted, owners, poses)
    return [position, weights], _measured(mesh, weights, fitted, lods, poses, morphs, shapes)
