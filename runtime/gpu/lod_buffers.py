"""Levels of detail on the GPU: vertices, indices of triangles, patches and seams, and the vertex arrays over them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.asset.asset import Asset, MaterialData
from runtime.asset.lod_mesh import LodMesh, uv_steps
from runtime.gpu.material_packing import MaterialChannels
from runtime.gpu.patch_validation import divided_patches, patch_tolerance_m
from runtime.gpu.patches import seam_edges
from runtime.gpu.vertex_layout import (
    ACTOR_ATTRIBUTES,
    NORMAL_UVS,
    Attribute,
    bind_buffer,
    index_bytes,
    index_size,
    step_defines,
    uv_attributes,
    vertex_bytes,
)


@dataclass(frozen=True)
class MaterialRange:
    """Consecutive faces of a LOD with equal materials.

    Attributes
    ----------
    first, count : int
    material : MaterialData
    defines : tuple of str
        From `material_defines`.
    """

    first: int
    count: int
    material: MaterialData
    defines: tuple[str, ...]


@dataclass(frozen=True)
class GpuLod:
    """Buffers of one level of detail.

    Attributes
    ----------
    mesh : LodMesh
        What the buffers were made from.
    ranges : tuple of MaterialRange
        One draw call each.
    vertices : Buffer
        `vertex_bytes`.
    indices : Buffer
        Of triangles, three each.
    index_size : int
        Bytes per index, 2 or 4.
    attributes : tuple of Attribute
        What lies in `vertices`.
    program_defines : tuple of (str, int)
        Preprocessor definitions of programs that draw the level, whatever the material.
    normal_uvs : Buffer or None
        Where the level has normal uvs: two uint16 per vertex.
    """

    mesh: LodMesh
    ranges: tuple[MaterialRange, ...]
    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    index_size: int
    attributes: tuple[Attribute, ...]
    program_defines: tuple[tuple[str, int], ...]
    normal_uvs: moderngl.Buffer | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all buffers."""
        buffers = (self.vertices, self.indices, self.normal_uvs)
        return sum(int(buffer.size) for buffer in buffers if buffer is not None)


def material_defines(material: MaterialData) -> tuple[str, ...]:
    """Preprocessor definitions that leave out of a program what a material does without (surface.glsl)."""
    lacks = {
        "NO_ALPHA_TEST": material.alpha_mode != "MASK",
        "NO_BLEND": material.alpha_mode != "BLEND",
        "NO_FACTOR": material.base_color_factor == (1.0, 1.0, 1.0, 1.0),
        "NO_ROUGHNESS_FACTOR": material.roughness_factor == 1.0,
        "NO_EMISSION": not any(material.emissive_factor),
        "NO_METAL": not material.metallic_factor,
        "ONE_SIDED": not material.double_sided,
        "UNLIT": material.unlit,
    }
    return tuple(name for name, lacking in lacks.items() if lacking)


def material_ranges(mesh: LodMesh, channels: MaterialChannels) -> tuple[MaterialRange, ...]:
    """Ranges of a level's faces, those with equal materials in one."""
    ranges: list[MaterialRange] = []
    for draw in mesh.draws:
        is_known = 0 <= draw.material < len(channels.materials)
        material = replace(channels.materials[draw.material] if is_known else MaterialData(), name="")
        last = ranges[-1] if ranges else None
        if last is not None and last.material == material and last.first + last.count == draw.first:
            ranges[-1] = replace(last, count=last.count + draw.count)
        elif draw.count:
            ranges.append(
                MaterialRange(draw.first, draw.count, material, (*material_defines(material), *channels.defines))
            )
    return tuple(ranges)


class Levels:
    """A character's levels of detail in a context, and the vertex arrays that programs draw them with.

    Parameters
    ----------
    ctx : moderngl.Context
    asset : Asset
    channels : MaterialChannels
        Materials in place of the asset's.
    """

    def __init__(self, ctx: moderngl.Context, asset: Asset, channels: MaterialChannels) -> None:
        self.ctx, self.asset, self.channels = ctx, asset, channels
        self.lods: tuple[GpuLod, ...] = ()
        self.errors_m = self.divided_errors_m = np.zeros(0)  # as they are, and at most when tessellated
        self._attributes = uv_attributes(asset.lods)
        self._owned: list[moderngl.Buffer] = []
        self._line_buffers: dict[int, moderngl.Buffer] = {}
        self._edge_texels: dict[int, float] = {}
        self._patch_buffers: dict[int, moderngl.Buffer] = {}
        self._vertex_arrays: dict[tuple[Any, ...], moderngl.VertexArray] = {}
        self._instances: dict[Any, moderngl.Buffer] = {}

    def _keep(self, content: bytes) -> moderngl.Buffer:
        self._owned.append(self.ctx.buffer(content))
        return self._owned[-1]

    def upload(self, mesh: LodMesh, defines: Mapping[str, int]) -> None:
        """Add the next level; `defines` are the preprocessor definitions of all the model's programs."""
        attributes = self._attributes if mesh.normal_uvs is None else (*self._attributes, *NORMAL_UVS)
        lod = GpuLod(
            mesh=mesh,
            ranges=material_ranges(mesh, self.channels),
            vertices=self._keep(vertex_bytes(mesh, self._attributes)),
            indices=self._keep(index_bytes(mesh, mesh.triangles)),
            index_size=index_size(mesh),
            normal_uvs=None if mesh.normal_uvs is None else self._keep(uv_steps(mesh.normal_uvs).tobytes()),
            attributes=self._attributes,
            program_defines=tuple({**defines, **step_defines(attributes)}.items()),
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
        """A buffer that holds these instances (`ACTOR_INSTANCE` records), one buffer per key."""
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
        self, program_key: Any, batch: Any, program: moderngl.Program, level: int, kind: str
    ) -> moderngl.VertexArray:
        """The vertex array of a level for a program: `kind` is "triangles", "patches" or "seams"."""
        key = (program_key, batch, level, kind)
        if key not in self._vertex_arrays:
            lod = self.lods[level]
            if kind == "triangles":
                indices: moderngl.Buffer | None = lod.indices
            else:
                indices = self.patches(level) if kind == "patches" else self.seam_lines(level)
            content = [
                bind_buffer(program, lod.vertices, lod.attributes),
                bind_buffer(program, lod.normal_uvs, NORMAL_UVS) if lod.normal_uvs is not None else None,
                bind_buffer(program, self._instances[batch], ACTOR_ATTRIBUTES, per_instance=True),
            ]
            self._vertex_arrays[key] = self.ctx.vertex_array(
                program,
                [entry for entry in content if entry is not None],
                indices,
                index_element_size=lod.index_size,
            )
        return self._vertex_arrays[key]

    def _drop_vertex_arrays(self, which: Callable[[Any], bool]) -> None:
        for key in [key for key in self._vertex_arrays if which(key)]:
            self._vertex_arrays.pop(key).release()

    def forget_programs(self, renderer: Any) -> None:
        """Free what was made for a renderer's programs."""
        self._drop_vertex_arrays(lambda key: key[0][0] == renderer)

    def release(self) -> None:
        """Free all buffers and vertex arrays."""
        self._drop_vertex_arrays(lambda key: True)
        for thing in [*self._owned, *self._instances.values()]:
            thing.release()
        self._owned.clear()
        self._instances.clear()
