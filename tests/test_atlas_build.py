"""Which atlas is chosen and why, what is refused, and whether every part of the test characters has its texels."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from builders_atlas import patch, skinned, tetrahedron
from conftest import asset

from preprocess.atlas import MODES, build_atlas, character_atlas
from preprocess.atlas.detail import COARSEST, Detail, find_levels
from preprocess.atlas.distortion import turned_areas
from preprocess.atlas.flatten import local_triangles
from preprocess.atlas.measure import measure_coverage, measure_stretch, straight_share
from preprocess.atlas.part_overlaps import part_overlaps
from preprocess.atlas.snap import bear_snapping
from preprocess.errors import InputError
from preprocess.mesh.predicates import face_orientation
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.texels import snap_canonical_uvs
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.settings import Settings


def square_patch(cells: int = 16) -> SkinnedMesh:
    """A patch whose uvs are its own x and y, a little inside the square."""
    positions, faces = patch(cells, cells, 0.02)
    mesh = skinned(positions, faces, 0.05 + 0.9 * positions[:, :2], faces)
    return dataclasses.replace(mesh, corner_texcoords=mesh.surface.uvs[mesh.surface.face_uvs][:, :, None])


def with_uvs(mesh: SkinnedMesh, uvs: np.ndarray) -> SkinnedMesh:
    return mesh.with_surface(dataclasses.replace(mesh.surface, uvs=uvs))


def two_patches(shift: tuple[float, float]) -> SkinnedMesh:
    """Two open patches, their uvs half the square wide, the second one's shifted."""
    positions, faces = patch(8, 8)
    uvs = 0.02 + 0.45 * positions[:, :2]
    both = np.concatenate([positions, positions + np.array([3, 0, 0])])
    face_uvs = np.concatenate([faces, faces + len(positions)])
    return skinned(both, face_uvs, np.concatenate([uvs, uvs + shift]), face_uvs)


def test_auto_keeps_sound_uvs_bit_by_bit_when_nothing_needs_straightening():
    mesh = square_patch()
    atlas = build_atlas(mesh, straighten_rel=None)
    assert (atlas.mode, atlas.num_charts, atlas.overlap, atlas.resampled) == ("keep", 1, 0, False)
    assert atlas.mesh.surface.uvs.tobytes() == mesh.surface.uvs.tobytes()
    assert atlas.coverage == pytest.approx(0.81, rel=1e-4)
    assert atlas.report == {} and atlas.kept_share == 1.0
    assert not atlas.made_seams.any()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_auto_lays_out_anew_what_is_not_finite(value):
    mesh = square_patch()
    uvs = mesh.surface.uvs.copy()
    uvs[5] = value
    atlas = build_atlas(with_uvs(mesh, uvs))
    assert atlas.overlap == 0 and "not finite" in atlas.report["not_chosen"][0]


def test_auto_unwraps_uvs_at_one_point():
    mesh = square_patch()
    atlas = build_atlas(with_uvs(mesh, np.full_like(mesh.surface.uvs, 0.3)))
    assert atlas.mode == "unwrap" and atlas.overlap == 0


def test_auto_unwraps_a_folded_chart():
    mesh = square_patch()
    uvs = mesh.surface.uvs.copy()
    uvs[:, 0] = np.abs(uvs[:, 0] - 0.5)  # mirrored at the middle: each texel twice
    atlas = build_atlas(with_uvs(mesh, uvs))
    assert atlas.mode in ("repack", "unwrap") and atlas.overlap == 0


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.2, 0.1), (1.0, 0.0), (-3.25, 7.5)])
def test_auto_repacks_sound_charts_that_overlap_or_lie_outside(shift):
    mesh = two_patches(shift)
    assert build_atlas(two_patches((0.5, 0.0))).mode == "keep"
    atlas = build_atlas(mesh, detail=painted(mesh, 1024))
    assert (atlas.mode, atlas.num_charts, atlas.overlap, atlas.kept_share) == ("repack", 2, 0, 1.0)
    uvs = atlas.mesh.surface.uvs
    assert uvs.min() >= 0 and uvs.max() <= 1


def painted(mesh: SkinnedMesh, size_px: int) -> Detail:
    """As if one image of this size were painted to the last texel."""
    corners = mesh.surface.uvs[mesh.surface.face_uvs] * size_px
    areas = turned_areas(local_triangles(mesh.surface.positions, mesh.surface.faces))
    needs = {"base_color": np.sqrt(np.abs(turned_areas(corners)) / areas)}
    return Detail(needs, np.full((mesh.num_faces, 2), float(size_px)), {"base_color": size_px})


def test_parts_that_share_texels_get_texels_of_their_own():
    """Two halves on one 1024² sheet need two sheets' worth: a side of 1024 · √2 at least, for the same density."""
    apart, stacked = two_patches((0.5, 0.0)), two_patches((0.0, 0.0))
    assert build_atlas(apart, detail=painted(apart, 1024)).sides == {"base_color": 1024}
    grown = dataclasses.replace(stacked.surface, uvs=(stacked.surface.uvs - 0.02) * 2)  # each on nearly all of it
    mesh = stacked.with_surface(grown)
    atlas = build_atlas(mesh, detail=painted(mesh, 1024))
    assert atlas.sides == {"base_color": 2048}
    before, after = (np.abs(turned_areas(m.surface.uvs[m.surface.face_uvs])).sum() for m in (mesh, atlas.mesh))
    assert after * 2048**2 >= before * 1024**2 * 0.86, "at most 7 % fewer texels a metre"


def test_what_does_not_fit_is_said():
    mesh = two_patches((0.0, 0.0))
    atlas = build_atlas(mesh, detail=painted(mesh, 8192))
    assert atlas.sides == {"base_color": 4096}
    assert any("would keep every texel" in warning for warning in atlas.warnings)


def test_auto_repacks_charts_that_share_texels():
    mesh = two_patches((0.45 + 0.5 / 1024, 0.0))  # half a texel apart
    assert find_overlap(mesh.surface.uvs, mesh.surface.face_uvs).one_to_one
    atlas = build_atlas(mesh, detail=painted(mesh, 1024))
    assert atlas.mode == "repack"
    assert "share" in atlas.report["not_chosen"][0]


def test_keep_is_honoured_even_with_overlap_and_says_so():
    atlas = build_atlas(two_patches((0.0, 0.0)), mode="keep")
    assert atlas.mode == "keep" and atlas.overlap > 0
    assert any("overlap" in warning for warning in atlas.warnings)


@pytest.mark.parametrize("mode", ["keep", "repack"])
def test_keep_and_repack_refuse_what_they_cannot_do_in_one_line(mode):
    bare = skinned(*tetrahedron())
    lost = with_uvs(square_patch(), np.full_like(square_patch().surface.uvs, np.nan))
    for mesh in (bare, lost):
        with pytest.raises(InputError, match="unwrap") as error:
            build_atlas(mesh, mode=mode)
        assert "\n" not in str(error.value)
    outside = with_uvs(square_patch(), square_patch().surface.uvs + 5)
    if mode == "keep":
        with pytest.raises(InputError, match="leave the unit square"):
            build_atlas(outside, mode=mode)
    else:
        assert build_atlas(outside, mode=mode).overlap == 0


def test_wrong_mode_and_empty_mesh():
    with pytest.raises(ValueError, match="none of"):
        build_atlas(square_patch(), mode="best")
    empty = skinned(np.zeros((1, 3)), np.zeros((0, 3), int))
    for mode in MODES:
        with pytest.raises(InputError, match="no faces"):
            build_atlas(empty, mode=mode)


def test_three_faces_at_an_edge_are_refused():
    positions = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0.0]])
    with pytest.raises(InputError, match="three or more faces"):
        build_atlas(skinned(positions, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])), mode="unwrap")


def test_made_seams_are_those_the_source_does_not_have():
    mesh = square_patch()
    atlas = build_atlas(mesh, mode="unwrap")
    assert atlas.num_charts > 1 and atlas.made_seams.any()
    # The source's texture coordinates are continuous, so every cut edge inside the patch is one we made.
    from preprocess.mesh.seams import find_seams

    seams = find_seams(atlas.mesh.surface)
    assert atlas.made_seams.sum() == 2 * len(seams.vertices)


def test_measures_of_a_square_by_hand():
    uvs = np.array([[0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    flat = TexturedSurface(np.c_[2 * uvs, np.zeros(4)], faces, uvs, faces)
    assert measure_stretch(flat) == pytest.approx((1.0, 1.0))
    assert measure_coverage(flat) == pytest.approx(0.25)
    assert straight_share(flat) == 1.0
    # Twice as wide on the surface as in uv: singular values √2 and 1/√2 after normalising the area.
    wide = dataclasses.replace(flat, positions=flat.positions * [2, 1, 1])
    assert measure_stretch(wide) == pytest.approx((np.sqrt(1.25), np.sqrt(2)))
    squashed = dataclasses.replace(flat, uvs=uvs * [1, 0])
    assert measure_stretch(squashed) == (np.inf, np.inf)


def test_faces_that_overlap_by_a_texel_are_parted_and_the_rest_stays():
    """Two patches whose borders cross by a texel of 1024 at one vertex."""
    mesh = two_patches((0.5, 0.0))
    uvs = mesh.surface.uvs.copy()
    near = np.argmin(np.abs(uvs - (0.47, 0.245)).sum(axis=1))  # the middle of the first one's right border
    uvs[near, 0] = 0.52 + 1 / 1024
    crossed = with_uvs(mesh, uvs)
    assert 1 <= find_overlap(uvs, mesh.surface.face_uvs).num_pairs <= 4
    parted = part_overlaps(uvs, mesh.surface.face_uvs)
    assert parted is not None and find_overlap(parted, mesh.surface.face_uvs).one_to_one
    assert (parted != uvs).any(axis=1).sum() <= 8 and np.abs(parted - uvs).max() < 2 / 1024
    assert part_overlaps(mesh.surface.uvs, mesh.surface.face_uvs).tobytes() == mesh.surface.uvs.tobytes()
    assert part_overlaps(two_patches((0.0, 0.0)).surface.uvs, mesh.surface.face_uvs) is None
    assert build_atlas(crossed, straighten_rel=None).overlap == 0


def test_stored_uvs_do_not_overlap_where_rounding_would_turn_a_face():
    """A needle a tenth of a step wide, in the middle of a kept chart."""
    step = 1.0 / 65535.0
    uvs = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.5], [0.5 + 0.04 * step, 0.1 + 0.06 * step], [0.1, 0.9], [0.9, 0.9]])
    faces = np.array([[0, 3, 2], [3, 1, 2], [0, 2, 4], [1, 5, 2], [2, 5, 4], [0, 1, 3]], np.int32)
    positions = np.c_[uvs, np.zeros(6)]
    for v in (uvs, uvs + 0.3 * step):
        moved = bear_snapping(v, faces)
        assert not (face_orientation(snap_canonical_uvs(moved), faces) == 0).any()
        assert find_overlap(snap_canonical_uvs(moved), faces).one_to_one
        assert np.abs(moved - v).max() < 4 * step
    assert build_atlas(skinned(positions, faces, uvs, faces), straighten_rel=None).overlap == 0
    square = square_patch().surface
    assert (bear_snapping(square.uvs, square.face_uvs) == square.uvs).all()


@pytest.mark.parametrize("kind", ("flat", "ramp", "line", "noise"))
def test_levels_say_where_a_coarser_mip_looks_the_same(kind):
    """Flat and evenly rising colours may be halved to the end, except at the border; a line not at all where it is."""
    texels = np.full((64, 64, 3), 0.5)
    if kind == "ramp":
        texels[:] = np.linspace(0.0, 0.25, 64)[None, :, None]
    if kind == "line":
        texels[20] = 1.0
    if kind == "noise":
        texels[:] = np.random.default_rng(0).uniform(size=(64, 64, 1))
    levels = find_levels(texels)
    assert levels.shape == (64, 64)
    if kind == "flat":
        assert (levels == COARSEST).all()
    if kind == "ramp":
        assert levels.min() >= 3
    if kind == "line":
        assert (levels[20] == 0).all() and (levels[40:] >= 3).all()
    if kind == "noise":
        assert levels.mean() < 0.2


# --- the test characters ----------------------------------------------------------------------------------------------

CHARACTERS = ("Fox", "lumberjack", "cat", "phoenix_bird", "robot", "Knight", "mannequiny", "human", "BrainStem")


@pytest.mark.parametrize("name", CHARACTERS)
def test_every_part_of_a_character_has_its_texels(name):
    """Without flags, as stored, at the size of its textures."""
    from preprocess.load import load_character

    character = load_character(asset(f"{name}.glb"))
    start = time.process_time()
    atlas = character_atlas(character, Settings())
    assert time.process_time() - start < 60, "bounded even with compilation on a slow machine"
    atlas.mesh.validate()
    surface = atlas.mesh.surface
    assert atlas.overlap == 0
    assert find_overlap(snap_canonical_uvs(surface.uvs), surface.face_uvs).one_to_one
    texels = atlas.texels
    assert texels["sparse_area"] <= 0.001 and texels["sparse_faces"] == 0
    assert texels["stretched_area"] <= 0.0011  # human: the source's own 0.00104
    assert texels["stretched_faces"] <= (52 if name == "human" else 8)  # of human's source, which is kept
    assert measure_stretch(surface)[0] < (1.4 if name == "human" else 1.3)
    assert atlas.coverage > (0.35 if atlas.mode == "keep" else 0.5)


def test_kept_human_is_nine_tenths_collapsible():
    from preprocess.load import load_character

    atlas = build_atlas(load_character(asset("human.glb")).mesh, mode="keep")
    assert atlas.straightened >= 0.9 and atlas.overlap == 0
