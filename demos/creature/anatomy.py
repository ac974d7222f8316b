"""The dragon's body as implicit pieces, from the inside out: trunk, limbs, tail, head, ears, wings, crest, claws."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.interpolate import CubicSpline

from demos.creature.field import Cone, Ellipsoid, Field, Floats, Piece, Vec

EYE: Vec = (0.112, 0.672, 0.466)
EYE_RADIUS = 0.063


def _trunk() -> list[Piece]:
    return [
        Piece("trunk", Ellipsoid((0, 0.306, -0.050), (0.190, 0.180, 0.245)), 0.10),
        Piece("trunk", Ellipsoid((0, 0.355, 0.135), (0.138, 0.150, 0.150)), 0.10),
        Piece("trunk", Ellipsoid((0, 0.315, -0.235), (0.158, 0.150, 0.155)), 0.10),
        Piece("neck", Cone((0, 0.41, 0.19), (0, 0.56, 0.315), 0.118, 0.100), 0.09),
    ]


def _tail() -> list[Piece]:
    """Cones along a smooth curve of centres (y, z) and radii."""
    knots = np.array(
        [
            (0.315, -0.30, 0.128),
            (0.265, -0.49, 0.090),
            (0.230, -0.63, 0.064),
            (0.225, -0.76, 0.046),
            (0.265, -0.88, 0.034),
            (0.325, -0.955, 0.026),
        ]
    )
    curve = CubicSpline(np.arange(len(knots)), knots)(np.linspace(0.0, len(knots) - 1.0, 16))
    links = itertools.pairwise(curve.tolist())
    return [Piece("tail", Cone((0, ya, za), (0, yb, zb), ra, rb), 0.035) for (ya, za, ra), (yb, zb, rb) in links]


def _tail_fin() -> list[Piece]:
    side = (1.0, 0.0, 0.0)
    return [
        Piece("fin", Cone((0, 0.315, -0.935), (0, 0.385, -1.01), 0.038, 0.078, side, 0.34), 0.03),
        Piece("fin", Cone((0, 0.385, -1.01), (0, 0.50, -1.10), 0.078, 0.017, side, 0.36), 0.02),
    ]


def _arm() -> list[Piece]:
    return [
        Piece("arm", Ellipsoid((0.110, 0.325, 0.165), (0.070, 0.110, 0.085), pitch=8), 0.06),
        Piece("arm", Cone((0.128, 0.29, 0.160), (0.148, 0.18, 0.140), 0.070, 0.056), 0.05),
        Piece("arm", Cone((0.148, 0.18, 0.140), (0.150, 0.065, 0.165), 0.056, 0.048), 0.03),
        Piece("arm", Ellipsoid((0.152, 0.042, 0.195), (0.064, 0.044, 0.076)), 0.035),
    ]


def _leg() -> list[Piece]:
    return [
        Piece("leg", Ellipsoid((0.132, 0.275, -0.205), (0.080, 0.132, 0.108), pitch=-22), 0.06),
        Piece("leg", Cone((0.145, 0.235, -0.18), (0.165, 0.175, -0.165), 0.085, 0.072), 0.05),
        Piece("leg", Cone((0.165, 0.165, -0.165), (0.158, 0.075, -0.235), 0.070, 0.048), 0.045),
        Piece("leg", Ellipsoid((0.160, 0.044, -0.205), (0.066, 0.046, 0.088)), 0.04),
    ]


def _toes(region: str, x: float, z: float, size: float) -> list[Piece]:
    """Three toes and their claws in front of a paw centred at (x, z)."""
    pieces = []
    for sideways, reach in ((-0.040, 0.066), (0.0, 0.082), (0.041, 0.064)):
        knuckle = (x + 0.8 * sideways, 0.040, z + 0.45 * reach)
        tip = (x + 1.12 * sideways, 0.028, z + reach)
        pieces.append(Piece(region, Cone(knuckle, tip, 0.028 * size, 0.026 * size), 0.014))
    for sideways, reach in ((-0.040, 0.066), (0.0, 0.082), (0.041, 0.064)):
        root = (x + 1.14 * sideways, 0.030, z + reach + 0.018)
        point = (x + 1.24 * sideways, 0.016, z + reach + 0.042)
        pieces.append(Piece("claw", Cone(root, point, 0.014, 0.006), 0.006))
    return pieces


def _head() -> list[Piece]:
    return [
        Piece("head", Ellipsoid((0, 0.650, 0.365), (0.178, 0.158, 0.172)), 0.07),
        Piece("head", Ellipsoid((0.098, 0.590, 0.405), (0.088, 0.078, 0.090)), 0.07),
        Piece("muzzle", Ellipsoid((0, 0.603, 0.525), (0.108, 0.064, 0.098)), 0.06),
        Piece("muzzle", Ellipsoid((0.052, 0.592, 0.572), (0.055, 0.046, 0.050)), 0.04),
        Piece("jaw", Ellipsoid((0, 0.553, 0.490), (0.100, 0.046, 0.125), pitch=4), 0.03),
        Piece("muzzle", Ellipsoid((0.042, 0.640, 0.590), (0.026, 0.022, 0.028)), 0.03),
        Piece("nostril", Ellipsoid((0.048, 0.646, 0.622), (0.014, 0.010, 0.014), yaw=25), 0.014, carve=True),
        Piece("head", Cone((0.060, 0.752, 0.480), (0.150, 0.722, 0.405), 0.030, 0.026), 0.045),
        Piece("lid", Ellipsoid((0.1095, 0.6855, 0.4535), (0.0664, 0.0664, 0.0664)), 0.012),
        Piece("eye", Ellipsoid(EYE, (EYE_RADIUS,) * 3), 0.003),
    ]


def _horn() -> list[Piece]:
    """A short horn that bends back, tapering along a smooth curve of centres and radii."""
    knots = np.array(
        [
            (0.060, 0.760, 0.345, 0.037),
            (0.074, 0.812, 0.312, 0.031),
            (0.088, 0.858, 0.262, 0.023),
            (0.098, 0.886, 0.196, 0.009),
        ]
    )
    curve = CubicSpline(np.arange(len(knots)), knots)(np.linspace(0.0, len(knots) - 1.0, 7))
    return [
        Piece("horn", Cone(_vec(a[:3]), _vec(b[:3]), float(a[3]), float(b[3])), 0.018 if k == 0 else 0.01)
        for k, (a, b) in enumerate(itertools.pairwise(curve))
    ]


EAR_THIN: Vec = (0.45, 0.10, 0.90)  # across an ear, towards its inner side


def _ear() -> list[Piece]:
    return [
        Piece("ear", Cone((0.145, 0.705, 0.310), (0.225, 0.772, 0.255), 0.046, 0.074, EAR_THIN, 0.40), 0.03),
        Piece("ear", Cone((0.225, 0.772, 0.255), (0.345, 0.855, 0.180), 0.074, 0.022, EAR_THIN, 0.42), 0.02),
        Piece("ear", Ellipsoid((0.246, 0.785, 0.298), (0.092, 0.037, 0.031), roll=35, yaw=28), 0.03, carve=True),
    ]


def _wing() -> list[Piece]:
    """A stubby wing: fans of membrane in one plane, thicker along the leading edge."""
    root = np.array([0.080, 0.470, 0.050])
    lead, trail = np.array([0.275, 0.215, -0.125]), np.array([0.165, -0.010, -0.215])
    thin = np.cross(lead, trail)
    pieces = []
    for along_lead, along_trail, size in ((1.0, 0.0, 0.036), (0.66, 0.48, 0.046), (0.22, 0.86, 0.042)):
        tip = root + along_lead * lead + along_trail * trail
        pieces.append(Piece("wing", Cone(_vec(root), _vec(tip), 0.050, size, _vec(thin), 0.37), 0.03))
    wrist = root + 0.55 * lead
    pieces.append(Piece("wing", Cone(_vec(root), _vec(wrist), 0.030, 0.019), 0.03))
    pieces.append(Piece("wing", Cone(_vec(wrist), _vec(root + 1.02 * lead), 0.019, 0.013), 0.02))
    return pieces


def _vec(array: Floats) -> Vec:
    return float(array[0]), float(array[1]), float(array[2])


def _crest() -> list[Piece]:
    """Leaf-shaped plates along the spine, larger over the shoulders."""
    side = (1.0, 0.0, 0.0)
    rows: tuple[tuple[float, float, float], ...] = (
        (0.735, 0.195, 0.050),
        (0.610, 0.150, 0.056),
        (0.520, 0.075, 0.060),
        (0.487, -0.030, 0.062),
        (0.478, -0.135, 0.060),
        (0.460, -0.240, 0.056),
        (0.425, -0.340, 0.050),
        (0.375, -0.435, 0.045),
        (0.330, -0.525, 0.040),
        (0.297, -0.610, 0.035),
        (0.278, -0.690, 0.030),
    )
    pieces = []
    for y, z, size in rows:
        pieces.append(
            Piece("crest", Cone((0, y, z), (0, y + 0.9 * size, z - 0.9 * size), size, 0.012, side, 0.40), 0.018)
        )
    return pieces


def build_body() -> Field:
    """The whole dragon in bind pose: standing on y = 0, looking along +z, about 1.7 m from nose to tail."""
    pieces = [
        *_trunk(),
        *_tail(),
        *_arm(),
        *_leg(),
        *_toes("arm", 0.152, 0.195, 1.0),
        *_toes("leg", 0.162, -0.190, 1.06),
        *_head(),
        *_horn(),
        *_tail_fin(),
        *_ear(),
        *_wing(),
        *_crest(),
    ]
    return Field(tuple(pieces))


# Wanted edge length of the triangles by region, metres.
_EDGE_M = {
    "trunk": 0.0225,
    "neck": 0.0190,
    "tail": 0.0165,
    "fin": 0.0120,
    "arm": 0.0150,
    "leg": 0.0155,
    "claw": 0.0085,
    "head": 0.0150,
    "muzzle": 0.0115,
    "nostril": 0.0090,
    "jaw": 0.0120,
    "mouth": 0.0100,
    "eye": 0.0095,
    "lid": 0.0095,
    "horn": 0.0095,
    "ear": 0.0110,
    "wing": 0.0120,
    "crest": 0.0100,
}


def edge_lengths(field: Field, points: Floats) -> Floats:
    """Wanted triangle edge at (N, 3) points, metres: finer where the shape is fine, and near the toes."""
    mix = field.regions_at(points)
    wanted = np.zeros(len(points))
    for region, share in zip(field.regions, mix.T, strict=True):
        wanted += _EDGE_M[region] * share
    low = np.clip((0.075 - points[:, 1]) / 0.03, 0.0, 1.0)
    return wanted * (1.0 - 0.22 * low)
