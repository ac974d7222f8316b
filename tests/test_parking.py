"""Vertices that the position texture misses get texels of their own, outside every triangle of every level."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from preprocess.decimate import Lod
from preprocess.fit import spare_texels as parking
from preprocess.fit.spare_texels import _along_curve, free_texels, lie_beyond, park_vertices
from preprocess.mesh.texels import sample_bilinear, snap_canonical_uvs
from preprocess.settings import PARK_REL
from runtime.asset.texel_footprint import touched_cells

SIZE = WEIGHT_SIZE = (32, 32)
ALIKE = np.ones((13, 1))  # all on one joint


def crowded_level(seed: int = 0) -> Lod:
    """A fan of triangles in a corner of the atlas, its vertices far closer than texels, with unrelated positions."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    uvs = np.r_[[(0.3, 0.3)], 0.3 + 0.01 * np.c_[np.cos(angles), np.sin(angles)]]
    ring = np.arange(1, 13)
    faces = np.stack([np.zeros(12, int), ring, np.roll(ring, -1)], axis=1).astype(np.int32)
    return Lod(
        uvs=uvs,
        face_uvs=faces,
        faces=faces,
        canonical_uvs=np.arange(13, dtype=np.int32),
        face_source=np.zeros(12, np.int32),
        positions=rng.normal(size=(13, 3)),
        error_m=0.0,
    )


def test_parked_vertices_are_exact_and_others_stay() -> None:
    lod = crowded_level()
    texels = np.random.default_rng(1).normal(size=(*SIZE, 3)).astype(np.float32)
    wanted = lod.positions.copy()
    wanted[5] = sample_bilinear(texels, snap_canonical_uvs(lod.uvs[5:6]))[0]  # one that the texture has right
    stored, (fitted,) = park_vertices(texels, [lod], wanted, 1.0, [ALIKE], WEIGHT_SIZE)
    assert fitted.fetch_uvs is not None
    fetched = sample_bilinear(stored, fitted.fetch_uvs)
    assert np.array_equal(fetched, fitted.positions)
    assert np.abs(fetched - wanted).max() < 1e-5 and fitted.error_m < 1e-5
    assert np.array_equal(fitted.fetch_uvs[5], snap_canonical_uvs(lod.uvs)[5])
    assert len(np.unique(fitted.fetch_uvs, axis=0)) == 13
    assert np.array_equal(snap_canonical_uvs(fitted.fetch_uvs), fitted.fetch_uvs)


def test_nothing_that_triangles_read_changes() -> None:
    lod = crowded_level()
    texels = np.random.default_rng(1).normal(size=(*SIZE, 3)).astype(np.float32)
    stored, _ = park_vertices(texels, [lod], lod.positions, 1.0, [ALIKE], WEIGHT_SIZE)
    rows, columns = np.nonzero(touched_cells(lod.uvs, lod.face_uvs, SIZE))
    for y in (0, 1):
        for x in (0, 1):
            assert np.array_equal(stored[rows + y, columns + x], texels[rows + y, columns + x])
    assert (stored != texels).any(axis=2).sum() == 13


def test_free_texels_are_apart_from_triangles_and_the_edge() -> None:
    lod = crowded_level()
    free = free_texels([lod], SIZE, (8, 8))  # outermost cells end at three quarters of theirs
    assert len(np.unique(free, axis=0)) == len(free) > 500
    assert free.min() == 4 and free.max() == 27
    near = np.abs((free + 0.5) / 32 - 0.3).max(axis=1) < 0.01
    assert not near.any()


def test_without_room_the_error_says_so() -> None:
    lod = crowded_level()
    texels = np.zeros((2, 2, 3), np.float32)  # its one cell is read
    stored, (fitted,) = park_vertices(texels, [lod], lod.positions, 1.0, [ALIKE], WEIGHT_SIZE)
    assert np.array_equal(stored, texels)
    assert fitted.error_m > PARK_REL and np.isclose(fitted.error_m, np.linalg.norm(lod.positions, axis=1).max())


def test_vertices_in_one_place_keep_their_uvs() -> None:
    lod = crowded_level()
    lod.uvs[1] = (0.31, 0.3001)
    lod.uvs[2] = lod.uvs[1] + 1e-9
    texels = np.zeros((*SIZE, 3), np.float32)
    _, (fitted,) = park_vertices(texels, [lod], np.zeros((13, 3)), 1.0, [ALIKE], WEIGHT_SIZE)
    assert fitted.fetch_uvs is not None and np.array_equal(fitted.fetch_uvs, lod.uvs)


def test_what_is_alike_is_parked_in_one_cell_of_the_weight_map() -> None:
    lod = crowded_level()
    texels = np.zeros((*SIZE, 3), np.float32)
    weights = np.eye(3)[np.arange(13) % 3]
    _, (fitted,) = park_vertices(texels, [lod], lod.positions, 1.0, [weights], (9, 9))
    assert fitted.fetch_uvs is not None
    places = fitted.fetch_uvs * 9 - 0.5
    cells = np.floor(places)
    assert (cells == cells[0]).all()  # of 3.6 x 3.6 texels
    order = np.argsort(_along_curve(places - cells))
    assert (np.diff(np.arange(13)[order] % 3) >= 0).all()  # joint by joint, quarter by quarter


def test_where_room_is_short_those_that_no_weights_would_suit_go_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two free texels, eleven vertices far off, and two that are right but beyond the weight map, on unlike joints."""
    monkeypatch.setattr(parking, "free_texels", lambda *_: np.array([(20, 20), (21, 20)]))
    full = crowded_level()
    beyond = np.array([(0.01, 0.01), (0.02, 0.01)])
    uvs = np.r_[full.uvs[:-2], beyond]
    texels = np.random.default_rng(1).normal(size=(*SIZE, 3)).astype(np.float32)
    right = [sample_bilinear(texels, snap_canonical_uvs(places)) for places in (full.uvs, beyond)]
    coarse = dataclasses.replace(full, uvs=uvs, positions=np.r_[full.positions[:-2], right[1]])
    weights = [np.tile((1.0, 0.0), (13, 1)), np.r_[np.tile((1.0, 0.0), (12, 1)), [(0.0, 1.0)]]]
    _, (_, fitted) = park_vertices(texels, [full, coarse], right[0], 1.0, weights, WEIGHT_SIZE)
    assert fitted.fetch_uvs is not None
    moved = (fitted.fetch_uvs != snap_canonical_uvs(uvs)).any(axis=1)
    assert np.flatnonzero(moved).tolist() == [11, 12]


def test_points_beyond_the_weight_map_are_found_where_weights_differ() -> None:
    """A map of 4 x 4 texels: centres from 1/8 to 7/8 of the atlas, beyond which it clamps."""
    uvs = np.array([(0.05, 0.2), (0.2, 0.2), (0.5, 0.99), (0.95, 0.6), (0.8, 0.6), (0.5, 0.5)])
    weights = np.array([(1, 0), (0, 1), (1, 0), (0.5, 0.5), (0.51, 0.49), (0, 1)], float)
    assert lie_beyond(uvs, weights, (4, 4)).tolist() == [True, False, False, False, False, False]
    assert not lie_beyond(uvs[1:2], weights[1:2], (4, 4)).any()
