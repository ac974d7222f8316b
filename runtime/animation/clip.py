"""Clips: what a glTF animation says about the nodes of a skeleton, validated once.

Letters in shapes: K keys, C components (3, or 4 for rotations). The stacked form that is sampled lies in keys.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.animation.clip_repair import mend_keys
from runtime.animation.keyframes import Keys, stack_tracks
from runtime.animation.skeleton import Skeleton
from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS, Limits

if TYPE_CHECKING:
    from runtime.gltf.document import Document

COMPONENTS = {"translation": 3, "rotation": 4, "scale": 3}
INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")


@dataclass(frozen=True)
class Track:
    """One property of one node over time.

    Attributes
    ----------
    node : int
        Into the skeleton's nodes.
    path : "translation", "rotation" or "scale"
    interpolation : "LINEAR", "STEP" or "CUBICSPLINE"
        Rotations are interpolated spherically, on the shorter arc, where LINEAR.
    times : (K,) float64, seconds, strictly rising
    values : (K, C) float64; (K, 3, C) for CUBICSPLINE: in-tangent, value, out-tangent
    """

    node: int
    path: str
    interpolation: str
    times: NDArray[np.float64]
    values: NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Clip:
    """A named animation of a skeleton.

    Attributes
    ----------
    name : str
    duration_s : float
        Time of the last key; 0 for a clip that is one pose.
    tracks : tuple of Track
    """

    name: str
    duration_s: float
    tracks: tuple[Track, ...]

    def __repr__(self) -> str:
        return f"<Clip {self.name!r}: {self.duration_s:.3g} s, {len(self.tracks)} tracks>"

    @cached_property
    def keys(self) -> Keys:
        """The tracks stacked for sampling many actors at once."""
        return stack_tracks(self.tracks)

    @cached_property
    def key_times(self) -> NDArray[np.float64]:
        """Every time at which some track has a key, seconds, rising."""
        if not self.tracks:
            return np.zeros(1)
        return np.unique(np.concatenate([track.times for track in self.tracks]))

    def restricted(self, nodes: Sequence[int]) -> Clip:
        """The same clip with the tracks of some nodes only."""
        kept = frozenset(int(node) for node in nodes)
        return Clip(self.name, self.duration_s, tuple(track for track in self.tracks if track.node in kept))


def _checked_track(
    node: int, path: str, mode: str, times: NDArray[Any], values: NDArray[Any], where: str, limits: Limits
) -> Track:
    """A track whose shapes, order and numbers hold; one line of complaint otherwise."""
    if mode not in INTERPOLATIONS:
        raise AssetError(f"{where}: interpolation {mode!r} is unknown; use LINEAR, STEP or CUBICSPLINE")
    width = COMPONENTS[path]
    keys_per_time = 3 if mode == "CUBICSPLINE" else 1
    times = np.array(times, dtype=np.float64)
    values = np.array(values, dtype=np.float64)
    if times.ndim != 1 or not len(times):
        raise AssetError(f"{where}: it has no key times; re-export the clip")
    if values.shape != (len(times) * keys_per_time, width):
        raise AssetError(
            f"{where}: {path} needs {len(times) * keys_per_time} rows of {width} for {len(times)} keys, "
            f"the file has {values.shape}; re-export the clip"
        )
    if not ((np.abs(times) <= limits.time_s).all() and (np.abs(values) <= limits.number).all()):
        raise AssetError(f"{where}: a key is not finite or far out of range; re-export the clip")
    if times[0] < 0 or (np.diff(times) <= 0).any():
        raise AssetError(f"{where}: its key times must rise from 0 on; re-export the clip")
    if mode == "CUBICSPLINE":
        values = values.reshape(len(times), 3, width)
    if path == "rotation":
        points = values[:, 1] if mode == "CUBICSPLINE" else values
        lengths = np.linalg.norm(points, axis=1)
        if (lengths < 1e-6).any():
            raise AssetError(f"{where}: a rotation key is zero; re-export the clip")
        if mode != "CUBICSPLINE":
            values = values / lengths[:, None]
    return Track(node, path, mode, times, values)


class _AccessorCache:
    """Accessors of a document, each decoded once: tracks share their key times."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._arrays: dict[int, NDArray[Any]] = {}

    def read(self, index: int) -> NDArray[Any]:
        if index not in self._arrays:
            self._arrays[index] = self._document.accessor(index)
        return self._arrays[index]


def _node_map(document: Document, skeleton: Skeleton, by_name: bool) -> dict[int, int]:
    """Node of the file to node of the skeleton, by index or by name."""
    if not by_name:
        return {int(node): index for index, node in enumerate(skeleton.document_nodes) if node >= 0}
    nodes = document.json.get("nodes", [])
    mapped: dict[int, int] = {}
    taken: set[int] = set()
    for index, node in enumerate(nodes):
        target = skeleton.node_by_name.get(node.get("name", ""))
        if target is not None and target not in taken:
            mapped[index] = target
            taken.add(target)
    return mapped


def _read_tracks(
    animation: dict[str, Any],
    to_skeleton: dict[int, int],
    skeleton: Skeleton,
    accessors: _AccessorCache,
    where: str,
    faults: list[str] | None,
    limits: Limits,
) -> list[Track]:
    """The tracks of one animation that move the skeleton's nodes."""
    fixed = frozenset(int(node) for node in skeleton.matrix_nodes)
    samplers = animation.get("samplers", [])
    tracks: list[Track] = []
    start_s = 0.0
    for channel in animation.get("channels", []):
        target = channel.get("target", {})
        path = target.get("path")
        node = to_skeleton.get(target.get("node", -1))
        if node is None or node in fixed or path not in COMPONENTS:
            continue
        place = f"{where}, node {skeleton.names[node]!r}, {path}"
        sampler_index = channel.get("sampler", -1)
        if not isinstance(sampler_index, int) or not 0 <= sampler_index < len(samplers):
            raise AssetError(f"{place}: sampler {sampler_index} does not exist; re-export the clip")
        sampler = samplers[sampler_index]
        if "input" not in sampler or "output" not in sampler:
            raise AssetError(f"{place}: its sampler lacks input or output; re-export the clip")
        times, values = accessors.read(sampler["input"]), accessors.read(sampler["output"])
        mode = str(sampler.get("interpolation", "LINEAR"))
        if faults is None:
            tracks.append(_checked_track(node, path, mode, times, values, place, limits))
            continue
        times, values, mended = mend_keys(times, values, 3 if mode == "CUBICSPLINE" else 1, path, limits)
        before = min(float(times[0]), 0.0) if times.ndim == 1 and len(times) else 0.0
        try:
            track = _checked_track(node, path, mode, times - before, values, place, limits)
        except AssetError as error:
            faults.append(f"left out: {error}")
            continue
        faults += [f"{place}: {words}" for words in mended]
        tracks.append(replace(track, times=track.times + before))
        start_s = min(start_s, before)
    if start_s < 0:
        assert faults is not None
        faults.append(f"{where} starts {-start_s:g} s before 0: moved to start at 0")
        tracks = [replace(track, times=track.times - start_s) for track in tracks]
    return tracks


def read_clips(
    document: Document, skeleton: Skeleton, by_name: bool = False, faults: list[str] | None = None
) -> tuple[Clip, ...]:
    """Read every clip of a file, as far as it moves the skeleton's nodes.

    Parameters
    ----------
    document : Document
    skeleton : Skeleton
    by_name : bool
        Match nodes by name rather than by index: for clips from another file than the skeleton's.
    faults : list of str, optional
        Where given, damaged tracks are mended (clip_faults.py) or left out, and each is told here.

    Returns
    -------
    tuple of Clip, in the file's order
        Channels that move other nodes, or morph weights, are left out. Clips without a name are called "clip N".

    Raises
    ------
    AssetError
        When key times do not rise, shapes disagree, or a number is not finite (without `faults`); or, by name, when
        the file has clips and none of its nodes is in the skeleton.
    """
    path = str(getattr(document, "path", None) or "file")
    animations: list[dict[str, Any]] = document.json.get("animations", [])
    to_skeleton = _node_map(document, skeleton, by_name)
    if by_name and animations and not to_skeleton:
        raise AssetError(f"{path}: none of its nodes has the name of one of the skeleton's; rename the joints to match")
    accessors = _AccessorCache(document)
    limits = getattr(document, "limits", LIMITS)
    clips: list[Clip] = []
    for number, animation in enumerate(animations):
        name = str(animation.get("name") or f"clip {number}")
        tracks = _read_tracks(animation, to_skeleton, skeleton, accessors, f"{path}: clip {name!r}", faults, limits)
        duration = max((float(track.times[-1]) for track in tracks), default=0.0)
        clips.append(Clip(name, duration, tuple(tracks)))
    return tuple(clips)
