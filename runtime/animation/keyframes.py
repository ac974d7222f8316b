"""The tracks of a clip stacked into flat arrays, so that one gather evaluates all of them for all actors.

Every key starts a *segment* that runs to the next key; the last key's segment holds its value. A segment stores what
evaluation needs and nothing is left to decide while sampling:

- a polynomial in u ∈ [0, 1] of degree 1 (LINEAR, STEP) or 3 (CUBICSPLINE, Hermite form expanded);
- a great arc ``q0·cos(uθ) + q⊥·sin(uθ)`` for rotations (LINEAR, STEP), with q⊥ the unit quaternion at right angles to
  q0 towards the next key on the shorter arc. It needs no division and stays exact as θ goes to 0. It is the slerp of
  Shoemake 1985, "Animating rotation with quaternion curves", with the division done once, ahead.

Arrays are stored components first and actors last: (C, R, A), so that every operation runs over contiguous memory.
Letters in shapes: R tracks of a bank, S segments of a bank, G different lists of key times, A actors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from runtime.animation.clip import Track

Floats = NDArray[np.floating[Any]]
WIDTHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}  # numbers a key, by path


@dataclass(frozen=True)
class Bank:
    """Tracks of one property and one form.

    Attributes
    ----------
    path : "translation", "rotation", "scale" or "weights"
    form : "arc", "linear" or "cubic"
    nodes : (R,) int32
        Of weights: morphs.
    time_lists : (R,) int32
        Which list of key times each track uses.
    first_segment : (R,) int64
        Where a track's segments start in `coefficients`.
    coefficients : (D, S) float64
        arc: q0 (4), q⊥ (4), θ (1). linear: value, slope. cubic: four coefficients of C components each, rising power.
    """

    path: str
    form: str
    nodes: NDArray[np.int32]
    time_lists: NDArray[np.int32]
    first_segment: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    _cast: dict[str, Floats] = field(default_factory=dict, repr=False, compare=False)

    def coefficients_as(self, dtype: np.dtype[Any]) -> Floats:
        """`coefficients` in another precision, kept for the next time."""
        if dtype.str not in self._cast:
            self._cast[dtype.str] = np.ascontiguousarray(self.coefficients, dtype=dtype)
        return self._cast[dtype.str]


@dataclass(frozen=True)
class Keys:
    """All tracks of a clip.

    Attributes
    ----------
    searched_times : (sum of K,) float64
        The G lists of key times one after another, list g shifted by `shifts[g]`, so that one search serves all.
    first_key : (G,) int64
    num_keys : (G,) int64
    shifts : (G,) float64
    start_times, rates : (sum of K,) float64
        Start of each segment, unshifted, and one over its length (0 for the last of a list).
    banks : tuple of Bank
    """

    searched_times: NDArray[np.float64]
    first_key: NDArray[np.int64]
    num_keys: NDArray[np.int64]
    shifts: NDArray[np.float64]
    start_times: NDArray[np.float64]
    rates: NDArray[np.float64]
    banks: tuple[Bank, ...]


def _hermite(track: Track) -> NDArray[np.float64]:
    """Polynomial coefficients of a CUBICSPLINE track, (4·C, K): glTF 2.0 specification, appendix C.5."""
    value, in_tangent, out_tangent = track.values[:, 1], track.values[:, 0], track.values[:, 2]
    coefficients = np.zeros((4, *value.shape))
    coefficients[0] = value
    spans = np.diff(track.times)[:, None]
    start, end = value[:-1], value[1:]
    leaving, arriving = spans * out_tangent[:-1], spans * in_tangent[1:]
    coefficients[1, :-1] = leaving
    coefficients[2, :-1] = 3 * (end - start) - 2 * leaving - arriving
    coefficients[3, :-1] = 2 * (start - end) + leaving + arriving
    return np.moveaxis(coefficients, 2, 1).reshape(-1, len(value))


def _line(track: Track) -> NDArray[np.float64]:
    """Value and slope of a LINEAR or STEP track, (2·C, K)."""
    slopes = np.zeros_like(track.values)
    if track.interpolation == "LINEAR":
        slopes[:-1] = np.diff(track.values, axis=0)
    return np.concatenate([track.values.T, slopes.T])


def _arc(track: Track) -> NDArray[np.float64]:
    """Start, perpendicular direction and angle of a LINEAR or STEP rotation track, (9, K)."""
    start = track.values
    towards = np.zeros_like(start)
    angles = np.zeros(len(start))
    if track.interpolation == "LINEAR":
        end = start[1:]
        cosines = np.sum(start[:-1] * end, axis=1)
        end = np.where(cosines[:, None] < 0, -end, end)
        cosines = np.minimum(np.abs(cosines), 1.0)
        offsets = end - cosines[:, None] * start[:-1]
        sines = np.linalg.norm(offsets, axis=1)
        turning = sines > 1e-12
        towards[:-1][turning] = offsets[turning] / sines[turning, None]
        angles[:-1] = np.where(turning, np.arctan2(sines, cosines), 0.0)
    return np.concatenate([start.T, towards.T, angles[None]])


_FORMS = {"arc": _arc, "linear": _line, "cubic": _hermite}


def _form(track: Track) -> str:
    """Which of the three forms a track takes."""
    if track.interpolation == "CUBICSPLINE":
        return "cubic"
    return "arc" if track.path == "rotation" else "linear"


def stack_tracks(tracks: Sequence[Track]) -> Keys:
    """Stack tracks for batched sampling. Lists of key times that agree are searched once."""
    list_of_times: dict[bytes, int] = {}
    times: list[NDArray[np.float64]] = []
    grouped: dict[tuple[str, str], list[tuple[int, Track]]] = {}
    for track in tracks:
        key = track.times.tobytes()
        if key not in list_of_times:
            list_of_times[key] = len(times)
            times.append(track.times)
        grouped.setdefault((track.path, _form(track)), []).append((list_of_times[key], track))

    counts = np.array([len(one) for one in times], dtype=np.int64)
    span = 2.0 * max((float(one[-1]) for one in times), default=0.0) + 2.0
    shifts = span * np.arange(len(times), dtype=np.float64)
    empty = np.zeros(0)
    rates = [np.append(1.0 / np.diff(one), 0.0) for one in times]

    banks: list[Bank] = []
    for (path, form), members in sorted(grouped.items(), key=lambda item: item[0]):
        lengths = np.array([len(track.times) for _, track in members], dtype=np.int64)
        banks.append(
            Bank(
                path=path,
                form=form,
                nodes=np.array([track.node for _, track in members], dtype=np.int32),
                time_lists=np.array([index for index, _ in members], dtype=np.int32),
                first_segment=np.cumsum(lengths) - lengths,
                coefficients=np.concatenate([_FORMS[form](track) for _, track in members], axis=1),
            )
        )
    return Keys(
        searched_times=np.concatenate([one + shift for one, shift in zip(times, shifts)] or [empty]),
        first_key=np.cumsum(counts) - counts,
        num_keys=counts,
        shifts=shifts,
        start_times=np.concatenate(times or [empty]),
        rates=np.concatenate(rates or [empty]),
        banks=tuple(banks),
    )


def locate(keys: Keys, times_s: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Segment within each list of key times, (G, A), and the place u ∈ [0, 1] inside it, (G, A)."""
    # Times before the first list's keys or beyond a list's last one must not stray into a neighbouring list.
    asked = keys.shifts[:, None] + np.clip(times_s, 0.0, keys.shifts[1] / 2 if len(keys.shifts) > 1 else None)
    found = np.searchsorted(keys.searched_times, asked, side="right") - 1
    found = np.maximum(found, keys.first_key[:, None])
    u = np.clip((times_s - keys.start_times[found]) * keys.rates[found], 0.0, 1.0)
    return found - keys.first_key[:, None], u


def _evaluate(bank: Bank, segments: NDArray[np.int64], u: NDArray[np.float64], dtype: np.dtype[Any]) -> Floats:
    """Values of one bank, (C, R, A)."""
    index = bank.first_segment[:, None] + segments[bank.time_lists]
    coefficients = np.take(bank.coefficients_as(dtype), index, axis=1, mode="clip")
    at = u[bank.time_lists].astype(dtype, copy=False)
    if bank.form == "arc":
        angle = coefficients[8] * at
        return np.asarray(coefficients[:4] * np.cos(angle) + coefficients[4:8] * np.sin(angle))
    width = WIDTHS[bank.path]
    if bank.form == "linear":
        return np.asarray(coefficients[:width] + coefficients[width:] * at)
    a, b, c, d = (coefficients[power * width : (power + 1) * width] for power in range(4))
    values: Floats = ((d * at + c) * at + b) * at + a
    if bank.path == "rotation":
        lengths = np.sqrt(np.sum(values * values, axis=0))
        values = values / np.maximum(lengths, np.finfo(dtype).tiny)
    return values


def evaluate(keys: Keys, times_s: NDArray[np.float64], dtype: np.dtype[Any]) -> list[tuple[Bank, Floats]]:
    """Every bank of a clip at many times.

    Parameters
    ----------
    keys : Keys
    times_s : (A,) float64, seconds
        Clamped to each track's own keys (glTF).
    dtype : precision of the result

    Returns
    -------
    list of (Bank, (C, R, A) float)
    """
    if not keys.banks:
        return []
    segments, u = locate(keys, times_s)
    return [(bank, _evaluate(bank, segments, u, dtype)) for bank in keys.banks]
