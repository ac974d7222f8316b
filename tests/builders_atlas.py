"""Small meshes for the atlas tests: parametric patches, tubes, closed solids, and what goes wrong in files."""

from __future__ import annotations

import numpy as np

from preprocess.mesh.surface import SkinnedMesh, TexturedSurface

Mesh = tuple[np.ndarray, np.ndarray]


def skinned(positions, faces, uvs=None, face_uvs=None) -> SkinnedMesh:
    """Wrap arrays: two joints by height, random-looking but fixed corner data, so that copies can be told apart."""
    positions, faces = np.asarray(positions, np.float64), np.asarray(faces, np.int32)
    has_uvs = uvs is not None
    uvs = np.zeros((0, 2)) if uvs is None else np.asarray(uvs, np.float64)
    face_uvs = np.zeros_like(faces) if face_uvs is None else np.asarray(face_uvs, np.int32)
    height = positions[:, 2] - positions[:, 2].min()
    share = height / max(float(height.max()), 1e-300)
    corner = positions[faces]
    normals = np.zeros((len(faces), 3, 3))
    normals[..., 2] = 1.0
    return SkinnedMesh(
        surface=TexturedSurface(positions, faces, uvs, face_uvs),
        corner_normals=normals,
        corner_tangents=None,
        corner_texcoords=np.stack([corner[..., :2], corner[..., 1:]], axis=2),
        corner_colors=None,
        joint_indices=np.tile(np.array([0, 1], np.int32), (len(positions), 1)),
        joint_weights=np.stack([1 - share, share], axis=1),
        face_materials=np.arange(len(faces), dtype=np.int32) % 3,
        face_parts=np.zeros(len(faces), np.int32),
        has_uvs=has_uvs,
    )


def patch(columns: int, rows: int, bump: float = 0.0) -> Mesh:
    """An open square with waves of the given height."""
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    positions = np.stack([x, y, bump * np.sin(9 * x) * np.cos(7 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns + 2], axis=1)
    upper = np.stack([corner, corner + columns + 2, corner + columns + 1], axis=1)
    return positions, np.concatenate([lower, upper])


def tube(sides: int, rings: int, length: float, closed: bool) -> Mesh:
    """A tube of radius 1, open at both ends (an annulus) or closed by fans (a sphere)."""
    angle = 2 * np.pi * np.arange(sides) / sides
    positions = [[np.cos(a), np.sin(a), length * j / rings] for j in range(rings + 1) for a in angle]
    faces = []
    for j in range(rings):
        for i in range(sides):
            a, b = j * sides + i, j * sides + (i + 1) % sides
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    if closed:
        bottom, top = len(positions), len(positions) + 1
        positions += [[0, 0, 0], [0, 0, length]]
        for i in range(sides):
            j = (i + 1) % sides
            faces += [[bottom, j, i], [top, rings * sides + i, rings * sides + j]]
    return np.array(positions, float), np.array(faces)


def torus(columns: int, rows: int) -> Mesh:
    """A closed surface with a handle."""
    u, v = (2 * np.pi * a for a in np.meshgrid(np.arange(columns) / columns, np.arange(rows) / rows))
    positions = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    faces = []
    for j in range(rows):
        for i in range(columns):
            a, b = j * columns + i, j * columns + (i + 1) % columns
            c, d = (j + 1) % rows * columns + i, (j + 1) % rows * columns + (i + 1) % columns
            faces += [[a, b, d], [a, d, c]]
    return positions, np.array(faces)


def mobius(segments: int) -> Mesh:
    """A strip with one side: no winding of its faces agrees everywhere."""
    positions, faces = [], []
    for i in range(segments):
        t = 2 * np.pi * i / segments
        for s in (-0.3, 0.3):
            radius = 1 + s * np.cos(t / 2)
            positions.append([radius * np.cos(t), radius * np.sin(t), s * np.sin(t / 2)])
    for i in range(segments):
        a, b = 2 * i, 2 * i + 1
        c, d = (a + 2, a + 3) if i < segments - 1 else (1, 0)
        faces += [[a, c, d], [a, d, b]]
    return np.array(positions), np.array(faces)


def tetrahedron() -> Mesh:
    """The smallest closed mesh without double faces."""
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array(
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    )


def copies(mesh: Mesh, count: int, spacing: float = 3.0) -> Mesh:
    """Many of one mesh in rows of 50; spacing 0 puts them into one another."""
    positions, faces = mesh
    shifts = spacing * np.stack([np.arange(count) % 50, np.arange(count) // 50, np.zeros(count)], axis=1)
    moved = positions[None] + shifts[:, None]
    return moved.reshape(-1, 3), (faces[None] + len(positions) * np.arange(count)[:, None, None]).reshape(-1, 3)


def grid_of_charts(count: int, cells: int = 4) -> SkinnedMesh:
    """Flat patches a metre wide, far apart in space, their uvs all in the same place: each one-to-one in itself."""
    positions, faces = patch(cells, cells)
    many, many_faces = copies((positions, faces), count)
    return skinned(many, many_faces, np.tile(positions[:, :2], (count, 1)), many_faces)


FAMILIES: dict[str, Mesh] = {
    "triangle": (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])),
    "two triangles": (np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])),
    "two-sided triangle": (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 1]])),
    "bow tie": (
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]]),
        np.array([[0, 1, 2], [0, 3, 4]]),
    ),
    "tetrahedron": tetrahedron(),
    "flat patch": patch(10, 10),
    "cape": patch(30, 20, 0.1),
    "open tube": tube(8, 100, 60, closed=False),
    "closed tube": tube(8, 100, 60, closed=True),
    "thinnest tube": tube(3, 50, 50, closed=True),
    "torus": torus(40, 20),
    "smallest torus": torus(4, 3),
    "mobius strip": mobius(40),
    "shortest mobius strip": mobius(5),
    "same place twice": copies(tube(12, 12, 3, closed=True), 2, 0.0),
    "many tetrahedra": copies(tetrahedron(), 300),
    "no area": (np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0.0]]), np.array([[0, 1, 2], [1, 3, 2]])),
    "one point": (np.zeros((3, 3)), np.array([[0, 1, 2]])),
    "huge": (tetrahedron()[0] * 1e12, tetrahedron()[1]),
    "tiny": (tetrahedron()[0] * 1e-12, tetrahedron()[1]),
}
