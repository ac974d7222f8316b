"""Decimation: hand-made cases with a proof of their answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from preprocess.arrays import Floats
from preprocess.decimate import (
    DecimateOptions,
    Lod,
    Strictness,
    decimate,
    decimate_to,
    floor_faces,
)
from preprocess.decimate.chain import _merged
from preprocess.decimate.levels import PEAK_WEIGHT
from preprocess.decimate.state import make_engine
from preprocess.mesh.surface import TexturedSurface
from tests.builders_decimate import box, square, two_strips, waves
from tests.builders_straighten import grid_faces, two_charts, weld_uvs
from tests.uv_measures import distance_to_segments, outline, uv_areas

EXACT = DecimateOptions(relaxed_px=0.0, min_faces=1)


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
    assert exact and relaxed and relaxed[-1].num_faces < chain.floor_faces
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
        # Nor is it a level for pictures of less than ten pixels.
        assert lod.error_m <= 0.1 * np.ptp(surface.positions, axis=0).max()
        assert any(f"{lod.num_faces} faces" in warning for warning in chain.warnings)
        assert (np.sign(uv_areas(lod.surface)) > 0).all()
    exact_only = decimate(surface, DecimateOptions(min_faces=4, relaxed_px=0.0))
    assert all(lod.exact for lod in exact_only.lods)


def test_relaxed_seams_let_charts_close_up() -> None:
    """Narrow strips: exact collapses keep two faces of each, relaxed ones merge what is narrower than allowed."""
    surface = strips(40)
    engine = make_engine(surface, DecimateOptions(peak_weight=PEAK_WEIGHT))
    engine.run_to(1)
    assert engine.num_faces >= 2 * 40
    engine.relax(0.05)
    engine.run_to(1)
    assert engine.num_faces < 40 and 0.0225 <= engine.deviation_uv <= 0.05
    lod = engine.snapshot()
    lod.surface.validate()
    edges = np.stack([lod.faces, np.roll(lod.faces, -1, axis=1)], axis=2).reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)  # an oriented manifold
    assert (np.sign(uv_areas(lod.surface)) > 0).all()


def strips(count: int) -> TexturedSurface:
    """A bent sheet of narrow strips beside each other, each a chart of its own."""
    across, along = 2 * count, 30
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, across + 1), np.linspace(0, 1, along + 1)))
    faces = grid_faces(across, along)
    strip = np.repeat(np.minimum((x[faces].mean(axis=1) * count).astype(int), count - 1)[:, None], 3, axis=1)
    corner_uvs = np.stack([0.9 * x[faces] + 0.002 * strip, 0.9 * y[faces]], axis=2)
    return weld_uvs(np.stack([x, y, 0.2 * np.sin(3.0 * x) * np.sin(2.0 * y)], axis=1), faces, corner_uvs)


def test_relaxed_levels_take_over_where_exact_ones_are_squeezed() -> None:
    def lod(num_faces: int, error_m: float, exact: bool) -> Lod:
        none = np.zeros((0, 2))
        faces = np.zeros((num_faces, 3), np.int32)
        return Lod(none, faces, faces, none, none, none, error_m=error_m, exact=exact)

    exact = [lod(100, 1.0, True), lod(70, 2.0, True), lod(50, 9.0, True)]
    near, far, barely = lod(60, 3.0, False), lod(30, 12.0, False), lod(75, 1.9, False)
    assert _merged(exact, [near, far]) == (exact[:2], [near, far])
    assert _merged(exact, [barely, far]) == (exact, [far])  # the exact one with 70 faces is as near
    assert _merged(exact, []) == (exact, [])


def test_drawn_position_is_the_textures() -> None:
    """Vertices that may not leave the position texture stand exactly where it draws them; cost is what is drawn."""
    surface = square(12, 0.3)
    v, u = np.mgrid[0:64, 0:64] / 64 + 0.5 / 64
    x, y = (u - 0.1) / 0.8, (v - 0.1) / 0.8
    texture = np.stack([x, y, 0.3 * np.sin(np.pi * x) * np.sin(np.pi * y)], axis=2)
    from preprocess.mesh.texels import sample_bilinear

    for lod in decimate(surface, replace(EXACT, lifted=False), position_texture=texture).lods:
        np.testing.assert_array_equal(lod.positions, sample_bilinear(texture, lod.uvs[lod.canonical_uvs]))


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
