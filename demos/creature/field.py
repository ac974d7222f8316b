"""Implicit solids and their smooth union: the clay that the body is modelled in.

A solid gives an (almost) signed distance, negative inside. Solids are joined one after the other by a quadratic
smooth minimum of a chosen radius; a carving solid is taken away by the matching smooth maximum. The same blend
factors mix region names, so that every point of the skin knows how much of it is muzzle, ear or claw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Vec = tuple[float, float, float]

# Points are visited in cubes of this size, so that far solids can be left out.
_CUBE_M = 0.09
# No two solids further apart than this blend.
_REACH_M = 0.12


@dataclass(frozen=True)
class Cone:
    """A cone with round ends, from a sphere at `a` to a sphere at `b`, optionally flattened along an axis."""

    a: Vec
    b: Vec
    radius_a: float
    radius_b: float
    flat_axis: Vec | None = None
    flatness: float = 1.0

    def distance(self, points: Floats) -> Floats:
        """Signed distance of (N, 3) points in metres, exact when not flattened."""
        a, b = np.array(self.a), np.array(self.b)
        local = points - a
        axis = b - a
        if self.flat_axis is not None:
            normal = np.array(self.flat_axis) / np.linalg.norm(self.flat_axis)
            stretch = 1.0 / self.flatness - 1.0
            local = local + (_dot(local, normal) * stretch)[:, None] * normal
            axis = axis + float(_dot(axis, normal)) * stretch * normal
        length = float(np.linalg.norm(axis))
        axis = axis / length
        along = _dot(local, axis)
        across = np.sqrt(np.maximum(_squares(local) - along * along, 0.0))
        # The nearest of the spheres that sweep the cone: its contact direction leans by asin(slope).
        slope = min(max((self.radius_a - self.radius_b) / length, -0.95), 0.95)
        t = _share((along - across * slope / np.sqrt(1.0 - slope * slope)) / length)
        from_centre = local - (t * length)[:, None] * axis
        size = np.sqrt(_squares(from_centre))
        distance = size - (self.radius_a + t * (self.radius_b - self.radius_a))
        if self.flat_axis is not None:
            thin = _dot(from_centre, normal) / np.maximum(size, 1e-9)
            distance = distance / np.sqrt(1.0 + thin * thin * (1.0 / self.flatness**2 - 1.0))
        return distance


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid, optionally turned about the x axis (`pitch`), then y (`yaw`), then z (`roll`), in degrees."""

    centre: Vec
    radii: Vec
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0

    def distance(self, points: Floats) -> Floats:
        """Distance of (N, 3) points in metres, exact to first order at the surface."""
        local = points - np.array(self.centre)
        if self.pitch or self.yaw or self.roll:
            axes = _turn(self.pitch, self.yaw, self.roll)
            local = np.stack([_dot(local, axes[:, k]) for k in range(3)], axis=1)
        scaled = local / np.array(self.radii)
        size = np.sqrt(_squares(scaled))
        slope = np.sqrt(_squares(scaled / np.array(self.radii)))
        return np.where(slope < 1e-9, -min(self.radii), size * (size - 1.0) / np.maximum(slope, 1e-9))


def _dot(points: Floats, direction: Floats) -> Floats:
    """Dot products, rounded the same way whatever the number of points or threads (matrix products are not)."""
    result: Floats = points[..., 0] * direction[0] + points[..., 1] * direction[1] + points[..., 2] * direction[2]
    return result


def _squares(points: Floats) -> Floats:
    """Squared lengths of (N, 3) points; a sum over an axis of three is far slower."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    return x * x + y * y + z * z


def _share(values: Floats) -> Floats:
    """Values held to [0, 1]."""
    return np.minimum(np.maximum(values, 0.0), 1.0)


def _turn(pitch: float, yaw: float, roll: float) -> Floats:
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians([pitch, yaw, roll])), np.sin(np.radians([pitch, yaw, roll]))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    result: Floats = about_z @ about_y @ about_x
    return result


@dataclass(frozen=True)
class Piece:
    """One solid of the body: the region it belongs to, its blend radius in metres, and whether it is carved out."""

    region: str
    solid: Cone | Ellipsoid
    blend: float
    carve: bool = False


@dataclass(frozen=True)
class Field:
    """An ordered list of pieces, mirrored in the plane x = 0."""

    pieces: tuple[Piece, ...]

    @property
    def regions(self) -> tuple[str, ...]:
        """Region names in order of first use."""
        return tuple(dict.fromkeys(piece.region for piece in self.pieces))

    def distance(self, points: Floats) -> Floats:
        """Signed distance of (N, 3) points to the skin, metres, negative inside."""
        return self._evaluate(points, False)[0]

    def regions_at(self, points: Floats) -> Floats:
        """How much of each region (N, 3) points near the skin belong to: (N, R), rows summing to one."""
        return self._evaluate(points, True)[1]

    def gradient(self, points: Floats, step_m: float = 1e-4) -> Floats:
        """Gradient of the distance by differences at the corners of a small tetrahedron, (N, 3)."""
        corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]]) * step_m
        values = self.distance((points[:, None] + corners).reshape(-1, 3)).reshape(-1, 4)
        sums = [sum(values[:, i] * corners[i, k] for i in range(4)) for k in range(3)]
        return np.stack(sums, axis=1) / (4.0 * step_m * step_m)

    def project(self, points: Floats, rounds: int = 2) -> Floats:
        """Move (N, 3) points near the skin onto it along the gradient."""
        for _ in range(rounds):
            gradient = self.gradient(points)
            length_sq = np.maximum((gradient * gradient).sum(axis=1), 0.05)
            move = (self.distance(points) / length_sq)[:, None] * gradient
            points = points - np.clip(move, -0.01, 0.01)
        return points

    def _evaluate(self, points: Floats, with_regions: bool) -> tuple[Floats, Floats]:
        """Join the pieces in order, each at the points that it matters to."""
        folded = points * np.array([1.0, 1.0, 1.0])
        folded[:, 0] = np.abs(folded[:, 0])
        names = self.regions
        distance = np.full(len(points), 10.0)
        mix = np.zeros((len(points), len(names) if with_regions else 0))
        if not len(points):
            return distance, mix
        cube_of_point, matters = self._cubes(folded)
        for piece, cubes in zip(self.pieces, matters):
            rows = np.flatnonzero(cubes[cube_of_point])
            before, other = distance[rows], piece.solid.distance(folded[rows])
            if piece.carve:
                other = -other
                share = _share(0.5 + 0.5 * (other - before) / piece.blend)
                distance[rows] = before + (other - before) * share + piece.blend * share * (1.0 - share)
            else:
                share = _share(0.5 + 0.5 * (before - other) / piece.blend)
                distance[rows] = before + (other - before) * share - piece.blend * share * (1.0 - share)
            if with_regions:
                mix[rows] *= (1.0 - share)[:, None]
                mix[rows, names.index(piece.region)] += share
        return distance, mix

    def _cubes(self, folded: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """The cube of each point, (N,), and which pieces can matter in which cube, (P, number of cubes)."""
        cells = np.floor(folded / _CUBE_M).astype(np.int64) + 512
        keys = (cells[:, 0] * 1024 + cells[:, 1]) * 1024 + cells[:, 2]
        _, first, cube_of_point = np.unique(keys, return_index=True, return_inverse=True)
        centres: Floats = np.asarray((cells[first] - 512 + 0.5) * _CUBE_M, np.float64)
        radius = 0.5 * np.sqrt(3.0) * _CUBE_M
        at_centre = np.stack([piece.solid.distance(centres) for piece in self.pieces])
        carve = np.array([piece.carve for piece in self.pieces])
        nearest = at_centre[~carve].min(axis=0)
        limit = np.where(carve[:, None], radius + 0.03, nearest + 2.0 * radius + _REACH_M)
        return cube_of_point, at_centre <= limit
