"""What the GPU makes of the textures and what 64 bits make of them agree to float rounding.

Static levels and tessellated points, linear blends and dual quaternions; positions and what turns normals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from builders_scene import SIDE_PX

from benchmarks._points import MIN_VERSION_CODE, PointCapture
from preprocess.fit.weight_quadtree import sample_weights
from preprocess.mesh.texels import sample_bilinear
from runtime.animation.dual_quaternions import joint_texels, quaternion_product
from runtime.animation.pose import sample, skinning_rows
from runtime.asset.asset import Asset, load
from runtime.asset.weight_stack import unpack_weights
from runtime.gpu.gl_state import functions, saved_state
from runtime.gpu.model import Model
from runtime.gpu.patch_validation import divided_patches
from runtime.gpu.patches import EDGES, corner_uvs
from runtime.gpu.programs import assemble
from runtime.gpu.textures import TEXTURE_UNITS, prepare
from runtime.gpu.vertex_layout import ACTOR_INSTANCE
from runtime.render.renderer import SKINNING
from runtime.scene.camera import framing

ROUNDING = 4e-6  # of the body's diagonal: some dozen operations in 32 bits
KEY_STEPS = 65535 * 16  # uvs come back from the GPU to within a step in the last place


class Twin:
    """Geometry at places of the atlas in 64 bits, from what is stored."""

    def __init__(self, asset: Asset, clip: int, share: float, skinning: str) -> None:
        self.asset, self.skinning = asset, skinning
        self.time_s = share * asset.clips[clip].duration_s
        self.rows = skinning_rows(asset.skeleton, sample(asset.clips[clip], asset.skeleton, self.time_s))[0]
        self.rows = self.rows.astype(np.float32).astype(np.float64)  # as they reach the GPU
        self._positions = prepare(asset).positions.metres
        self._stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)

    def matrices(self, places: np.ndarray) -> np.ndarray:
        """Blended joints, (N, 3, 4)."""
        weights = sample_weights(self._stored, self.asset.weight_details, places)
        if self.skinning == "linear":
            return np.einsum("nj,jrc->nrc", weights, self.rows)
        texels = joint_texels(self.rows[None])[0].astype(np.float64)
        # The first joint of a place's record decides between q and -q; blends of near rotations do not depend on it.
        leading = texels[weights.argmax(axis=1), 0]
        signs = np.where(leading @ texels[:, 0].T < 0, -1.0, 1.0)
        real, dual = ((weights * signs) @ texels[:, part] for part in (0, 1))
        length = np.linalg.norm(real, axis=1, keepdims=True)
        real, dual = real / length, dual / length
        stretch = np.einsum("nj,jrc->nrc", weights, texels[:, 2:, :3])
        x, y, z, w = real.T
        turn = np.stack(
            [
                np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=-1),
                np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=-1),
                np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1),
            ],
            axis=-2,
        )
        moved = 2 * quaternion_product(dual, real * (-1, -1, -1, 1))[:, :3]
        return np.concatenate([turn @ stretch, moved[:, :, None]], axis=2)

    def points(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3), and what turns normals, (N, 3, 3)."""
        rest, blended = sample_bilinear(self._positions, places), self.matrices(places)
        linear = blended[:, :, :3]
        turns = np.linalg.inv(linear).transpose(0, 2, 1) * np.abs(np.linalg.det(linear))[:, None, None]
        return np.einsum("nrc,nc->nr", linear, rest) + blended[:, :, 3], turns


@pytest.fixture(scope="module")
def fox(built: Callable[[str], Path]) -> Asset:
    return load(built("Fox.glb"))


@pytest.fixture
def model(request: pytest.FixtureRequest, ctx: moderngl.Context) -> Iterator[Model]:
    """Of the small body, or of a built character: weights with details, parked vertices, positions in words."""
    made = Model(ctx, request.getfixturevalue(request.param))
    yield made
    made.release()


characters = pytest.mark.parametrize("model", ["ball", pytest.param("fox", marks=pytest.mark.slow)], indirect=True)
ways = pytest.mark.parametrize("skinning", list(SKINNING))


def release(*things: Any) -> None:
    for thing in things:
        thing.release()


def diagonal_of(asset: Asset) -> float:
    low, high = asset.manifest.bind_bounds
    return float(np.linalg.norm(high - low))


def captured_vertices(model: Model, twin: Twin, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and normal matrices of a level's triangles, corner by corner, from the vertex shader."""
    ctx, mesh = model.ctx, model.lods[level].mesh
    defines = {**SKINNING[twin.skinning], **dict(model.lods[level].program_defines)}
    text = assemble("static.vert", ctx.version_code, defines).text
    program = ctx.program(vertex_shader=text, varyings=["surface_position", "surface_normal_matrix"])
    joints = joint_texels(twin.rows[None]) if twin.skinning != "linear" else twin.rows[None].astype(np.float32)
    target = ctx.simple_framebuffer((1, 1))
    with saved_state(range(16), (0,), True):
        for name, value in {**TEXTURE_UNITS, **model.constants}.items():
            if name in program:
                program[name].value = value
        for name, texture in model.textures.items():
            texture.use(TEXTURE_UNITS[name])
        model.joint_texture(np.ascontiguousarray(joints)).use(TEXTURE_UNITS["joint_texture"])
        record = np.zeros(1, ACTOR_INSTANCE)
        record["rows"][:] = np.eye(4)[:3]
        model.levels.instance_buffer("twin", record)
        out = ctx.buffer(reserve=4 * 12 * 3 * len(mesh.triangles))
        target.use()
        model.levels.vertex_array(("twin", level), "twin", program, level, "triangles").transform(
            out, mode=moderngl.TRIANGLES
        )
        found = np.frombuffer(out.read(), np.float32).reshape(-1, 12).astype(np.float64)
        functions().glUseProgram(0)
    release(out, program, *target.color_attachments, target.depth_attachment, target)
    return found[:, :3], found[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)  # columns come first


@characters
@ways
def test_static_levels(model: Model, skinning: str) -> None:
    asset = model.asset
    twin = Twin(asset, min(1, len(asset.clips) - 1), 0.3, skinning)
    for level, mesh in enumerate(asset.lods):
        positions, turns = captured_vertices(model, twin, level)
        wanted, wanted_turns = twin.points(mesh.canonical_uvs.astype(np.float64)[mesh.triangles.ravel()])
        assert np.abs(positions - wanted).max() < ROUNDING * diagonal_of(asset), level
        assert np.abs(turns - wanted_turns).max() < 2e-5 * np.abs(wanted_turns).max(), level


def places_of(mesh: Any, patches: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where points (N, 12) of tessellated patches are fetched: the twin of patch.tese."""
    corners = corner_uvs(mesh.uvs, mesh.canonical_uvs, patches)

    def keys(uvs: np.ndarray) -> list[tuple[int, ...]]:
        return [tuple(row) for row in np.rint(uvs.astype(np.float64) * KEY_STEPS).astype(int).reshape(-1, 6).tolist()]

    numbers = {key: number for number, key in enumerate(keys(corners))}
    patch = np.array([numbers[key] for key in keys(points[:, 6:])])
    at = points[:, 3:6].astype(np.float64)
    uvs = mesh.uvs.astype(np.float64)
    places = np.einsum("nk,nkc->nc", at, uvs[patches[patch, :3].astype(int)])
    ends = uvs[patches[patch][:, EDGES].astype(int)].reshape(-1, 3, 2, 2)
    for edge in range(3):
        first, second, other = edge, (edge + 1) % 3, (edge + 2) % 3
        on = at[:, other] == 0.0
        places[on] = at[on, first, None] * ends[on, edge, 0] + at[on, second, None] * ends[on, edge, 1]
    for corner in range(3):
        on = at[:, corner] == 1.0
        places[on] = corners[patch[on], corner]
    return places


@characters
@ways
@pytest.mark.parametrize("tessellation", [3.7, "auto"])
def test_tessellated_points(model: Model, skinning: str, tessellation: float | str) -> None:
    asset, ctx = model.asset, model.ctx
    if ctx.version_code < MIN_VERSION_CODE:
        pytest.skip("reading tessellated points back needs OpenGL 4.3")
    clip, level = min(1, len(asset.clips) - 1), len(asset.lods) - 1
    twin = Twin(asset, clip, 0.3, skinning)
    actor = model.actor(clip=clip, time_s=twin.time_s)
    capture = PointCapture(model, {}, skinning)
    camera = framing(asset.manifest.bind_bounds)
    target = ctx.simple_framebuffer((SIDE_PX, SIDE_PX))
    target.use()
    points = capture.points(actor, camera, level, tessellation)
    mesh = asset.lods[level]
    assert len(points) > 3 * len(mesh.triangles)
    places = places_of(mesh, divided_patches(asset, mesh), points)
    wanted = twin.points(places)[0] - np.asarray(camera.eye)
    scale = diagonal_of(asset) + np.linalg.norm(camera.eye)
    assert np.abs(points[:, :3] - wanted).max() < ROUNDING * scale
    release(capture, *target.color_attachments, target.depth_attachment, target)
