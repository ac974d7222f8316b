"""Makes an atlas bear storing: rounded to the steps of its file, no face turns over or goes flat, no vertices meet.

The uvs themselves stay as they are, so that straight seams stay straight to the last bit; only a vertex that rounding
takes to the wrong side of a thin triangle, or to where another one is, goes to a step nearby.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.texels import snap_canonical_uvs
from preprocess.numerics.jit import entry, helper
from runtime.asset.lod_mesh import UV_STEPS

REACH = 3  # steps that a vertex may go, each way
SWEEPS = 12
CROWDED = 1 << 20  # as bad as that many wrong faces: a step that another vertex has


def bear_snapping(uvs: Floats, face_uvs: Ints) -> Floats:
    """Texture vertices moved by a few steps where rounding them would turn or flatten a face or join them, (T, 2).

    Parameters
    ----------
    uvs : (T, 2) float64
        In the unit square.
    face_uvs : (F, 3) int32
    """
    wanted = face_orientation(uvs, face_uvs).astype(np.int64)
    steps = np.rint(snap_canonical_uvs(uvs) * UV_STEPS).astype(np.int64)
    order = np.argsort(face_uvs.ravel(), kind="stable")
    first = np.searchsorted(face_uvs.ravel()[order], np.arange(len(uvs) + 1))
    offsets = np.stack(np.meshgrid(*[np.arange(-REACH, REACH + 1)] * 2), axis=-1).reshape(-1, 2)
    offsets = offsets[np.argsort((offsets**2).sum(axis=1), kind="stable")]
    moved = steps.copy()
    for _ in range(SWEEPS):
        taken = np.sort(moved[:, 1] * (UV_STEPS + 1) + moved[:, 0])
        vertices = np.union1d(_of_wrong_faces(moved, face_uvs, wanted), _meeting(moved, uvs))
        if not len(vertices):
            break
        _move_to_good_steps(moved, vertices, face_uvs, wanted, first, order // 3, offsets, taken, UV_STEPS)
    return np.where((moved != steps).any(axis=1)[:, None], moved / UV_STEPS, uvs)


def _of_wrong_faces(steps: np.ndarray, face_uvs: Ints, wanted: np.ndarray) -> np.ndarray:
    """Vertices of faces that do not turn as they should."""
    corners = steps[face_uvs]
    p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    turn = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return np.unique(face_uvs[(turn * wanted <= 0) & (wanted != 0)])


def _meeting(steps: np.ndarray, uvs: Floats) -> np.ndarray:
    """Vertices at the step of another one that has another uv, but for one of them."""
    places = np.unique(uvs, axis=0, return_inverse=True)[1].reshape(-1)
    codes = np.unique(steps, axis=0, return_inverse=True)[1].reshape(-1)
    pairs, first = np.unique(np.stack([codes, places], axis=1), axis=0, return_index=True)
    repeated = np.r_[False, pairs[1:, 0] == pairs[:-1, 0]]
    return first[repeated]


@helper
def _count_wrong(steps, v, face_uvs, wanted, first, faces_of):  # type: ignore[no-untyped-def]
    """Faces around a vertex that do not turn as they should."""
    wrong = 0
    for i in range(first[v], first[v + 1]):
        g = faces_of[i]
        a, b, c = face_uvs[g, 0], face_uvs[g, 1], face_uvs[g, 2]
        px, py = steps[b, 0] - steps[a, 0], steps[b, 1] - steps[a, 1]
        qx, qy = steps[c, 0] - steps[a, 0], steps[c, 1] - steps[a, 1]
        if (px * qy - py * qx) * wanted[g] <= 0 and wanted[g] != 0:
            wrong += 1
    return wrong


@entry
def _move_to_good_steps(  # type: ignore[no-untyped-def]
    steps, vertices, face_uvs, wanted, first, faces_of, offsets, taken, most
):
    """Take the nearest step that no other vertex has and with which the fewest faces around a vertex are wrong."""
    for v in vertices:
        x, y = steps[v, 0], steps[v, 1]
        best_x, best_y, best = x, y, 2 * CROWDED
        for o in range(len(offsets)):
            tx, ty = min(max(x + offsets[o, 0], 0), most), min(max(y + offsets[o, 1], 0), most)
            steps[v, 0], steps[v, 1] = tx, ty
            code = ty * (most + 1) + tx
            others = np.searchsorted(taken, code + 1) - np.searchsorted(taken, code)
            if tx == x and ty == y:
                others -= 1
            wrong = _count_wrong(steps, v, face_uvs, wanted, first, faces_of) + (CROWDED if others > 0 else 0)
            if wrong < best:
                best_x, best_y, best = tx, ty, wrong
        steps[v, 0], steps[v, 1] = best_x, best_y
