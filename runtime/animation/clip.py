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
from runtime.gltf.morph_names import morph_names

if TYPE_CHECKING:
    from runtime.gltf.document import Document

COMPONENTS = {"translation": 3, "rotation": 4, "scale": 3}
WEIGHTS = "weights"  # the path of a track that moves a morph, one number a key
INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")


@dataclass(frozen=True)
class Track:
    """One property of one node over time.

    Attributes
    ----------
    node : int
        Into the skeleton's nodes; of weights, into its morphs.
    path : "translation", "rotation", "scale" or "weights"
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
        tracks = tuple(track for track in self.tracks if track.node in kept and track.path != WEIGHTS)
        return Clip(self.name, self.duration_s, tracks)


def _checked_track(
    node: int, path: str, mode: str, times: NDArray[Any], values: NDArray[Any], where: str, limits: Limits
) -> Track:
    """A track whose shapes, order and numbers hold; one line of complaint otherwise."""
    if mode not in INTERPOLATIONS:
        raise AssetError(f"{where}: interpolation {mode!r} is unknown; use LINEAR, STEP or CUBICSPLINE")
    width = COMPONENTS.get(path, 1)
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


def _morph_map(document: Document, skeleton: Skeleton) -> dict[int, tuple[int, ...]]:
    """Morph of the skeleton that each target of a node of the file is, by name; -1 for none."""
    if not skeleton.morphs:
        return {}
    index = {name: morph for morph, name in enumerate(skeleton.morphs)}
    return {node: tuple(index.get(name, -1) for name in names) for node, names in morph_names(document).items()}


def _read_sampler(
    animation: dict[str, Any], channel: dict[str, Any], accessors: _AccessorCache, place: str
) -> tuple[str, NDArray[Any], NDArray[Any]]:
    """Interpolation, key times and values of a channel, as they are."""
    samplers, index = animation.get("samplers", []), channel.get("sampler", -1)
    if not isinstance(index, int) or not 0 <= index < len(samplers):
        raise AssetError(f"{place}: sampler {index} does not exist; re-export the clip")
    sampler = samplers[index]
    if "input" not in sampler or "output" not in sampler:
        raise AssetError(f"{place}: its sampler lacks input or output; re-export the clip")
    times, values = accessors.read(sampler["input"]), accessors.read(sampler["output"])
    return str(sampler.get("interpolation", "LINEAR")), times, values


def _by_target(values: NDArray[Any], count: int, place: str) -> NDArray[Any]:
    """Keys of all targets of a mesh, a number each, as a row a key."""
    if values.size % count:
        raise AssetError(f"{place}: {values.size} values are no rows of {count} targets; re-export the clip")
    return values.reshape(-1, count)


def _read_tracks(
    animation: dict[str, Any],
    to_skeleton: dict[int, int],
    to_morphs: dict[int, tuple[int, ...]],
    skeleton: Skeleton,
    accessors: _AccessorCache,
    where: str,
    faults: list[str] | None,
    limits: Limits,
) -> list[Track]:
    """The tracks of one animation that move the skeleton's nodes and morphs. Several meshes may show one morph."""
    fixed = frozenset(int(node) for node in skeleton.matrix_nodes)
    tracks: list[Track] = []
    moved: set[int] = set()
    start_s = 0.0
    for channel in animation.get("channels", []):
        target = channel.get("target", {})
        path, source = target.get("path"), target.get("node", -1)
        if path == WEIGHTS:
            wanted = [(morph, at) for at, morph in enumerate(to_morphs.get(source, ())) if morph not in {-1, *moved}]
            place = f"{where}, node {source}, {path}"
        else:
            node = to_skeleton.get(source)
            wanted = [(node, -1)] if node is not None and node not in fixed and path in COMPONENTS else []
            place = f"{where}, node {skeleton.names[node]!r}, {path}" if node is not None else where
        if not wanted:
            continue
        mode, times, values = _read_sampler(animation, channel, accessors, place)
        mended: list[str] = []
        before = 0.0
        try:
            if path == WEIGHTS:
                values = _by_target(values, len(to_morphs[source]), place)
            if faults is not None:
                times, values, mended = mend_keys(times, values, 3 if mode == "CUBICSPLINE" else 1, path, limits)
                before = min(float(times[0]), 0.0) if times.ndim == 1 and len(times) else 0.0
            found = [
                _checked_track(
                    to, path, mode, times - before, values if at < 0 else values[:, at : at + 1], place, limits
                )
                for to, at in wanted
            ]
        except AssetError as error:
            if faults is None:
                raise
            faults.append(f"left out: {error}" + "".join(f" ({words})" for words in mended))
            continue
        if path == WEIGHTS:
            moved |= {track.node for track in found}
        if faults is not None:
            faults += [f"{place}: {words}" for words in mended]
        tracks += [replace(track, times=track.times + before) for track in found] if before else found
        start_s = min(start_s, before)
    if start_s < 0:
        assert faults is not None
        faults.append(f"{where} starts {-start_s:g} s before 0: moved to start at 0")
        tracks = [replace(track, times=track.times - start_s) for track in tracks]
    return tracks


def read_clips(
    document: Document, skeleton: Skeleton, by_name: bool = False, faults: list[str] | None = None
) -> tuple[Clip, ...]:
    """Read every clip of a file, as far as it moves the skeleton's nodes and morphs.

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
        Channels that move other nodes, or morphs that the skeleton does not have, are left out. Clips without a name
        are called "clip N".

    Raises
    ------
    AssetError
        When key times do not rise, shapes disagree, or a number is not finite (without `faults`); or, by name, when
        the file has clips and none of its nodes is in the skeleton.
    """
    path = str(getattr(document, "path", None) or "file")
    animations: list[dict[str, Any]] = document.json.get("animations", [])
    to_skeleton, to_morphs = _node_map(document, skeleton, by_name), _morph_map(document, skeleton)
    if by_name and animations and not to_skeleton and not to_morphs:
        raise AssetError(f"{path}: none of its nodes has the name of one of the skeleton's; rename the joints to match")
    accessors = _AccessorCache(document)
    limits = getattr(document, "limits", LIMITS)
    clips: list[Clip] = []
    for number, animation in enumerate(animations):
        name = str(animation.get("name") or f"clip {number}")
        where = f"{path}: clip {name!r}"
        tracks = _read_tracks(animation, to_skeleton, to_morphs, skeleton, accessors, where, faults, limits)
        duration = max((float(track.times[-1]) for track in tracks), default=0.0)
        clips.append(Clip(name, duration, tuple(tracks)))
    return tuple(clips)
