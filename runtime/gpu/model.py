"""A character on the GPU: its textures, its levels of detail, and one texture of poses.

Everything is uploaded in `Model(ctx, asset)` and freed in `release()`. The caller's GL state is left as it was found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.animation.bounds import JointBoxes, stored_joint_boxes
from runtime.animation.mixer import Mixer
from runtime.asset.asset import Asset
from runtime.asset.morphs import Morphs
from runtime.errors import NotCopied, RenderError
from runtime.gpu.context import can_free, is_gone, require_current
from runtime.gpu.gl_state import saved_state
from runtime.gpu.lod_buffers import GpuLod, Levels
from runtime.gpu.programs import TESSELLATION_VERSION_CODE, require_version
from runtime.gpu.textures import (
    NUM_TEXTURE_UNITS,
    TEXTURE_UNITS,
    Prepared,
    fill_texture,
    filter_anisotropically,
    make_texture,
    prepare,
    texture_bytes,
)
from runtime.validation import describe, is_number

if TYPE_CHECKING:
    from runtime.animation.clip import Clip
    from runtime.scene.actor import Actor

SUMS_A_ROW = 1024  # shaders/include/morphs.glsl: MORPHS_WIDTH_LOG2
_WHITE = np.full((1, 1, 4), 255, np.uint8)


def require_alive(ctx: moderngl.Context, what: str) -> None:
    """Refuse a context that was released, or that is not current in this thread.

    Raises
    ------
    RenderError
    """
    if not isinstance(ctx, moderngl.Context):
        raise RenderError(f"a {what} needs a moderngl context, not {describe(ctx)}")
    if is_gone(ctx):
        raise RenderError(f"the OpenGL context of this {what} was released: make a new one")
    require_current(ctx, what)


class Model(NotCopied):
    """A built character in a context: draw any number of its actors.

    Parameters
    ----------
    ctx : moderngl.Context
        The caller's; OpenGL 3.3, or 4.1 for tessellation.
    asset : Asset or Prepared
        From `runtime.load`, or `prepare` of it.
    position_format : "auto", "words", "unorm16" or "float32"
        How positions lie in GPU memory: 4, 8 or 16 bytes a texel. Characters that were built for words lose nothing
        in them; "auto" takes them for these, and 16 bits a channel for others. A `Prepared` has its own.
    anisotropy : float or None
        Most samples along the way in which a surface is seen shortened, 1 for none. None: 8; where OpenGL runs on the
        processor, of base colours alone, and of characters with much that is squeezed in the atlas.
    in_slices : bool
        Upload nothing yet: call `upload_slice` until it says that all is there (see `runtime.gpu.loading`).

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
        position_format: str = "auto",
        anisotropy: float | None = None,
        in_slices: bool = False,
    ) -> None:
        require_alive(ctx, "model")
        require_version(ctx)
        if not isinstance(asset, Asset | Prepared):
            raise RenderError(f"a model is made of what runtime.load gives, not of {asset!r:.80}")
        prepared = asset if isinstance(asset, Prepared) else prepare(asset, position_format)
        asset = prepared.asset
        self.ctx = ctx
        self.asset = asset
        self.mixer = Mixer(asset.skeleton, asset.clips)
        self.joint_boxes = JointBoxes(
            stored_joint_boxes(asset.joint_bounds, asset.manifest.bind_bounds), asset.morph_reaches
        )
        self.has_patches = ctx.version_code >= TESSELLATION_VERSION_CODE
        if anisotropy is not None and not (is_number(anisotropy) and anisotropy >= 1):
            raise RenderError(f"anisotropy is a number of at least 1, or None, not {describe(anisotropy)}")
        self._anisotropy = anisotropy
        self._released = False
        self._owned: list[Any] = []
        self._joint_texture: moderngl.Texture | None = None
        moves = asset.morphs is not None and len(asset.morphs.texels)
        self._morphs: Morphs | None = asset.morphs if moves else None
        self._morph_sums: moderngl.Texture | None = None
        self._summed: NDArray[Any] = np.zeros((0, 0), np.float32)  # weights that the sums are of
        self.textures: dict[str, moderngl.Texture] = {}
        self.channels = prepared.channels
        self.levels = Levels(ctx, asset, self.channels)
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
        if self._morphs is not None:
            exact["morph_numbers"] = self._morphs.texel_numbers
        positions = prepared.positions
        filtered: dict[str, tuple[NDArray[Any], ...]] = {}
        if positions.texels.dtype == np.uint32:
            exact["position_texture"] = positions.texels
        else:
            filtered["position_texture"] = (positions.texels,)
        for name in ("normal", "base_color", "orm", "emissive"):
            filtered[f"{name}_texture"] = self.channels.textures.get(name, (_WHITE,))
        for name, levels in filtered.items():
            self.textures[name] = self._keep(make_texture(self.ctx, levels[0], levels[1:]))
            yield from fill_texture(self.ctx, self.textures[name], levels)
        filter_anisotropically(self.ctx, self.textures, self._anisotropy, prepared.squeezed)
        for name, texels in exact.items():
            self.textures[name] = self._keep(make_texture(self.ctx, texels, linear=False))
            yield from fill_texture(self.ctx, self.textures[name], (texels,))
        self.constants: dict[str, Any] = {
            "position_scale": tuple(positions.scale),
            "position_offset": tuple(positions.offset),
            "weight_size": asset.weight_size,
            "first_divided_record": cells.first_divided,
            **({} if self._morphs is None else {"morph_height": -(-len(self._morphs.texels) // SUMS_A_ROW)}),
            "box_min": tuple(asset.manifest.bind_bounds[0]),
            "box_size": tuple(asset.manifest.bind_bounds[1] - asset.manifest.bind_bounds[0]),
        }
        if positions.shifts is not None and positions.masks is not None:
            self.constants["position_shifts"] = tuple(map(int, positions.shifts))
            self.constants["position_masks"] = tuple(map(int, positions.masks))
        for mesh in asset.lods:
            self.levels.upload(mesh, self.shader_defines)
            yield

    @property
    def lods(self) -> tuple[GpuLod, ...]:
        """Levels of detail, the finest first."""
        return self.levels.lods

    @property
    def shader_defines(self) -> dict[str, int]:
        """Preprocessor definitions that this model's programs need."""
        return {
            **({} if self.weight_cells.joints is None else {"WIDE_JOINTS": 1}),
            **({} if self._morphs is None else {"MORPHS": 1}),
            **({"POSITION_WORDS": 1} if "position_shifts" in self.constants else {}),
            **({"COLOR_AT_NORMAL_UV": 1} if self.asset.colors_moved else {}),
            **({"FLOAT_NORMALS": 1} if self.asset.textures["normal"].levels[0].dtype.kind == "f" else {}),
        }

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

    def write_morphs(self, weights: NDArray[np.floating[Any]]) -> None:
        """Sum up the morph targets of actors with these weights (A, M), a block of rows each, in the poses' order."""
        if self._morphs is None or np.array_equal(weights, self._summed):
            return
        count, rows = len(self._morphs.texels), -(-len(self._morphs.texels) // SUMS_A_ROW)
        width, needed = 3 * min(count, SUMS_A_ROW), len(weights) * rows
        texture = self._morph_sums
        if texture is None or texture.height < needed:
            limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
            if needed > limit:
                raise RenderError(
                    f"{len(weights)} actors of {self.asset.name} with {count} morphed texels at once, this context "
                    f"allows textures of {limit} texels: draw in parts"
                )
            capacity = min(limit, max(needed, 2 * texture.height if texture else 1))
            if texture is not None:
                texture.release()
            texture = self._morph_sums = self.ctx.texture((width, capacity), 4, dtype="f4")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        sums = self._morphs.blend(weights).reshape(len(weights), -1, 4)
        missing = rows * width - 3 * count
        if missing:
            sums = np.concatenate([sums, np.zeros((len(weights), missing, 4), np.float32)], axis=1)
        texture.write(np.ascontiguousarray(sums), viewport=(0, 0, width, needed))
        self._summed = np.array(weights)

    def bind_textures(self) -> None:
        """Put all textures, that of poses too, into their units (`TEXTURE_UNITS`)."""
        for sampler, texture in self.textures.items():
            texture.use(TEXTURE_UNITS[sampler])
        assert self._joint_texture is not None
        self._joint_texture.use(TEXTURE_UNITS["joint_texture"])
        if self._morph_sums is not None:
            self._morph_sums.use(TEXTURE_UNITS["morph_sums"])

    def actor(
        self,
        clip: str | int | Clip | None = None,
        *,
        transform: ArrayLike | None = None,
        tint: ArrayLike = (1.0, 1.0, 1.0, 1.0),
        root_motion: bool | str = False,
        time_s: float = 0.0,
        speed: float = 1.0,
        loop: bool = True,
    ) -> Actor:
        """A new actor of this model.

        Parameters
        ----------
        clip : name or number of a clip, or a Clip, optional
            The rest pose without.
        transform : (4, 4) float, optional
            Object space to world; identity by default.
        tint : (3,) or (4,) float
            Multiplies the base colour, linear.
        root_motion : bool or "turn"
            Let the clip carry the actor over the ground; with "turn", turn it about +Y as well.
        time_s, speed, loop
            As for `Actor.play`.

        Raises
        ------
        ValueError
            If there is no such clip, or a number makes no sense.
        """
        from runtime.scene.actor import Actor

        self.require_usable()
        return Actor(
            self,
            clip,
            transform=transform,
            tint=tint,
            root_motion=root_motion,
            time_s=time_s,
            speed=speed,
            loop=loop,
        )

    def set_morph_weights(self, actors: Sequence[Actor], weights: Mapping[str, Any] | ArrayLike | None) -> None:
        """Set morph targets of many actors at once, over what clips say of them.

        Parameters
        ----------
        actors : sequence of A actors of this model
        weights : mapping of names to a weight or (A,) weights, (M,) or (A, M) float, or None
            As for `Actor.set_morph_weights`.

        Raises
        ------
        ValueError
            When there is no such morph, or a weight is not finite or too large.
        """
        self.mixer.set_morph_weights([actor.row for actor in actors], weights)

    def require_usable(self) -> None:
        """Refuse a model that was released or is not all there, or whose context was released or is not current.

        Raises
        ------
        RenderError
        """
        self.require_uploaded()
        require_alive(self.ctx, "model")

    def require_uploaded(self) -> None:
        """Refuse a model that was released or is not all there.

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

    @property
    def gpu_bytes(self) -> dict[str, int]:
        """Bytes in GPU memory by purpose: geometry, weights, morphs, materials, levels (vertices and indices)."""

        def total(*names: str) -> int:
            return sum(texture_bytes(self.textures[name]) for name in names if name in self.textures)

        return {
            "position": total("position_texture"),
            "weights": total("weight_cells", "weight_records", "joint_records"),
            "morphs": total("morph_numbers") + (0 if self._morph_sums is None else texture_bytes(self._morph_sums)),
            "levels": sum(lod.nbytes for lod in self.lods),
            "normal": sum(level.nbytes for level in self.channels.textures["normal"]),
            "colors": sum(
                level.nbytes for name in ("base_color", "orm", "emissive")
                for level in self.channels.textures.get(name, ())
            ),
        }  # fmt: skip

    def release(self) -> None:
        """Free everything on the GPU. May be called more than once."""
        if self._released:
            return
        can_free_now = can_free(self.ctx, "model")
        self._released = True
        if not can_free_now:
            return
        self.levels.release()
        for thing in [*self._owned, self._joint_texture, self._morph_sums]:
            if thing is not None:
                thing.release()
        self._owned.clear()
