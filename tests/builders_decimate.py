"""Surfaces with straight, evenly timed seams, whose floors are known."""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats
from preprocess.mesh.surface import TexturedSurface
from tests.builders_straighten import grid_faces, weld_uvs


def square(cells: int = 8, bump: float = 0.0) -> TexturedSurface:
    """An open square in one chart, with a hill of the given height in 3D."""
    side = np.linspace(0.0, 1.0, cells + 1)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    z = bump * np.sin(np.pi * x) * np.sin(np.pi * y)
    faces = grid_faces(cells, cells)
    uvs = np.stack([0.1 + 0.8 * x, 0.1 + 0.8 * y], axis=1)
    return TexturedSurface(np.stack([x, y, z], axis=1), faces, uvs, faces.copy())


def box(cells: int = 6, round_rel: float = 0.0, mirrored: bool = False) -> TexturedSurface:
    """A closed cube of six square charts, blended towards a sphere; `mirrored` turns every other chart over."""
    side = np.linspace(-1.0, 1.0, cells + 1)
    a, b = (values.ravel() for values in np.meshgrid(side, side))
    points, corners, uvs = [], [], []
    for number in range(6):
        axis, sign = number // 2, 1.0 if number % 2 else -1.0
        face = np.empty((len(a), 3))
        face[:, axis] = sign
        face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = (a, b) if sign > 0 else (b, a)
        points.append(face)
        corners.append(grid_faces(cells, cells) + number * len(a))
        place = np.array([0.03 + 0.33 * (number % 3), 0.1 + 0.45 * (number // 3)])
        uv = np.stack([0.14 * (a + 1.0), 0.14 * (b + 1.0)], axis=1)
        if mirrored and number % 2:
            uv[:, 0] = 0.28 - uv[:, 0]
        uvs.append(place + uv)
    stacked = np.concatenate(points)
    faces = np.concatenate(corners)
    corner_uvs = np.concatenate(uvs)[faces]
    _, first, inverse = np.unique(np.round(stacked, 9), axis=0, return_index=True, return_inverse=True)
    positions = stacked[first]
    ball = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    positions = (1.0 - round_rel) * positions + round_rel * ball
    return weld_uvs(positions, inverse.ravel()[faces].astype(np.int32), corner_uvs)


def two_strips(left_middle: float = 0.5, right_middle: float = 0.5, bend: float = 0.0) -> TexturedSurface:
    """Two quads side by side, each with a vertex in the middle of the seam between them: eight vertices, six faces.

    The middle vertex lies at the given fractions of the left and the right chart's side of the seam, and `bend` away
    from the right one.
    """
    # 0 1 2: seam from bottom to top; 3, 4: left; 5, 6: right
    positions = np.array(
        [[0, 0, 0], [0, 0.5, 0], [0, 1, 0], [-1, 0, 0], [-1, 1, 0], [1, 0, 0], [1, 1, 0]], dtype=np.float64
    )
    faces = np.array([[3, 0, 1], [3, 1, 4], [1, 2, 4], [0, 5, 1], [5, 6, 1], [1, 6, 2]], np.int32)
    left = {0: (0.4, 0.0), 1: (0.4, left_middle), 2: (0.4, 1.0), 3: (0.0, 0.0), 4: (0.0, 1.0)}
    right = {0: (0.6, 0.0), 1: (0.6 + bend, right_middle), 2: (0.6, 1.0), 5: (1.0, 0.0), 6: (1.0, 1.0)}
    corner_uvs = np.array([[(left if f < 3 else right)[v] for v in face] for f, face in enumerate(faces.tolist())])
    return weld_uvs(positions, faces, corner_uvs)


def parts(surface: TexturedSurface, count: int) -> TexturedSurface:
    """Copies of a surface beside each other, in space and in uv."""
    copies = range(count)
    shift = np.array([3.0, 0.0, 0.0])
    return TexturedSurface(
        np.concatenate([surface.positions + i * shift for i in copies]),
        np.concatenate([surface.faces + i * len(surface.positions) for i in copies]).astype(np.int32),
        np.concatenate([(surface.uvs + np.array([i, 0.0])) / (count, 1.0) for i in copies]),
        np.concatenate([surface.face_uvs + i * len(surface.uvs) for i in copies]).astype(np.int32),
    )


def waves(surface: TexturedSurface, height: float = 0.05) -> TexturedSurface:
    """The same with ripples along z, so that nothing is flat."""
    positions: Floats = surface.positions.copy()
    positions[:, 2] += height * np.sin(7.0 * positions[:, 0] + 1.0) * np.cos(5.0 * positions[:, 1])
    return TexturedSurface(positions, surface.faces, surface.uvs, surface.face_uvs)
