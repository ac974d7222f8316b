"""Witnesses: the compiled kernels against NumPy twins, and what polishing may and may not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.decimate import DecimateOptions, decimate, decimate_to, rules
from preprocess.decimate.deviation import CORNERS, CORNERS_STRIDE, find_face, set_apex, square_departure, write_face
from preprocess.decimate.deviation_samples import FIRST_POSE, SLIP, SLIP_COLUMN, make_witnesses
from preprocess.decimate.levels import PEAK_WEIGHT, Lod
from preprocess.decimate.measure import make_reference, measure
from preprocess.decimate.state import Engine, make_engine
from preprocess.decimate.topology import TAIL, TWIN, WEDGE
from preprocess.mesh.seams import find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from tests.builders_decimate import box, square

BUMPY = DecimateOptions(relaxed_px=0.0, min_faces=1, peak_weight=PEAK_WEIGHT)


def bent(surface: TexturedSurface) -> Floats:
    """Two poses: a turn of the upper half about the x axis, and a stretch, (2, V, 3, 4)."""
    matrices = np.zeros((2, len(surface.positions), 3, 4))
    matrices[:, :, :, :3] = np.eye(3)
    upper = surface.positions[:, 1] > np.median(surface.positions[:, 1])
    matrices[0, upper, :, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    matrices[1, :, 0, 0] = 1.0 + surface.positions[:, 1]
    return matrices


@njit
def call_departures(m, f, squares, found_out):  # type: ignore[no-untyped-def]
    """Departure of every witness from the one face f, as the kernels see it."""
    h = 3 * f
    set_apex(m, m.links[h, 0])
    write_face(m, 0, f, m.uv[m.links[h, 1], 0], m.uv[m.links[h, 1], 1], h + 1, h + 2)
    for k in range(len(m.points)):
        found_out[k] = find_face(m, k, m.faces[f, 1], 1, 0)
        if found_out[k] >= 0:
            squares[k] = square_departure(m, k, found_out[k])


def over_faces(engine: Engine) -> dict[int, int]:
    """The face that each witness lies over."""
    mesh, found = engine.mesh, {}
    for f in range(len(mesh.faces)):
        k = int(mesh.faces[f, rules.FIRST_WITNESS])
        while k >= 0:
            assert k not in found, "in two lists"
            found[k] = f
            k = int(mesh.witnesses[k, rules.FOLLOWING])
    return found


def alive(engine: Engine) -> NDArray[np.int64]:
    mesh = engine.mesh
    return np.flatnonzero(mesh.links[: 3 * len(mesh.faces) : 3, TAIL] >= 0)


def weights_in(engine: Engine, f: int, uv: Floats) -> Floats:
    a, b, c = engine.mesh.uv[engine.mesh.links[3 * f : 3 * f + 3, WEDGE]]
    s, t = np.linalg.solve(np.stack([b - a, c - a], axis=1), uv - a)
    return np.array([1.0 - s - t, s, t])


def departures(engine: Engine) -> Floats:
    """By the definition, of every witness the largest over the poses, normalised."""
    engine._pose_again()
    mesh = engine.mesh
    poses = (mesh.points.shape[1] - FIRST_POSE) // 6
    found = []
    for k, f in over_faces(engine).items():
        weights = weights_in(engine, f, mesh.points[k, :2])
        vertices = mesh.links[3 * f : 3 * f + 3, TAIL]
        largest = 0.0
        for q in range(poses):
            corners = mesh.xyz[vertices] if q == 0 else mesh.pose[vertices, q - 1, :3]
            point, normal = np.split(mesh.points[k, FIRST_POSE + 6 * q : FIRST_POSE + 6 * q + 6], 2)
            away = weights @ corners - point
            along = away @ normal
            largest = max(largest, along**2 + mesh.points[k, SLIP_COLUMN] * (away @ away - along**2))
        found.append(largest**0.5)
    return np.array(found)


def test_departure_against_numpy() -> None:
    surface = square(4, 0.3)
    engine = make_engine(surface, BUMPY, poses=bent(surface))
    mesh = engine.mesh
    mesh.xyz[:] += 0.01 * np.random.default_rng(3).standard_normal(mesh.xyz.shape)
    for f in (0, 7, 20):
        squares, found = np.full(len(mesh.points), np.nan), np.zeros(len(mesh.points), np.int64)
        call_departures(mesh, f, squares, found)
        vertices = mesh.links[3 * f : 3 * f + 3, TAIL]
        for k in range(0, len(mesh.points), 5):
            weights = weights_in(engine, f, mesh.points[k, :2])
            weights = np.maximum(weights, 0.0) / np.maximum(weights, 0.0).sum()
            expected = 0.0
            for q in range(3):
                corners = mesh.xyz[vertices] if q == 0 else mesh.pose[vertices, q - 1, :3]
                point, normal = np.split(mesh.points[k, FIRST_POSE + 6 * q : FIRST_POSE + 6 * q + 6], 2)
                away = weights @ corners - point
                square_along = (away @ normal) ** 2
                expected = max(expected, square_along + mesh.points[k, 2] * (away @ away - square_along))
            assert found[k] == 0
            assert squares[k] == pytest.approx(expected, rel=1e-9, abs=1e-18)
    assert mesh.fan.shape[1] == CORNERS + 3 * CORNERS_STRIDE


@pytest.mark.parametrize("polished", [False, True])
def test_every_witness_stays_over_the_face_at_its_uv(polished: bool) -> None:
    """At exact levels the charts cover the same uvs, so no witness is ever lost and each lies in its face."""
    for surface in (square(10, 0.3), box(5, 0.7), box(4, 1.0, mirrored=True)):
        engine = make_engine(surface, BUMPY, poses=bent(surface))
        for target in (len(surface.faces) // 2, len(surface.faces) // 5):
            engine.run_to(target)
            if polished:
                engine.polish()
            over = over_faces(engine)
            assert sorted(over) == list(range(len(engine.mesh.points)))
            assert set(over.values()) <= set(alive(engine).tolist())
            for k, f in over.items():
                assert weights_in(engine, f, engine.mesh.points[k, :2]).min() > -1e-7


def test_full_mesh_departs_from_nothing() -> None:
    surface = box(5, 0.7)
    assert departures(make_engine(surface, BUMPY, poses=bent(surface))).max() < 1e-12


def test_slip_counts_at_edges_and_holes() -> None:
    """A flat square: nothing inside, everything on its boundary. A cube: everything at its corners."""
    flat = make_engine(square(4), BUMPY).mesh.points
    inside = np.all((flat[:, :2] > 0.11) & (flat[:, :2] < 0.89), axis=1)
    assert (flat[inside, SLIP_COLUMN] == SLIP).all()
    on_vertices = np.isclose((flat[:, :2] - 0.1) / 0.2 % 1.0, 0.0).all(axis=1) & ~inside
    assert on_vertices.any() and (flat[on_vertices, SLIP_COLUMN] == 1.0).all()
    cube = make_engine(box(2), BUMPY).mesh
    corners = np.isclose(np.abs(cube.xyz), np.abs(cube.xyz).max()).all(axis=1)
    # Witnesses on vertices come first, in the vertices' order; three faces at right angles, of one or two triangles.
    assert corners.sum() == 8 and (cube.points[: len(cube.xyz)][corners, SLIP_COLUMN] > 0.7).all()


def test_lists_of_witnesses() -> None:
    """Each vertex, face and (of a small mesh) each face's sides once."""
    engine = make_engine(square(3, 0.2), BUMPY)
    witnesses = make_witnesses(engine.half_edges, engine.mesh.uv, engine.mesh.xyz[None])
    assert len(witnesses.points) == 16 + 4 * 18
    assert sorted(over_faces(engine)) == list(range(16 + 4 * 18))
    # A witness at a face's middle is over that face.
    assert all(over_faces(engine)[16 + f] == f for f in range(18))


def test_polish_brings_the_surface_nearer() -> None:
    """Every change is made because the witnesses around it gain; nothing on an outline moves."""
    for poses in (False, True):
        surface = box(12, 0.6)
        engine = make_engine(surface, BUMPY, poses=bent(surface) if poses else None)
        engine.run_to(160)
        rough, before = engine.snapshot(), departures(engine)
        uv_area = np.abs(engine.mesh.uv).sum()
        engine.polish()
        smooth = engine.snapshot()
        assert (departures(engine) ** 6).sum() < 0.5 * (before**6).sum()
        assert departures(engine).max() <= before.max() * (1 + 1e-12)
        assert smooth.num_faces == rough.num_faces and len(smooth.uvs) == len(rough.uvs)
        assert np.abs(engine.mesh.uv).sum() != uv_area  # it did something
        if not poses:
            reference = make_reference(surface)
            assert measure(reference, smooth).mean_m < measure(reference, rough).mean_m
        smooth.surface.validate()
        edges = np.stack([smooth.faces, np.roll(smooth.faces, -1, axis=1)], axis=2).reshape(-1, 2)
        assert len(np.unique(edges, axis=0)) == len(edges)


def test_twins_stay_twins_when_edges_turn() -> None:
    engine = make_engine(box(8, 0.8), BUMPY)
    engine.run_to(200)
    engine.polish()
    links = engine.mesh.links
    for h in np.flatnonzero(links[:, TAIL] >= 0):
        t = links[h, TWIN]
        following = h - 2 if h % 3 == 2 else h + 1
        assert links[t, TWIN] == h and links[t, TAIL] == links[following, TAIL]
    for v in np.unique(links[links[:, TAIL] >= 0, TAIL]):
        assert links[engine.mesh.vertices[v, rules.OUT], TAIL] == v


def test_without_weight_nothing_is_watched() -> None:
    surface = box(6, 0.7)
    options = replace(BUMPY, peak_weight=0.0)
    engine = make_engine(surface, options)
    assert len(engine.mesh.points) == 0
    engine.run_to(100)
    before = engine.snapshot()
    engine.polish()
    np.testing.assert_array_equal(engine.snapshot().faces, before.faces)
    assert decimate(surface, options).lods[-1].num_faces <= 26  # coarser ones are too far off


def test_a_spike_survives() -> None:
    """A needle has hardly any area, so quadrics alone let it go; its tip is the largest error there is."""
    surface = square(60)
    middle = int(np.argmin(np.linalg.norm(surface.positions[:, :2] - 0.5, axis=1)))
    positions = surface.positions.copy()
    positions[:, 2] += 0.05 * np.sin(9.0 * positions[:, 0]) * np.cos(8.0 * positions[:, 1])
    positions[middle, 2] += 0.02
    surface = replace(surface, positions=positions)
    reference = make_reference(surface)

    def largest(weight: float) -> float:
        lod = decimate_to(surface, 200, replace(BUMPY, peak_weight=weight)).lods[0]
        return measure(reference, lod).largest_m

    assert largest(PEAK_WEIGHT) < 0.6 * largest(0.0)


def ball_texture() -> Floats:
    """Positions of the ball over its atlas, every texel where it would lie on its chart's plane blown up."""
    surface, side = box(16, 1.0), 256
    v, u = np.mgrid[0:side, 0:side] / side + 0.5 / side
    texels = np.zeros((side, side, 3))
    number = np.clip(np.rint((u - 0.17) / 0.33), 0, 2) + 3 * np.clip(np.rint((v - 0.24) / 0.45), 0, 1)
    for chart in range(6):
        axis, sign = chart // 2, 1.0 if chart % 2 else -1.0
        mine = number == chart
        a = (u[mine] - 0.03 - 0.33 * (chart % 3)) / 0.14 - 1.0
        b = (v[mine] - 0.1 - 0.45 * (chart // 3)) / 0.14 - 1.0
        cube = np.full((len(a), 3), sign)
        cube[:, (axis + 1) % 3], cube[:, (axis + 2) % 3] = (a, b) if sign > 0 else (b, a)
        texels[mine] = cube / np.linalg.norm(cube, axis=1, keepdims=True)
    drawn = sample_bilinear(texels, surface.uvs[surface.face_uvs.ravel()])
    assert np.abs(drawn - surface.positions[surface.faces.ravel()]).max() < 1e-3
    return texels


def coarse_ball(lifted: bool) -> tuple[float, Lod]:
    """Largest error of a coarse ball, and the ball."""
    surface = box(16, 1.0)
    engine = make_engine(surface, replace(BUMPY, lifted=lifted), ball_texture())
    engine.run_to(200)
    engine.polish()
    lod = engine.snapshot()
    return measure(make_reference(surface), lod).largest_m, lod


def test_a_ball_is_met_on_both_sides() -> None:
    """With its vertices on the ball a level lies inside of it; lifted it is nearly as far out as in."""
    inscribed, flat = coarse_ball(False)
    met, lod = coarse_ball(True)
    assert np.linalg.norm(flat.positions, axis=1).max() < 1.0 + 1e-3
    assert met < 0.65 * inscribed
    assert 1.0 + 0.5 * met < np.linalg.norm(lod.positions, axis=1).max() < 1.0 + 1.5 * met
    np.testing.assert_array_equal(lod.positions, coarse_ball(True)[1].positions)  # the same bits again


def test_a_lifted_seam_stays_where_it_is_in_uv() -> None:
    """A vertex on a seam is one point for both sides, and its uvs lie on the outlines of the charts."""
    _, lod = coarse_ball(True)
    seams = find_seams(lod.surface)
    assert len(seams.uv_pairs) > 20
    point = np.zeros(len(lod.uvs), np.int64)
    point[lod.face_uvs.ravel()] = lod.faces.ravel()
    np.testing.assert_array_equal(point[seams.uv_pairs[:, 0]], point[seams.uv_pairs[:, 1]])
    uvs = lod.uvs[np.unique(seams.uv_pairs)]
    u, v = (uvs[:, 0] - 0.03) % 0.33, (uvs[:, 1] - 0.1) % 0.45
    from_outline = np.min([np.abs(u), np.abs(u - 0.33), np.abs(u - 0.28), np.abs(v), np.abs(v - 0.28)], axis=0)
    assert from_outline.max() < 1e-8
    lifted = np.abs(np.linalg.norm(lod.positions[np.unique(point[seams.uv_pairs])], axis=1) - 1.0)
    assert lifted.max() > 0.005


def test_an_offset_turns_with_its_bones() -> None:
    """In every pose a vertex is where its own matrices put it, lifted or not."""
    surface = box(8, 1.0)
    poses = bent(surface)
    engine = make_engine(surface, BUMPY, poses=poses)
    engine.run_to(100)
    engine.polish()
    engine._pose_again()
    mesh, skinning = engine.mesh, engine.skinning
    vertices, wedges = engine._owners()
    metres = mesh.xyz[vertices] * engine.scale_m + engine.centre_m
    expected = np.einsum("pvij,vj->pvi", skinning.at(mesh.uv[wedges])[..., :3], metres) + 0.0
    found = mesh.pose[vertices, :, :3].transpose(1, 0, 2) * engine.scale_m + engine.centre_m
    np.testing.assert_allclose(found, expected, atol=1e-9)
