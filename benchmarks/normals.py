"""Normals: built characters against their sources, at random points of the full mesh (equal chance for equal area).

The source's normal is the one glTF says to shade with: corner normals interpolated, with the file's tangent-space
normal map in them, tangents from the file or by MikkTSpace (`_source_normals.py`, which shares nothing with the
pipeline but the loaded file). Beside it, what the runtime's fragment shader has there: the finest level's normal uvs
interpolated over its triangle, the texture's full-size level sampled, and the joints' blend at the canonical uvs
applied.

Posed, in moments of all clips, a vertex of the source and its normal move by the linear blend of its joints and by that
blend's cofactors: `corners` are the full mesh's corners, all counting alike. Inside a face there are two ways: move the
point by the blend of its own weights (`by points`), or move normals at the vertices and interpolate, as viewers do (`by
vertices`). Where a large face bends much these are degrees apart (`ways apart`), whoever draws it.

`edges` are points within a texel and a half of an edge of their face; `thin` those of faces that the atlas gives less
than a texel's height; `divided` those whose triangle the finest level has divided. `worst clip` is the clip with the
largest RMS. All angles are degrees, all shares of points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._drawn_points import DrawnPoints, find_drawn_points, single_faces
from benchmarks._inputs import ASSETS, BUILT_HELP, built_characters, command_line, source_of
from benchmarks._source_normals import SourceNormals, cofactors, unit
from benchmarks._table import print_table
from preprocess.arrays import Floats
from preprocess.fit.weight_quadtree import sample_weights
from preprocess.load import Character, load_character
from preprocess.mesh.texels import sample_bilinear
from runtime.animation.pose import sample, skinning_rows
from runtime.asset.asset import Asset, load
from runtime.asset.weight_stack import unpack_weights

EDGE_PX = 1.5


def pick_points(character: Character, count: int) -> tuple[np.ndarray, Floats]:
    """Faces (N,) and barycentric coordinates (N, 3), even over the surface."""
    surface, faces = character.mesh.surface, single_faces(character.mesh)
    corners = surface.positions[surface.faces[faces]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    return faces[rng.choice(len(area), count, p=area / area.sum())], rng.dirichlet((1, 1, 1), count)


class DrawnNormals:
    """Normals that the runtime shades with, at N points of the finest level."""

    def __init__(self, asset: Asset, points: DrawnPoints) -> None:
        level = asset.lods[0]
        self._points = points
        uvs = level.uvs if level.normal_uvs is None else level.normal_uvs
        self.corners = uvs.astype(np.float64)[points.triangles]
        texels = asset.textures["normal"].levels[0][:, :, :3]
        full = np.iinfo(texels.dtype).max if texels.dtype.kind == "u" else 1.0
        self.size = texels.shape[1::-1]
        decoded = texels.astype(np.float64) / full * 2.0 - 1.0
        self.at_rest = sample_bilinear(decoded, np.einsum("nk,nkc->nc", points.shares, self.corners))
        places, self._point = np.unique(level.canonical_uvs, axis=0, return_inverse=True)
        stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
        self._weights = sample_weights(stored, asset.weight_details, places.astype(np.float64))

    def at(self, rows: Floats | None = None) -> Floats:
        """Unit normals (N, 3), at rest or under joint matrices (J, 3, 4)."""
        if rows is None:
            return unit(self.at_rest)
        skin = (self._weights @ rows.reshape(len(rows), 12)).reshape(-1, 3, 4)
        turns = cofactors(skin[:, :, :3])[self._point.ravel()][self._points.triangles]
        return unit(np.einsum("nk,nkij,nj->ni", self._points.shares, turns, self.at_rest))

    def heights_px(self) -> Floats:
        """Heights of each point's triangle over its three edges, texels, (N, 3)."""
        corners = self.corners * self.size
        opposite = np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1)
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        doubled = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        return np.asarray(doubled[:, None] / np.maximum(np.linalg.norm(opposite, axis=2), 1e-12))


def angles_deg(a: Floats, b: Floats) -> Floats:
    """Angles between unit vectors (N, 3), degrees."""
    result: Floats = np.degrees(2.0 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2.0, 0.0, 1.0)))
    return result


def rms(values: Floats) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt((values**2).mean())) if len(values) else float("nan")


class Comparison:
    """Points of a source beside the same points as they are drawn."""

    def __init__(self, asset: Asset, character: Character, faces: np.ndarray, shares: Floats) -> None:
        self.points = find_drawn_points(asset, character.mesh, faces, shares)
        self.source = SourceNormals(character, faces, shares)
        self.drawn = DrawnNormals(asset, self.points)

    def at_rest(self) -> Floats:
        """Angles, (N,)."""
        return angles_deg(self.source.at_rest(), self.drawn.at())


def measure_rest(asset: Asset, points: Comparison) -> dict[str, Any]:
    """Angles at random points, at rest."""
    angle, heights = points.at_rest(), points.drawn.heights_px()
    edges, thin = (heights * points.points.shares).min(axis=1) <= EDGE_PX, heights.min(axis=1) < 1.0
    return {
        "character": asset.name,
        "texture": f"{points.drawn.size[0]}²",
        "points rms": rms(angle),
        "median": float(np.median(angle)),
        "99 %": float(np.percentile(angle, 99)),
        "edges": float(edges.mean()),
        "rms edges": rms(angle[edges]),
        "rms inside": rms(angle[~edges]),
        "max inside": float(angle[~edges].max(initial=0.0)),
        "thin": float(thin.mean()),
        "rms thin": rms(angle[thin]),
        "divided": float(1 - points.points.own.mean()),
    }


def measure_clips(
    asset: Asset, character: Character, points: Comparison, corners: Comparison, moments: int
) -> dict[str, Any]:
    """Angles in moments of all clips: at corners, and at random points by both ways to pose the source."""
    dense = character.mesh.dense_weights(asset.num_joints)
    clips: dict[str, list[float]] = {}
    others: dict[str, list[float]] = {"by points": [], "by vertices": [], "ways apart": []}
    for clip in asset.clips:
        for rows in skinning_rows(
            asset.skeleton, sample(clip, asset.skeleton, np.linspace(0, clip.duration_s, moments))
        ):
            skin = (dense @ rows.reshape(len(rows), 12)).reshape(-1, 3, 4)
            at_corners = angles_deg(corners.source.skinned_vertices(skin), corners.drawn.at(rows))
            clips.setdefault(clip.name, []).append(rms(at_corners))
            ways, drawn = (
                (points.source.skinned_points(skin), points.source.skinned_vertices(skin)),
                points.drawn.at(rows),
            )
            pairs = ((ways[0], drawn), (ways[1], drawn), ways)
            for name, pair in zip(others, pairs, strict=True):
                others[name].append(rms(angles_deg(*pair)))
    worst = {name: rms(np.array(values)) for name, values in clips.items()}
    name = max(worst, key=lambda name: worst[name], default="")
    return {
        "character": asset.name,
        "corners rms, rest": rms(corners.at_rest()),
        "clips": rms(np.concatenate([np.array(values) for values in clips.values()] or [np.zeros(0)])),
        "worst clip": worst.get(name, float("nan")),
        "": name,
        **{name: rms(np.array(values)) for name, values in others.items()},
    }


def measure(asset: Asset, character: Character, num_points: int, moments: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """A row at rest and one of clips."""
    faces = single_faces(character.mesh)
    points = Comparison(asset, character, *pick_points(character, num_points))
    corners = Comparison(asset, character, np.repeat(faces, 3), np.tile(np.eye(3), (len(faces), 1)))
    return measure_rest(asset, points), measure_clips(asset, character, points, corners, moments)


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print; one row per character."""
    parser = command_line("normals", __doc__)
    parser.add_argument("--built", type=Path, nargs="+", help=BUILT_HELP)
    parser.add_argument("--sources", type=Path, default=ASSETS, help="folder of the files they were built from")
    parser.add_argument("--points", type=int, default=40_000, help="random points (40000)")
    parser.add_argument("--moments", type=int, default=3, help="of each clip (3)")
    options = parser.parse_args(argv)
    at_rest: list[dict[str, Any]] = []
    posed: list[dict[str, Any]] = []
    for folder in built_characters(options.built):
        asset = load(folder)
        source = source_of(asset, options.sources)
        if source is None:
            continue
        for table, row in zip(
            (at_rest, posed), measure(asset, load_character(source), options.points, options.moments), strict=True
        ):
            table.append(row)
    print_table(at_rest)
    print()
    print_table(posed)
    return [*at_rest, *posed]
