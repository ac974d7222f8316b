"""Which atlas is chosen and why, what is refused, and the floors of the test characters."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from builders_atlas import patch, skinned, tetrahedron, tube
from conftest import asset

from preprocess.atlas import MODES, build_atlas, default_floor
from preprocess.atlas.measure import measure_coverage, measure_stretch, straight_share
from preprocess.decimate import decimate_to
from preprocess.errors import InputError
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.mesh.uv_overlap import find_overlap


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
    assert atlas.coverage == pytest.approx(0.81)
    assert atlas.report["not_chosen"] == []
    assert not atlas.made_seams.any()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_auto_unwraps_uvs_that_are_not_finite(value):
    mesh = square_patch()
    uvs = mesh.surface.uvs.copy()
    uvs[5] = value
    atlas = build_atlas(with_uvs(mesh, uvs))
    assert atlas.mode == "unwrap" and atlas.overlap == 0
    assert [reason.split(":")[0] for reason in atlas.report["not_chosen"]] == ["keep", "repack"]


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
    atlas = build_atlas(mesh)
    assert (atlas.mode, atlas.num_charts, atlas.overlap) == ("repack", 2, 0)
    uvs = atlas.mesh.surface.uvs
    assert uvs.min() >= 0 and uvs.max() <= 1


def test_auto_repacks_charts_that_share_texels():
    mesh = two_patches((0.45 + 0.5 / 1024, 0.0))  # half a texel apart
    assert find_overlap(mesh.surface.uvs, mesh.surface.face_uvs).one_to_one
    atlas = build_atlas(mesh)
    assert atlas.mode == "repack"
    assert "share" in atlas.report["not_chosen"][0]


def test_auto_unwraps_when_seams_cannot_reach_the_floor():
    """Every face is a chart of its own: one-to-one, but nothing can ever collapse."""
    positions, faces = tube(16, 40, 10, closed=True)
    count = len(faces)
    cell = int(np.ceil(np.sqrt(count)))
    at = np.stack([np.arange(count) % cell, np.arange(count) // cell], axis=1)[:, None]
    corners = np.array([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8]])
    mesh = skinned(positions, faces, ((at + corners) / cell).reshape(-1, 2), np.arange(3 * count).reshape(-1, 3))
    kept = build_atlas(mesh, mode="keep")
    assert (kept.mode, kept.num_charts, kept.overlap) == ("keep", count, 0)
    atlas = build_atlas(mesh)
    assert atlas.mode == "unwrap"
    assert f"{count} charts keep a face each" in atlas.report["not_chosen"][0]
    assert len(decimate_to(atlas.mesh.surface, 200).lods[0].faces) <= 200


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


# --- the test characters ----------------------------------------------------------------------------------------------

CHARACTERS = ("human", "Fox", "Knight", "robot", "mannequiny")


@pytest.mark.parametrize("name", CHARACTERS)
def test_characters_reach_the_floor_without_flags(name):
    from preprocess.load import load_character

    mesh = load_character(asset(f"{name}.glb")).mesh
    start = time.process_time()
    atlas = build_atlas(mesh)
    assert time.process_time() - start < 60, "bounded even with compilation on a slow machine"
    atlas.mesh.validate()
    assert atlas.overlap == 0
    assert atlas.stretch_l2 < 1.5
    floor = default_floor(mesh.num_faces)
    assert floor == max(int(0.03 * mesh.num_faces), 200)
    assert len(decimate_to(atlas.mesh.surface, floor).lods[0].faces) <= floor


@pytest.mark.parametrize("name", ("human", "Fox"))
def test_base_mesh_atlas_of_sound_characters(name):
    """`unwrap` must do as well where `auto` does not need it."""
    from preprocess.load import load_character

    mesh = load_character(asset(f"{name}.glb")).mesh
    atlas = build_atlas(mesh, mode="unwrap")
    floor = default_floor(mesh.num_faces)
    assert atlas.overlap == 0
    assert atlas.stretch_l2 < 1.25
    assert atlas.coverage > 0.6
    assert len(decimate_to(atlas.mesh.surface, floor).lods[0].faces) <= floor


def test_kept_human_is_nine_tenths_collapsible():
    from preprocess.load import load_character

    atlas = build_atlas(load_character(asset("human.glb")).mesh, mode="keep")
    assert atlas.straightened >= 0.9 and atlas.overlap == 0
