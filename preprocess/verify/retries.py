"""What a build tries next where its measurement is beyond the goals: a short list, each way once.

A way is taken for the faults that it can mend, by settings that a person did not fix; of all tries the best is kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from preprocess.settings import Settings
from preprocess.verify.goals import Finding

MOST_RETRIES = 2  # a build more each
LARGEST_GEOMETRY_PX, LARGEST_COLOR_PX = 2048, 2048
SHAPE = frozenset({"vertices", "middles", "weights"})
LOOK = frozenset({"normals", "base_color", "emission", "surface_factors"})


def _larger_geometry(settings: Settings, manifest: Mapping[str, Any]) -> Settings | None:
    position, weights = (max(manifest["textures"][name]["size"]) for name in ("position", "weights"))
    if settings.geometry_size_px is not None or settings.weight_size_px is not None:
        return None
    if 2 * position > LARGEST_GEOMETRY_PX:
        return None
    return dataclasses.replace(settings, geometry_size_px=2 * position, weight_size_px=2 * weights)


def _larger_colors(settings: Settings, manifest: Mapping[str, Any]) -> Settings | None:
    side = max(
        max(entry["size"]) for name, entry in manifest["textures"].items() if name not in ("position", "weights")
    )
    if settings.color_size_px is not None or 2 * side > LARGEST_COLOR_PX:
        return None
    return dataclasses.replace(settings, color_size_px=2 * side)


def _unwrapped(settings: Settings, manifest: Mapping[str, Any]) -> Settings | None:
    if settings.atlas != "auto" or manifest["atlas"]["mode"] == "unwrap":
        return None
    return dataclasses.replace(settings, atlas="unwrap")


@dataclass(frozen=True)
class Retry:
    """One way: what it is, in words; the kinds of findings it may mend; the settings it makes of others, if any."""

    words: str
    kinds: frozenset[str]
    change: Callable[[Settings, Mapping[str, Any]], Settings | None]


# Larger maps widen the gutters between charts too, counted in texels.
RETRIES = (
    Retry("position and weight maps twice as wide", SHAPE, _larger_geometry),
    Retry("normals and colours twice as wide", LOOK, _larger_colors),
    Retry("another atlas", SHAPE | LOOK, _unwrapped),
)


def next_retry(
    settings: Settings, manifest: Mapping[str, Any], findings: Sequence[Finding], used: Sequence[str]
) -> tuple[str, Settings] | None:
    """The next way, in words, and its settings; None where none is left or none is needed.

    Parameters
    ----------
    settings : Settings
        Of the last try.
    manifest : mapping
        Of the last try.
    findings : sequence of Finding
        About the last try.
    used : sequence of str
        Ways that were tried, in words.
    """
    wrong = {one.kind for one in findings if one.is_gross or (one.kind in SHAPE and not one.holds)}
    if len(used) >= MOST_RETRIES:
        return None
    for retry in RETRIES:
        if retry.words not in used and retry.kinds & wrong:
            changed = retry.change(settings, manifest)
            if changed is not None:
                return retry.words, changed
    return None
