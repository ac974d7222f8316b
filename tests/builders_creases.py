"""Bodies with hard edges inside one chart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from builders_gltf import GltfBuilder
from numpy.typing import NDArray

from preprocess.load import Character, load_character

# Sides of a cube as they lie in a net of 4 x 3 squares: column, row, normal, right, up. Five edges stay joined.
NET = (
    (1, 0, (0, 1, 0), (1, 0, 0), (0, 0, -1)),
    (0, 1, (-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    (1, 1, (0, 0, 1), (1, 0, 0), (0, 1, 0)),
    (2, 1, (1, 0, 0), (0, 0, -1), (0, 1, 0)),
    (3, 1, (0, 0, -1), (-1, 0, 0), (0, 1, 0)),
    (1, 2, (0, -1, 0), (1, 0, 0), (0, 0, 1)),
)

# Colours of the sides in this order, sRGB.
PALETTE = np.array([[200, 40, 40], [40, 180, 60], [50, 60, 200], [220, 210, 60], [120, 120, 120], [140, 128, 118]])


def cube_net(path: Path, cells: int = 1, turn_rad: float = 0.35, smooth: bool = False) -> Path:
    """A cube of side 1 unfolded into one chart, turned so that no edge runs along the texels.

    Hard edges as exporters write them, or with `smooth` the normals of a ball.
    """
    steps = np.linspace(0.0, 1.0, cells + 1)
    along, down = (a.ravel() for a in np.meshgrid(steps, steps))
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right_of, below, across = corner + 1, corner + cells + 1, corner + cells + 2
    square = np.concatenate([np.stack([corner, below, across], 1), np.stack([corner, across, right_of], 1)])
    positions, normals, uvs, faces = [], [], [], []
    for column, row, normal, right, up in NET:
        place = 0.5 * np.array(normal) + np.outer(along - 0.5, right) - np.outer(down - 0.5, up)
        faces.append(square + sum(map(len, positions)))
        positions.append(place)
        normals.append(place / np.linalg.norm(place, axis=1)[:, None] if smooth else np.tile(normal, (len(place), 1)))
        uvs.append(np.stack([column + along, row + down], axis=1))
    centred = (np.concatenate(uvs) - (2.0, 1.5)) / 5.5
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    builder = GltfBuilder()
    primitive = builder.primitive(
        np.concatenate(positions),
        np.concatenate(faces),
        NORMAL=np.concatenate(normals),
        TEXCOORD_0=centred @ turn.T + 0.5,
    )
    builder.node(mesh=builder.mesh(primitive), name="box")
    return builder.write(path)


def painted_cube(path: Path, cells: int = 2, smooth: bool = True) -> Path:
    """A cube whose sides take their colours from the cells of a palette: its uvs are points, its charts overlap."""
    steps = np.linspace(0.0, 1.0, cells + 1)
    along, down = (a.ravel() for a in np.meshgrid(steps, steps))
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right_of, below, across = corner + 1, corner + cells + 1, corner + cells + 2
    square = np.concatenate([np.stack([corner, below, across], 1), np.stack([corner, across, right_of], 1)])
    positions, normals, uvs, faces = [], [], [], []
    for number, (_, _, normal, right, up) in enumerate(NET):
        place = 0.5 * np.array(normal) + np.outer(along - 0.5, right) - np.outer(down - 0.5, up)
        faces.append(square + sum(map(len, positions)))
        positions.append(place)
        normals.append(place / np.linalg.norm(place, axis=1)[:, None] if smooth else np.tile(normal, (len(place), 1)))
        uvs.append(np.tile([(number + 0.5) / 6, 0.5], (len(place), 1)))
    builder = GltfBuilder()
    palette = np.repeat(np.repeat(PALETTE[None], 4, axis=0), 4, axis=1).astype(np.uint8)
    material = builder.add(
        "materials", pbrMetallicRoughness={"baseColorTexture": {"index": builder.texture(palette)}, "metallicFactor": 0}
    )
    primitive = builder.primitive(
        np.concatenate(positions), np.concatenate(faces), NORMAL=np.concatenate(normals), TEXCOORD_0=np.concatenate(uvs)
    )
    builder.node(mesh=builder.mesh({**primitive, "material": material}), name="box")
    return builder.write(path)


def load_cube(folder: Path, **how: object) -> Character:
    """The same, loaded."""
    return load_character(cube_net(folder / "box.glb", **how))  # type: ignore[arg-type]


def side_of(normals: NDArray[np.floating]) -> NDArray[np.int64]:
    """Which side of the cube a normal belongs to, 0 to 5."""
    axis = np.abs(normals).argmax(axis=-1)
    sign = np.take_along_axis(normals, axis[..., None], axis=-1)[..., 0] > 0
    return np.asarray(2 * axis + sign, np.int64)
