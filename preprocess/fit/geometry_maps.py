"""Positions and joint weights as textures: baked, fitted to the vertices, seams erased (paper, sections 4 and 8)."""

from __future__ import annotations

import dataclasses

import numpy as np

from preprocess.arrays import Floats
from preprocess.bake.geometry import bake_positions, bake_weights, settle_weights, vertex_values
from preprocess.erase import LOCAL, EraseOptions, plan_erasure
from preprocess.fit.position_sizes import Positions, smallest_positions, weight_side
from preprocess.fit.stored_texture import StoredTexture, seam_report
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import snap_canonical_uvs
from runtime.asset.weight_stack import pack_weights, unpack_weights

# The surface between vertices must stay (a change of 1e4 lets it stray two to six times as far); seams are closed as
# far as that leaves them: at the automatic size to less than a hundredth of a per cent of the diagonal, rms.
GEOMETRY_OPTIONS = EraseOptions(weights=dataclasses.replace(LOCAL, samples=1e8, change=1e7), seam_weight=5e9)
RANGE_REL = 0.05  # of the diagonal: how far beyond the surface's box texels may go, which sets what 32 bits can tell
# Joint weights run from 0 to 1 and are stored in 255 steps: held tighter, maps of few texels swing far out of that
# range and lose more where they are cut off than they gain.
WEIGHT_OPTIONS = EraseOptions(weights=dataclasses.replace(LOCAL, samples=1e6), seam_weight=1e6)


def store_positions(mesh: SkinnedMesh, seams: Seams, side: int | None) -> StoredTexture:
    """Object-space positions in 32-bit float, fitted to the vertices of the full mesh.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    seams : Seams
        Its seams.
    side : int or None
        Texels; None for as few as are good enough.
    """
    surface = mesh.surface
    expected = vertex_values(mesh, surface.positions)
    canonical_uvs = snap_canonical_uvs(surface.uvs)

    def bake(side: int) -> Positions:
        baked = bake_positions(mesh, (side, side))
        eraser = plan_erasure(surface, seams, side, side, GEOMETRY_OPTIONS, sample_uvs=canonical_uvs)
        erased = eraser.erase(baked, sample_values=expected).texels
        return Positions(baked, erased, float(np.linalg.norm(eraser.measure(erased).rms)), eraser)

    positions = bake(side) if side else smallest_positions(surface, expected, bake)
    baked, erased = positions.baked, _near_the_box(positions, surface, expected)
    stored = erased.astype(np.float32)
    size = (baked.shape[1], baked.shape[0])
    return StoredTexture("position", (stored,), "float", size, seam_report(surface, seams, baked, erased, stored))


def _near_the_box(positions: Positions, surface: TexturedSurface, expected: Floats) -> Floats:
    """Positions erased once more, near the surface's box: single texels beside seams swing far out of it."""
    room = RANGE_REL * surface.diagonal_m
    low, high = surface.positions.min(axis=0) - room, surface.positions.max(axis=0) + room
    erased, extent = positions.erased, np.maximum(high - low, 1e-30)
    if positions.eraser is None or ((erased >= low) & (erased <= high)).all():
        return erased
    inside = np.clip((positions.baked - low) / extent, 0.0, 1.0)
    again = positions.eraser.erase(inside, sample_values=(expected - low) / extent, bounds=(0.0, 1.0)).texels
    return np.asarray(again * extent + low, np.float64)


def store_weights(mesh: SkinnedMesh, seams: Seams, num_joints: int, side: int | None) -> StoredTexture:
    """Joint weights, 8 bits each (16 with more than 256 joints), a partition of unity as stored.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    seams : Seams
        Its seams.
    num_joints : int
    side : int or None
        Texels; None for what takes the least memory with its details.
    """
    surface = mesh.surface
    side = side or weight_side(mesh.num_vertices)
    baked = bake_weights(mesh, num_joints, (side, side))
    used = np.flatnonzero(baked.max(axis=(0, 1)) > 0)
    values = vertex_values(mesh, mesh.dense_weights(num_joints)[:, used])
    eraser = plan_erasure(surface, seams, side, side, WEIGHT_OPTIONS, sample_uvs=surface.uvs)
    erased = np.zeros_like(baked)
    erased[..., used] = eraser.erase(baked[..., used], sample_values=values).texels
    settled = np.zeros_like(baked)
    settled[..., used] = settle_weights(erased[..., used], baked[..., used], surface.uvs, values)
    packed = pack_weights(settled)
    stored = unpack_weights(packed.stack, (side, side), num_joints)
    seam = seam_report(surface, seams, baked, erased, stored)
    extra = {"layout": "texel-joints", "slots": packed.slots}
    return StoredTexture("weights", (packed.texels01,), packed.format, (side, side), seam, extra)
