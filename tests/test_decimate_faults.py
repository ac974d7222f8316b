"""Decimation: faults of the input are repaired and reported, or refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from preprocess.decimate import (
    DecimateOptions,
    Strictness,
    decimate,
    decimate_to,
    decimate_within,
)
from preprocess.errors import InputError
from preprocess.mesh.surface import TexturedSurface
from tests.builders_decimate import square
from tests.uv_measures import uv_areas

EXACT = DecimateOptions(relaxed_px=0.0, min_faces=1)


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
