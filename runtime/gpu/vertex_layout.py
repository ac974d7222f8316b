"""What lies in vertex and instance buffers: of actors, of patches and of crowds.

A vertex is two uvs: its own, for the material, and its canonical one, for the geometry: the same bits for every copy of
a surface point. Where a level has hard edges, a third lies in a buffer of its own, for the normal. A crowd's vertex
has what the textures say at its canonical uv instead, as attributes. What an actor adds comes once an instance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.asset.lod_mesh import UV_STEPS, LodMesh, uv_steps
from runtime.gpu.gl_state import FLOAT, UNSIGNED_BYTE

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Attribute:
    """One vertex attribute: its name in GLSL and how it is stored, in moderngl's words ("4f4": four float32)."""

    name: str
    form: str

    @property
    def components(self) -> int:
        """How many numbers it has."""
        return int(self.form[0])

    @property
    def nbytes(self) -> int:
        """Bytes of each vertex or instance."""
        return self.components * int(self.form[-1])

    @property
    def gl_type(self) -> tuple[int, int]:
        """OpenGL's type, and whether integers count as 0 to 1."""
        return {"f4": (FLOAT, 0), "f1": (UNSIGNED_BYTE, 1)}[self.form[1:]]


UVS, UVS_IN_STEPS = Attribute("in_uv", "2f4"), Attribute("in_uv_steps", "2u2")
CANONICAL_UVS, CANONICAL_UVS_IN_STEPS = Attribute("in_canonical_uv", "2f4"), Attribute("in_canonical_steps", "2u2")
NORMAL_UVS = (Attribute("in_normal_uv", "2u2"),)
WORLD_ROWS = tuple(Attribute(f"in_world_row{row}", "4f4") for row in range(3))
# moderngl knows no normalised attributes of 16 bits: shaders divide by the steps, which these definitions give them.
STEP_DEFINES = {UVS_IN_STEPS: "UV_STEPS", CANONICAL_UVS_IN_STEPS: "CANONICAL_STEPS", NORMAL_UVS[0]: "NORMAL_UV"}

# Instance records; the attributes that follow are their fields, in the same order.
ACTOR_INSTANCE = np.dtype([("rows", "<f4", (3, 4)), ("tint", "<f4", 4), ("pose", "<i4"), ("level", "<i4")])
ACTOR_ATTRIBUTES = (*WORLD_ROWS, Attribute("in_tint", "4f4"), Attribute("in_pose_and_level", "2i4"))
CROWD_INSTANCE = np.dtype([("rows", "<f4", (3, 4)), ("pose_row", "<f4"), ("tint", "u1", 4), ("actor", "<f4")])
CROWD_ATTRIBUTES = (
    *WORLD_ROWS,
    *(Attribute("in_pose_row", "1f4"), Attribute("in_tint", "4f1"), Attribute("in_actor", "1f4")),
)
MORPH_LISTS = (Attribute("in_morph_list", "2u4"),)  # of a crowd's vertex: its first record, and how many


def step_defines(attributes: Sequence[Attribute]) -> dict[str, int]:
    """Preprocessor definitions for attributes that are whole steps: the number of steps."""
    return {STEP_DEFINES[one]: UV_STEPS for one in attributes if one in STEP_DEFINES}


def uv_attributes(meshes: Sequence[LodMesh]) -> tuple[Attribute, Attribute]:
    """How uvs and canonical uvs of these levels are stored: in steps where all levels' are whole ones."""

    def are_steps(name: str) -> bool:
        arrays = [getattr(mesh, name) for mesh in meshes]
        return all(np.array_equal((uv_steps(uvs) / UV_STEPS).astype(np.float32), uvs) for uvs in arrays)

    own = UVS_IN_STEPS if are_steps("uvs") else UVS
    return own, CANONICAL_UVS_IN_STEPS if are_steps("canonical_uvs") else CANONICAL_UVS


def vertex_bytes(mesh: LodMesh, attributes: Sequence[Attribute]) -> bytes:
    """A level's vertices as `uv_attributes` has them: uv and canonical uv."""
    columns = zip((mesh.uvs, mesh.canonical_uvs), attributes, strict=True)
    return _interleaved([uv_steps(uvs) if one in STEP_DEFINES else uvs for uvs, one in columns])


def index_bytes(mesh: LodMesh, indices: NDArray[np.unsignedinteger[Any]]) -> bytes:
    """Indices of a level's vertices, in as few bytes as their number allows (`index_size`)."""
    return indices.astype(f"<u{index_size(mesh)}").tobytes()


def index_size(mesh: LodMesh) -> int:
    """Bytes per index of a level. The largest number of each size is kept free: hosts restart primitives at it."""
    return 2 if len(mesh.uvs) <= np.iinfo(np.uint16).max else 4


def crowd_attributes(num_joints: int) -> tuple[Attribute, ...]:
    """A crowd's vertex: its place at rest and in the atlas, four or eight joints, its column of ready-made poses."""
    more = num_joints > 4
    return (
        *(Attribute("in_position", "3f4"), UVS, Attribute("in_joints", "4u2")),
        *((Attribute("in_more_joints", "4u2"),) if more else ()),
        Attribute("in_weights", "4f2"),
        *((Attribute("in_more_weights", "4f2"),) if more else ()),
        *(Attribute("in_column", "1u2"), Attribute("", "1u2")),
    )


def crowd_vertex_bytes(
    positions: Floats, uvs: Floats, joints: NDArray[np.uint16], weights: Floats, columns: NDArray[np.uint16]
) -> bytes:
    """A crowd's vertices as `crowd_attributes` has them.

    Parameters
    ----------
    positions : (V, 3) float, metres
    uvs : (V, 2) float
    joints, weights : (V, 4 or 8)
    columns : (V,) uint16
        Where a vertex lies in the vertex animation texture.
    """
    parts = [positions.astype("<f4"), uvs.astype("<f4"), joints.astype("<u2"), weights.astype("<f2")]
    return _interleaved([*parts, np.repeat(columns.astype("<u2")[:, None], 2, axis=1)])


def _interleaved(columns: Sequence[NDArray[Any]]) -> bytes:
    """Bytes of arrays (V, C) with each vertex's values side by side."""
    rows = [np.ascontiguousarray(column).view(np.uint8).reshape(len(column), -1) for column in columns]
    return np.concatenate(rows, axis=1).tobytes()


def bind_buffer(
    program: moderngl.Program, buffer: moderngl.Buffer, attributes: Sequence[Attribute], per_instance: bool = False
) -> tuple[Any, ...] | None:
    """moderngl's description of a buffer, with gaps where the program does not use an attribute; None if it uses none.

    Parameters
    ----------
    program : moderngl.Program
    buffer : moderngl.Buffer
    attributes : sequence of Attribute
        What lies in the buffer, in order.
    per_instance : bool
        Whether they advance once an instance.
    """
    names = [one.name for one in attributes if one.name in program]
    if not names:
        return None
    formats = [one.form if one.name in program else f"{one.nbytes}x" for one in attributes]
    return (buffer, " ".join(formats) + (" /i" if per_instance else ""), *names)


def attribute_offsets(attributes: Sequence[Attribute]) -> Iterator[tuple[Attribute, int]]:
    """Each attribute and the byte of its record at which it starts."""
    offset = 0
    for one in attributes:
        yield one, offset
        offset += one.nbytes
