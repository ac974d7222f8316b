"""The weight map under the quadtrees: coarse, all joints, a partition of unity as stored (paper, section 8)."""

from __future__ import annotations

import numpy as np

from preprocess.bake.geometry import bake_weights
from preprocess.fit.stored_texture import StoredTexture, seam_report
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import SkinnedMesh
from runtime.asset.weight_stack import pack_weights, unpack_weights

# Quadtrees mend a map that is too coarse (weight_quadtree.py), so any size is right; the one that takes the least
# memory has about a texel for every five vertices.
WEIGHT_SIZES_PX = (32, 48, 64, 96, 128, 192, 256, 384, 512)
WEIGHT_TEXELS_PER_VERTEX = 0.22


def weight_side(num_vertices: int) -> int:
    """Side of the weight map, texels."""
    wanted = np.sqrt(WEIGHT_TEXELS_PER_VERTEX * num_vertices)
    return min(WEIGHT_SIZES_PX, key=lambda side: abs(np.log(side / max(wanted, 1.0))))


def store_weights(mesh: SkinnedMesh, seams: Seams, num_joints: int, side: int | None = None) -> StoredTexture:
    """Joint weights, 8 bits each (16 with more than 256 joints), fitted to the vertices of the full mesh.

    Parameters
    ----------
    mesh : SkinnedMesh
        With the atlas as its uvs.
    seams : Seams
        Its seams.
    num_joints : int
    side : int, optional
        Texels; by default what takes the least memory with its quadtrees.
    """
    side = side or weight_side(mesh.num_vertices)
    baked = bake_weights(mesh, num_joints, (side, side))
    packed = pack_weights(baked)
    stored = unpack_weights(packed.stack, (side, side), num_joints)
    seam = seam_report(mesh.surface, seams, baked, baked, stored)
    extra = {"layout": "texel-joints", "slots": packed.slots}
    return StoredTexture("weights", (packed.texels01,), packed.format, (side, side), seam, extra)
