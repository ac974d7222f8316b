"""Small textured surfaces with seams, for the tests of seam erasure."""

from __future__ import annotations

import dataclasses

import numpy as np

from preprocess.mesh.surface import TexturedSurface

CUBE_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def make_cube(turn_rad: float = 0.3, size_uv: float = 0.2) -> TexturedSurface:
    """A cube whose six faces are charts of their own, each turned a little more: all twelve edges are seams."""
    positions = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    uvs, faces, face_uvs = [], [], []
    corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size_uv
    for n, quad in enumerate(CUBE_FACES):
        angle = turn_rad * (n + 1)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        centre = np.array([(n % 3 + 0.5) / 3, (n // 3 + 0.5) / 2])
        uvs.append(corner @ turn.T + centre)
        for triangle in ((0, 1, 2), (0, 2, 3)):
            faces.append(quad[list(triangle)])
            face_uvs.append(4 * n + np.array(triangle))
    return TexturedSurface(positions, np.array(faces, np.int32), np.concatenate(uvs), np.array(face_uvs, np.int32))


def make_pair(shift_uv: tuple[float, float] = (0.5, 0.0), turn_rad: float = 0.0) -> TexturedSurface:
    """Two triangles that share one 3D edge; in uv the second is a moved and turned copy: one seam, four boundaries."""
    positions = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [1.0, 1, 0]])
    first = np.array([[0.1, 0.1], [0.4, 0.15], [0.12, 0.45]])
    edge = np.array([[0.4, 0.15], [0.12, 0.45], [0.42, 0.42]])
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    second = (edge - edge.mean(0)) @ turn.T + edge.mean(0) + shift_uv
    return TexturedSurface(
        positions,
        np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        np.concatenate([first, second]),
        np.array([[0, 1, 2], [3, 5, 4]], np.int32),
    )


def make_square() -> TexturedSurface:
    """Two triangles in one chart: boundaries, no seam."""
    uvs = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TexturedSurface(np.column_stack([uvs, np.zeros(4)]), faces, uvs, faces.copy())


def paint(width: int, height: int, channels: int = 3, seed: int = 0) -> np.ndarray:
    """A texture of smooth waves with noise on them, in [0, 1]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    waves = [np.sin(2 * np.pi * (rng.uniform(0.5, 2) * x + rng.uniform(0.5, 2) * y + c)) for c in range(channels)]
    return np.clip(0.5 + 0.35 * np.stack(waves, axis=2) + rng.normal(0, 0.03, (height, width, channels)), 0, 1)


MESHES = {
    "cube": make_cube(),
    "pair": make_pair(),
    "turned pair": make_pair(turn_rad=2.2),
    "mirrored": dataclasses.replace(make_cube(), uvs=make_cube().uvs * (-1, 1) + (1, 0)),
}
