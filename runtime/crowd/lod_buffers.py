"""A crowd's levels of detail: vertices with attributes, expanded once from the textures of their model.

The GPU expands them itself (crowd_expand.vert, transform feedback), with the functions that draw single actors. Of the
coarsest levels the positions of all vertices in all baked poses are made ready (vertex_animation_texture.py), as far as
memory allows.
Letters in shapes: V vertices, K records times four joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.crowd.animation_texture import dropped_shift, pick_joints
from runtime.crowd.vertex_animation_texture import ROUNDING_REL, VertexAnimation, bake_vertex_animation
from runtime.gpu import gl_state
from runtime.gpu.lod_buffers import MaterialRange
from runtime.gpu.model import Model
from runtime.gpu.programs import assemble
from runtime.gpu.textures import TEXTURE_UNITS, make_texture
from runtime.gpu.vertex_layout import (
    CANONICAL_UVS,
    NORMAL_UVS,
    Attribute,
    bind_buffer,
    crowd_attributes,
    crowd_vertex_bytes,
    step_defines,
)

Floats = NDArray[np.floating[Any]]
_EXPANDED_BYTES = 44  # of a vertex: position, four joints, four weights, float32
# Four joints per vertex rather than eight where that moves nothing by more than this part of the level's own error.
DROPPED_REL = 0.15


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
    ranges : tuple of MaterialRange
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
    ranges: tuple[MaterialRange, ...]
    error_m: float
    normal_uvs: moderngl.Buffer | None = None


@dataclass(frozen=True)
class CrowdLevel:
    """Buffers of one level of detail of a crowd.

    Attributes
    ----------
    vertices, indices : Buffer
    attributes : tuple of Attribute
        What lies in `vertices`.
    index_size : int
    ranges : tuple of MaterialRange
    defines : mapping
        Preprocessor definitions that the level asks for.
    uniforms : mapping
        That the level gives its programs.
    animation : Texture or None
        Positions of all vertices in all poses, where they are ready-made.
    error_m : float
        Of the shape, as for single actors: what was simplified here counts where it is more than `DROPPED_REL` of it.
    normal_uvs : Buffer or None
        Of the mesh.
    """

    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    attributes: tuple[Attribute, ...]
    index_size: int
    ranges: tuple[MaterialRange, ...]
    defines: Mapping[str, int]
    uniforms: Mapping[str, Any]
    animation: moderngl.Texture | None
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
    vertices = ctx.buffer(np.ascontiguousarray(canonical_uvs).tobytes())
    array = ctx.vertex_array(program, [bind_buffer(program, vertices, (CANONICAL_UVS,))])
    output = ctx.buffer(reserve=max(count, 1) * _EXPANDED_BYTES)
    parts = []
    for number in range(num_records):
        program["record_number"].value = number  # type: ignore[union-attr]
        array.transform(output, mode=moderngl.POINTS, vertices=count)
        parts.append(np.frombuffer(output.read(), dtype=np.float32).reshape(-1, 11)[:count])
    array.release()
    vertices.release()
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
            ranges=lod.ranges,
            error_m=lod.mesh.error_m,
            normal_uvs=lod.normal_uvs,
        )
        for lod, (positions, joints, weights) in zip(model.lods, expand_levels(ctx, model))
    ]


def bake_level_animations(
    meshes: Sequence[LevelMesh], matrices: NDArray[np.float32], most_bytes: int, most_columns: int
) -> list[VertexAnimation | None]:
    """Ready-made positions of the coarsest levels: of as many as memory and their own error allow.

    Parameters
    ----------
    meshes : sequence of LevelMesh, the finest first
    matrices : (R, J, 3, 4) float32
    most_bytes : int
        Of all levels together.
    most_columns : int
        Of one level.
    """
    found: list[VertexAnimation | None] = [None] * len(meshes)
    left = most_bytes
    for number in range(len(meshes) - 1, -1, -1):
        mesh = meshes[number]
        if len(mesh.positions) == 0 or 4 * len(matrices) * len(mesh.positions) > 8 * max(left, 0):
            break  # too many even if most vertices shared their columns
        animation = bake_vertex_animation(matrices, mesh.positions, mesh.joints, mesh.weights)
        left -= animation.texels.nbytes
        if left < 0 or animation.texels.shape[1] > most_columns or animation.rounding_m > ROUNDING_REL * mesh.error_m:
            break
        found[number] = animation
    return found


def upload_level(
    ctx: moderngl.Context, mesh: LevelMesh, animation: VertexAnimation | None, matrices: NDArray[np.float32]
) -> CrowdLevel:
    """Put a level on the GPU. Its indices are the mesh's, and stay with it."""
    shifts = [dropped_shift(matrices, mesh.positions, mesh.joints, mesh.weights, width) for width in (4, 8)]
    eight = animation is None and shifts[0] > DROPPED_REL * mesh.error_m and shifts[0] > shifts[1]
    joints, weights = pick_joints(mesh.joints, mesh.weights, 8 if eight else 4)
    attributes = crowd_attributes(joints.shape[1])
    columns = np.zeros(len(mesh.positions), np.uint16) if animation is None else animation.column_of_vertex
    vertices = ctx.buffer(crowd_vertex_bytes(mesh.positions, mesh.uvs, joints, weights, columns))
    defines: dict[str, int] = {"EIGHT_JOINTS": 1} if eight else {}
    if mesh.normal_uvs is not None:
        defines |= step_defines(NORMAL_UVS)
    texture, uniforms = None, {}
    if animation is not None:
        texture = make_texture(ctx, animation.texels[:, :, None], linear=False)
        texture.write(animation.texels)
        defines["VERTEX_ANIMATION"] = 1
        scale, offset = tuple(animation.scale.tolist()), tuple(animation.offset.tolist())
        uniforms = {"vertex_animation_scale": scale, "vertex_animation_offset": offset}
    simplified_m = shifts[int(eight)] if animation is None else animation.rounding_m
    return CrowdLevel(
        vertices=vertices,
        indices=mesh.indices,
        attributes=attributes,
        index_size=mesh.index_size,
        ranges=mesh.ranges,
        defines=defines,
        uniforms=uniforms,
        animation=texture,
        error_m=mesh.error_m + (simplified_m if simplified_m > DROPPED_REL * mesh.error_m else 0.0),
        normal_uvs=mesh.normal_uvs,
    )
