"""A small head whose face moves: a closed, skinned body with a uv seam, and teeth that share one of its morphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from builders_gltf import GltfBuilder, cube

NAMES = ("smile", "long", "twist")
CLIP_TIMES = [0.0, 0.5, 1.0]
CLIP_WEIGHTS = np.array([[0.0, 0.2, 0.0], [1.0, 0.0, 0.4], [0.25, 0.6, 0.0]])


def ellipsoid(columns: int = 20, rows: int = 14) -> dict[str, np.ndarray]:
    """A closed body of 2 m about (0, 1, 0) with its seam at the back, as exporters write it: copies along the seam."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    around, down = 2 * np.pi * u.ravel() + np.pi / 2 * 3, np.pi * v.ravel()
    unit = np.stack([np.sin(down) * np.cos(around), np.cos(down), np.sin(down) * np.sin(around)], axis=1)
    unit[np.abs(unit) < 1e-12] = 0.0
    unit = unit.reshape(rows + 1, columns + 1, 3)
    unit[:, -1] = unit[:, 0]
    unit[0], unit[-1] = (0, 1, 0), (0, -1, 0)
    unit = unit.reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, below, both = corner + 1, corner + columns + 1, corner + columns + 2
    upper, lower = np.stack([corner, right, both], axis=1), np.stack([corner, both, below], axis=1)
    faces = np.concatenate([upper[columns:], lower[:-columns]])
    radii = np.array([0.6, 1.0, 0.5])
    normals = unit / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uvs = np.stack([u.ravel(), v.ravel()], axis=1) * 0.9 + 0.05
    return {"positions": unit * radii + (0, 1, 0), "normals": normals, "faces": faces, "uvs": uvs}


def shifts_of(positions: np.ndarray) -> dict[str, np.ndarray]:
    """What each morph moves points at rest by, (N, 3): a cheek, the whole height, the upper half."""
    x, y, z = positions.T
    near = np.exp(-((x - 0.2) ** 2 + (y - 1.2) ** 2 + (z - 0.45) ** 2) / 0.02)
    near = np.where(near > 0.02, near, 0.0)
    angle = 0.5 * np.clip(y - 1.0, 0.0, None)
    turned = np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], axis=1)
    return {
        "smile": near[:, None] * (0.1, 0.15, 0.05),
        "long": np.stack([np.zeros_like(y), 0.3 * (y - 1.0), np.zeros_like(y)], axis=1),
        "twist": turned - positions,
    }


def skin_weights(positions: np.ndarray) -> np.ndarray:
    """Weights of the two joints, (N, 2)."""
    upper = np.clip((positions[:, 1] - 0.6) / 0.8, 0.0, 1.0)
    return np.stack([1 - upper, upper], axis=1)


def write_head(path: Path, *, interpolation: str = "LINEAR", defaults: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Path:
    """The head with a clip that bends it and moves its face, and another that moves the face alone."""
    builder = GltfBuilder()
    root = builder.node(name="root")
    neck = builder.node(root, name="neck", translation=[0, 1, 0])
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 1, 3] = -1
    skin = builder.skin([root, neck], inverse)
    body, teeth = ellipsoid(), cube()
    teeth["positions"] = teeth["positions"] * 0.1 + (0.2, 1.2, 0.25)
    nodes = []
    for name, shape, names in (("body", body, NAMES), ("teeth", teeth, NAMES[:1])):
        weights = skin_weights(shape["positions"])
        primitive = builder.primitive(
            shape["positions"],
            shape["faces"],
            NORMAL=shape["normals"],
            TEXCOORD_0=shape["uvs"],
            JOINTS_0=np.tile([0, 1, 0, 0], (len(weights), 1)),
            WEIGHTS_0=np.concatenate([weights, np.zeros_like(weights)], axis=1),
        )
        shifts = shifts_of(shape["positions"])
        if name == "teeth":
            shifts["smile"] = np.tile([0.0, 0.05, 0.0], (len(weights), 1))
        primitive["targets"] = [{"POSITION": builder.accessor(shifts[target])} for target in names]
        mesh = builder.mesh(
            primitive, name=name, weights=list(defaults[: len(names)]), extras={"targetNames": list(names)}
        )
        nodes.append(builder.node(mesh=mesh, skin=skin, name=name))
    half = np.sin(0.4), np.cos(0.4)
    keys = CLIP_WEIGHTS
    if interpolation == "CUBICSPLINE":
        keys = np.stack([np.full_like(keys, 0.5), keys, np.full_like(keys, -0.25)], axis=1).reshape(-1, 3)
    bend = (neck, "rotation", "LINEAR", [0, 1], [[0, 0, 0, 1], [half[0], 0, 0, half[1]]])
    face = [(node, "weights", interpolation, CLIP_TIMES, keys[:, :count].ravel()) for node, count in zip(nodes, (3, 1))]
    builder.clip("nod", bend, *face)
    builder.clip("face", *face)
    return builder.write(path)
