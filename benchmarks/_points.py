"""Positions of tessellated points read back, and whether points that triangles share are the same bits.

moderngl's transform feedback takes no patches, so the evaluation shader writes its points into a storage buffer, which
needs OpenGL 4.3. The shaders are those of the runtime with a few lines more. Used by tests and by the cracks benchmark.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import moderngl
import numpy as np

from runtime.gpu.model import Model
from runtime.gpu.programs import assemble, remember_members, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.render.renderer import SKINNING, Renderer
from runtime.scene.actor import Actor
from runtime.scene.camera import Camera

MIN_VERSION_CODE = 430
MAX_POINTS = 2_000_000
POINT_BYTES = 48
STORAGE_BINDING = 3
WRITE_POINT = """
layout(std430) buffer Points { uint num_points; uint unused[3]; vec4 points[]; };
void main() {
    evaluate();
    uint at = atomicAdd(num_points, 1u);
    points[3u * at] = vec4(surface_position, gl_TessCoord.x);
    points[3u * at + 1u] = vec4(gl_TessCoord.yz, corner_canonical_uv[0]);
    points[3u * at + 2u] = vec4(corner_canonical_uv[1], corner_canonical_uv[2]);
}
"""


def capture_program(ctx: moderngl.Context, defines: Mapping[str, str | int]) -> moderngl.Program:
    """The tessellating program with an evaluation shader that also writes every point into a storage buffer."""
    texts = {
        name: assemble(name, 410, defines).text for name in ("patch.vert", "patch.tesc", "patch.tese", "depth.frag")
    }
    texts = {name: text.replace("#version 410 core", "#version 430 core") for name, text in texts.items()}
    texts["patch.tese"] = texts["patch.tese"].replace("void main()", "void evaluate()") + WRITE_POINT
    program = ctx.program(
        vertex_shader=texts["patch.vert"],
        tess_control_shader=texts["patch.tesc"],
        tess_evaluation_shader=texts["patch.tese"],
        fragment_shader=texts["depth.frag"],
    )
    remember_members(program)
    blocks: Any = program
    blocks["Points"].binding, blocks["Frame"].binding = STORAGE_BINDING, 0
    set_uniforms(program, TEXTURE_UNITS)
    return program


class PointCapture:
    """A renderer that also writes down every point it tessellates.

    Parameters
    ----------
    model : Model
    defines : mapping
        Preprocessor definitions, as for `Renderer`.
    skinning : str
        As for `Renderer`.
    """

    def __init__(self, model: Model, defines: Mapping[str, str | int], skinning: str = "linear") -> None:
        ctx = model.ctx
        self._renderer = Renderer(ctx, shader_defines=defines, skinning=skinning)
        every = {**defines, **SKINNING[skinning], **dict(model.lods[0].program_defines)}
        program = capture_program(ctx, every)
        self._renderer._passes.adopt(program, "depth", True, model)
        self._storage = ctx.buffer(reserve=16 + POINT_BYTES * MAX_POINTS)

    def points(self, actor: Actor, camera: Camera, level: int, tessellation: float | str) -> np.ndarray:
        """Draw into the bound framebuffer; every evaluated point.

        Returns
        -------
        (N, 12) float32
            Position (3), place in its patch (3), canonical uvs of the patch's corners (6).
        """
        self._storage.write(bytes(16))
        self._storage.bind_to_storage_buffer(STORAGE_BINDING)
        self._renderer.draw([actor], camera, view="depth", lod=level, tessellation=tessellation)
        count = int(np.frombuffer(self._storage.read(4), np.uint32)[0])
        assert count <= MAX_POINTS
        if not count:
            return np.zeros((0, 12), np.float32)
        return np.frombuffer(self._storage.read(POINT_BYTES * count, offset=16), np.float32).reshape(-1, 12).copy()

    def release(self) -> None:
        """Free everything but the model."""
        self._storage.release()
        self._renderer.release()


def shared_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keys (N, 4) that name a point of the surface's edges and corners, bits of its position (N, 3), its patch (N,)."""
    corner_uvs = np.ascontiguousarray(points[:, 6:]).view(np.int64)
    _, corners = np.unique(corner_uvs, return_inverse=True)
    corners = corners.reshape(-1, 3)
    _, patch = np.unique(corners, axis=0, return_inverse=True)
    patch = patch.ravel()
    place = np.ascontiguousarray(points[:, 3:6])
    keys, rows = [], []
    for corner in range(3):
        here = np.flatnonzero(place[:, corner] == 1.0)
        vertex = corners[here, corner]
        keys.append(np.stack([vertex, vertex, np.zeros_like(vertex), np.zeros_like(vertex)], axis=1))
        rows.append(here)
        other = (corner + 2) % 3  # the edge from this corner to the next
        here = np.flatnonzero((place[:, other] == 0.0) & (place < 1.0).all(axis=1))
        a, b = corners[here, corner], corners[here, (corner + 1) % 3]
        share_a, share_b = (
            place[:, k].copy().view(np.int32)[here].astype(np.int64) for k in (corner, (corner + 1) % 3)
        )
        swap = a > b
        keys.append(np.stack([np.where(swap, b, a), np.where(swap, a, b), np.where(swap, share_b, share_a),
                              np.where(swap, share_a, share_b)], axis=1))  # fmt: skip
        rows.append(here)
    chosen = np.concatenate(rows)
    return np.concatenate(keys), np.ascontiguousarray(points[chosen, :3]).view(np.int32), patch[chosen]


def differing_points(points: np.ndarray) -> tuple[int, int]:
    """Shared points whose positions are not the same bits everywhere, and edge points that only one patch makes."""
    keys, bits, patch = shared_points(points)
    _, point = np.unique(keys, axis=0, return_inverse=True)
    point = point.ravel()
    order = np.lexsort((patch, point))
    same_point = point[order[1:]] == point[order[:-1]]
    differ = (bits[order[1:]] != bits[order[:-1]]).any(axis=1) & same_point
    is_edge = keys[:, 0] != keys[:, 1]
    patches_of_point = np.zeros(point.max() + 1, int)
    pairs = np.unique(np.stack([point, patch], axis=1), axis=0)
    np.add.at(patches_of_point, pairs[:, 0], 1)
    lonely = patches_of_point[np.unique(point[is_edge])] != 2
    return int(differ.sum()), int(lonely.sum())
