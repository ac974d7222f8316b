"""Decimation: hand-made cases with a proof of their answers, and what must hold of every level of every surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from preprocess.decimate import (
    Chain,
    DecimateOptions,
    Strictness,
    decimate,
    decimate_to,
    decimate_within,
    floor_faces,
)
from preprocess.decimate.vertex_cache import cache_order, miss_ratio
from preprocess.erase import erase, measure_seams
from preprocess.errors import InputError
from preprocess.mesh import Floats, TexturedSurface
from preprocess.obj import read_surface
from preprocess.seams import find_seams
from preprocess.straighten import straighten
from tests.builders_decimate import box, parts, square, two_strips, waves
from tests.builders_straighten import moebius, ring_in_square, tube, two_charts, with_dart

FAMILY: dict[str, Callable[[], TexturedSurface]] = {
    "square": lambda: square(8, 0.3),
    "box": lambda: box(6),
    "ball": lambda: box(6, 1.0),
    "ball, charts turned over": lambda: box(6, 1.0, mirrored=True),
    "parts": lambda: parts(box(4, 0.5), 3),
    "two charts": lambda: waves(straighten(two_charts(), 0.05).surface),
    "two charts, crooked": lambda: waves(two_charts()),
    "tube": lambda: straighten(tube(), 0.05).surface,
    "closed loop": lambda: straighten(ring_in_square(), 0.01).surface,
    "moebius": lambda: straighten(moebius(), 0.05).surface,
    "dart": lambda: waves(straighten(with_dart(), 0.05).surface),
}
EXACT = DecimateOptions(relaxed_px=0.0, min_faces=1)


@pytest.fixture(scope="module", params=list(FAMILY))
def case(request: pytest.FixtureRequest) -> tuple[TexturedSurface, Chain]:
    surface = FAMILY[request.param]()
    return surface, decimate(surface, EXACT)


def uv_areas(surface: TexturedSurface) -> Floats:
    corners = surface.uvs[surface.face_uvs]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def outline(surface: TexturedSurface) -> Floats:
    """uv segments of the silhouette, (S, 2 ends, 2)."""
    seams = find_seams(surface)
    return surface.uvs[np.concatenate([seams.uv_pairs.reshape(-1, 2), seams.boundary_uvs])]


def distance_to_segments(points: Floats, segments: Floats) -> Floats:
    start, line = segments[None, :, 0], (segments[:, 1] - segments[:, 0])[None]
    t = ((points[:, None] - start) * line).sum(2) / np.maximum((line**2).sum(2), 1e-300)
    nearest = start + np.clip(t, 0.0, 1.0)[..., None] * line
    return np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)


def partner(surface: TexturedSurface, points: Floats) -> Floats:
    """The other side's uv of points on seams, by linear interpolation along the seam edge they lie on."""
    seams = find_seams(surface)
    sides = surface.uvs[np.concatenate([seams.uv_pairs, seams.uv_pairs[:, ::-1]])]  # [edge, side, end, 2]
    start, line = sides[None, :, 0, 0], (sides[:, 0, 1] - sides[:, 0, 0])[None]
    t = ((points[:, None] - start) * line).sum(2) / (line**2).sum(2)
    t = np.clip(t, 0.0, 1.0)
    away = np.linalg.norm(points[:, None] - start - t[..., None] * line, axis=2)
    edge = away.argmin(axis=1)
    t = t[np.arange(len(points)), edge][:, None]
    return (1.0 - t) * sides[edge, 1, 0] + t * sides[edge, 1, 1]


# --- Properties of every level -----------------------------------------------------------------------------------


def test_levels_are_sound_meshes(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    for lod in chain.lods:
        lod.surface.validate()
        assert lod.owner_uvs.shape == (len(lod.positions),)
        # Compact, no face twice, each directed edge once: an oriented manifold.
        assert len(np.unique(lod.faces)) == len(lod.positions)
        assert len(np.unique(lod.face_uvs)) == len(lod.uvs)
        edges = np.stack([lod.faces, np.roll(lod.faces, -1, axis=1)], axis=2).reshape(-1, 2)
        assert len(np.unique(edges, axis=0)) == len(edges)
        # Every surface vertex is owned by one of its own copies.
        copies = set(zip(lod.faces.ravel().tolist(), lod.face_uvs.ravel().tolist(), strict=True))
        assert all((vertex, int(owner)) in copies for vertex, owner in enumerate(lod.owner_uvs))
        assert len(np.unique(lod.face_source)) == lod.num_faces
        assert 0 <= lod.face_source.min() and lod.face_source.max() < len(surface.faces)


def test_chart_outlines_stay(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    full = outline(surface)
    length = np.linalg.norm(full[:, 1] - full[:, 0], axis=1).sum()
    for lod in chain.lods:
        now = outline(lod.surface)
        assert np.linalg.norm(now[:, 1] - now[:, 0], axis=1).sum() == pytest.approx(length, rel=1e-9)
        between = np.concatenate([(1 - t) * now[:, 0] + t * now[:, 1] for t in (0.0, 0.21, 0.5, 0.83)])
        assert distance_to_segments(between, full).max() < 2e-9
        assert distance_to_segments(full.reshape(-1, 2), now).max() < 2e-9


def test_map_stays_one_to_one(case: tuple[TexturedSurface, Chain]) -> None:
    """The outline is the same and no triangle is turned over, so every point is covered once: equal areas prove it."""
    surface, chain = case
    full = uv_areas(surface)
    for lod in chain.lods:
        now = uv_areas(lod.surface)
        assert (np.sign(now) == np.sign(full[lod.face_source])).all()
        assert np.abs(now).min() > 1e-12
        assert np.abs(now).sum() == pytest.approx(np.abs(full).sum(), rel=1e-9)


def test_both_sides_of_seams_keep_their_timing(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    if not len(find_seams(surface).vertices):
        return
    for lod in chain.lods:
        seams = find_seams(lod.surface)
        sides = lod.uvs[seams.uv_pairs]
        for t in (0.0, 0.3, 0.5, 0.9, 1.0):
            first, second = ((1 - t) * sides[:, k, 0] + t * sides[:, k, 1] for k in range(2))
            if t not in (0.0, 1.0):  # at a corner another seam's partner is as near
                np.testing.assert_allclose(partner(surface, first), second, rtol=0, atol=5e-9)


def test_erased_textures_stay_seamless(case: tuple[TexturedSurface, Chain]) -> None:
    """The integral along a level's seams is that along the full mesh's, whose integrand is zero everywhere."""
    surface, chain = case
    seams = find_seams(surface)
    if not len(seams.vertices):
        return
    rows, columns = np.mgrid[0:48, 0:48]
    texels = np.sin(0.7 * columns + 0.4 * rows)[..., None] * 0.4 + 0.5
    erased = erase(texels, surface, seams).texels
    full = measure_seams(erased, surface, seams)
    for lod in chain.lods:
        now = measure_seams(erased, lod.surface, find_seams(lod.surface))
        assert np.max(now.max) <= np.max(full.max) + 1e-7


def test_errors_grow_and_faces_fall(case: tuple[TexturedSurface, Chain]) -> None:
    _, chain = case
    faces = [lod.num_faces for lod in chain.lods]
    errors = [lod.error_m for lod in chain.lods]
    assert faces == sorted(set(faces), reverse=True)
    assert errors == sorted(errors)
    assert chain.lods[0].error_m < 1e-12
    for lod in chain.lods:
        assert lod.exact and lod.uv_bound_px < 1e-5
        assert lod.mean_error_m <= lod.error_m


def test_two_runs_agree_to_the_bit(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    for lod, again in zip(chain.lods, decimate(surface, EXACT).lods, strict=True):
        for name in ("uvs", "face_uvs", "faces", "owner_uvs", "face_source", "positions"):
            assert getattr(lod, name).tobytes() == getattr(again, name).tobytes()
        assert (lod.error_m, lod.mean_error_m) == (again.error_m, again.mean_error_m)


def test_the_floor_is_the_charts_own(case: tuple[TexturedSurface, Chain]) -> None:
    surface, chain = case
    bound = floor_faces(surface)
    reached = decimate_to(surface, 1).floor_faces
    assert bound <= reached <= 1.15 * bound + 8
    assert chain.floor_faces in (-1, reached)


# --- Cases whose answers are proved by hand ------------------------------------------------------------------------


def test_straight_evenly_timed_seam_collapses() -> None:
    """The middle vertex is halfway on both sides: the two quads come down to two triangles each, 4 faces."""
    assert decimate_to(two_strips(), 1).lods[0].num_faces == 4 == floor_faces(two_strips())


@pytest.mark.parametrize(
    ("surface", "shape_too"),
    [
        (two_strips(0.5, 0.6), True),  # straight on both sides, but timed differently: seamless keeps it
        (two_strips(0.5, 0.5, bend=-0.05), False),  # crooked on one side: shape keeps it as well
    ],
)
def test_uneven_or_crooked_seams_do_not(surface: TexturedSurface, shape_too: bool) -> None:
    seamless = decimate_to(surface, 1)
    assert seamless.lods[0].num_faces == 6 == floor_faces(surface)  # nothing can go: every vertex is on the outline
    assert seamless.blocked["seam or boundary edge between two corners"] > 0
    shape = decimate_to(surface, 1, DecimateOptions(strict=Strictness.SHAPE))
    assert shape.lods[0].num_faces == (4 if shape_too else 6)
    none = decimate_to(surface, 1, DecimateOptions(strict=Strictness.NONE))
    assert none.lods[0].num_faces == 2  # outlines may shrink, but two charts joined along a seam stay two


def test_square_comes_down_to_two_triangles() -> None:
    """Four corners, collinear boundary, flat inside: k - 2 = 2."""
    chain = decimate_to(square(8), 1)
    assert chain.lods[0].num_faces == 2 == floor_faces(square(8))
    found, expected = chain.lods[0].positions, square(1).positions
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(expected, axis=0), atol=1e-12)


def test_box_comes_down_to_its_corners() -> None:
    """Six charts of four corners: 6 (4 - 2) = 12 faces, the eight corners of the cube, in place."""
    for surface in (box(6), box(6, mirrored=True)):
        lod = decimate_to(surface, 1).lods[0]
        assert lod.num_faces == 12 == floor_faces(surface)
        np.testing.assert_allclose(np.abs(lod.positions), 1.0, atol=1e-9)
        assert len(lod.positions) == 8 and len(lod.uvs) == 24


def test_tetrahedron_and_triangle_stay() -> None:
    """A triangle is its chart; collapsing an edge of a tetrahedron would leave two faces back to back."""
    triangle = TexturedSurface(
        np.eye(3),
        np.array([[0, 1, 2]], np.int32),
        np.array([[0, 0], [1, 0], [0, 1.0]]),
        np.array([[0, 1, 2]], np.int32),
    )
    assert decimate_to(triangle, 1).lods[0].num_faces == 1
    assert decimate(triangle).lods[-1].num_faces == 1
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]], np.int32)
    uvs = np.array([[0, 0], [0.4, 0], [0, 0.4], [0.5, 0.5], [0.9, 0.5], [0.5, 0.9], [0.5, 0], [0.9, 0], [0.5, 0.4]])
    uvs = np.concatenate([uvs, [[0, 0.5], [0.4, 0.5], [0, 0.9]]])
    tetrahedron = TexturedSurface(
        np.concatenate([np.zeros((1, 3)), np.eye(3)]),
        faces[:, ::-1].copy(),
        uvs,
        np.arange(12, dtype=np.int32).reshape(4, 3),
    )
    assert decimate_to(tetrahedron, 1).lods[0].num_faces == 4


def test_edge_between_two_outlines_stays() -> None:
    """A strip one quad wide: every edge across it joins its two long sides, which may never meet.

    The long sides are collinear, so their own vertices go, one triangle each: two faces are left.
    """
    surface = square(8)
    keep = np.flatnonzero(surface.uvs[surface.face_uvs][..., 1].max(axis=1) < 0.21)
    strip = TexturedSurface(surface.positions, surface.faces[keep], surface.uvs, surface.face_uvs[keep])
    assert decimate_to(strip, 1).lods[0].num_faces == 2


def test_relaxed_levels_say_how_much() -> None:
    surface = waves(two_charts(20, 0.004))
    chain = decimate(surface, DecimateOptions(min_faces=4, texture_px=512))
    exact = [lod for lod in chain.lods if lod.exact]
    relaxed = [lod for lod in chain.lods if not lod.exact]
    assert exact and relaxed and relaxed[0].num_faces < chain.floor_faces
    full = outline(surface)
    area = np.abs(uv_areas(surface)).sum()
    sides = np.cross(*np.moveaxis(np.diff(surface.positions[surface.faces], axis=1), 1, 0))
    metres_per_uv = np.sqrt(0.5 * np.linalg.norm(sides, axis=1).sum() / area)
    for lod in relaxed:
        now = outline(lod.surface)
        between = np.concatenate([(1 - t) * now[:, 0] + t * now[:, 1] for t in (0.0, 0.25, 0.5, 0.75)])
        strayed = distance_to_segments(between, full).max()
        assert 0.0 < strayed * 512 <= lod.uv_bound_px * (1 + 1e-9)
        # Half a texel of the mip it is seen at: half of its error, as a length on the surface.
        assert lod.uv_bound_px / 512 * metres_per_uv <= 0.5 * lod.error_m * (1 + 1e-9)
        # Nor is it a level for pictures of less than two pixels.
        assert lod.error_m <= 0.5 * np.ptp(surface.positions, axis=0).max()
        assert any(f"{lod.num_faces} faces" in warning for warning in chain.warnings)
        assert (np.sign(uv_areas(lod.surface)) > 0).all()
    exact_only = decimate(surface, DecimateOptions(min_faces=4, relaxed_px=0.0))
    assert all(lod.exact for lod in exact_only.lods)


def test_drawn_position_is_the_textures() -> None:
    """With a position texture the vertices stand exactly where it draws them, and cost is what is drawn."""
    surface = square(12, 0.3)
    v, u = np.mgrid[0:64, 0:64] / 64 + 0.5 / 64
    x, y = (u - 0.1) / 0.8, (v - 0.1) / 0.8
    texture = np.stack([x, y, 0.3 * np.sin(np.pi * x) * np.sin(np.pi * y)], axis=2)
    from preprocess.texels import sample_bilinear

    for lod in decimate(surface, EXACT, position_texture=texture).lods:
        np.testing.assert_array_equal(lod.positions, sample_bilinear(texture, lod.uvs[lod.owner_uvs]))


def test_poses_keep_what_bends() -> None:
    """A flat strip that one pose folds in the middle: in bind pose every vertex is free, so only the pose can tell."""
    surface = square(16)
    matrices = np.zeros((1, len(surface.positions), 3, 4))
    matrices[0, :, :, :3] = np.eye(3)
    upper = surface.positions[:, 1] > 0.5
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])  # a right angle about the line y = 1/2
    hinge = np.array([0, 0.5, 0])
    matrices[0, upper, :, :3] = turn
    matrices[0, upper, :, 3] = hinge - turn @ hinge
    target = 40

    def error(poses: Floats | None) -> float:
        lod = decimate_to(surface, target, EXACT, poses=poses).lods[0]
        from preprocess.decimate.measure import make_reference, measure

        return measure(make_reference(surface, matrices), lod).mean_m

    assert error(matrices) < 0.2 * error(None)


# --- Faults of the input -------------------------------------------------------------------------------------------


def with_faces(surface: TexturedSurface, faces: list[list[int]]) -> TexturedSurface:
    extra = np.array(faces, np.int32)
    first = len(surface.uvs)
    uvs = np.concatenate([surface.uvs, np.random.default_rng(1).uniform(2.0, 3.0, (extra.size, 2))])
    extra_uvs = np.arange(first, first + extra.size, dtype=np.int32).reshape(-1, 3)
    return TexturedSurface(
        surface.positions, np.concatenate([surface.faces, extra]), uvs, np.concatenate([surface.face_uvs, extra_uvs])
    )


def test_duplicates_degenerates_and_isolated_vertices_are_dropped_and_reported() -> None:
    surface = square(4)
    broken = with_faces(surface, [[0, 0, 1], surface.faces[3].tolist(), surface.faces[3][[2, 1, 0]].tolist()])
    broken = replace(broken, positions=np.concatenate([broken.positions, [[9.0, 9, 9]]]))
    chain = decimate_to(broken, 1)
    assert chain.lods[0].num_faces == 2
    assert chain.repairs.degenerate_faces == 1 and chain.repairs.duplicate_faces == 2
    assert chain.repairs.isolated_vertices == 1
    assert len(chain.warnings) == 3
    assert decimate_to(surface, 1).warnings == ()


def test_non_manifold_edges_and_vertices_are_split() -> None:
    """A fin on an inner edge: the edge has three faces and is cut; a bow tie's vertex is split; both run to a floor."""
    surface = square(4)
    fin = replace(surface, positions=np.concatenate([surface.positions, [[0.4, 0.4, 1.0]]]))
    edge = surface.faces[10][:2].tolist()
    chain = decimate(with_faces(fin, [[*edge, len(surface.positions)]]), EXACT)
    assert chain.repairs.split_edges == 1 and chain.repairs.split_vertices >= 1
    assert chain.lods[-1].num_faces < len(surface.faces)
    bow = TexturedSurface(
        np.array([[0, 0, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0.0]]),
        np.array([[0, 1, 2], [0, 3, 4]], np.int32),
        np.array([[0.5, 0.5], [0, 1], [0, 0], [1, 0], [1, 1.0]]),
        np.array([[0, 1, 2], [0, 3, 4]], np.int32),
    )
    chain = decimate_to(bow, 1)
    assert chain.repairs.split_vertices == 1 and chain.lods[0].num_faces == 2
    assert len(chain.lods[0].positions) == 6


def test_faces_that_are_flat_in_uv_or_space_do_no_harm() -> None:
    surface = square(6, 0.2)
    uvs, positions = surface.uvs.copy(), surface.positions.copy()
    uvs[8], positions[24] = uvs[9], positions[25]
    chain = decimate(replace(surface, uvs=uvs, positions=positions), EXACT)
    for lod in chain.lods:
        assert np.isfinite(lod.positions).all() and uv_areas(lod.surface).min() > -1e-12
    assert chain.lods[-1].num_faces <= 8


def test_bad_requests_are_refused_in_one_line() -> None:
    surface = square(2)
    empty = TexturedSurface(surface.positions, surface.faces[:0], surface.uvs, surface.face_uvs[:0])
    positions, uvs = surface.positions.copy(), surface.uvs.copy()
    positions[3, 1], uvs[2, 0] = np.nan, np.inf
    twice = replace(surface, faces=np.zeros_like(surface.faces))
    calls: list[tuple[Callable[[], object], str]] = [
        (lambda: decimate_to(surface, 0), "below one"),
        (lambda: decimate_to(surface, 9), "above the mesh's 8"),
        (lambda: decimate(surface, DecimateOptions(ratios=(0.5, 0.0))), "ratio"),
        (lambda: decimate(surface, DecimateOptions(ratios=(1.5,))), "ratio"),
        (lambda: decimate_within(surface, 0.0), "not above zero"),
        (lambda: decimate(empty), "no faces"),
        (lambda: decimate(replace(surface, positions=positions)), "1 positions are not finite"),
        (lambda: decimate(replace(surface, uvs=uvs)), "1 texture coordinates are not finite"),
        (lambda: decimate(twice), "every face uses a vertex twice"),
    ]
    for call, words in calls:
        with pytest.raises(InputError, match=words) as refusal:
            call()
        assert "\n" not in str(refusal.value)


# --- Options, the error bound, real characters ---------------------------------------------------------------------


def test_ratios_and_error_targets() -> None:
    surface = box(8, 1.0)
    chain = decimate(surface, DecimateOptions(ratios=(1.0, 0.5, 0.1)))
    assert [lod.num_faces for lod in chain.lods] == [768, 384, 76]
    close = decimate_within(surface, 0.02).lods[0]
    far = decimate_within(surface, 0.1).lods[0]
    assert close.error_m <= 0.02 < 0.1 and far.error_m <= 0.1
    assert far.num_faces < close.num_faces < 768
    # Not much coarser would have done: a tenth fewer faces are beyond the bound.
    coarser = decimate(surface, DecimateOptions(ratios=(0.85 * close.num_faces / 768,))).lods[0]
    assert coarser.error_m > 0.02


def test_cache_order_is_a_permutation_with_few_misses() -> None:
    faces = square(24).faces
    shuffled = faces[np.random.default_rng(0).permutation(len(faces))]
    order = cache_order(shuffled, int(faces.max()) + 1)
    assert np.sort(order).tolist() == list(range(len(faces)))
    assert miss_ratio(shuffled) > 1.5 and miss_ratio(shuffled[order]) < 0.8
    one = cache_order(np.array([[0, 1, 2]], np.int32), 3)
    assert one.tolist() == [0]


@pytest.mark.parametrize("name", ["human.glb", "Fox.glb", "blub.obj"])
def test_characters_reach_their_floor(name: str, asset_path: Callable[[str], Path]) -> None:
    surface = straighten(read_surface(asset_path(name)), 0.01).surface
    bound = floor_faces(surface)
    chain = decimate_to(surface, 1)
    assert bound <= chain.floor_faces <= 1.12 * bound
    lod = chain.lods[0]
    # Charts that are folded over in the source stay so; no other triangle turns over.
    before, now = uv_areas(surface), uv_areas(lod.surface)
    assert ((np.sign(now) == np.sign(before[lod.face_source])) | (np.abs(before[lod.face_source]) < 1e-9)).all()
    full = outline(surface)
    now_outline = outline(lod.surface)
    assert distance_to_segments(now_outline.reshape(-1, 2), full).max() < 1e-8


def test_small_parts_vanish_only_when_allowed_and_said() -> None:
    """A ball of 768 faces with 12 boxes of a twentieth of its size, which keep 12 faces each at exact seams."""
    ball, crumb = box(8, 1.0), box(1)
    pieces = [ball]
    for i in range(12):
        angle = 2.0 * np.pi * i / 12
        place = 1.1 * np.array([np.cos(angle), np.sin(angle), 0.0])
        pieces.append(replace(crumb, positions=0.03 * crumb.positions + place))
    starts = np.cumsum([0] + [len(piece.positions) for piece in pieces])
    uv_starts = np.cumsum([0] + [len(piece.uvs) for piece in pieces])
    surface = TexturedSurface(
        np.concatenate([piece.positions for piece in pieces]),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, starts)]).astype(np.int32),
        np.concatenate([piece.uvs / (13, 1) + (i / 13, 0) for i, piece in enumerate(pieces)]),
        np.concatenate([piece.face_uvs + start for piece, start in zip(pieces, uv_starts)]).astype(np.int32),
    )
    options = DecimateOptions(min_faces=8)
    chain = decimate(surface, options)
    dropping = [lod for lod in chain.lods if lod.dropped_parts]
    assert dropping and chain.floor_faces == 13 * 12
    for lod in dropping:
        assert not lod.exact and lod.error_m > 0.1  # a box's diagonal
        assert any(f"leaves out {lod.dropped_parts} small parts" in warning for warning in chain.warnings)
    kept = decimate(surface, replace(options, drop_parts=False))
    assert not any(lod.dropped_parts for lod in kept.lods) and not any("leaves out" in text for text in kept.warnings)


def test_borders_between_groups_stay() -> None:
    """Two halves of a square, drawn differently: the border is straight, so each half comes down to two faces."""
    surface = square(8, 0.1)
    groups = (surface.positions[surface.faces][:, :, 0].mean(axis=1) > 0.5).astype(np.int32)
    full = np.abs(uv_areas(surface))
    for lod in decimate(surface, EXACT, face_groups=groups).lods:
        now = np.abs(uv_areas(lod.surface))
        for group in range(2):
            assert now[groups[lod.face_source] == group].sum() == pytest.approx(full[groups == group].sum(), rel=1e-9)
    assert decimate(surface, EXACT, face_groups=groups).lods[-1].num_faces == 4


@pytest.mark.parametrize("seed", range(60))
def test_triangle_soup_does_no_harm(seed: int) -> None:
    """Random faces on few vertices and uvs: repeated, non-manifold, flat, overlapping. What comes out is manifold."""
    rng = np.random.default_rng(seed)
    num_vertices, num_faces, num_uvs = (int(rng.integers(low, high)) for low, high in ((3, 14), (1, 40), (1, 30)))
    positions, uvs = rng.normal(size=(num_vertices, 3)), rng.random((num_uvs, 2))
    if seed % 3 == 0:
        positions, uvs = np.round(positions), np.round(3 * uvs) / 3
    faces = rng.integers(0, num_vertices, (num_faces, 3)).astype(np.int32)
    face_uvs = rng.integers(0, num_uvs, (num_faces, 3)).astype(np.int32)
    if seed % 4 == 0 and num_uvs >= num_vertices:
        face_uvs = faces.copy()
    soup = TexturedSurface(positions, faces, uvs, face_uvs)
    options = DecimateOptions(min_faces=1, strict=list(Strictness)[seed % 3])
    try:
        chain = decimate(soup, options)
    except InputError as refusal:
        assert "uses a vertex twice" in str(refusal)
        return
    for lod in chain.lods:
        lod.surface.validate()
        again = decimate_to(lod.surface, lod.num_faces)
        assert again.repairs.split_edges == again.repairs.split_vertices == again.repairs.duplicate_faces == 0
