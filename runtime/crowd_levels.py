"""A crowd's levels of detail as vertices with attributes, expanded once from the textures of their model.

The GPU expands them itself (crowd_expand.vert, transform feedback), with the functions that draw single actors.
Letters in shapes: V vertices, K records times four joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime import gl_state
from runtime.gpu_asset import Model
from runtime.gpu_levels import DrawGroup
from runtime.gpu_textures import TEXTURE_UNITS
from runtime.programs import assemble

Floats = NDArray[np.floating[Any]]
_EXPANDED_BYTES = 44  # a vertex: position, four joints, four weights, float32


@dataclass(frozen=True)
class CrowdLevel:
    """Buffers of one level of detail of a crowd."""

    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    index_size: int
    groups: tuple[DrawGroup, ...]
    eight_joints: bool
    nearest_row: bool
    error_m: float


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
                parts = _expand(ctx, program, lod.vertices, len(lod.mesh.uvs), model.weight_cells.max_records)
                joints = np.concatenate([part[:, 3:7] for part in parts], axis=1).astype(np.int64)
                weights = np.concatenate([part[:, 7:11] for part in parts], axis=1)
                levels.append((parts[0][:, :3], joints, weights))
    finally:
        program.release()
    return levels


def _expand(
    ctx: moderngl.Context, program: moderngl.Program, vertices: moderngl.Buffer, count: int, num_records: int
) -> list[NDArray[np.float32]]:
    """What the shader writes for every vertex, (V, 11), one array a record of a weight cell."""
    array = ctx.vertex_array(program, [(vertices, "2x4 2f4", "in_owner_uv")])
    output = ctx.buffer(reserve=max(count, 1) * _EXPANDED_BYTES)
    parts = []
    for number in range(num_records):
        program["record_number"].value = number  # type: ignore[union-attr]
        array.transform(output, mode=moderngl.POINTS, vertices=count)
        parts.append(np.frombuffer(output.read(), dtype=np.float32).reshape(-1, 11)[:count])
    array.release()
    output.release()
    return parts


def vertex_bytes(positions: Floats, uvs: Floats, joints: NDArray[np.uint16], weights: Floats) -> bytes:
    """Vertices as crowd.vert reads them: position and uv float32, joints uint16, weights float16.

    Parameters
    ----------
    positions : (V, 3) float, metres
    uvs : (V, 2) float
    joints, weights : (V, 4 or 8)
    """
    parts = (positions.astype("<f4"), uvs.astype("<f4"), joints.astype("<u2"), weights.astype("<f2"))
    rows = [np.ascontiguousarray(part).view(np.uint8).reshape(len(positions), -1) for part in parts]
    return np.concatenate(rows, axis=1).tobytes()
