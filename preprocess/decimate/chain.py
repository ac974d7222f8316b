"""Decimation as a stage: a chain of levels in one continuous run (paper, section 5; docs/method.md, section 5).

Each level is a simplification of the one before: the run goes on from full detail to the floor, and what is left at
each target is kept. The automatic chain halves the faces from level to level, in three steps where they are few.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from preprocess.decimate import rules
from preprocess.decimate.levels import PEAK_WEIGHT, Chain, DecimateOptions, Lod, Strictness
from preprocess.decimate.lower_bound import count_floor
from preprocess.decimate.measure import Distances, Reference, make_reference, measure
from preprocess.decimate.minimax import Try, make_even_level, make_level
from preprocess.decimate.state import ROUNDING_UV, Engine, make_engine
from preprocess.decimate.topology import build_half_edges, source_uvs
from preprocess.errors import InputError
from preprocess.mesh.surface import TexturedSurface

log = logging.getLogger(__name__)

# A level that would save less than this share of the one before is not worth its bytes.
MIN_SAVING_REL = 0.2
# A level whose error is this share of a coarser one's or more is not worth its bytes either.
AS_NEAR_REL = 0.9
# With at most so many faces there are two levels between each and its half: most actors of a crowd are drawn so.
FEW_FACES = 4000
STEPS_TO_HALF = 3
# Levels with at most this share of the faces are polished; above it witnesses are too few to tell more than quadrics.
POLISH_BELOW_REL = 0.3
# A level above it is polished where a face has so many witnesses, if that lowers its largest error.
DENSE_WITNESSES = 5
# With more of them a level is made once: a second time would take seconds for each.
MOST_WITNESSES_TWICE = 150_000
# The run may stop this far above the floor that the charts' corners set.
NEAR_FLOOR_REL = 2.0
# No level whose error is a larger share of the longest extent: where it were used, the character is ten pixels.
MAX_ERROR_REL = 0.1
# Relaxed levels end with about so many of the fewest faces that are asked for, of a level twice as coarse.
RELAXED_SHARE = math.sqrt(0.5)
# Error that a relaxed level may have, of the one before; of the extent, where that has none.
RELAXED_GROWTH = 1.25
LEAST_ERROR_REL = 1e-3


def _targets(num_faces: int, options: DecimateOptions) -> list[int]:
    """Face counts to aim at, finest first; the last automatic one is the floor itself."""
    if options.ratios is not None:
        for ratio in options.ratios:
            if not 0.0 < ratio <= 1.0:
                raise InputError(f"level ratio {ratio:g} is not above 0 and at most 1: give fractions of the faces")
        return sorted({max(1, round(ratio * num_faces)) for ratio in options.ratios}, reverse=True)
    levels = max(0, math.floor(math.log2(max(num_faces / max(options.min_faces, 1), 1.0))))
    halved = [num_faces / 2**level for level in range(levels + 2)]
    steps = [2.0 ** (step / STEPS_TO_HALF) for step in range(1, STEPS_TO_HALF)]
    between = [faces / step for faces in halved[1:-1] for step in steps if faces <= FEW_FACES]
    return sorted({max(1, round(faces)) for faces in (*halved, *between)}, reverse=True)


def _by_error(options: DecimateOptions | None) -> DecimateOptions:
    """Options for levels that are chosen by their largest error."""
    options = options or DecimateOptions()
    return options if options.peak_weight is not None else replace(options, peak_weight=PEAK_WEIGHT)


def check_target(target_faces: int, num_faces: int) -> None:
    """Refuse a number of faces that no decimation can reach.

    Raises
    ------
    InputError
        If it is below one or above the mesh's own.
    """
    if target_faces < 1:
        raise InputError(f"a target of {target_faces} faces is below one: give at least one face")
    if target_faces > num_faces:
        raise InputError(f"a target of {target_faces} faces is above the mesh's {num_faces}: give a smaller one")


def decimate_to(
    surface: TexturedSurface,
    target_faces: int,
    options: DecimateOptions | None = None,
    *,
    position_texture: NDArray[np.floating] | None = None,
    poses: NDArray[np.floating] | None = None,
) -> Chain:
    """One level with at most `target_faces` faces, or the floor.

    Parameters
    ----------
    surface : TexturedSurface
    target_faces : int
        Between one and the surface's number of faces.
    options, position_texture, poses
        See `decimate`.

    Returns
    -------
    Chain
        With one level; `blocked` says why it has more faces than asked for, if it has.

    Raises
    ------
    InputError
        If the target cannot be, or the surface has no faces or numbers that are not finite.
    """
    check_target(target_faces, len(surface.faces))
    engine = make_engine(surface, options or DecimateOptions(), position_texture, poses)
    engine.run_to(target_faces)
    if engine.num_faces > target_faces:
        engine.polish()
        engine.run_to(target_faces)  # turned edges may have made room
    stopped = engine.num_faces > target_faces
    blocked = engine.blocked() if stopped else {}
    return Chain((engine.snapshot(),), engine.num_faces if stopped else -1, blocked, engine.repairs)


def decimate_within(
    surface: TexturedSurface,
    error_m: float,
    options: DecimateOptions | None = None,
    *,
    position_texture: NDArray[np.floating] | None = None,
    poses: NDArray[np.floating] | None = None,
) -> Chain:
    """The coarsest level whose measured error is within a bound, to a twentieth of its faces.

    Parameters
    ----------
    surface : TexturedSurface
    error_m : float
        Above zero.
    options, position_texture, poses
        See `decimate`.

    Returns
    -------
    Chain
        With one level; its `blocked` is empty unless the floor was reached.

    Raises
    ------
    InputError
        If the bound is not above zero, or as `decimate`.
    """
    if not error_m > 0.0:
        raise InputError(f"an error of {error_m:g} m is not above zero: give a distance in metres")
    engine = make_engine(surface, _by_error(options), position_texture, poses)
    reference = make_reference(surface, poses)
    best = _measured(reference, engine.snapshot(), 0.0)
    target = engine.num_faces
    while True:
        target = min(math.floor(0.95 * target), target - 1)
        engine.run_to(target)
        lod = _measured(reference, engine.snapshot(), best.error_m)
        if lod.error_m > error_m or lod.num_faces >= best.num_faces:
            break
        best = lod
        if engine.num_faces > target:
            break
    stopped = engine.num_faces > target
    floor, blocked = (engine.num_faces, engine.blocked()) if stopped else (-1, {})
    return Chain((best,), floor, blocked, engine.repairs)


def _measured(reference: Reference, lod: Lod, at_least_m: float) -> Lod:
    """A level with its distances filled in; see `_with_distances`."""
    return _with_distances(lod, measure(reference, lod), at_least_m)


def _with_distances(lod: Lod, distances: Distances, at_least_m: float) -> Lod:
    """A level that says how far off it is; its error is no less than a finer level's, so selection is monotone."""
    return replace(
        lod,
        error_m=max(distances.largest_m, at_least_m),
        mean_error_m=distances.mean_m,
        normal_error_rad=distances.normal_rad,
    )


def _next_level(engine: Engine, reference: Reference, target: int, near_floor: float) -> Try:
    """Go on to a level: polished where witnesses can tell what is nearer, evened out where it has few faces."""
    watched = len(engine.mesh.points) > 0
    if watched and target <= POLISH_BELOW_REL * len(reference.surface.faces):
        twice = near_floor < target <= FEW_FACES and len(engine.mesh.points) <= MOST_WITNESSES_TWICE
        return (make_even_level if twice else make_level)(engine, reference, target)
    engine.run_to(target)
    if not watched or DENSE_WITNESSES * engine.num_faces > len(engine.mesh.points):
        return Try(engine, engine.snapshot())
    polished = make_level(engine.copy(), reference, target)
    lod = engine.snapshot()
    rough = Try(engine, lod, measure(reference, lod))
    return min(rough, polished, key=lambda level: level.largest_m)


@dataclass(frozen=True)
class _Attempt:
    """A relaxed level to be: the state that was reached, and what went for it."""

    engine: Engine
    num_dropped: int
    size_m: float


def _relaxed_attempt(engine: Engine, error_m: float, options: DecimateOptions) -> _Attempt:
    """Go on from a state as far as an error allows: collapses within it, then parts smaller than it, and so on."""
    copy = engine.copy()
    copy.relax(options.relaxed_px * error_m / engine.metres_per_uv)
    num_dropped, size_m = 0, 0.0
    while True:
        before = copy.num_faces
        copy.run_within(error_m)
        if options.drop_parts:
            gone, largest_m = copy.drop_parts(error_m)
            num_dropped, size_m = num_dropped + gone, max(size_m, largest_m)
        if copy.num_faces == before:
            return _Attempt(copy, num_dropped, size_m)


def _relaxed_levels(engine: Engine, reference: Reference, finest: Lod, options: DecimateOptions) -> list[Lod]:
    """Levels near the exact floor and below it, each with seams that stray by less than can be seen where it is used.

    A level is used where its error is about a pixel, and the mip level there has texels of about a pixel, so half a
    texel of that mip is half of the error, as a length on the surface. So here the error comes first: it grows from
    level to level, and each goes as far as it allows, in the surface, in the seams, and in the parts that are left out.
    Where the measured distance is larger after all, the level says so and is used from as much further away.
    """
    lods: list[Lod] = []
    last, dropped = finest, 0
    largest_m = MAX_ERROR_REL * reference.extent_m
    error_m = last.error_m
    while error_m < largest_m and last.num_faces > options.min_faces * RELAXED_SHARE:
        error_m = min(RELAXED_GROWTH * error_m, largest_m) if error_m > 0.0 else LEAST_ERROR_REL * reference.extent_m
        tried = _relaxed_attempt(engine, error_m, options)
        if tried.engine.num_faces > (1 - MIN_SAVING_REL) * last.num_faces:
            continue
        tried.engine.polish()
        strayed_uv = tried.engine.deviation_uv
        hidden_m = max(last.error_m, strayed_uv * engine.metres_per_uv / options.relaxed_px, tried.size_m)
        lod = _measured(reference, tried.engine.snapshot(), hidden_m)
        if lod.error_m > largest_m:
            continue
        engine, dropped = tried.engine, dropped + tried.num_dropped
        last = replace(
            lod,
            exact=strayed_uv <= ROUNDING_UV and not dropped,
            uv_bound_px=strayed_uv * options.texture_px,
            dropped_parts=dropped,
        )
        lods.append(last)
    return lods


def _merged(exact: list[Lod], relaxed: list[Lod]) -> tuple[list[Lod], list[Lod]]:
    """Exact levels, and relaxed ones from where no exact one with as few faces is as near."""
    relaxed = [
        lod
        for lod in relaxed
        if all(lod.error_m < AS_NEAR_REL * other.error_m for other in exact if other.num_faces <= lod.num_faces)
    ]
    return [lod for lod in exact if not relaxed or lod.num_faces > relaxed[0].num_faces], relaxed


def near_enough(lods: Sequence[Lod]) -> list[Lod]:
    """Levels, the finest first, but for those whose error is beyond `MAX_ERROR_REL`."""
    largest_m = MAX_ERROR_REL * float(np.ptp(lods[0].positions, axis=0).max())
    return [lod for number, lod in enumerate(lods) if number == 0 or lod.error_m <= largest_m]


def _useful(lods: list[Lod], relaxed: list[Lod]) -> tuple[list[Lod], list[Lod]]:
    """Those levels, exact and relaxed, that no coarser one is as near as: the others would not be chosen."""
    kept: list[Lod] = []
    for lod in reversed(lods + relaxed):
        if not kept or lod.error_m < AS_NEAR_REL * kept[-1].error_m or lod is lods[0]:
            kept.append(lod)
    numbers = {id(lod) for lod in kept}
    return [lod for lod in lods if id(lod) in numbers], [lod for lod in relaxed if id(lod) in numbers]


def decimate(
    surface: TexturedSurface,
    options: DecimateOptions | None = None,
    *,
    position_texture: NDArray[np.floating] | None = None,
    poses: NDArray[np.floating] | None = None,
    face_groups: NDArray[np.integer] | None = None,
) -> Chain:
    """A chain of levels of detail that share one set of textures, each measured against the full mesh.

    Parameters
    ----------
    surface : TexturedSurface
        Its seams should be straight (`preprocess.straighten` or an atlas made for it); where they are not, they stay.
    options : DecimateOptions
    position_texture : (H, W, 3) float, metres, or None
        What the vertices will be drawn at; the cost of a collapse is that of what is drawn.
    poses : (P, V, 3, 4) float or None
        Skinning matrix of every vertex of `surface` in each pose that counts besides the bind pose.
    face_groups : (F,) int or None
        Faces that are drawn differently (blended, double-sided): borders between groups stay where they are in uv,
        like seams.

    Returns
    -------
    Chain
        Level 0 is the full mesh (cleaned), unless `options.ratios` leaves it out. Relaxed levels come last and only
        in the automatic chain.

    Raises
    ------
    InputError
        If the surface has no faces, numbers that are not finite, or a ratio is not in (0, 1].
    """
    options = _by_error(options)
    engine = make_engine(surface, options, position_texture, poses, face_groups)
    reference = make_reference(surface, poses)
    may_relax = options.ratios is None and options.relaxed_px > 0 and options.strict is Strictness.SEAMLESS
    near_floor = NEAR_FLOOR_REL * engine.predict_floor() if may_relax else 0
    lods: list[Lod] = []
    relaxed: list[Lod] = []
    floor, blocked = -1, {}
    above_floor: tuple[Engine, Lod] | None = None
    for target in _targets(engine.num_faces, options):
        if above_floor is None and lods and target < near_floor:
            above_floor = engine.copy(), lods[-1]
        level = _next_level(engine, reference, target, near_floor)
        engine = level.engine
        last_error = lods[-1].error_m if lods else 0.0
        if not lods and not engine.mesh.counter[rules.COLLAPSES] and engine.shows_surface:
            lods.append(replace(level.lod, error_m=0.0, mean_error_m=0.0, normal_error_rad=0.0))
        elif not lods or options.ratios is not None or engine.num_faces <= (1 - MIN_SAVING_REL) * lods[-1].num_faces:
            lods.append(_with_distances(level.lod, level.distances or measure(reference, level.lod), last_error))
        if engine.num_faces > target:
            floor, blocked = engine.num_faces, engine.blocked()
            if above_floor is not None:
                # The last steps to the floor take what is left, at any cost; relaxed levels start before them.
                before, finest = above_floor
                relaxed = _relaxed_levels(before, reference, finest, options)
            break
    if options.ratios is None:
        lods, relaxed = _useful(*_merged(near_enough(lods), relaxed))
    lods += relaxed
    log.info("decimate: %d -> %s faces", len(surface.faces), ", ".join(str(lod.num_faces) for lod in lods))
    return Chain(tuple(lods), floor, blocked, engine.repairs)


def floor_faces(surface: TexturedSurface, tolerance_uv: float = ROUNDING_UV) -> int:
    """Faces at which no exact collapse can be left, from the charts' corners alone.

    A chart of Euler characteristic c whose outline keeps k corners has at least k - 2 c faces. The run may stop
    above it where a collapse would fold the mesh.

    Parameters
    ----------
    surface : TexturedSurface
    tolerance_uv : float

    Raises
    ------
    InputError
        See `decimate`.
    """
    half_edges, _ = build_half_edges(surface)
    return count_floor(half_edges, source_uvs(half_edges, surface), tolerance_uv)
