"""Levels of detail on the GPU: vertices, indices of triangles, patches and seams, and what each program reads of them.

A vertex is two uvs: its own, for the material, and its canonical uv, for the geometry; where a level has hard edges, a
third lies in a buffer of its own, for the normal. What an actor adds comes as one record an instance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.asset.asset import Asset, MaterialData
from runtime.asset.lod_mesh import LodMesh
from runtime.gpu.patch_validation import divided_patches, patch_tolerance_m
from runtime.gpu.patches import seam_edges

INSTANCE = np.dtype([("rows", "<f4", (3, 4)), ("tint", "<f4", 4), ("numbers", "<i4", 2)])
# Of a vertex: its own uv, then its canonical one; as 16-bit steps where these say exactly what all levels have.
UV_ATTRIBUTES = {
    "uvs": {True: ("2u2", "in_uv_steps"), False: ("2f4", "in_uv")},
    "canonical_uvs": {True: ("2u2", "in_canonical_steps"), False: ("2f4", "in_canonical_uv")},
}
ATTRIBUTE_DEFINES = {"in_uv_steps": "UV_STEPS", "in_canonical_steps": "CANONICAL_STEPS"}
NORMAL_ATTRIBUTES = (("2u2", "in_normal_uv"),)
UV_STEPS = 65535  # uvs in 16 bits count them; moderngl knows no normalised attributes of 16 bits
INSTANCE_ATTRIBUTES = (
    ("4f4", "in_world_row0"),
    ("4f4", "in_world_row1"),
    ("4f4", "in_world_row2"),
    ("4f4", "in_tint"),
    ("2i4", "in_numbers"),
)


@dataclass(frozen=True)
class DrawGroup:
    """Consecutive faces of a LOD with equal materials."""

    first: int
    count: int
    material: MaterialData


@dataclass(frozen=True)
class GpuLod:
    """Buffers of one level of detail.

    Attributes
    ----------
    mesh : LodMesh
        What the buffers were made from.
    groups : tuple of DrawGroup
        One draw call each.
    vertices : Buffer
        `vertex_bytes`.
    indices : Buffer
        Of triangles, three each.
    index_size : int
        Bytes per index, 2 or 4.
    attributes : tuple of (format, name)
        What lies in `vertices`, from `vertex_attributes`.
    normal_uvs : Buffer or None
        `normal_bytes`, where the level has normal uvs.
    """

    mesh: LodMesh
    groups: tuple[DrawGroup, ...]
    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    index_size: int
    attributes: tuple[tuple[str, str], ...]
    normal_uvs: moderngl.Buffer | None = None

    @property
    def shader_defines(self) -> dict[str, int]:
        """Preprocessor definitions that programs for this level need, beside the model's."""
        return self.uv_defines if self.normal_uvs is None else {**self.uv_defines, "NORMAL_UV": 1}

    @property
    def uv_defines(self) -> dict[str, int]:
        """Those of them that say how uvs come; the same for all levels of a model."""
        return {ATTRIBUTE_DEFINES[name]: 1 for _, name in self.attributes if name in ATTRIBUTE_DEFINES}

    @property
    def nbytes(self) -> int:
        """Bytes of all buffers."""
        buffers = (self.vertices, self.indices, self.normal_uvs)
        return sum(int(buffer.size) for buffer in buffers if buffer is not None)


def draw_groups(mesh: LodMesh, materials: tuple[MaterialData, ...]) -> tuple[DrawGroup, ...]:
    """Ranges of a level's faces, those with equal materials in one."""
    groups: list[DrawGroup] = []
    for draw in mesh.draws:
        material = materials[draw.material] if 0 <= draw.material < len(materials) else MaterialData()
        anonymous = MaterialData(**{**material.__dict__, "name": ""})
        if groups and groups[-1].material == anonymous and groups[-1].first + groups[-1].count == draw.first:
            groups[-1] = DrawGroup(groups[-1].first, groups[-1].count + draw.count, anonymous)
        elif draw.count:
            groups.append(DrawGroup(draw.first, draw.count, anonymous))
    return tuple(groups)


def uv_steps(uvs: NDArray[np.float32]) -> NDArray[np.uint16]:
    """The 16-bit steps nearest to uvs, (N, 2)."""
    return np.rint(np.clip(uvs.astype(np.float64), 0.0, 1.0) * UV_STEPS).astype(np.uint16)


def vertex_attributes(meshes: Sequence[LodMesh]) -> tuple[tuple[str, str], ...]:
    """What a vertex of these levels is, (format, name) each: uvs in steps where all levels' are whole ones."""

    def whole(uvs: NDArray[np.float32]) -> bool:
        return np.array_equal((uv_steps(uvs) / UV_STEPS).astype(np.float32), uvs)

    return tuple(forms[all(whole(getattr(mesh, part)) for mesh in meshes)] for part, forms in UV_ATTRIBUTES.items())


def vertex_bytes(mesh: LodMesh, attributes: tuple[tuple[str, str], ...]) -> bytes:
    """A level's vertices: uv and canonical uv, four bytes each in steps and eight in floats."""
    parts = [
        uv_steps(uvs) if name in ATTRIBUTE_DEFINES else uvs
        for uvs, (_, name) in zip((mesh.uvs, mesh.canonical_uvs), attributes, strict=True)
    ]
    return np.concatenate([np.ascontiguousarray(part).view(np.uint8) for part in parts], axis=1).tobytes()


def normal_bytes(normal_uvs: NDArray[np.float32]) -> bytes:
    """Normal uvs as whole steps, two uint16 a vertex."""
    return uv_steps(normal_uvs).tobytes()


def index_bytes(mesh: LodMesh, indices: NDArray[np.uint32]) -> bytes:
    """Indices in as few bytes as the level's vertices allow."""
    return indices.astype(np.uint16 if len(mesh.uvs) <= 0xFFFF else np.uint32).tobytes()


class Levels:
    """A character's levels of detail in a context, and the vertex arrays that programs draw them with.

    Parameters
    ----------
    ctx : moderngl.Context
    asset : Asset
    materials : tuple of MaterialData
        In place of the asset's.
    """

    def __init__(self, ctx: moderngl.Context, asset: Asset, materials: tuple[MaterialData, ...]) -> None:
        self.ctx, self.asset, self.materials = ctx, asset, materials
        self.lods: tuple[GpuLod, ...] = ()
        self.errors_m = self.divided_errors_m = np.zeros(0)  # as they are, and at most when tessellated
        self._attributes = vertex_attributes(asset.lods)
        self._owned: list[moderngl.Buffer] = []
        self._line_buffers: dict[int, moderngl.Buffer] = {}
        self._edge_texels: dict[int, float] = {}
        self._patch_buffers: dict[int, moderngl.Buffer] = {}
        self._vertex_arrays: dict[tuple[Any, ...], moderngl.VertexArray] = {}
        self._instances: dict[Any, moderngl.Buffer] = {}

    def _keep(self, content: bytes) -> moderngl.Buffer:
        self._owned.append(self.ctx.buffer(content))
        return self._owned[-1]

    def upload(self, mesh: LodMesh) -> None:
        """Add the next level."""
        lod = GpuLod(
            mesh=mesh,
            groups=draw_groups(mesh, self.materials),
            vertices=self._keep(vertex_bytes(mesh, self._attributes)),
            indices=self._keep(index_bytes(mesh, mesh.triangles)),
            index_size=2 if len(mesh.uvs) <= 0xFFFF else 4,
            normal_uvs=None if mesh.normal_uvs is None else self._keep(normal_bytes(mesh.normal_uvs)),
            attributes=self._attributes,
        )
        self.lods = (*self.lods, lod)
        self.errors_m = np.array([lod.mesh.error_m for lod in self.lods])
        self.divided_errors_m = self.errors_m + [patch_tolerance_m(self.asset, lod.mesh) for lod in self.lods]

    def patches(self, level: int) -> moderngl.Buffer:
        """Index buffer of a level's patches, nine a triangle (made when first asked for)."""
        if level not in self._patch_buffers:
            mesh = self.lods[level].mesh
            self._patch_buffers[level] = self._keep(index_bytes(mesh, divided_patches(self.asset, mesh)))
        return self._patch_buffers[level]

    def longest_edge_texels(self, level: int) -> float:
        """Length of a level's longest edge in texels of the position texture, along its longer axis."""
        if level not in self._edge_texels:
            mesh = self.lods[level].mesh
            corners = mesh.uvs[mesh.triangles.astype(np.int64)] * self.asset.textures["position"].size
            self._edge_texels[level] = float(np.abs(corners - np.roll(corners, 1, axis=1)).max())
        return self._edge_texels[level]

    def seam_lines(self, level: int) -> moderngl.Buffer | None:
        """Index buffer of a level's seam edges, None where it has none (made when first asked for)."""
        if level not in self._line_buffers:
            mesh = self.lods[level].mesh
            indices = seam_edges(mesh.uvs, mesh.canonical_uvs, mesh.triangles)
            if not len(indices):
                return None
            self._line_buffers[level] = self._keep(index_bytes(mesh, indices))
        return self._line_buffers[level]

    def instance_buffer(self, key: Any, instances: NDArray[Any]) -> moderngl.Buffer:
        """A buffer that holds these instances (`INSTANCE` records), one buffer a key."""
        buffer = self._instances.get(key)
        if buffer is None or buffer.size < instances.nbytes:
            capacity = instances.nbytes if buffer is None else max(instances.nbytes, 2 * buffer.size)
            if buffer is not None:
                self._drop_vertex_arrays(lambda vao_key: vao_key[1] == key)
                buffer.release()
            buffer = self.ctx.buffer(reserve=capacity, dynamic=True)
            self._instances[key] = buffer
        buffer.write(instances)
        return buffer

    def vertex_array(
        self, program_key: Any, group: Any, program: moderngl.Program, level: int, kind: str
    ) -> moderngl.VertexArray:
        """The vertex array of a level for a program: `kind` is "triangles", "patches" or "seams"."""
        key = (program_key, group, level, kind)
        if key not in self._vertex_arrays:
            lod = self.lods[level]
            indices = {
                "triangles": lambda: lod.indices,
                "patches": lambda: self.patches(level),
                "seams": lambda: self.seam_lines(level),
            }
            content = [
                layout(program, lod.vertices, lod.attributes),
                layout(program, lod.normal_uvs, NORMAL_ATTRIBUTES) if lod.normal_uvs is not None else None,
                instance_layout(program, self._instances[group]),
            ]
            self._vertex_arrays[key] = self.ctx.vertex_array(
                program,
                [entry for entry in content if entry is not None],
                indices[kind](),
                index_element_size=lod.index_size,
            )
        return self._vertex_arrays[key]

    def _drop_vertex_arrays(self, which: Callable[[Any], bool]) -> None:
        for key in [key for key in self._vertex_arrays if which(key)]:
            self._vertex_arrays.pop(key).release()

    def forget_programs(self, owner: Any) -> None:
        """Free what was made for a renderer's programs."""
        self._drop_vertex_arrays(lambda key: key[0][0] == owner)

    def release(self) -> None:
        """Free all buffers and vertex arrays."""
        self._drop_vertex_arrays(lambda key: True)
        for thing in [*self._owned, *self._instances.values()]:
            thing.release()
        self._owned.clear()
        self._instances.clear()


def instance_layout(program: moderngl.Program, buffer: moderngl.Buffer) -> tuple[Any, ...] | None:
    """moderngl's description of a buffer of `INSTANCE` records for a program."""
    return layout(program, buffer, INSTANCE_ATTRIBUTES, per_instance=True)


def layout(
    program: moderngl.Program,
    buffer: moderngl.Buffer,
    attributes: tuple[tuple[str, str], ...],
    per_instance: bool = False,
) -> tuple[Any, ...] | None:
    """moderngl's description of a buffer, with gaps where the program does not use an attribute."""
    formats, names = [], []
    for form, name in attributes:
        if name in program:
            formats.append(form)
            names.append(name)
        else:
            formats.append(f"{int(form[0]) * int(form[-1])}x")
    if not names:
        return None
    return (buffer, " ".join(formats) + (" /i" if per_instance else ""), *names)
