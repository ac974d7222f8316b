"""Makes an atlas bear storing: rounded to the steps of its file, no face turns over, goes flat or overlaps another.

The uvs themselves stay as they are, so that straight seams stay straight to the last bit; only a vertex that rounding
takes to the wrong side of a thin triangle goes to a step nearby.
"""

from __future__ import annotations

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.texels import UV_STEPS, snap_canonical_uvs
from preprocess.numerics.jit import entry

REACH = 3  # steps that a vertex may go, each way
SWEEPS = 12


def bear_snapping(uvs: Floats, face_uvs: Ints) -> Floats:
    """Texture vertices moved by a few steps where rounding them would turn or flatten a face, (T, 2) float64.

    Parameters
    ----------
    uvs : (T, 2) float64
        In the unit square.
    face_uvs : (F, 3) int32
    """
    wanted = face_orientation(uvs, face_uvs).astype(np.int64)
    steps = np.rint(snap_canonical_uvs(uvs) * UV_STEPS).astype(np.int64)
    corners = face_uvs.ravel()
    faces_of = np.argsort(corners, kind="stable") // 3
    first = np.searchsorted(corners[np.argsort(corners, kind="stable")], np.arange(len(uvs) + 1))
    offsets = np.stack(np.meshgrid(*[np.arange(-REACH, REACH + 1)] * 2), axis=-1).reshape(-1, 2)
    offsets = offsets[np.argsort((offsets**2).sum(axis=1), kind="stable")]
    moved = steps.copy()
    _move_to_good_steps(moved, face_uvs, wanted, first, faces_of, offsets, UV_STEPS, SWEEPS)
    changed = (moved != steps).any(axis=1)
    return np.where(changed[:, None], moved / UV_STEPS, uvs)


@entry
def _move_to_good_steps(steps, face_uvs, wanted, first, faces_of, offsets, most, sweeps):  # type: ignore[no-untyped-def]
    """For every corner of a wrong face, take the nearest step with which the fewest faces around it are wrong."""
    for _ in range(sweeps):
        again = False
        for f in range(len(face_uvs)):
            for k in range(3):
                a, b, c = steps[face_uvs[f, 0]], steps[face_uvs[f, 1]], steps[face_uvs[f, 2]]
                turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
                if turn * wanted[f] > 0 or wanted[f] == 0:
                    break
                again = True
                v = face_uvs[f, k]
                x, y = steps[v, 0], steps[v, 1]
                best, best_wrong = 0, len(face_uvs) + 1
                for o in range(len(offsets)):
                    steps[v, 0] = min(max(x + offsets[o, 0], 0), most)
                    steps[v, 1] = min(max(y + offsets[o, 1], 0), most)
                    wrong = 0
                    for i in range(first[v], first[v + 1]):
                        g = faces_of[i]
                        p, q, r = steps[face_uvs[g, 0]], steps[face_uvs[g, 1]], steps[face_uvs[g, 2]]
                        area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
                        if area * wanted[g] <= 0 and wanted[g] != 0:
                            wrong += 1
                    if wrong < best_wrong:
                        best, best_wrong = o, wrong
                steps[v, 0] = min(max(x + offsets[best, 0], 0), most)
                steps[v, 1] = min(max(y + offsets[best, 1], 0), most)
        if not again:
            break
