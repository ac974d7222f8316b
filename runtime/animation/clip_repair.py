"""Keys of damaged clips, mended where it is clear what they were meant to be.

Exporters write two keys at one time for a jump, keys before time zero, and now and then a number that is none. A
character is not worth less for it: what can be kept is kept, and said.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.gltf.limits import LIMITS, Limits

ZERO_LENGTH = 1e-6  # a shorter quaternion turns nothing


def _sound_rows(values: NDArray[np.float64], is_rotation: bool, most: float) -> NDArray[np.bool_]:
    """Which keys are in range and, for rotations, not zero, (K,) bool, of values (K, 1 or 3, C)."""
    sound = np.asarray((np.abs(values) <= most).all(axis=(1, 2)))
    if is_rotation:
        points = np.where(sound[:, None], values[:, values.shape[1] // 2], 0.0)
        sound &= np.linalg.norm(points, axis=1) >= ZERO_LENGTH
    return sound


def mend_keys(
    times: NDArray[Any], values: NDArray[Any], keys_per_time: int, path: str, limits: Limits = LIMITS
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]]:
    """Drop keys that say nothing and part those that share a time; anything else stays for the reader to refuse.

    Parameters
    ----------
    times : (K,)
        Seconds.
    values : (K * keys_per_time, C)
    keys_per_time : int
        3 for CUBICSPLINE, else 1.
    path : "translation", "rotation" or "scale"
    limits : Limits

    Returns
    -------
    times : (L,) float64
    values : (L * keys_per_time, C) float64
    faults : list of str
        What was mended, a few words each.
    """
    times, values = np.array(times, np.float64), np.array(values, np.float64)
    if times.ndim != 1 or values.ndim != 2 or len(values) != len(times) * keys_per_time or not len(times):
        return times, values, []
    faults = []
    rows = values.reshape(len(times), keys_per_time, -1)
    sound = (np.abs(times) <= limits.time_s) & _sound_rows(rows, path == "rotation", limits.number)
    if not sound.all():
        faults.append(f"{int((~sound).sum())} keys that are not finite, far out of range or turn by nothing dropped")
        times, rows = times[sound], rows[sound]
    repeated = np.flatnonzero(np.diff(times) == 0) + 1
    if len(repeated):
        faults.append(f"{len(repeated)} keys at the time of another parted")
        inner = repeated[np.isin(repeated + 1, repeated)]  # of three and more at one time, the first and the last
        times, rows = np.delete(times, inner), np.delete(rows, inner, axis=0)
        again = np.flatnonzero(np.diff(times) == 0) + 1
        # Next to it as files store times, in 32 bits: the jump stays a jump.
        times[again] = np.nextafter(times[again].astype(np.float32), np.float32(np.inf))
    return times, rows.reshape(-1, values.shape[1]), faults
