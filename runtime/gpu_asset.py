"""A character on the GPU: its textures, its levels of detail, and one texture of poses.

Everything is uploaded in `Model(ctx, asset)` and freed in `release()`. The caller's GL state is left as it was found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.asset import Asset, LodMesh, MaterialData, TextureData
from runtime.errors import RenderError
from runtime.gl_state import saved_state
from runtime.patch_faults import faulty_faces, keep_flat
from runtime.patches import build_patches, seam_edges
from runtime.programs import TESSELLATION_VERSION_CODE, require_version
from runtime.weight_cells import WeightCells, build_weight_cells

if TYPE_CHECKING:
    from runtime.actor import Actor

# Texture units, the same for every program.
TEXTURE_UNITS = {
    "position_texture": 0,
    "weight_cells": 1,
    "weight_records": 2,
    "joint_records": 3,
    "joint_texture": 4,
    "normal_texture": 5,
    "base_color_texture": 6,
    "orm_texture": 7,
    "emissive_texture": 8,
    "reflection_texture": 9,
}
NUM_TEXTURE_UNITS = len(TEXTURE_UNITS)
_DTYPES = {"uint8": "f1", "uint16": "nu2", "float16": "f2", "float32": "f4"}
_WHITE = np.full((1, 1, 4), 255, np.uint8)
INSTANCE = np.dtype([("rows", "<f4", (3, 4)), ("tint", "<f4", 4), ("numbers", "<i4", 2)])
SLICE_BYTES = 1 << 20  # uploaded at a time by a model made in slices: well under a millisecond on any bus
PATCH_TOLERANCE_REL = 1e-3  # a divided triangle may always stray so far from the flat one, of the body's diagonal
POSITION_FORMATS = ("unorm16", "float32")


def require_alive(ctx: moderngl.Context, what: str) -> None:
    """Refuse a context that was released.

    Raises
    ------
    RenderError
    """
    if type(ctx.mglo).__name__ == "InvalidObject":
        raise RenderError(f"the OpenGL context of this {what} was released: make a new one")


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
    vertices : Buffer
        uv and owner uv, four float32 a vertex.
    indices, patches, seams : Buffer
        Of triangles (3), patches (9; None below OpenGL 4.1) and seam edges (2; None until asked for).
    instances : Buffer
        Room for the actors that are drawn with this level.
    index_size : int
        Bytes an index, 2 or 4.
    """

    mesh: LodMesh
    groups: tuple[DrawGroup, ...]
    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    index_size: int


def _make_texture(
    ctx: moderngl.Context, texels: NDArray[Any], mips: tuple[NDArray[Any], ...] = (), linear: bool = True
) -> moderngl.Texture:
    """A 2D texture for an array (H, W, C), clamped, with its mip levels, not yet filled."""
    kind = texels.dtype.name
    integer = {"uint16": "u2", "uint32": "u4"}
    dtype = _DTYPES[kind] if linear else integer[kind]
    height, width, channels = texels.shape
    texture = ctx.texture((width, height), channels, alignment=1, dtype=dtype)
    if mips:
        texture.build_mipmaps(0, len(mips))
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    else:
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR) if linear else (moderngl.NEAREST, moderngl.NEAREST)
    texture.repeat_x = texture.repeat_y = False
    return texture


def _fill(texture: moderngl.Texture, levels: tuple[NDArray[Any], ...]) -> Iterator[None]:
    """Write a texture's levels, some rows at a time: `SLICE_BYTES` at most, at least one row."""
    for level, texels in enumerate(levels):
        height, width = texels.shape[:2]
        rows = max(1, SLICE_BYTES // max(texels[0].nbytes, 1))
        for first in range(0, height, rows):
            part = np.ascontiguousarray(texels[first : first + rows])
            texture.write(part, viewport=(0, first, width, len(part)), level=level, alignment=1)
            yield


def _position_texels(texels: NDArray[Any], form: str) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.float64]]:
    """Texels for the GPU, and the scale and offset that turn them back into metres."""
    positions = texels[:, :, :3].astype(np.float64)
    if form == "float32":
        full = np.zeros((*positions.shape[:2], 4), np.float32)
        full[:, :, :3] = positions
        return full, np.ones(3), np.zeros(3)
    low, high = positions.min(axis=(0, 1)), positions.max(axis=(0, 1))
    size = np.maximum(high - low, 1e-30)
    full16 = np.zeros((*positions.shape[:2], 4), np.uint16)
    full16[:, :, :3] = np.rint((positions - low) / size * 65535.0)
    return full16, size, low


def _groups(mesh: LodMesh, materials: tuple[MaterialData, ...]) -> tuple[DrawGroup, ...]:
    groups: list[DrawGroup] = []
    for draw in mesh.draws:
        material = materials[draw.material] if 0 <= draw.material < len(materials) else MaterialData()
        anonymous = MaterialData(**{**material.__dict__, "name": ""})
        if groups and groups[-1].material == anonymous and groups[-1].first + groups[-1].count == draw.first:
            groups[-1] = DrawGroup(groups[-1].first, groups[-1].count + draw.count, anonymous)
        elif draw.count:
            groups.append(DrawGroup(draw.first, draw.count, anonymous))
    return tuple(groups)


@dataclass(frozen=True)
class Prepared:
    """A character turned into what the GPU takes, without a context: the slow part of making a model.

    Attributes
    ----------
    asset : Asset
    position_texels : (H, W, 4) uint16 or float32
    position_scale, position_offset : (3,) float64
        Metres are texels times scale plus offset.
    weight_cells : WeightCells
    """

    asset: Asset
    position_texels: NDArray[Any]
    position_scale: NDArray[np.float64]
    position_offset: NDArray[np.float64]
    weight_cells: WeightCells


def prepare(asset: Asset, position_format: str = "unorm16") -> Prepared:
    """Turn a character into what the GPU takes. Needs no context: may run in any thread.

    Raises
    ------
    RenderError
        If there is no such position format.
    """
    if position_format not in POSITION_FORMATS:
        raise RenderError(f"no position format {position_format!r}: one of {', '.join(POSITION_FORMATS)}")
    texels, scale, offset = _position_texels(asset.textures["position"].levels[0], position_format)
    cells = build_weight_cells(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
    return Prepared(asset, texels, scale, offset, cells)


class Model:
    """A built character in a context: draw any number of its actors.

    Parameters
    ----------
    ctx : moderngl.Context
        The caller's; OpenGL 3.3, or 4.1 for tessellation.
    asset : Asset or Prepared
        From `runtime.load`, or `prepare` of it.
    position_format : "unorm16" or "float32"
        How positions lie in GPU memory. 16 bits hold them to 1/131070 of the bounding box an axis. A `Prepared` has
        its own.
    in_slices : bool
        Upload nothing yet: call `upload_slice` until it says that all is there (see `runtime.loading`).

    Raises
    ------
    RenderError
        If the context is too old or was released, or the character does not fit its limits.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        asset: Asset | Prepared,
        *,
        position_format: str = "unorm16",
        in_slices: bool = False,
    ) -> None:
        from runtime.mixer import Mixer

        require_alive(ctx, "model")
        require_version(ctx)
        prepared = asset if isinstance(asset, Prepared) else prepare(asset, position_format)
        asset = prepared.asset
        self.ctx = ctx
        self.asset = asset
        self.mixer = Mixer(asset.skeleton, asset.clips)
        self.has_patches = ctx.version_code >= TESSELLATION_VERSION_CODE
        self._released = False
        self._owned: list[Any] = []
        self._line_buffers: dict[int, moderngl.Buffer] = {}
        self._edge_texels: dict[int, float] = {}
        self._patch_buffers: dict[int, moderngl.Buffer] = {}
        self._vertex_arrays: dict[tuple[Any, ...], moderngl.VertexArray] = {}
        self._joint_texture: moderngl.Texture | None = None
        self._instances: dict[Any, moderngl.Buffer] = {}
        self.textures: dict[str, moderngl.Texture] = {}
        self.lods: tuple[GpuLod, ...] = ()
        self._check_limits()
        self._uploads: Iterator[None] | None = self._upload_all(prepared)
        while not in_slices and self.upload_slice():
            pass

    def upload_slice(self) -> bool:
        """Upload a little more of a model made in slices: about `SLICE_BYTES`. False when all is there."""
        if self._released:
            raise RenderError(f"the model {self.asset.name} was released: make a new one")
        if self._uploads is None:
            return False
        require_alive(self.ctx, "model")
        try:
            with self._guard():
                next(self._uploads)
        except StopIteration:
            self._uploads = None
        except BaseException:
            self.release()
            raise
        return self._uploads is not None

    def _check_limits(self) -> None:
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        largest = max(max(texture.size) for texture in self.asset.textures.values())
        if largest > limit or 3 * self.asset.num_joints > limit:
            needed = max(largest, 3 * self.asset.num_joints)
            raise RenderError(
                f"{self.asset.name} needs textures of {needed} texels, this context allows {limit}: build it smaller"
            )

    def _guard(self) -> Any:
        units = [*range(NUM_TEXTURE_UNITS), self.ctx.default_texture_unit]
        return saved_state(units, (), self.ctx.version_code >= 400)

    def _keep(self, thing: Any) -> Any:
        self._owned.append(thing)
        return thing

    def _upload_all(self, prepared: Prepared) -> Iterator[None]:
        """Textures, then levels, a slice a step."""
        asset, cells = self.asset, prepared.weight_cells
        self.weight_cells = cells
        exact: dict[str, NDArray[Any]] = {
            "weight_cells": cells.first_record[:, :, None],
            "weight_records": cells.records,
        }
        if cells.joints is not None:
            exact["joint_records"] = cells.joints
        filtered: dict[str, tuple[NDArray[Any], ...]] = {"position_texture": (prepared.position_texels,)}
        for name in ("normal", "base_color", "orm", "emissive"):
            filtered[f"{name}_texture"] = (asset.textures.get(name) or TextureData(name, (_WHITE,))).levels
        for name, levels in filtered.items():
            self.textures[name] = self._keep(_make_texture(self.ctx, levels[0], levels[1:]))
            yield from _fill(self.textures[name], levels)
        for name, texels in exact.items():
            self.textures[name] = self._keep(_make_texture(self.ctx, texels, linear=False))
            yield from _fill(self.textures[name], (texels,))
        integer_normals = asset.textures["normal"].levels[0].dtype.kind == "u"
        self.constants: dict[str, Any] = {
            "position_scale": tuple(prepared.position_scale),
            "position_offset": tuple(prepared.position_offset),
            "weight_size": asset.weight_size,
            "normal_decode": (2.0, -1.0) if integer_normals else (1.0, 0.0),
            "box_min": tuple(asset.manifest.bind_bounds[0]),
            "box_size": tuple(asset.manifest.bind_bounds[1] - asset.manifest.bind_bounds[0]),
        }
        self.decode = (prepared.position_scale, prepared.position_offset)
        for mesh in asset.lods:
            self.lods = (*self.lods, self._upload_lod(mesh))
            yield

    def _upload_lod(self, mesh: LodMesh) -> GpuLod:
        vertices = np.concatenate([mesh.uvs, mesh.owner_uvs], axis=1)
        return GpuLod(
            mesh=mesh,
            groups=_groups(mesh, self.asset.materials),
            vertices=self._keep(self.ctx.buffer(vertices.tobytes())),
            indices=self._keep(self.ctx.buffer(self._index_bytes(mesh, mesh.triangles))),
            index_size=2 if len(mesh.uvs) <= 0xFFFF else 4,
        )

    def _index_bytes(self, mesh: LodMesh, indices: NDArray[np.uint32]) -> bytes:
        return indices.astype(np.uint16 if len(mesh.uvs) <= 0xFFFF else np.uint32).tobytes()

    @property
    def shader_defines(self) -> dict[str, int]:
        """Preprocessor definitions that this model's programs need."""
        return {} if self.weight_cells.joints is None else {"WIDE_JOINTS": 1}

    def patches(self, level: int) -> moderngl.Buffer:
        """Index buffer of a level's patches, nine a triangle (made when first asked for)."""
        if level not in self._patch_buffers:
            mesh = self.lods[level].mesh
            indices = build_patches(mesh.uvs, mesh.owner_uvs, mesh.triangles)
            if len(indices):
                indices = self._without_faults(mesh, indices)
            self._patch_buffers[level] = self._keep(self.ctx.buffer(self._index_bytes(mesh, indices)))
        return self._patch_buffers[level]

    def _without_faults(self, mesh: LodMesh, patches: NDArray[np.uint32]) -> NDArray[np.uint32]:
        positions = np.asarray(self.asset.textures["position"].levels[0][:, :, :3], np.float32)
        low, high = self.asset.manifest.bind_bounds
        tolerance_m = max(mesh.error_m, PATCH_TOLERANCE_REL * float(np.linalg.norm(high - low)))
        faulty = faulty_faces(positions, mesh.uvs, mesh.owner_uvs, patches, tolerance_m)
        _, points = np.unique(mesh.owner_uvs, axis=0, return_inverse=True)
        return keep_flat(patches, points.ravel(), faulty)

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
            indices = seam_edges(mesh.uvs, mesh.owner_uvs, mesh.triangles)
            if not len(indices):
                return None
            self._line_buffers[level] = self._keep(self.ctx.buffer(self._index_bytes(mesh, indices)))
        return self._line_buffers[level]

    def joint_texture(self, joint_texels: NDArray[np.float32]) -> moderngl.Texture:
        """The texture of poses, filled with (A, J, R, 4) float32, R texels a joint along x, one pose a row."""
        num_poses, num_joints, per_joint = joint_texels.shape[:3]
        width = per_joint * num_joints
        texture = self._joint_texture
        if texture is None or texture.height < num_poses or texture.width != width:
            limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
            if num_poses > limit or width > limit:
                raise RenderError(
                    f"{num_poses} actors of {self.asset.name} with {num_joints} joints at once, this context allows "
                    f"textures of {limit} texels: draw in parts"
                )
            capacity = min(limit, max(num_poses, 2 * texture.height if texture else 1))
            if texture is not None:
                texture.release()
            texture = self.ctx.texture((width, capacity), 4, dtype="f4")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._joint_texture = texture
        texture.write(joint_texels, viewport=(0, 0, width, num_poses))
        return texture

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
        buffer.write(instances.tobytes())
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
                _layout(program, lod.vertices, (("2f4", "in_uv"), ("2f4", "in_owner_uv"))),
                instance_layout(program, self._instances[group]),
            ]
            self._vertex_arrays[key] = self.ctx.vertex_array(
                program,
                [entry for entry in content if entry is not None],
                indices[kind](),
                index_element_size=lod.index_size,
            )
        return self._vertex_arrays[key]

    def _drop_vertex_arrays(self, which: Any) -> None:
        for key in [key for key in self._vertex_arrays if which(key)]:
            self._vertex_arrays.pop(key).release()

    def forget_programs(self, owner: Any) -> None:
        """Free what was made for a renderer's programs."""
        self._drop_vertex_arrays(lambda key: key[0][0] == owner)

    def actor(self, clip: str | int | None = None, **options: Any) -> Actor:
        """A new actor of this model; see `runtime.actor.Actor` for the options.

        Raises
        ------
        ValueError
            If there is no such clip.
        """
        from runtime.actor import Actor

        self.require_usable()
        return Actor(self, clip=clip, **options)

    def require_usable(self) -> None:
        """Refuse a model that was released, or whose context was.

        Raises
        ------
        RenderError
        """
        if self._released:
            raise RenderError(f"the model {self.asset.name} was released: make a new one")
        if self._uploads is not None:
            raise RenderError(
                f"the model {self.asset.name} is not uploaded yet: call upload_slice() until it says False"
            )
        require_alive(self.ctx, "model")

    @property
    def gpu_bytes(self) -> dict[str, int]:
        """Bytes in GPU memory by purpose: geometry, weights, materials, levels (vertices and indices)."""
        size = {"uint8": 1, "f1": 1, "nu2": 2, "f2": 2, "f4": 4, "u2": 2, "u4": 4}

        def total(*names: str) -> int:
            textures = [self.textures[name] for name in names if name in self.textures]
            return sum(t.width * t.height * t.components * size[t.dtype] for t in textures)

        return {
            "position": total("position_texture"),
            "weights": total("weight_cells", "weight_records", "joint_records"),
            "levels": sum(lod.vertices.size + lod.indices.size for lod in self.lods),
            "normal": sum(level.nbytes for level in self.asset.textures["normal"].levels),
            "colors": sum(
                level.nbytes for name in ("base_color", "orm", "emissive") if name in self.asset.textures
                for level in self.asset.textures[name].levels
            ),
        }  # fmt: skip

    def release(self) -> None:
        """Free everything on the GPU. May be called more than once."""
        if self._released:
            return
        self._released = True
        if type(self.ctx.mglo).__name__ == "InvalidObject":
            return
        self._drop_vertex_arrays(lambda key: True)
        for thing in [*self._owned, *self._instances.values(), self._joint_texture]:
            if thing is not None:
                thing.release()
        self._owned.clear()
        self._instances.clear()


INSTANCE_ATTRIBUTES = (
    ("4f4", "in_world_row0"),
    ("4f4", "in_world_row1"),
    ("4f4", "in_world_row2"),
    ("4f4", "in_tint"),
    ("2i4", "in_numbers"),
)


def instance_layout(program: moderngl.Program, buffer: moderngl.Buffer) -> tuple[Any, ...] | None:
    """moderngl's description of a buffer of `INSTANCE` records for a program."""
    return _layout(program, buffer, INSTANCE_ATTRIBUTES, per_instance=True)


def _layout(
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
            formats.append(f"{int(form[0]) * 4}x")
    if not names:
        return None
    return (buffer, " ".join(formats) + (" /i" if per_instance else ""), *names)
