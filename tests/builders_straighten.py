"""Small surfaces with crooked seams, made by cutting simple shapes apart in uv."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from preprocess.arrays import Floats, Ints
from preprocess.atlas.placement import place_charts
from preprocess.mesh.surface import TexturedSurface


def grid_faces(columns: int, rows: int) -> Ints:
    """Triangles of a grid of columns x rows cells, vertices row by row."""
    i, j = np.meshgrid(np.arange(columns), np.arange(rows))
    a = (j * (columns + 1) + i).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)


def wavy(fractions: Floats, size: float, seed: int) -> Floats:
    """A smooth wave with noise, zero at 0 and 1; equal fractions have equal values."""
    unique, index = np.unique(fractions, return_inverse=True)
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, len(unique))[index].reshape(fractions.shape)
    return size * np.sin(np.pi * fractions) * (0.7 * np.sin(7.0 * fractions) + 0.3 * noise)


def two_charts(cells: int = 12, wave: float = 0.02, seed: int = 0, mirrored: bool = False) -> TexturedSurface:
    """A flat square, cut down the middle into two charts whose edges at the cut are crooked in different ways."""
    side = np.linspace(0.0, 1.0, cells + 1)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    positions = np.stack([x, y, np.zeros_like(x)], axis=1)
    faces = grid_faces(cells, cells)
    left = positions[faces][:, :, 0].mean(axis=1) < 0.5
    uv_left = np.stack([0.4 * x + 0.05, 0.9 * y + 0.05], axis=1)
    uv_right = np.stack([0.4 * x + 0.55, 0.9 * y + 0.05], axis=1)
    near = np.clip(1.0 - 4.0 * np.abs(x - 0.5), 0.0, 1.0)
    uv_left[:, 0] += near * wavy(y, wave, seed)
    uv_right[:, 0] += near * wavy(y, wave, seed + 1)
    if mirrored:
        uv_right[:, 0] = 1.5 - uv_right[:, 0]
    corner_uvs = np.where(left[:, None, None], uv_left[faces], uv_right[faces])
    return weld_uvs(positions, faces, corner_uvs)


def tube(around: int = 16, along: int = 6, wave: float = 0.01, seed: int = 0) -> TexturedSurface:
    """A cylinder, open at both ends, cut once along and once around: the seam around is a closed loop in 3D only."""
    angle = 2.0 * np.pi * np.arange(around) / around
    height = np.linspace(0.0, 1.0, 2 * along + 1)
    a, h = (v.ravel() for v in np.meshgrid(angle, height))
    positions = np.stack([np.cos(a), h, np.sin(a)], axis=1)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(around), np.arange(2 * along)))
    p, q = j * around + i, j * around + (i + 1) % around
    r, s = q + around, p + around
    faces = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)]).astype(np.int32)
    columns = np.concatenate([np.stack([i, i + 1, i + 1], axis=1), np.stack([i, i + 1, i], axis=1)])
    rows = np.concatenate([np.stack([j, j, j + 1], axis=1), np.stack([j, j + 1, j + 1], axis=1)])
    upper = rows.min(axis=1) >= along
    u = columns / around
    v = rows / (2 * along) * 0.8 + np.where(upper, 0.15, 0.05)[:, None]
    at_cut = rows == along
    v = v + at_cut * np.where(upper[:, None], 1.0, -1.0) * np.abs(wavy(u, wave, seed))
    return weld_uvs(positions, faces, np.stack([0.05 + 0.9 * u, v], axis=2))


def ring_in_square(around: int = 24, wave: float = 0.01, seed: int = 0) -> TexturedSurface:
    """A disk of two charts: a cap inside and an annulus around it. The seam is a closed loop without a corner."""
    angle = 2.0 * np.pi * np.arange(around) / around
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radii = [0.25, 0.5, 0.75, 1.0]
    flat = np.concatenate([np.zeros((1, 2))] + [r * circle for r in radii])
    i = np.arange(around)
    k = (i + 1) % around
    parts = [np.stack([np.zeros_like(i), 1 + i, 1 + k], axis=1)]
    for ring in range(3):
        a, b = 1 + ring * around + i, 1 + ring * around + k
        parts += [np.stack([a, a + around, b + around], axis=1), np.stack([a, b + around, b], axis=1)]
    faces = np.concatenate(parts).astype(np.int32)
    cap = np.arange(len(faces)) < 3 * around
    bumps = 1.0 + wave * np.random.default_rng(seed).uniform(-1.0, 1.0, (2, around))
    inner, outer = flat.copy(), flat.copy()
    inner[1 + around : 1 + 2 * around] *= bumps[0][:, None]
    outer[1 + around : 1 + 2 * around] *= bumps[1][:, None]
    uv_cap = 0.2 * inner + (0.78, 0.5)
    uv_ring = 0.25 * outer + (0.3, 0.5)
    positions = np.column_stack([flat[:, 0], flat[:, 1], 0.3 * (1.0 - (flat**2).sum(axis=1))])
    return weld_uvs(positions, faces, np.where(cap[:, None, None], uv_cap[faces], uv_ring[faces]))


def moebius(around: int = 20, across: int = 3) -> TexturedSurface:
    """A Moebius strip, cut once to lie flat: its one seam joins the strip to its mirror image."""
    t, w = (v.ravel() for v in np.meshgrid(np.arange(around + 1), np.arange(across + 1), indexing="ij"))
    s = w / across - 0.5
    a = 2.0 * np.pi * t / around
    points = np.stack(
        [(2 + s * np.cos(a / 2)) * np.cos(a), (2 + s * np.cos(a / 2)) * np.sin(a), s * np.sin(a / 2)], axis=1
    )
    num = around * (across + 1)
    surface_vertex = np.where(t < around, t * (across + 1) + w, across - w)
    faces = grid_faces(across, around)
    wiggle = 0.01 * np.sin(2.5 * t) * ((w == 0) | (w == across))
    uvs = np.stack([0.05 + 0.9 * t / around, 0.3 + 0.4 * w / across + wiggle], axis=1)
    return weld_uvs(points[:num], surface_vertex[faces].astype(np.int32), uvs[faces])


def with_dart(cells: int = 12, width: float = 0.01) -> TexturedSurface:
    """A square with a crooked dart: a seam that ends inside the chart, its two sides slightly apart."""
    side = np.linspace(0.0, 1.0, cells + 1)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    faces = grid_faces(cells, cells)
    middle = cells // 2
    on_dart = (np.abs(x - side[middle]) < 1e-9) & (y < 0.5 - 1e-9)
    left = x[faces].mean(axis=1) < side[middle]
    uvs = np.stack([0.05 + 0.9 * x, 0.05 + 0.9 * y], axis=1)
    corner = uvs[faces].copy()
    depth = (0.5 - y) * (1.0 + 0.5 * np.sin(40.0 * y))
    corner[..., 0] += (on_dart * depth)[faces] * width * np.where(left, -1.0, 1.0)[:, None]
    corner[..., 0] += (on_dart * 0.004 * np.sin(23.0 * y))[faces]
    return weld_uvs(np.stack([x, y, 0.0 * x], axis=1), faces, corner)


def random_charts(seed: int) -> TexturedSurface:
    """A random triangulation of the square, torn into random charts with ragged outlines, holes and pinches; packed."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(size=(int(rng.integers(8, 150)), 2)), [[0, 0], [1, 0], [1, 1], [0, 1]]])
    faces = Delaunay(points).simplices
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    faces = np.where(area[:, None] < 0, faces[:, [0, 2, 1]], faces)[np.abs(area) > 1e-6].astype(np.int32)
    if seed % 3 == 0:
        faces = faces[rng.uniform(size=len(faces)) < 0.93]
    centres = rng.uniform(size=(int(rng.integers(1, 12)), 2))
    distance = ((points[faces].mean(axis=1)[:, None] - centres) ** 2).sum(axis=2)
    label = np.argmin(distance + rng.uniform(0.0, 0.02, distance.shape), axis=1)
    # Faces of one label that meet at an edge make a chart: labels apart in uv, then what hangs together there.
    corners = points[faces] * 0.9 + 2.0 * label[:, None, None]
    surface = weld_uvs(np.column_stack([points, 0.0 * points[:, 0]]), faces, corners)
    return place_charts(surface, np.zeros(len(surface.faces)))


def weld_uvs(positions: Floats, faces: Ints, corner_uvs: Floats) -> TexturedSurface:
    """One texture vertex for all corners of a surface vertex with the same uv."""
    keys = np.column_stack([faces.ravel(), np.round(corner_uvs.reshape(-1, 2), 12)])
    unique, index = np.unique(keys, axis=0, return_inverse=True)
    face_uvs = index.reshape(-1, 3).astype(np.int32)
    return TexturedSurface(positions, faces, np.ascontiguousarray(unique[:, 1:]), face_uvs)
