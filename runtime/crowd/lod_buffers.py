"""A crowd's levels of detail: vertices with attributes, expanded once from the textures of their model.

The GPU expands them itself (crowd_expand.vert, transform feedback), with the functions that draw single actors. Of the
coarsest levels the places of all vertices in all baked poses are made ready (crowd_places.py), as far as memory allows.
Letters in shapes: V vertices, K records times four joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.crowd.animation_texture import dropped_shift, pick_joints
from runtime.crowd.vertex_animation_texture import ROUNDING_SHARE, Places, bake_places
from runtime.gpu import gl_state
from runtime.gpu.lod_buffers import DrawGroup
from runtime.gpu.model import Model
from runtime.gpu.programs import assemble
from runtime.gpu.textures import TEXTURE_UNITS

Floats = NDArray[np.floating[Any]]
_EXPANDED_BYTES = 44  # a vertex: position, four joints, four weights, float32


# Four joints a vertex rather than eight where that moves nothing by more than this part of the level's own error.
DROPPED_SHARE = 0.15


@dataclass(frozen=True)
class LevelMesh:
    """One level as it is to be drawn, whatever it was made from.

    Attributes
    ----------
    positions : (V, 3) float, at rest, metres
    uvs : (V, 2) float
    joints : (V, K) int
    weights : (V, K) float
    indices : Buffer
        Of triangles.
    index_size : int
        Bytes an index.
    groups : tuple of DrawGroup
    error_m : float
    normal_uvs : Buffer or None
        As of `GpuLod`; not released with the crowd.
    """

    positions: Floats
    uvs: Floats
    joints: NDArray[np.int64]
    weights: Floats
    indices: moderngl.Buffer
    index_size: int
    groups: tuple[DrawGroup, ...]
    error_m: float
    normal_uvs: moderngl.Buffer | None = None


@dataclass(frozen=True)
class CrowdLevel:
    """Buffers of one level of detail of a crowd.

    Attributes
    ----------
    vertices, indices : Buffer
    index_size : int
    groups : tuple of DrawGroup
    eight_joints : bool
        Eight joints a vertex, not four.
    places : Texture or None
        Places of all vertices in all poses, where they are ready-made.
    place_scale, place_offset : tuple of three float
        A place in metres is what `places` holds, times the scale, plus the offset.
    error_m : float
        Of the shape, and of what was simplified here.
    normal_uvs : Buffer or None
        Of the mesh.
    """

    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    index_size: int
    groups: tuple[DrawGroup, ...]
    eight_joints: bool
    places: moderngl.Texture | None
    place_scale: tuple[float, ...]
    place_offset: tuple[float, ...]
    error_m: float
    normal_uvs: moderngl.Buffer | None


@contextmanager
def _small_framebuffer(ctx: moderngl.Context, gl: gl_state.Functions) -> Iterator[None]:
    """A complete framebuffer while transform feedback runs: a context without a window may have none bound."""
    drawing = gl.integer(gl_state.DRAW_FRAMEBUFFER_BINDING)
    reading = gl.integer(gl_state.READ_FRAMEBUFFER_BINDING)
    color = ctx.renderbuffer((1, 1))
    framebuffer = ctx.framebuffer([color])
    try:
        gl.glBindFramebuffer(gl_state.DRAW_FRAMEBUFFER, framebuffer.glo)
        yield
    finally:
        framebuffer.release()
        color.release()
        gl.glBindFramebuffer(gl_state.DRAW_FRAMEBUFFER, drawing)
        gl.glBindFramebuffer(gl_state.READ_FRAMEBUFFER, reading)


def expand_levels(ctx: moderngl.Context, model: Model) -> list[tuple[Floats, NDArray[np.int64], Floats]]:
    """Position (V, 3), joints (V, K) and weights (V, K) of every level's vertices, read back from the GPU."""
    text = assemble("crowd_expand.vert", ctx.version_code, model.shader_defines).text
    program = ctx.program(vertex_shader=text, varyings=("rest", "joints", "weights"))
    for name, texture in model.textures.items():
        if name in program:
            program[name].value = TEXTURE_UNITS[name]  # type: ignore[union-attr]
            texture.use(TEXTURE_UNITS[name])
    for name, value in model.constants.items():
        if name in program:
            program[name].value = value  # type: ignore[union-attr]
    levels = []
    try:
        with _small_framebuffer(ctx, gl_state.functions()):
            for lod in model.lods:
                parts = _expand(ctx, program, lod.mesh.canonical_uvs, model.weight_cells.max_records)
                joints = np.concatenate([part[:, 3:7] for part in parts], axis=1).astype(np.int64)
                weights = np.concatenate([part[:, 7:11] for part in parts], axis=1)
                levels.append((parts[0][:, :3], joints, weights))
    finally:
        program.release()
    return levels


def _expand(
    ctx: moderngl.Context, program: moderngl.Program, canonical_uvs: NDArray[np.float32], num_records: int
) -> list[NDArray[np.float32]]:
    """What the shader writes for every vertex, (V, 11), one array a record of a weight cell."""
    count = len(canonical_uvs)
    places = ctx.buffer(np.ascontiguousarray(canonical_uvs).tobytes())
    array = ctx.vertex_array(program, [(places, "2f4", "in_canonical_uv")])
    output = ctx.buffer(reserve=max(count, 1) * _EXPANDED_BYTES)
    parts = []
    for number in range(num_records):
        program["record_number"].value = number  # type: ignore[union-attr]
        array.transform(output, mode=moderngl.POINTS, vertices=count)
        parts.append(np.frombuffer(output.read(), dtype=np.float32).reshape(-1, 11)[:count])
    array.release()
    places.release()
    output.release()
    return parts


def model_meshes(ctx: moderngl.Context, model: Model) -> list[LevelMesh]:
    """A model's own levels, ready to become a crowd's."""
    return [
        LevelMesh(
            positions=positions,
            uvs=lod.mesh.uvs,
            joints=joints,
            weights=weights,
            indices=lod.indices,
            index_size=lod.index_size,
            groups=lod.groups,
            error_m=lod.mesh.error_m,
            normal_uvs=lod.normal_uvs,
        )
        for lod, (positions, joints, weights) in zip(model.lods, expand_levels(ctx, model))
    ]


def bake_level_places(
    meshes: Sequence[LevelMesh], matrices: NDArray[np.float32], most_bytes: int, most_places: int
) -> list[Places | None]:
    """Ready-made places of the coarsest levels: of as many as memory and their own error allow.

    Parameters
    ----------
    meshes : sequence of LevelMesh, the finest first
    matrices : (R, J, 3, 4) float32
    most_bytes : int
        Of all levels together.
    most_places : int
        Of one level.
    """
    found: list[Places | None] = [None] * len(meshes)
    left = most_bytes
    for number in range(len(meshes) - 1, -1, -1):
        mesh = meshes[number]
        if len(mesh.positions) == 0 or 4 * len(matrices) * len(mesh.positions) > 8 * max(left, 0):
            break  # too many even if most vertices shared their places
        places = bake_places(matrices, mesh.positions, mesh.joints, mesh.weights)
        left -= places.texels.nbytes
        if left < 0 or places.texels.shape[1] > most_places or places.rounding_m > ROUNDING_SHARE * mesh.error_m:
            break
        found[number] = places
    return found


def upload_level(
    ctx: moderngl.Context, mesh: LevelMesh, places: Places | None, matrices: NDArray[np.float32]
) -> CrowdLevel:
    """Put a level on the GPU. Its indices are those of the mesh, and stay their owner's."""
    shifts = [dropped_shift(matrices, mesh.positions, mesh.joints, mesh.weights, width) for width in (4, 8)]
    eight = places is None and shifts[0] > DROPPED_SHARE * mesh.error_m and shifts[0] > shifts[1]
    joints, weights = pick_joints(mesh.joints, mesh.weights, 8 if eight else 4)
    numbers = np.zeros(len(mesh.positions), np.uint16) if places is None else places.place_of_vertex
    vertices = ctx.buffer(vertex_bytes(mesh.positions, mesh.uvs, joints, weights, numbers))
    texture = None
    if places is not None:
        texture = ctx.texture(places.texels.shape[::-1], 1, places.texels.tobytes(), dtype="u4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        texture.repeat_x = texture.repeat_y = False
    return CrowdLevel(
        vertices=vertices,
        indices=mesh.indices,
        index_size=mesh.index_size,
        groups=mesh.groups,
        eight_joints=eight,
        places=texture,
        place_scale=(0.0, 0.0, 0.0) if places is None else tuple(places.scale.tolist()),
        place_offset=(0.0, 0.0, 0.0) if places is None else tuple(places.offset.tolist()),
        error_m=mesh.error_m + (shifts[int(eight)] if places is None else places.rounding_m),
        normal_uvs=mesh.normal_uvs,
    )


def vertex_bytes(
    positions: Floats, uvs: Floats, joints: NDArray[np.uint16], weights: Floats, places: NDArray[np.uint16]
) -> bytes:
    """Vertices as crowd.vert reads them: position and uv float32, joints uint16, weights float16, place uint16 twice.

    Parameters
    ----------
    positions : (V, 3) float, metres
    uvs : (V, 2) float
    joints, weights : (V, 4 or 8)
    places : (V,) uint16
    """
    parts = (
        *(positions.astype("<f4"), uvs.astype("<f4"), joints.astype("<u2"), weights.astype("<f2")),
        np.repeat(places.astype("<u2")[:, None], 2, axis=1),
    )
    rows = [np.ascontiguousarray(part).view(np.uint8).reshape(len(positions), -1) for part in parts]
    return np.concatenate(rows, axis=1).tobytes()
