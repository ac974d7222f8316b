"""A small built character made by formula: a closed, skinned, cube-shaped ball with six charts, in the folder's format.

It needs no pipeline, so the runtime is tested alone. Its textures are sampled from the formula and not seam-erased: the
two sides of every seam sample slightly different positions, which only canonical uvs makes watertight.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from preprocess.files.images import Image, write_image
from preprocess.mesh.texels import px_to_uv
from runtime.asset.weight_stack import pack_weights

X, Y, Z = np.eye(3)
AXES = np.array([[-Z, Y, X], [Z, Y, -X], [X, -Z, Y], [X, Z, -Y], [X, Y, Z], [-X, Y, -Z]])  # right, up, out of each face
CHART = 0.27  # side of a chart in uv; three by two charts with gutters between them
RADII = np.array([0.5, 1.0, 0.35])
CENTRE = np.array([0.0, 1.0, 0.0])


def chart_origin(face: int) -> np.ndarray:
    """Corner of a cube face's chart in uv."""
    return np.array([0.031 + 0.333 * (face % 3), 0.043 + 0.5 * (face // 3)])


def surface_point(face: int | np.ndarray, st: np.ndarray) -> np.ndarray:
    """Point on the body of a cube face at (s, t) in [-1, 1]^2, (..., 3)."""
    right, up, out = np.moveaxis(AXES[face], -2, 0)
    cube = right * st[..., :1] + up * st[..., 1:] + out
    unit = cube / np.linalg.norm(cube, axis=-1, keepdims=True)
    bumps = 1.0 + 0.04 * np.sin(5 * unit[..., :1] + 1.0) * np.cos(4 * unit[..., 1:2])
    return unit * bumps * RADII + CENTRE


def surface_normal(face: int | np.ndarray, st: np.ndarray) -> np.ndarray:
    """Outward unit normal, by differences."""
    step_s, step_t = np.eye(2) * 1e-5
    along_s = surface_point(face, st + step_s) - surface_point(face, st - step_s)
    along_t = surface_point(face, st + step_t) - surface_point(face, st - step_t)
    normal = np.cross(along_s, along_t)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def joint_heights(num_joints: int) -> np.ndarray:
    return np.linspace(0.0, 1.8, num_joints)


def weights_at(points: np.ndarray, num_joints: int) -> np.ndarray:
    """Smooth weights by height, two or three joints a point, (..., J)."""
    if num_joints == 1:
        return np.ones((*points.shape[:-1], 1))
    spacing = 1.8 / (num_joints - 1)
    bumps = np.maximum(0.0, 1.0 - np.abs(points[..., 1:2] - joint_heights(num_joints)) / (1.3 * spacing)) ** 2
    bumps[..., 0] += np.maximum(0.0, -points[..., 1])
    bumps[..., -1] += np.maximum(0.0, points[..., 1] - 1.8)
    return bumps / bumps.sum(axis=-1, keepdims=True)


def texel_places(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Cube face (H, W) and (s, t) (H, W, 2) of every texel: the nearest chart's, continued beyond its border."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    uv = px_to_uv(np.stack([columns, rows], axis=-1), width, height)
    origins = np.array([chart_origin(face) for face in range(6)])
    st = (uv[None] - origins[:, None, None]) / CHART * 2 - 1
    face = np.abs(st).max(axis=-1).argmin(axis=0)
    return face, np.clip(np.take_along_axis(st, face[None, ..., None], axis=0)[0], -1.6, 1.6)


def lod_mesh(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """uvs, canonical uvs (both (N, 2)), triangles (F, 3) and the cube face of each triangle, n x n squares a face."""
    grid = np.linspace(-1, 1, n + 1)
    s, t = np.meshgrid(grid, grid)
    st = np.stack([s.ravel(), t.ravel()], axis=-1)
    uvs = np.concatenate([chart_origin(face) + (st + 1) / 2 * CHART for face in range(6)])
    cube = np.concatenate([st[:, :1] * AXES[f, 0] + st[:, 1:] * AXES[f, 1] + AXES[f, 2] for f in range(6)])
    _, first, point = np.unique(np.round(cube * n * 4).astype(int), axis=0, return_index=True, return_inverse=True)
    canonical_uvs = uvs[first[point.ravel()]]
    i, j = np.meshgrid(np.arange(n), np.arange(n))
    a = (j * (n + 1) + i).ravel()
    quads = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    triangles = np.concatenate([quads + face * (n + 1) ** 2 for face in range(6)])
    return uvs, canonical_uvs, triangles, np.repeat(np.arange(6), len(quads))


class GlbWriter:
    """The least of glTF that a test needs."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
        self.data = b""

    def accessor(self, array: np.ndarray, kind: str) -> int:
        component = {"float32": 5126, "uint16": 5123, "uint32": 5125}[array.dtype.name]
        data = np.ascontiguousarray(array).tobytes()
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.json["accessors"].append(
            {
                "bufferView": len(self.json["bufferViews"]) - 1,
                "componentType": component,
                "count": len(array),
                "type": kind,
            }
        )
        self.data += data + b"\0" * (-len(data) % 4)
        return len(self.json["accessors"]) - 1

    def write(self, path: Path) -> None:
        self.json["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        chunks = (
            struct.pack("<II", len(text), 0x4E4F534A)
            + text
            + struct.pack("<II", len(self.data), 0x004E4942)
            + self.data
        )
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def quaternion(axis: tuple[float, float, float], angle: float) -> list[float]:
    return [*(np.sin(angle / 2) * np.asarray(axis, float)), float(np.cos(angle / 2))]


def build_ball(
    folder: Path,
    *,
    num_joints: int = 4,
    sizes: tuple[int, ...] = (12, 6, 3),
    position_px: int = 64,
    weight_px: int = 32,
    color_px: int = 64,
    materials: list[dict[str, Any]] | None = None,
    face_materials: tuple[int, ...] = (0,) * 6,
) -> Path:
    """Write the folder; `sizes` are squares along a cube edge of each LOD."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_model(folder / "model.glb", num_joints, sizes, materials or [{"name": "skin"}], face_materials)
    textures = _write_textures(folder, num_joints, position_px, weight_px, color_px)
    finest = surface_corners(sizes[0])
    weights = weights_at(finest, num_joints)
    boxes = [_box(finest[weights[:, joint] > 0]) for joint in range(num_joints)]
    errors = [0.0, *(0.9 / n**2 for n in sizes[1:])]
    manifest = {
        "schema": 1,
        "name": "ball",
        "source": {"file": "ball", "sha256": ""},
        "model": "model.glb",
        "joints": [f"joint{i}" for i in range(num_joints)],
        "clips": [{"name": "bend", "duration_s": 1.0}],
        "bounds": {"bind": _box(finest), "joints": boxes, "clips": {"bend": [[-2, -1, -2], [2, 3, 2]]}},
        "textures": textures,
        "lods": [
            {"node": f"ball_LOD{level}", "faces": 12 * n * n, "vertices": 6 * (n + 1) ** 2, "error_m": errors[level]}
            for level, n in enumerate(sizes)
        ],
        "atlas": {"mode": "formula", "charts": 6},
        "timings": {},
        "warnings": [],
    }
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=1))
    return folder


def surface_corners(n: int) -> np.ndarray:
    """Positions of a LOD's vertices by the formula, (N, 3)."""
    grid = np.linspace(-1, 1, n + 1)
    s, t = np.meshgrid(grid, grid)
    st = np.stack([s.ravel(), t.ravel()], axis=-1)
    return np.concatenate([surface_point(face, st) for face in range(6)])


def _box(points: np.ndarray) -> list[list[float]] | None:
    return None if not len(points) else [(points.min(axis=0) - 0.02).tolist(), (points.max(axis=0) + 0.02).tolist()]


def _write_model(
    path: Path,
    num_joints: int,
    sizes: tuple[int, ...],
    materials: list[dict[str, Any]],
    face_materials: tuple[int, ...],
) -> None:
    glb = GlbWriter()
    heights = joint_heights(num_joints)
    nodes: list[dict[str, Any]] = []
    for joint, height in enumerate(heights):
        node: dict[str, Any] = {
            "name": f"joint{joint}",
            "translation": [0, float(height - heights[joint - 1]) if joint else 0.0, 0],
        }
        if joint + 1 < num_joints:
            node["children"] = [joint + 1]
        nodes.append(node)
    meshes = []
    for level, n in enumerate(sizes):
        uvs, canonical_uvs, triangles, faces = lod_mesh(n)
        uv_accessor = glb.accessor(uvs.astype(np.float32), "VEC2")
        canonical_accessor = glb.accessor(canonical_uvs.astype(np.float32), "VEC2")
        primitives = []
        for material in sorted(set(face_materials)):
            chosen = triangles[np.isin(faces, [f for f in range(6) if face_materials[f] == material])]
            indices = glb.accessor(chosen.astype(np.uint32).ravel(), "SCALAR")
            attributes = {"TEXCOORD_0": uv_accessor, "_OWNER_UV": canonical_accessor}
            primitives.append({"attributes": attributes, "indices": indices, "material": material})
        meshes.append({"primitives": primitives})
        nodes.append({"name": f"ball_LOD{level}", "mesh": level, "skin": 0})
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (num_joints, 1, 1))
    inverse_bind[:, 3, 1] = -heights  # column-major
    skin = {
        "joints": list(range(num_joints)),
        "inverseBindMatrices": glb.accessor(inverse_bind.reshape(-1, 16), "MAT4"),
    }
    times = glb.accessor(np.array([0, 0.25, 0.5, 0.75, 1.0], np.float32), "SCALAR")
    swing = np.array([0, 1, 0, -1, 0]) * (1.2 / max(num_joints - 1, 1))
    channels, samplers = [], []
    for joint in range(1, num_joints) if num_joints > 1 else range(1):
        axis = (0.0, 0.0, 1.0) if joint % 2 else (0.6, 0.8, 0.0)
        keys = np.array([quaternion(axis, angle) for angle in swing], np.float32)
        samplers.append({"input": times, "output": glb.accessor(keys, "VEC4")})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": joint, "path": "rotation"}})
    glb.json |= {
        "nodes": nodes,
        "meshes": meshes,
        "skins": [skin],
        "materials": materials,
        "animations": [{"name": "bend", "channels": channels, "samplers": samplers}],
        "scenes": [{"nodes": [0, *range(num_joints, num_joints + len(sizes))]}],
        "scene": 0,
    }
    glb.write(path)


def _write_textures(folder: Path, num_joints: int, position_px: int, weight_px: int, color_px: int) -> dict[str, Any]:
    face, st = texel_places(position_px, position_px)
    write_image(folder / "position.exr", Image(surface_point(face, st), "float"))
    face, st = texel_places(weight_px, weight_px)
    packed = pack_weights(weights_at(surface_point(face, st), num_joints))
    write_image(folder / "weights.png", Image(packed.texels01, packed.format))
    entries: dict[str, Any] = {
        "position": {"file": "position.exr", "size": [position_px] * 2, "format": "float", "mips": 1, "mip_files": []},
        "weights": {
            "file": "weights.png",
            "size": [weight_px] * 2,
            "format": packed.format,
            "mips": 1,
            "layout": "texel-joints",
            "slots": packed.slots,
        },
    }
    (folder / "mips").mkdir(exist_ok=True)
    num_levels = int(np.log2(color_px)) - 2
    for name, stored in (("normal", "uint16"), ("base_color", "uint8"), ("orm", "uint8")):
        mip_files = []
        for level in range(num_levels):
            face, st = texel_places(color_px >> level, color_px >> level)
            file = f"{name}.png" if level == 0 else f"mips/{name}.{level}.png"
            write_image(folder / file, Image(np.clip(_color(name, face, st), 0, 1), stored))
            mip_files += [file] if level else []
        entries[name] = {
            "file": f"{name}.png",
            "size": [color_px] * 2,
            "format": stored,
            "mips": num_levels,
            "mip_files": mip_files,
        }
    return entries


def _color(name: str, face: np.ndarray, st: np.ndarray) -> np.ndarray:
    points = surface_point(face, st)
    if name == "normal":
        return surface_normal(face, st) * 0.5 + 0.5
    bands = 0.5 + 0.5 * np.sin(points * [9.0, 7.0, 11.0])
    if name == "orm":
        return np.stack([np.ones(face.shape), 0.3 + 0.5 * bands[..., 1], (bands[..., 0] > 0.8).astype(float)], axis=-1)
    return 0.25 + 0.6 * bands
