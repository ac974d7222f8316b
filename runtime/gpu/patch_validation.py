"""Which triangles of a coarse level must not be divided: those whose inside the textures do not show.

A coarse triangle's corners lie where they should, but between them its uv triangle may leave its chart, or cross faces
that are smaller than a texel. Points fetched there are anywhere: spikes, and pockets turned inside out. Such triangles
are found once, by fetching a grid of points in each, and stay flat: then a tessellated level is never further from the
surface than the level itself by more than its own error.
Letters in shapes: N vertices, F faces, S points a triangle, K small triangles of a grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.asset.asset import Asset
from runtime.asset.lod_mesh import LodMesh
from runtime.asset.texel_footprint import fetch_bilinear
from runtime.gpu.patches import build_patches, corner_uvs, place_corners, surface_copies

Floats = NDArray[np.float32]

SEGMENTS = 6  # of the grid, an edge
FACES_AT_ONCE = 4096
PATCH_TOLERANCE_REL = 1e-3  # a divided triangle may always stray so far from the flat one, of the body's diagonal


def _grid() -> tuple[Floats, NDArray[np.int64]]:
    """Barycentric coordinates of a triangle's grid, (S, 3), and its small triangles, (K, 3), turned like the whole."""
    places = [(i, j) for i in range(SEGMENTS + 1) for j in range(SEGMENTS + 1 - i)]
    number = {place: index for index, place in enumerate(places)}
    shares = np.array([(SEGMENTS - i - j, i, j) for i, j in places], np.float32) / np.float32(SEGMENTS)
    upright = [((i, j), (i + 1, j), (i, j + 1)) for i, j in places if i + j < SEGMENTS]
    turned = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in places if i + j < SEGMENTS - 1]
    return shares, np.array([[number[place] for place in small] for small in upright + turned])


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", a, b), np.float32)


def distance_to_triangles(points: Floats, corners: Floats) -> Floats:
    """Distance of points (F, S, 3) to their triangle (F, 3, 3): (F, S)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(length, 1e-30)
    height = _dot(points - corners[:, None, 0], normal[:, None])
    inside = np.broadcast_to(length > 0, height.shape).copy()
    nearest = np.full(height.shape, np.inf, np.float32)
    for side in range(3):
        start = corners[:, side]
        along = corners[:, (side + 1) % 3] - start
        from_start = points - start[:, None]
        inside &= _dot(from_start, np.cross(normal, along)[:, None]) >= 0
        share = np.clip(_dot(from_start, along[:, None]) / np.maximum(_dot(along, along), 1e-30)[:, None], 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(from_start - share[..., None] * along[:, None], axis=-1))
    return np.asarray(np.where(inside, np.abs(height), nearest), np.float32)


def faulty_faces(
    positions: Floats, uvs: Floats, canonical_uvs: Floats, patches: NDArray[np.uint32], error_m: float
) -> NDArray[np.bool_]:
    """Faces with a point further than `error_m` from the flat triangle as it is when whole, or a part backwards.

    Parameters
    ----------
    positions : (H, W, 3) float32
        The position texture, metres.
    uvs, canonical_uvs : (N, 2) float32
    patches : (F, 12) uint32
        Points of edges are fetched where the owning edge has them, corners at `runtime.gpu.patches.corner_uvs`.
    error_m : float

    Returns
    -------
    (F,) bool
    """
    shares, small = _grid()
    faulty = np.zeros(len(patches), bool)
    for first in range(0, len(patches), FACES_AT_ONCE):
        part = patches[first : first + FACES_AT_ONCE].astype(np.int64)
        places = np.einsum("sk,fki->fsi", shares, uvs[part[:, :3]])
        for side in range(3):  # an edge is where the third corner has no share
            on_edge = shares[:, (side + 2) % 3] == 0
            ends = shares[on_edge][:, [side, (side + 1) % 3]]
            places[:, on_edge] = np.einsum("sk,fki->fsi", ends, uvs[part[:, 3 + 2 * side : 5 + 2 * side]])
        at_corners = corner_uvs(uvs, canonical_uvs, part)
        for corner in range(3):
            places[:, shares[:, corner] == 1] = at_corners[:, corner, None]
        points = fetch_bilinear(positions, places)
        corners = fetch_bilinear(positions, canonical_uvs[part[:, :3]])
        too_far = (distance_to_triangles(points, corners) > error_m).any(axis=1)
        a, b, c = (points[:, small[:, corner]] for corner in range(3))
        whole = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        backwards = (_dot(np.cross(b - a, c - a), whole[:, None]) < 0).any(axis=1)
        faulty[first : first + len(part)] = too_far | backwards
    return faulty


def keep_flat(patches: NDArray[np.uint32], points: NDArray[np.int64], faulty: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Patches in which the edges of faulty faces are owned by a single point: the shaders do not divide these.

    Both faces of an edge see it so, whichever of them is faulty.

    Parameters
    ----------
    patches : (F, 12) uint32
    points : (N,) int64
        The surface point of each vertex.
    faulty : (F,) bool
    """
    corners = points[patches[:, :3].astype(np.int64)]
    start, end = corners, np.roll(corners, -1, axis=1)
    _, edge = np.unique(np.minimum(start, end) * (points.max() + 1) + np.maximum(start, end), return_inverse=True)
    edge = edge.reshape(-1, 3)
    is_flat = np.zeros(edge.max() + 1, bool)
    is_flat[edge[faulty]] = True
    kept = patches.copy()
    kept[:, 4:9:2] = np.where(is_flat[edge], patches[:, 3:9:2], patches[:, 4:9:2])
    return kept


def patch_tolerance_m(asset: Asset, mesh: LodMesh) -> float:
    """How far points of a level's divided triangles may lie from the flat ones, metres; they stay whole otherwise."""
    low, high = asset.manifest.bind_bounds
    return max(mesh.error_m, PATCH_TOLERANCE_REL * float(np.linalg.norm(high - low)))


def divided_patches(asset: Asset, mesh: LodMesh) -> NDArray[np.uint32]:
    """Patches of a level in which the edges of faulty faces are owned by a single point, (F, 12) uint32.

    Corners lie on the surface, like the points between them, but the finest level's, which never left it, and those
    that the texture misses by more than divided triangles may stray.
    """
    positions = np.asarray(asset.textures["position"].levels[0][:, :, :3], np.float32)
    tolerance_m = patch_tolerance_m(asset, mesh)
    copies = surface_copies(mesh.uvs, mesh.canonical_uvs)
    shift_m = np.linalg.norm(
        fetch_bilinear(positions, mesh.uvs[copies]) - fetch_bilinear(positions, mesh.canonical_uvs), axis=-1
    )
    moved = (shift_m <= tolerance_m) & (mesh is not asset.lods[0])
    patches = place_corners(build_patches(mesh.uvs, mesh.canonical_uvs, mesh.triangles), copies, moved)
    faulty = faulty_faces(positions, mesh.uvs, mesh.canonical_uvs, patches, tolerance_m)
    _, points = np.unique(mesh.canonical_uvs, axis=0, return_inverse=True)
    return keep_flat(patches, points.ravel(), faulty)
