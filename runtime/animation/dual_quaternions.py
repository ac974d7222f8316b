"""Joint matrices as dual quaternions and stretches, for skinning that keeps volume in twists.

A matrix is split into a rotation, a translation and what is left, a stretch: M = T R S. Rotations and translations are
blended as unit dual quaternions, stretches as matrices (Kavan et al. 2008, "Geometric skinning with approximate dual
quaternion blending", section 4, for the two phases). Letters in shapes: A actors, J joints.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
TEXELS_PER_JOINT = 5  # real part, dual part, three rows of the stretch


def quaternions(rotations: Floats) -> NDArray[np.float64]:
    """Unit quaternions (x, y, z, w) of rotation matrices, (..., 3, 3) to (..., 4) float64.

    References
    ----------
    Shepperd 1978: the largest component is found first, so none loses precision.
    """
    m = np.asarray(rotations, np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    # Row i is 4 q_i (x, y, z, w); the row of the largest q_i is taken.
    rows = np.stack(
        [
            np.stack([1 + xx - yy - zz, d, e, a], axis=-1),
            np.stack([d, 1 - xx + yy - zz, f, b], axis=-1),
            np.stack([e, f, 1 - xx - yy + zz, c], axis=-1),
            np.stack([a, b, c, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    chosen: NDArray[np.float64] = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    unit: NDArray[np.float64] = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return unit


def quaternion_product(p: Floats, q: Floats) -> NDArray[np.float64]:
    """Products of quaternions (x, y, z, w), (..., 4)."""
    vector = p[..., 3:] * q[..., :3] + q[..., 3:] * p[..., :3] + np.cross(p[..., :3], q[..., :3])
    scalar = p[..., 3] * q[..., 3] - (p[..., :3] * q[..., :3]).sum(axis=-1)
    return np.concatenate([vector, scalar[..., None]], axis=-1)


def joint_texels(rows: Floats) -> NDArray[np.float32]:
    """What the shaders read for each joint.

    Parameters
    ----------
    rows : (A, J, 3, 4) float
        Skinning matrices.

    Returns
    -------
    (A, J, 5, 4) float32
        Real part, dual part, and the stretch's rows.
    """
    matrices = np.asarray(rows, np.float64)
    linear = matrices[..., :3]
    left, _, right = np.linalg.svd(linear)
    handedness = np.where(np.linalg.det(left @ right) < 0, -1.0, 1.0)
    left[..., :, 2] *= handedness[..., None]  # a reflection goes into the stretch
    rotations = left @ right
    texels = np.zeros((*matrices.shape[:-2], TEXELS_PER_JOINT, 4), np.float32)
    real = quaternions(rotations)
    translation = np.concatenate([matrices[..., 3], np.zeros((*matrices.shape[:-2], 1))], axis=-1)
    texels[..., 0, :] = real
    texels[..., 1, :] = 0.5 * quaternion_product(translation, real)
    texels[..., 2:, :3] = np.swapaxes(rotations, -1, -2) @ linear
    return texels
