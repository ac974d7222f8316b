"""Dual quaternion skinning: exact for one joint, keeps the radius in twists, the same on both processors."""

from __future__ import annotations

from pathlib import Path

import moderngl
import numpy as np
import pytest
from builders_asset import build_ball

from runtime.animation.dual_quaternions import joint_texels, quaternion_product, quaternions
from runtime.animation.skeleton import rotation_matrices
from runtime.asset.asset import load
from runtime.errors import RenderError
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.scene.camera import Camera


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(count, 4))
    return rotation_matrices(q / np.linalg.norm(q, axis=1, keepdims=True))


def matrix_of(texels: np.ndarray) -> np.ndarray:
    """Slow twin of the shader for one unblended joint, (3, 4)."""
    real, dual, stretch = texels[0].astype(float), texels[1].astype(float), texels[2:, :3].astype(float)
    conjugate = real * [-1, -1, -1, 1]
    moved = 2 * quaternion_product(dual, conjugate)[:3]
    return np.concatenate([rotation_matrices(real) @ stretch, moved[:, None]], axis=1)


def test_quaternions_turn_as_their_matrices() -> None:
    special = np.array([np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
    for rotations in (random_rotations(500), special):
        assert np.abs(rotation_matrices(quaternions(rotations)) - rotations).max() < 1e-12


@pytest.mark.parametrize("mirrored", [False, True])
def test_any_affine_matrix_comes_back(mirrored: bool) -> None:
    rng = np.random.default_rng(1)
    stretch = rng.normal(size=(50, 3, 3)) * 0.2 + np.diag([-1.0 if mirrored else 1.0, 0.8, 1.3])
    rows = np.concatenate([random_rotations(50) @ stretch, rng.normal(size=(50, 3, 1))], axis=2)[None]
    texels = joint_texels(rows)
    assert texels.shape == (1, 50, 5, 4)
    rebuilt = np.array([matrix_of(joint) for joint in texels[0]])
    assert np.abs(rebuilt - rows[0]).max() < 1e-5


def picture(ctx: moderngl.Context, model: Model, skinning: str, joints: np.ndarray | None) -> np.ndarray:
    renderer = Renderer(ctx, skinning=skinning)
    framebuffer = ctx.simple_framebuffer((128, 128), 4)
    framebuffer.use()
    framebuffer.clear(depth=1.0)
    actor = model.actor()
    if joints is not None:
        actor.set_joints(joints)
    renderer.draw([actor], Camera((0.0, 1.0, 3.4), (0.0, 1.0, 0.0)), view="mask")
    mask = np.frombuffer(framebuffer.read(components=1), np.uint8).reshape(128, 128)[::-1] > 0
    for thing in (*framebuffer.color_attachments, framebuffer.depth_attachment, framebuffer, renderer, actor):
        thing.release()
    return mask


def test_rest_is_the_same_and_twists_keep_their_width(ctx: moderngl.Context, tmp_path: Path) -> None:
    model = Model(ctx, load(build_ball(tmp_path / "b.seamless", num_joints=2, sizes=(16,))))
    rest = picture(ctx, model, "linear", None)
    assert (picture(ctx, model, "dual_quaternion", None) != rest).mean() < 1e-3
    half_turn = np.stack([np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])])  # the upper joint, about the body's axis
    half_turn[1, 1, 3] = 1.8  # where it stands
    half_turn[1, :3, :3] = rotation_matrices(np.array([0.0, np.sin(1.5), 0.0, np.cos(1.5)]))  # one way is shorter
    linear = picture(ctx, model, "linear", half_turn).sum(axis=1)
    dual = picture(ctx, model, "dual_quaternion", half_turn).sum(axis=1)
    middle = slice(55, 75)
    assert linear[middle].min() < 0.2 * rest.sum(axis=1)[middle].min()  # the candy wrapper
    assert dual[middle].min() > 0.65 * rest.sum(axis=1)[middle].min()  # a flat body seen from its narrow side
    model.release()


def test_unknown_skinning_is_named(ctx: moderngl.Context) -> None:
    with pytest.raises(RenderError, match="no skinning 'cubic'"):
        Renderer(ctx, skinning="cubic")
