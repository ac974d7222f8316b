"""Which figures of a measurement are beyond the goals, in words: one line a fault, with figure, goal and place.

Goals of geometry and normals are those of docs/drawing.md. Those of colours are far above what resampling costs on any
character here (docs/verify.md has the figures), and far below what a wrong texture, factor or material is off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from preprocess.verify.measure import Measurement, Spread

VERTEX_RMS_REL, VERTEX_MAX_REL = 2e-4, 2e-3
MIDDLE_RMS_REL = 2e-3
WEIGHT_RMS = 0.05
JOINT_MAX_REL = 1e-4
NORMAL_RMS_DEG = 1.0
COLOR_RMS, COLOR_MEAN = 8 / 255, 4 / 255
FACTOR_RMS, FACTOR_MEAN = 0.05, 0.02
LEAST_MATCHED = 0.5
# Normals and colours give way at seams and where the source is finer than the atlas: worth a warning beyond the goal,
# and another build beyond so many times the goal. A folder that is so far off is not sound, though its build said so.
GROSS = 3.0
SAME_REL, SAME_ABS = 1.05, 1e-6  # two measurements of one folder on two machines
LEAST_POINTS = 8  # of a material: fewer say nothing about what it has in common


@dataclass(frozen=True)
class Finding:
    """One figure that was judged.

    Attributes
    ----------
    kind : str
        "vertices", "middles", "weights", "joints", "outside", "matched", "normals", "base_color", "emission" or
        "surface_factors".
    text : str
        The figure, its goal, and where it is worst: one line.
    holds : bool
    is_gross : bool
        Whether it is beyond by so much that no warning makes up for it.
    is_told : bool
        Whether the build measured the same and warned of it.
    """

    kind: str
    text: str
    holds: bool
    is_gross: bool = False
    is_told: bool = False


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %"


def _of_shape(found: Measurement) -> Iterator[Finding]:
    spread = found.vertices
    yield Finding(
        "vertices",
        f"vertices of level 0, posed, are off by {_percent(spread.rms)} of the diagonal rms, "
        f"{_percent(spread.largest)} at most (goals {_percent(VERTEX_RMS_REL)}, {_percent(VERTEX_MAX_REL)}), "
        f"worst: {spread.worst}",
        spread.rms <= VERTEX_RMS_REL and spread.largest <= VERTEX_MAX_REL,
        spread.rms > GROSS * VERTEX_RMS_REL or spread.largest > GROSS * VERTEX_MAX_REL,
    )
    spread = found.middles
    yield Finding(
        "middles",
        f"middles of divided faces are off by {_percent(spread.rms)} rms (goal {_percent(MIDDLE_RMS_REL)}), "
        f"{_percent(spread.largest)} at most, worst: {spread.worst}",
        spread.rms <= MIDDLE_RMS_REL,
        spread.rms > GROSS * MIDDLE_RMS_REL,
    )
    spread = found.weights
    yield Finding(
        "weights",
        f"joint weights at vertices are off by {spread.rms:.3g} rms (goal {WEIGHT_RMS}), {spread.largest:.3g} at most, "
        f"worst: {spread.worst}",
        spread.rms <= WEIGHT_RMS,
        spread.rms > GROSS * WEIGHT_RMS,
    )
    spread = found.joints
    yield Finding(
        "joints",
        f"joints are off by {_percent(spread.largest)} at most (goal {_percent(JOINT_MAX_REL)}), worst: {spread.worst}",
        spread.largest <= JOINT_MAX_REL,
    )
    spread = found.outside
    yield Finding(
        "outside",
        f"vertices leave the manifest's boxes by {_percent(spread.largest)} (goal {_percent(VERTEX_MAX_REL)}), worst: "
        f"{spread.worst}",
        spread.largest <= VERTEX_MAX_REL,
    )
    yield Finding(
        "matched",
        f"{_percent(found.matched)} of the faces of level 0 are found on the source (goal {_percent(LEAST_MATCHED)})",
        found.matched >= LEAST_MATCHED,
    )


def _over_all(spreads: dict[str, Spread]) -> tuple[float, str, float, str]:
    """Rms over all points, the material that is furthest off; the largest mean of a material, and whose it is."""
    counted = {name: spread for name, spread in spreads.items() if spread.count >= LEAST_POINTS}
    total = sum(spread.count for spread in spreads.values())
    if not total or not counted:
        return 0.0, "none", 0.0, "none"
    rms = (sum(spread.count * spread.rms**2 for spread in spreads.values()) / total) ** 0.5
    worst = max(counted, key=lambda name: counted[name].rms)
    shifted = max(counted, key=lambda name: counted[name].mean)
    return rms, f"material {worst!r} ({{}})", counted[shifted].mean, f"material {shifted!r}"


def _of_look(found: Measurement) -> Iterator[Finding]:
    rms, worst, _, _ = _over_all(found.normals)
    each = max((s.rms for s in found.normals.values() if s.count >= LEAST_POINTS), default=0.0)
    yield Finding(
        "normals",
        f"normals are off by {rms:.2g} degrees rms (goal {NORMAL_RMS_DEG:g}), most in {worst.format(f'{each:.2g}')}",
        rms <= NORMAL_RMS_DEG,
        rms > GROSS * NORMAL_RMS_DEG,
    )
    for kind, label, goal_rms, goal_mean, unit in (
        ("base_color", "base colours", COLOR_RMS, COLOR_MEAN, 255.0),
        ("emission", "emission", FACTOR_RMS, FACTOR_MEAN, 1.0),
        ("surface_factors", "occlusion, roughness and metallic", FACTOR_RMS, FACTOR_MEAN, 1.0),
    ):
        spreads: dict[str, Spread] = getattr(found, kind)
        rms, worst, mean, shifted = _over_all(spreads)
        each = max((s.rms for s in spreads.values() if s.count >= LEAST_POINTS), default=0.0)
        of = " of 255" if unit == 255.0 else ""
        yield Finding(
            kind,
            f"{label}: off by {unit * rms:.2g}{of} rms (goal {unit * goal_rms:.2g}), most in "
            f"{worst.format(f'{unit * each:.2g}')}; on the mean by {unit * mean:.2g} (goal {unit * goal_mean:.2g}) in "
            f"{shifted}",
            rms <= goal_rms and mean <= goal_mean,
            rms > GROSS * goal_rms,
        )


def judge(found: Measurement) -> list[Finding]:
    """Every figure beside its goal, in the order in which they matter."""
    return [*_of_shape(found), *_of_look(found)]


def is_as_built(kind: str, found: Measurement, recorded: Any) -> bool:
    """Whether a kind of figure is no worse than what the build measured, as manifests have it: told, not hidden."""
    ours = as_json(found).get(kind)
    theirs = recorded.get(kind) if isinstance(recorded, dict) else None
    return isinstance(ours, dict) and isinstance(theirs, dict) and _no_worse(ours, theirs)


def _no_worse(ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """A spread, or spreads by material."""
    if "rms" not in ours:
        return ours.keys() == theirs.keys() and all(
            isinstance(theirs[name], dict) and _no_worse(spread, theirs[name]) for name, spread in ours.items()
        )
    figures = [theirs.get(key) for key in ("rms", "largest")]
    if not all(isinstance(figure, int | float) and not isinstance(figure, bool) for figure in figures):
        return False
    return all(ours[key] <= SAME_REL * theirs[key] + SAME_ABS for key in ("rms", "largest"))


def as_json(found: Measurement) -> dict[str, Any]:
    """A measurement as manifests have it."""
    return asdict(found)
