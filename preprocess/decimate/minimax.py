"""Errors evened out: a level is made a few times over, and each time the spots that were far off count more.

Polishing ends where no single change helps, which leaves some spots several times as far off as the rest, and the
largest error is theirs alone. What would help there is a vertex that some easy spot can spare. So witnesses near what
was far off get a larger weight, and the level is made again from the finer one: iterated reweighting, which makes least
squares approach the least maximum (Lawson 1961; Rice and Usow 1968). The nearest of the tries is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from preprocess.arrays import Floats
from preprocess.decimate.levels import Lod
from preprocess.decimate.measure import Distances, Reference, measure
from preprocess.decimate.state import Engine

TRIES = 2
# Spots up to this share of the largest distance are near enough: their weights stay.
EASY_REL = 0.6
# A witness takes the worst of so many samples around it.
NEIGHBOURS = 6


@dataclass(frozen=True)
class Try:
    """A level as it was made: the state to go on from, the level, and how far off it is (None: nobody asked)."""

    engine: Engine
    lod: Lod
    distances: Distances | None = None

    @property
    def largest_m(self) -> float:
        """Largest distance from the full mesh, metres; infinite where it was not measured."""
        return self.distances.largest_m if self.distances else np.inf


def make_level(engine: Engine, reference: Reference, target_faces: int) -> Try:
    """Collapse, polish and measure; the engine given is what is worked on."""
    engine.run_to(target_faces)
    engine.polish()
    engine.run_to(target_faces)  # where it was stuck, turned edges may have made room
    lod = engine.snapshot()
    return Try(engine, lod, measure(reference, lod))


def make_even_level(engine: Engine, reference: Reference, target_faces: int, tries: int = TRIES) -> Try:
    """The nearest of several tries at a level; the engine given stays as it is.

    Parameters
    ----------
    engine : Engine
        A finer level, whose witnesses all weigh alike.
    reference : Reference
        Of the same surface.
    target_faces : int
    tries : int
    """
    weights = np.ones(len(engine.mesh.points))
    best = last = make_level(engine.copy(), reference, target_faces)
    for _ in range(tries - 1):
        if last.distances:
            weights = weights * _growth(engine, last.distances)
        copy = engine.copy()
        copy.weigh_witnesses(weights)
        last = make_level(copy, reference, target_faces)
        best = min(best, last, key=lambda level: level.largest_m)
    best.engine.weigh_witnesses(np.ones(len(weights)))
    return best


def _growth(engine: Engine, distances: Distances) -> Floats:
    """What each witness's weight, of a squared distance, is to be multiplied with, (S,)."""
    ranks = range(1, min(NEIGHBOURS, len(distances.places)) + 1)
    _, near = cKDTree(distances.places).query(engine.witness_places(), k=ranks)
    worst = distances.each_m[near].max(axis=1)
    result: Floats = np.maximum(worst / max(EASY_REL * distances.largest_m, 1e-30), 1.0) ** 2
    return result
