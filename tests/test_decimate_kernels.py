"""Decimation's compiled kernels against slow and obvious twins."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import quadprog
from numba import njit

from preprocess.arrays import Floats
from preprocess.decimate.levels import DecimateOptions
from preprocess.decimate.lower_bound import count_floor
from preprocess.decimate.measure import make_reference, measure, sample_mesh
from preprocess.decimate.placement import draw_position, solve_joint
from preprocess.decimate.quadrics import FIRST, accumulate_faces, add_with_uv_held, evaluate_position
from preprocess.decimate.state import BOUNDARY_WEIGHT, make_engine
from preprocess.decimate.topology import NO_WEDGE, TAIL, TWIN, WEDGE, build_half_edges
from preprocess.mesh.closest_point import build_tree
from preprocess.mesh.skinning import make_skinning
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from tests.builders_decimate import box, parts, square, two_strips, waves
from tests.builders_straighten import moebius, ring_in_square, tube, with_dart

SURFACES = {
    "square": square(4, 0.3),
    "box": box(3, 0.5),
    "strips": two_strips(),
    "parts": parts(box(2), 2),
    "tube": tube(6, 2),
    "ring": ring_in_square(8),
    "dart": with_dart(6),
}


@njit
def call_solve_joint(links, xyz, uv, quadric, work, h, p0, q0, p1, q1, regularise, scale):  # type: ignore[no-untyped-def]
    return solve_joint(links, xyz, uv, quadric, work, h, p0, q0, p1, q1, regularise, scale)


@njit
def call_held(quadric, w, u, v, x, y, z):  # type: ignore[no-untyped-def]
    ten = np.zeros(10)
    add_with_uv_held(quadric, w, u, v, ten)
    return evaluate_position(ten, FIRST, x, y, z)


@njit
def call_draw(texture, u, v, point):  # type: ignore[no-untyped-def]
    draw_position(texture, u, v, point)


def unpack(row: Floats) -> tuple[Floats, Floats, float]:
    """A, b, c of a 5D quadric's 21 numbers."""
    matrix = np.zeros((5, 5))
    matrix[np.triu_indices(5)] = row[:15]
    matrix += np.triu(matrix, 1).T
    return matrix, row[15:20], float(row[20])


# --- Connectivity ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(SURFACES))
def test_half_edges_against_dictionaries(name: str) -> None:
    surface = SURFACES[name]
    half_edges, repairs = build_half_edges(surface)
    assert repairs.warnings() == ()
    num_faces, infinity = half_edges.num_faces, len(half_edges.vertex_source)
    vertices = half_edges.vertex_source[half_edges.tail[: 3 * num_faces]].reshape(-1, 3)
    np.testing.assert_array_equal(vertices, surface.faces)
    np.testing.assert_array_equal(
        surface.uvs[half_edges.wedge_source[half_edges.wedge[: 3 * num_faces]]].reshape(-1, 3, 2),
        surface.uvs[surface.face_uvs],
    )

    ahead = np.arange(len(half_edges.tail)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    head = half_edges.tail[ahead]
    directed = {
        (int(a), int(b)): h
        for h, (a, b) in enumerate(zip(half_edges.tail, head, strict=True))
        if infinity not in (a, b)
    }
    silhouettes = dict.fromkeys(range(infinity), 0)
    for (a, b), h in directed.items():
        twin = int(half_edges.twin[h])
        assert twin == directed[b, a] and half_edges.twin[twin] == h
        corners = {(half_edges.wedge[h], half_edges.wedge[ahead[twin]])}
        corners.add((half_edges.wedge[ahead[h]], half_edges.wedge[twin]))
        silhouettes[a] += any(one != other for one, other in corners)
    assert silhouettes == dict(enumerate(half_edges.num_silhouettes[:infinity].tolist()))
    virtual = half_edges.tail[3 * num_faces :].reshape(-1, 3)
    assert (virtual[:, 2] == infinity).all() and (half_edges.wedge[3 * num_faces :] == NO_WEDGE).all()
    np.testing.assert_array_equal(half_edges.twin[half_edges.twin], np.arange(len(half_edges.tail)))
    np.testing.assert_array_equal(half_edges.tail[ahead[half_edges.twin]], half_edges.tail)
    known = infinity + (1 if len(virtual) else 0)  # a closed surface has no virtual vertex
    np.testing.assert_array_equal(half_edges.tail[half_edges.out[:known]], np.arange(known))

    # Walks around a wedge's corner meet one fan: wedges are manifold in the parameter mesh.
    for wedge in range(len(half_edges.wedge_source)):
        corners_of = np.flatnonzero(half_edges.wedge == wedge)
        inner = sum(half_edges.wedge[ahead[half_edges.twin[h]]] == wedge for h in corners_of)
        assert inner >= len(corners_of) - 1


def test_non_orientable_surfaces_are_cut_open() -> None:
    """No orientation fits a Moebius strip: edges whose two faces disagree become boundaries, two sides each."""
    half_edges, repairs = build_half_edges(moebius(8, 2))
    assert repairs.split_edges == 2 and repairs.split_vertices == 3
    assert len(half_edges.tail) // 3 - half_edges.num_faces == 16 + 2 * 2


def test_floor_counts_corners() -> None:
    """k - 2 c by hand: a square 2; a cube 12; the tube's two rectangles 4 corners each, cut at the top and bottom."""
    for surface, faces in ((square(5), 2), (box(4), 12), (parts(box(2), 3), 36)):
        half_edges, _ = build_half_edges(surface)
        assert count_floor(half_edges, surface.uvs[half_edges.wedge_source], 1e-9) == faces


# --- Quadrics ----------------------------------------------------------------------------------------------------


def slow_quadrics(engine_links: np.ndarray, num_faces: int, xyz: Floats, uv: Floats, scale: float) -> Floats:
    """Sum of the faces' quadrics at each wedge, as (A, b, c) flattened to 21 numbers, with dense matrices."""
    rows = np.zeros((len(uv), 21))
    upper = np.triu_indices(5)
    for f in range(num_faces):
        corners = range(3 * f, 3 * f + 3)
        points = [np.r_[xyz[engine_links[h, TAIL]], scale * uv[engine_links[h, WEDGE]]] for h in corners]
        normal = np.cross(points[1][:3] - points[0][:3], points[2][:3] - points[0][:3])
        basis, _ = np.linalg.qr(np.stack([points[1] - points[0], points[2] - points[0]], axis=1))
        matrix = np.eye(5) - basis @ basis.T
        weight = np.linalg.norm(normal) / 6.0
        terms = np.r_[matrix[upper], -matrix @ points[0], points[0] @ matrix @ points[0]]
        for h in corners:
            rows[engine_links[h, WEDGE]] += weight * terms
            if engine_links[h, TWIN] >= 3 * num_faces:
                start, end = points[h - 3 * f], points[(h + 1) % 3]
                line = end[:3] - start[:3]
                across = np.cross(line, normal)
                across /= np.linalg.norm(across)
                side = np.r_[across, 0.0, 0.0]
                plane = np.r_[np.outer(side, side)[upper], -side * (side @ start), (side @ start) ** 2]
                for end_corner in (h, 3 * f + (h + 1) % 3):
                    rows[engine_links[end_corner, WEDGE]] += BOUNDARY_WEIGHT * (line @ line) * plane
    return rows


@pytest.mark.parametrize("name", ["square", "box", "strips", "tube"])
def test_face_quadrics_against_dense_matrices(name: str) -> None:
    mesh = make_engine(SURFACES[name], DecimateOptions()).mesh
    num_faces = len(mesh.faces)
    quick = np.zeros_like(mesh.quadric)
    accumulate_faces(
        mesh.links, num_faces, mesh.xyz, mesh.uv, 0.3, BOUNDARY_WEIGHT, quick, np.zeros((3, 5)), np.zeros((2, 5))
    )
    np.testing.assert_allclose(quick, slow_quadrics(mesh.links, num_faces, mesh.xyz, mesh.uv, 0.3), atol=1e-13)


def test_holding_the_uv_changes_no_value() -> None:
    rng = np.random.default_rng(0)
    quadric = rng.normal(size=(4, 21))
    for _ in range(20):
        w, point = int(rng.integers(4)), rng.normal(size=5)
        matrix, b, c = unpack(quadric[w])
        x, y, z, u, v = point
        expected = point @ matrix @ point + 2 * b @ point + c
        assert call_held(quadric, w, u, v, x, y, z) == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_drawn_position_follows_the_texel_rule() -> None:
    rng = np.random.default_rng(1)
    for height, width in ((1, 1), (1, 5), (4, 1), (7, 9)):
        texture = rng.normal(size=(height, width, 3))
        uvs = np.r_[rng.uniform(-0.2, 1.2, (50, 2)), [[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]]]
        quick = np.zeros((len(uvs), 3))
        for (u, v), point in zip(uvs, quick, strict=True):
            call_draw(texture, u, v, point)
        np.testing.assert_allclose(quick, sample_bilinear(texture, uvs), atol=1e-14)


# --- The quadratic program of seam edges ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(40))
def test_joint_placement_equals_the_quadratic_program(seed: int) -> None:
    """Goldfarb and Idnani's method on the paper's ten unknowns finds the same point and parameter, to 1e-9.

    Unknowns (x1, y1, z1, u1, v1, x2, y2, z2, u2, v2), equal positions, each uv on its line at one common fraction t,
    0 <= t <= 1; the four wedges' quadrics are random sums of squares.
    """
    rng = np.random.default_rng(seed)
    sharp = 0.05 + rng.uniform(size=(4, 1, 1))
    roots = rng.normal(size=(4, 5, 8)) * sharp
    matrices = roots @ roots.transpose(0, 2, 1)
    centres = rng.normal(size=(4, 5)) + np.r_[0, 0, 0, 1, 1] * rng.uniform(-2, 3)
    quadric = np.zeros((8, 21))
    for k in range(4):
        b = -matrices[k] @ centres[k]
        quadric[k] = np.r_[matrices[k][np.triu_indices(5)], b, centres[k] @ matrices[k] @ centres[k]]
    scale = float(rng.uniform(0.1, 2.0))
    uv = np.r_[np.zeros((4, 2)), rng.uniform(size=(4, 2))]
    p0, q0, p1, q1 = 4, 5, 6, 7
    # One edge 0 -> 1 between two faces: half-edge 0 and its twin 3; wedges 0, 1 on the left, 2 (start), 3 on the right.
    links = np.zeros((6, 5), np.int64)
    links[0, WEDGE], links[1, WEDGE], links[4, WEDGE], links[3, WEDGE] = 0, 1, 2, 3
    links[0, TAIL], links[3, TAIL], links[0, TWIN], links[3, TWIN] = 0, 1, 3, 0
    solved, x, y, z, t = call_solve_joint(
        links, rng.normal(size=(2, 3)), uv, quadric, np.zeros((16, 8)), 0, p0, q0, p1, q1, 0.0, scale
    )
    assert solved and 0.0 <= t <= 1.0

    left, right = unpack(quadric[0] + quadric[1]), unpack(quadric[2] + quadric[3])
    hessian = np.zeros((10, 10))
    hessian[:5, :5], hessian[5:, 5:] = left[0], right[0]
    linear = np.r_[left[1], right[1]]
    starts, lines = scale * uv[[p0, p1]], scale * (uv[[q0, q1]] - uv[[p0, p1]])
    equal, values = [], []
    for axis in range(3):
        equal.append(np.eye(10)[axis] - np.eye(10)[5 + axis])
        values.append(0.0)
    fractions, offsets = [], []
    for side in range(2):
        d = lines[side]
        across, along = np.zeros(10), np.zeros(10)
        across[5 * side + 3 : 5 * side + 5] = -d[1], d[0]
        along[5 * side + 3 : 5 * side + 5] = d / (d @ d)
        equal.append(across)
        values.append(float(across[5 * side + 3 : 5 * side + 5] @ starts[side]))
        fractions.append(along)
        offsets.append(float(along[5 * side + 3 : 5 * side + 5] @ starts[side]))
    equal.append(fractions[0] - fractions[1])
    values.append(offsets[0] - offsets[1])
    # Only one side's box: the other's fraction is equal.
    constraints = np.stack([*equal, fractions[0], -fractions[0]], axis=1)
    bounds = np.r_[values, offsets[0], -1.0 - offsets[0]]
    point = quadprog.solve_qp(hessian, -linear, constraints, bounds, len(equal))[0]
    expected_t = fractions[0] @ point - offsets[0]
    assert t == pytest.approx(expected_t, abs=1e-9)
    np.testing.assert_allclose([x, y, z], point[:3], rtol=0, atol=1e-9 * max(1.0, np.abs(point).max()))


# --- Distances -----------------------------------------------------------------------------------------------------


def slow_nearest(point: Floats, triangle: Floats) -> float:
    """Distance to a triangle: the plane where the foot lies inside, else the nearest of three segments."""
    a, b, c = triangle
    best = np.inf
    weights = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), point - a, rcond=None)[0]
    if (weights >= 0).all() and weights.sum() <= 1:
        best = float(np.linalg.norm(a + weights @ np.stack([b - a, c - a]) - point))
    for start, end in itertools.combinations(triangle, 2):
        line = end - start
        t = np.clip((point - start) @ line / max(line @ line, 1e-300), 0.0, 1.0)
        best = min(best, float(np.linalg.norm(start + t * line - point)))
    return best


@pytest.mark.parametrize("count", [1, 3, 4, 5, 60])
def test_nearest_points_against_brute_force(count: int) -> None:
    rng = np.random.default_rng(count)
    corners = rng.normal(size=(count, 3, 3)) * rng.uniform(0.05, 1.0, (count, 1, 1))
    corners[count // 2, 2] = corners[count // 2, 1]  # one is a segment
    points = rng.normal(size=(40, 3)) * 1.5
    distances, faces, weights = build_tree(corners).query(points)
    expected = [[slow_nearest(point, triangle) for triangle in corners] for point in points]
    np.testing.assert_allclose(distances, np.min(expected, axis=1), atol=1e-12)
    found = np.einsum("nk,nki->ni", weights, corners[faces])
    np.testing.assert_allclose(np.linalg.norm(found - points, axis=1), distances, atol=1e-12)
    assert (weights > -1e-12).all()


def test_samples_cover_the_area_evenly() -> None:
    surface = square(5)
    samples = sample_mesh(surface.positions, surface.faces, 4000)
    points = samples.points(surface.positions, surface.faces)[:4000]
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=5)[0]
    assert np.abs(counts - 160).max() <= 16
    assert (samples.weights >= 0).all()


def test_a_known_error_is_measured() -> None:
    """A square with its middle lifted by h against the flat square: largest distance h, both ways."""
    flat, hill = square(2), square(2)
    positions = hill.positions.copy()
    positions[4, 2] = 0.25
    hill = TexturedSurface(positions, hill.faces, hill.uvs, hill.face_uvs)
    from preprocess.decimate import decimate_to

    lod = decimate_to(flat, 2).lods[0]
    distances = measure(make_reference(hill, None, 2000), lod)
    assert distances.largest_m == pytest.approx(0.25)
    assert 0.03 < distances.mean_m < 0.2 and distances.normal_rad > 0.2


def test_blended_matrices_are_linear_in_each_face() -> None:
    surface = waves(square(4))
    rng = np.random.default_rng(3)
    poses = rng.normal(size=(2, len(surface.positions), 3, 4))
    skinning = make_skinning(poses, surface.faces, surface.uvs[surface.face_uvs])
    at_vertices = skinning.at(surface.uvs)
    np.testing.assert_allclose(at_vertices, poses, atol=1e-9)
    middle = surface.uvs[surface.face_uvs[7]].mean(axis=0)[None]
    expected = poses[:, surface.faces[7]].mean(axis=1)
    np.testing.assert_allclose(skinning.at(middle)[:, 0], expected, atol=1e-12)
