"""What a built folder draws beside what its source says, in figures.

Posed vertices are skinned in 64 bits on both sides, each side with its own skeleton and clips; normals, colours and
emission are compared at random points of the surface. Which figures are beyond the goals says goals.py.
Letters in shapes: V vertices, J joints, P poses, N points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from preprocess.arrays import Floats, Indices
from preprocess.files.srgb import linear_to_srgb
from preprocess.load.character import Character
from preprocess.mesh.face_geometry import face_areas
from preprocess.verify.drawn import Drawn, positions_at, read_drawn, weights_at
from preprocess.verify.matching import Match, match
from preprocess.verify.source import Source
from runtime.animation.clip import Clip
from runtime.animation.pose import rest_pose, sample, skinning_rows
from runtime.animation.skeleton import Skeleton
from runtime.asset.asset import Asset

MAX_POSES, MOST_OF_A_CLIP = 16, 4  # of all clips together, but one of each
MAX_POSED = 16384  # vertices, and middles, that are posed; of more, every so many
NUM_POINTS = 3000  # at which normals and colours are compared
# Faces whose texture strays further from the flat face than this, of the diagonal, are never divided (docs/drawing.md).
FLAT_REL = 1e-3


@dataclass(frozen=True)
class Spread:
    """A figure of one kind over many places.

    Attributes
    ----------
    rms, largest : float
    mean : float
        Of the signed differences, the largest of the channels: what all places have in common.
    worst : str
        Where the largest is, in words.
    count : int
        Number of places.
    """

    rms: float
    largest: float
    mean: float = 0.0
    worst: str = ""
    count: int = 0


@dataclass(frozen=True)
class Measurement:
    """Every figure of a built folder beside its source.

    Attributes
    ----------
    vertices, middles : Spread
        Posed, fractions of the bounding diagonal; middles of faces as the texture has them.
    weights : Spread
        Of joints at vertices.
    joints : Spread
        Places of joints in all poses, fractions of the diagonal.
    normals : dict of material to Spread, degrees
    base_color, emission, surface_factors : dict of material to Spread
        Colours sRGB-encoded, emission linear and relative to the material's brightest.
    outside : Spread
        How far posed vertices leave the boxes of their clips, fractions of the diagonal.
    matched : float
        Fraction of the drawn faces that are the source's.
    """

    vertices: Spread
    middles: Spread
    weights: Spread
    joints: Spread
    normals: dict[str, Spread]
    base_color: dict[str, Spread]
    emission: dict[str, Spread]
    surface_factors: dict[str, Spread]
    outside: Spread
    matched: float


@dataclass(frozen=True)
class _Poses:
    """Both sides in the same moments: rows (P, J, 3, 4), places of the joints (P, J, 3), names of the moments."""

    drawn: Floats
    source: Floats
    drawn_joints: Floats
    source_joints: Floats
    names: tuple[str, ...]
    clips: tuple[str, ...]


def _moments(clips: tuple[Clip, ...]) -> list[tuple[int, Floats]]:
    """Clip and times, seconds."""
    count = max(1, min(MOST_OF_A_CLIP, MAX_POSES // max(len(clips), 1)))
    shares = (np.arange(count) + 0.5) / count
    return [(number, shares * clip.duration_s) for number, clip in enumerate(clips)]


def _rows(skeleton: Skeleton, clips: tuple[Clip, ...], moments: list[tuple[int, Floats]]) -> tuple[Floats, Floats]:
    """Skinning matrices and joints' places, the rest pose first."""
    poses = [rest_pose(skeleton)] + [sample(clips[number], skeleton, times) for number, times in moments]
    rows, joints = [], []
    for pose in poses:
        nodes = np.empty((pose.num_actors, skeleton.num_nodes, 3, 4))
        rows.append(skinning_rows(skeleton, pose, nodes_out=nodes))
        joints.append(nodes[..., 3][:, skeleton.joint_nodes])
    return np.concatenate(rows), np.concatenate(joints)


def pose_rows(skeleton: Skeleton, clips: tuple[Clip, ...], most: int = MAX_POSES) -> Floats:
    """Skinning matrices of the rest pose and of moments of all clips, at most so many of them, (P, J, 3, 4)."""
    moments = _moments(clips)
    if len(moments) > most:
        moments = [moments[number] for number in np.linspace(0, len(moments) - 1, most).astype(int)]
    return _rows(skeleton, clips, moments)[0]


def _pose(asset: Asset, character: Character) -> _Poses:
    common = min(len(asset.clips), len(character.clips))
    moments = _moments(character.clips[:common])
    drawn, drawn_joints = _rows(asset.skeleton, asset.clips, moments)
    source, source_joints = _rows(character.skeleton, character.clips, moments)
    names = [f"{character.clips[number].name} at {time:.2f} s" for number, times in moments for time in times]
    clips = [character.clips[number].name for number, times in moments for _ in times]
    return _Poses(drawn, source, drawn_joints, source_joints, ("at rest", *names), ("", *clips))


def skinned(rows: Floats, weights: Floats, positions: Floats) -> Floats:
    """Linear blend skinning in 64 bits: (P, J, 3, 4), (N, J), (N, 3) to (P, N, 3)."""
    num_poses, num_joints = rows.shape[:2]
    flat = rows.transpose(1, 0, 2, 3).reshape(num_joints, num_poses * 12)
    blended = (weights @ flat).reshape(len(weights), num_poses, 3, 4)
    moved = np.matmul(blended[..., :3], positions[:, None, :, None])[..., 0] + blended[..., 3]
    return np.asarray(moved.transpose(1, 0, 2), np.float64)


def _thinned(count: int) -> Indices:
    """Every so many of as many."""
    return np.arange(0, count, max(1, -(-count // MAX_POSED)))


def _place(drawn: Drawn, face: int) -> str:
    """A drawn face in words: its material and the joint that moves it most."""
    asset = drawn.asset
    joint = asset.joint_names[int(drawn.weights[drawn.faces[face]].sum(axis=0).argmax())]
    material = asset.materials[int(drawn.materials[face])].name
    return f"material {material!r}, joint {joint!r}"


def _face_of(drawn: Drawn, vertex: int) -> int:
    return int((drawn.faces == vertex).any(axis=1).argmax())


def _posed_spread(off: Floats, names: tuple[str, ...], scale: float, where: Callable[[int], str]) -> Spread:
    """Distances (P, N) in metres as fractions; the worst with its moment."""
    if not off.size:
        return Spread(0.0, 0.0)
    pose, point = np.unravel_index(int(off.argmax()), off.shape)
    over = f"{where(int(point))}, {names[int(pose)]}"
    return Spread(float(np.sqrt((off**2).mean())) * scale, float(off.max()) * scale, 0.0, over, off.shape[1])


def _measure_vertices(
    drawn: Drawn, source: Source, found: Match, poses: _Poses, scale: float
) -> tuple[Spread, Spread, Spread]:
    """Posed vertices, their weights, and how far they leave the boxes of their clips."""
    rows = _thinned(len(drawn.positions))
    around, shares = found.vertices[rows], found.shares[rows]
    weights, rest = np.zeros((len(rows), drawn.weights.shape[1])), np.zeros((len(rows), 3))
    for corner in range(3):
        share = shares[:, corner : corner + 1]
        used = np.flatnonzero(share[:, 0] > 0)
        weights[used] += share[used] * source.weights(around[used, corner])
        rest[used] += share[used] * source.mesh.surface.positions[around[used, corner]]
    posed = skinned(poses.drawn, drawn.weights[rows], drawn.positions[rows])
    off = np.linalg.norm(posed - skinned(poses.source, weights, rest), axis=2)

    def where(point: int) -> str:
        return _place(drawn, _face_of(drawn, int(rows[point])))

    vertices = _posed_spread(off, poses.names, scale, where)
    if found.unseen_m * scale > 2.0 * vertices.largest:
        face = int((source.mesh.surface.faces == found.unseen).any(axis=1).argmax())
        name = source.character.materials[int(source.mesh.face_materials[face])].name
        vertices = Spread(
            vertices.rms, found.unseen_m * scale, 0.0, f"a vertex of material {name!r} is not drawn", len(rows)
        )
    unlike = np.abs(drawn.weights[rows] - weights)
    worst = int(unlike.max(axis=1).argmax())
    of_weights = Spread(
        float(np.sqrt((unlike**2).sum(axis=1).mean())), float(unlike.max()), 0.0, where(worst), len(rows)
    )
    return vertices, of_weights, _measure_boxes(drawn, posed, poses, scale)


def _measure_boxes(drawn: Drawn, posed: Floats, poses: _Poses, scale: float) -> Spread:
    """How far posed vertices (P, N, 3) are outside of the manifest's boxes."""
    manifest = drawn.asset.manifest
    boxes = [manifest.bind_bounds] + [manifest.clip_bounds[name] for name in poses.clips[1:]]
    low, high = (np.stack([box[side] for box in boxes]) for side in (0, 1))
    least = np.stack([drawn.positions.min(axis=0), *posed[1:].min(axis=1)])
    most = np.stack([drawn.positions.max(axis=0), *posed[1:].max(axis=1)])
    out = np.maximum(np.maximum(low - least, most - high).max(axis=1) * scale, 0.0)
    worst = int(out.argmax())
    return Spread(
        float(np.sqrt((out**2).mean())), float(out[worst]), 0.0, ("bind pose", *poses.names[1:])[worst], len(out)
    )


def _measure_middles(drawn: Drawn, source: Source, found: Match, poses: _Poses, scale: float) -> Spread:
    """Middles of faces as the textures have them, but for those that are drawn flat."""
    faces = np.flatnonzero(found.faces >= 0)
    faces = faces[_thinned(len(faces))]
    places = drawn.uvs[faces].mean(axis=1)
    positions = positions_at(drawn.asset, places)
    stray = np.linalg.norm(positions - drawn.positions[drawn.faces[faces]].mean(axis=1), axis=1) * scale
    divided = stray <= max(FLAT_REL, drawn.asset.lods[0].error_m * scale)
    faces, places, positions = faces[divided], places[divided], positions[divided]
    corners = source.mesh.surface.faces[found.faces[faces]]
    weights = np.stack([source.weights(corners[:, k]) for k in range(3)]).mean(axis=0)
    rest = source.mesh.surface.positions[corners].mean(axis=1)
    posed = skinned(poses.drawn, weights_at(drawn.asset, places), positions)
    off = np.linalg.norm(posed - skinned(poses.source, weights, rest), axis=2)
    return _posed_spread(off, poses.names, scale, lambda point: _place(drawn, int(faces[point])))


@dataclass(frozen=True)
class _Points:
    """Random points of the surface, on both sides: faces (N,) and barycentric coordinates (N, 3)."""

    drawn_faces: Indices
    drawn_shares: Floats
    source_faces: Indices
    source_shares: Floats
    turns: Indices


def random_points(corners: Floats, count: int) -> tuple[Indices, Floats]:
    """Faces (count,) and barycentric coordinates (count, 3), spread evenly over the area of faces (F, 3, 3).

    The same every time; none where nothing has an area.
    """
    areas = 2.0 * face_areas(corners)
    total = float(areas.sum())
    if not total > 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    rng = np.random.default_rng(16)
    at = (np.arange(count) + rng.random(count)) / count * total
    faces = np.minimum(np.searchsorted(np.cumsum(areas), at), len(corners) - 1)
    root, share = np.sqrt(rng.random(count)), rng.random(count)
    return faces, np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)


def _points_with_twins(drawn: Drawn, found: Match) -> _Points:
    """Random points of the faces that have a twin."""
    faces = np.flatnonzero(found.faces >= 0)
    chosen, shares = random_points(drawn.positions[drawn.faces[faces]], NUM_POINTS)
    chosen = faces[chosen]
    return _Points(chosen, shares, found.faces[chosen], found.source_shares(chosen, shares), found.turns[chosen])


def _steps(drawn: Drawn, points: _Points, name: str) -> Floats:
    """Change of the source's barycentric coordinates over one stored texel right and down, (N, 2, 3)."""
    entries = drawn.asset.manifest.entry.textures.colors()
    if name not in entries:
        return np.zeros((len(points.drawn_faces), 2, 3))
    at_normals = name == "normal" or entries[name].uvs == "normal"
    corners = (drawn.normal_uvs if at_normals else drawn.uvs)[points.drawn_faces] * entries[name].size
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    inverse = np.where(np.abs(area) > 1e-9, 1.0 / np.where(area == 0, 1.0, area), 0.0)[:, None]
    first = np.stack([b[:, 1] - c[:, 1], c[:, 0] - b[:, 0]], axis=1) * inverse
    second = np.stack([c[:, 1] - a[:, 1], a[:, 0] - c[:, 0]], axis=1) * inverse
    steps = np.stack([first, second, -first - second], axis=2)
    order = (np.arange(3) - points.turns[:, None]) % 3
    return np.take_along_axis(steps, order[:, None].repeat(2, axis=1), axis=2)


def _by_material(drawn: Drawn, source: Source, points: _Points, off: Floats, signed: Floats) -> dict[str, Spread]:
    """Spreads of distances (N,) and signed differences (N, C) at points, by the source's materials."""
    spreads = {}
    of_point = source.mesh.face_materials[points.source_faces]
    for index in np.unique(of_point):
        rows = np.flatnonzero(of_point == index)
        worst = int(rows[off[rows].argmax()])
        name = source.character.materials[int(index)].name
        while name in spreads:
            name += "'"
        spreads[name] = Spread(
            float(np.sqrt((off[rows] ** 2).mean())),
            float(off[worst]),
            float(np.abs(signed[rows].mean(axis=0)).max()),
            _place(drawn, int(points.drawn_faces[worst])),
            len(rows),
        )
    return spreads


def _measure_normals(drawn: Drawn, source: Source, points: _Points) -> dict[str, Spread]:
    """Angles between normals at rest, degrees."""
    ours = drawn.normals(points.drawn_faces, points.drawn_shares)
    theirs = source.normals(points.source_faces, points.source_shares, _steps(drawn, points, "normal"))
    apart = np.rad2deg(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(ours - theirs, axis=1), 0.0, 1.0)))
    return _by_material(drawn, source, points, apart, apart[:, None])


def _measure_channels(
    drawn: Drawn, source: Source, points: _Points
) -> tuple[dict[str, Spread], dict[str, Spread], dict[str, Spread]]:
    """Base colour (encoded, alpha with it), emission (relative to the brightest) and surface factors."""
    here, there = (points.drawn_faces, points.drawn_shares), (points.source_faces, points.source_shares)
    results = []
    for name in ("base_color", "emissive", "orm"):
        steps = _steps(drawn, points, name)
        if name == "base_color":
            ours, theirs = drawn.base_colors(*here), source.base_colors(*there, steps)
            for side in (ours, theirs):
                side[:, :3] = linear_to_srgb(np.clip(side[:, :3], 0.0, 1.0))
        elif name == "emissive":
            ours, theirs = drawn.emission(*here), source.emission(*there, steps)
            brightest = np.array([max(m.emissive_factor) for m in source.character.materials])
            scale = np.maximum(brightest[source.mesh.face_materials[points.source_faces]], 1.0)[:, None]
            ours, theirs = ours / scale, theirs / scale
        else:
            ours, theirs = drawn.surface_factors(*here), source.surface_factors(*there, steps)
        apart = ours - theirs
        results.append(_by_material(drawn, source, points, np.abs(apart).max(axis=1), apart))
    return results[0], results[1], results[2]


def measure(asset: Asset, character: Character) -> Measurement:
    """Compare a built folder with the file that it was built from.

    Parameters
    ----------
    asset : Asset
        The folder, as the runtime loads it.
    character : Character
        The file, as parsed: nothing that a stage made of it.
    """
    drawn, source = read_drawn(asset), Source(character)
    scale = 1.0 / max(source.mesh.surface.diagonal_m, 1e-30)
    found = match(drawn, source)
    poses = _pose(asset, character)
    vertices, weights, outside = _measure_vertices(drawn, source, found, poses, scale)
    points = _points_with_twins(drawn, found)
    base_color, emission, surface_factors = _measure_channels(drawn, source, points)
    apart = np.linalg.norm(poses.drawn_joints - poses.source_joints, axis=2)
    return Measurement(
        vertices=vertices,
        middles=_measure_middles(drawn, source, found, poses, scale),
        weights=weights,
        joints=_posed_spread(apart, poses.names, scale, lambda joint: f"joint {asset.joint_names[joint]!r}"),
        normals=_measure_normals(drawn, source, points),
        base_color=base_color,
        emission=emission,
        surface_factors=surface_factors,
        outside=outside,
        matched=float((found.faces >= 0).mean()),
    )
