"""Weights finer than their map: leaves are right where asked, come back from their image, and reach the records."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from preprocess.fit.shared_records import share_corners
from preprocess.fit.weight_quadtree import (
    WEIGHT_ALLOWED,
    WeightPoints,
    dense_leaves,
    detail_weights,
    pose_moves,
    sample_weights,
)
from preprocess.mesh.texels import sample_bilinear
from runtime.asset.texel_footprint import touched_cells
from runtime.asset.weight_quadtree import (
    WeightDetails,
    build_quadtree,
    details_size,
    no_details,
    pack_details,
    unpack_details,
)
from runtime.asset.weight_stack import pack_weights, unpack_weights
from runtime.errors import AssetError
from runtime.gpu.weight_records import MORE_RECORDS, RECORDS_WIDTH, WeightCells, build_weight_cells

NUM_JOINTS = 6
ALLOWED = 5e-4


def random_points(count: int, seed: int = 3, num_joints: int = NUM_JOINTS) -> WeightPoints:
    """Points of unrelated weights: no map of a few texels holds them."""
    rng = np.random.default_rng(seed)
    weights = np.zeros((count, num_joints))
    for row in weights:
        row[rng.choice(num_joints, 2, replace=False)] = (0.25, 0.75)
    uvs, positions = rng.uniform(0.05, 0.95, (count, 2)), rng.normal(size=(count, 3))
    return WeightPoints(uvs, weights, positions, np.ones(count, bool), np.full(count, ALLOWED))


def a_map(side: int, num_joints: int = NUM_JOINTS) -> tuple[np.ndarray, np.ndarray]:
    """A stored stack and its dense weights."""
    dense = np.zeros((side, side, num_joints))
    dense[..., 0] = np.linspace(0, 1, side)
    dense[..., 1] = 1 - dense[..., 0]
    packed = pack_weights(dense)
    return packed.stack, unpack_weights(packed.stack, packed.size, num_joints)


def at_rest(num_joints: int = NUM_JOINTS) -> np.ndarray:
    return pose_moves(np.tile(np.eye(4), (1, num_joints, 1, 1)), 1.0)


@pytest.fixture(scope="module")
def fitted() -> tuple[np.ndarray, np.ndarray, WeightPoints, WeightDetails]:
    stack, stored = a_map(8)
    points = random_points(60)
    return stack, stored, points, detail_weights(stored, points, at_rest())


def test_vertices_get_their_weights(fitted) -> None:  # type: ignore[no-untyped-def]
    _, stored, points, details = fitted
    assert np.abs(sample_bilinear(stored, points.uvs) - points.weights).max() > 0.5
    assert np.abs(sample_weights(stored, details, points.uvs) - points.weights).max() <= WEIGHT_ALLOWED * ALLOWED
    assert details.depths.max() >= 1
    assert (details.weights.sum(axis=2) == 255).all()


def test_a_right_map_needs_no_details() -> None:
    _, stored = a_map(8)
    points = random_points(40)
    exact = dataclasses.replace(points, weights=sample_bilinear(stored, points.uvs))
    details = detail_weights(stored, exact, at_rest())
    assert len(details.depths) == 0
    assert np.array_equal(sample_weights(stored, details, points.uvs), sample_bilinear(stored, points.uvs))


def test_leaves_cover_their_cells_once(fitted) -> None:  # type: ignore[no-untyped-def]
    _, _, _, details = fitted
    deepest = int(details.depths.max())
    finest = np.zeros((7 << deepest, 7 << deepest), int)
    for depth, (x, y) in zip(details.depths, details.places):
        step = 1 << (deepest - depth)
        finest[y * step : (y + 1) * step, x * step : (x + 1) * step] += 1
    blocks = finest.reshape(7, 1 << deepest, 7, 1 << deepest)
    assert finest.max() == 1
    assert ((blocks.min(axis=(1, 3)) == 1) | (blocks.max(axis=(1, 3)) == 0)).all()


@pytest.mark.parametrize("wide", [False, True])
def test_the_image_holds_everything(fitted, wide: bool) -> None:  # type: ignore[no-untyped-def]
    details = fitted[3]
    image = pack_details(details, wide)
    assert image.shape[1::-1] == details_size(len(details.depths), details.joints.shape[-1])
    back = unpack_details(image, len(details.depths), "image")
    for field in ("depths", "places"):
        assert np.array_equal(getattr(back, field), getattr(details, field))
    assert np.array_equal(dense_leaves(back, NUM_JOINTS), dense_leaves(details, NUM_JOINTS))


def test_damaged_details_are_refused(fitted) -> None:  # type: ignore[no-untyped-def]
    details = fitted[3]
    image = pack_details(details, False)
    image[: len(image) // 3] = 0
    image[len(image) // 3 : 2 * len(image) // 3] = 0
    with pytest.raises(AssetError, match="damaged"):
        unpack_details(image, len(details.depths), "image")
    deep = int(np.flatnonzero(details.depths > 0)[0])
    keep = np.arange(len(details.depths)) != deep
    with pytest.raises(AssetError, match="quarters"):
        build_quadtree(WeightDetails(*(getattr(details, f.name)[keep] for f in dataclasses.fields(details))))
    twice = np.r_[np.arange(len(details.depths)), 0]
    with pytest.raises(AssetError):
        build_quadtree(WeightDetails(*(getattr(details, f.name)[twice] for f in dataclasses.fields(details))))


def read_records(cells: WeightCells, uv: np.ndarray, side: int, num_joints: int) -> np.ndarray:
    """What the shader makes of a place: find_record, then the palette's records, one point at a time."""
    px = np.clip(uv * side - 0.5, 0, side - 1)
    corner = np.minimum(px.astype(int), side - 2)
    x, y = px - corner
    record = int(cells.first_record[corner[1], corner[0]])
    flat = cells.records.reshape(-1, 4)
    while record >= cells.first_divided:
        right, below = int(x >= 0.5), int(y >= 0.5)
        x, y = 2 * x - right, 2 * y - below
        record = int(flat[record, right + 2 * below])
    shares = np.array([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    weights, left = np.zeros(num_joints), 1.0
    while True:
        words = flat[record]
        joints = [int(words[0]) >> (8 * k) & 255 for k in range(4)]
        more = joints[3] == MORE_RECORDS
        if cells.joints is not None:
            joints = [int(joint) for joint in cells.joints.reshape(-1, 4)[record]]
        for slot in range(3):
            given = sum(shares[k] * (int(words[1 + slot]) >> (8 * k) & 255) for k in range(4)) / 255
            weights[joints[slot]] += given
            left -= given
        if not more:
            weights[joints[3]] += left
            return weights
        record += 1


@pytest.mark.parametrize("num_joints", [NUM_JOINTS, 300])
def test_records_say_the_same_as_the_leaves(num_joints: int) -> None:
    stack, stored = a_map(8, num_joints)
    points = random_points(40, num_joints=num_joints)
    details = detail_weights(stored, points, at_rest(num_joints))
    cells = build_weight_cells(stack, (8, 8), num_joints, details)
    assert cells.records.shape[1] == RECORDS_WIDTH
    places = np.r_[points.uvs, np.random.default_rng(5).uniform(0, 1, (60, 2))]
    expected = sample_weights(stored, details, places)
    for uv, weights in zip(places, expected):
        assert np.abs(read_records(cells, uv, 8, num_joints) - weights).max() < 1e-12


def test_cells_that_nothing_reads_cost_nothing() -> None:
    rng = np.random.default_rng(1)
    dense = rng.dirichlet(np.ones(3), (64, 64))
    packed = pack_weights(dense)
    triangle = np.array([(0.1, 0.1), (0.5, 0.12), (0.2, 0.4)])
    touched = touched_cells(triangle, np.array([(0, 1, 2)]), (64, 64))
    all_cells = build_weight_cells(packed.stack, (64, 64), 3)
    few = build_weight_cells(packed.stack, (64, 64), 3, no_details(), touched)
    assert few.first_divided == touched.sum() and few.records.nbytes < all_cells.records.nbytes / 5
    stored = unpack_weights(packed.stack, (64, 64), 3)
    for share in rng.dirichlet(np.ones(3), 20):
        uv = share @ triangle
        assert np.abs(read_records(few, uv, 64, 3) - sample_bilinear(stored, uv[None])[0]).max() < 1e-12


@pytest.mark.parametrize("mirrored", [False, True])
def test_touched_cells_are_those_with_points_of_the_triangles(mirrored: bool) -> None:
    rng = np.random.default_rng(7)
    uvs = rng.uniform(0, 1, (30, 2)) * 0.4 + rng.uniform(0, 0.6, (10, 1, 2)).repeat(3, axis=1).reshape(30, 2)
    faces = np.arange(30).reshape(10, 3)[:, :: -1 if mirrored else 1]
    touched = touched_cells(uvs, faces, (24, 16))
    assert touched.shape == (15, 23)
    places = np.einsum("sk,fki->fsi", rng.dirichlet(np.ones(3) * 0.7, 4000), uvs[faces]).reshape(-1, 2)
    px = np.clip(places * (24, 16) - 0.5, 0, (23, 15))
    corner = np.minimum(px.astype(int), (22, 14))
    found = np.zeros_like(touched)
    found[corner[:, 1], corner[:, 0]] = True
    assert (touched | ~found).all()
    assert (touched & ~found).sum() < 0.1 * touched.sum()
    lone = np.zeros((1, 3), int)
    assert touched_cells(uvs, lone, (24, 16)).sum() <= 4 and not touched_cells(uvs, lone[:0], (24, 16)).any()


def test_neighbours_share_what_suits_both() -> None:
    """Four quarters of a cell, and one of another: none takes from the other cell, however well that would do."""
    corners = np.arange(5.0)[:, None, None] * np.ones((5, 4, 2))
    places = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (2, 0)])
    depths = np.ones(5, int)
    leaf_of_point = np.arange(5)
    vertices = np.array([1, 0, 0, 0, 0])

    def suits(points: np.ndarray, leaves: np.ndarray) -> np.ndarray:
        return (points != 3) & (leaves != 1)

    shared = share_corners(corners, places, depths, leaf_of_point, vertices, suits)[:, 0, 0]
    assert shared[3] == 3 and shared[4] == 4  # picky, and alone
    assert set(shared[:3]) <= {0.0, 2.0, 3.0} and len(set(shared)) < 5
    nothing = share_corners(corners, places, depths, leaf_of_point, vertices, lambda points, leaves: points < 0)
    assert np.array_equal(nothing, corners)
    everything = share_corners(corners, places, depths, leaf_of_point, vertices, lambda points, leaves: points >= 0)
    assert len(np.unique(everything[:4, 0, 0])) == 1 and everything[4, 0, 0] == 4


@pytest.mark.parametrize("seed", range(5))
def test_shared_leaves_hold_corners_that_were_tried_on_all_their_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    finest = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2)
    corners = np.arange(64.0)[:, None, None] * np.ones((64, 4, 1))
    leaf_of_point = rng.integers(0, 64, 300)
    allowed = rng.random((300, 64)) < 0.8

    def suits(points: np.ndarray, leaves: np.ndarray) -> np.ndarray:
        return allowed[points, leaves]

    vertices = np.bincount(leaf_of_point, minlength=64)
    shared = share_corners(corners, finest, np.full(64, 1), leaf_of_point, vertices, suits)[:, 0, 0].astype(int)
    given = shared != np.arange(64)
    assert given.sum() > 10 and np.array_equal(shared[shared], shared)
    for point, leaf in enumerate(leaf_of_point):
        assert not given[leaf] or allowed[point, shared[leaf]]
    assert (finest[given] // 2 == finest[shared[given]] // 2).all()  # of the same cell
