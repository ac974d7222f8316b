"""What the dragon looks like: base colour, roughness and relief, painted in space and read off at each texel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demos.creature.anatomy import EAR_THIN, EYE
from demos.creature.field import Field
from demos.creature.noise import cells, fractal_noise
from demos.creature.surface import Floats
from demos.creature.texels import BodyMesh, Texels, locate_texels, tangent_normals

SIZE = 1024  # texels a side of every texture


def _rgb(code: str) -> Floats:
    """sRGB colour of a hexadecimal code, in [0, 1]."""
    return np.array([int(code[k : k + 2], 16) for k in (0, 2, 4)]) / 255.0


_BACK = _rgb("15605f")
_FLANK = _rgb("2fa08c")
_LIGHT = _rgb("7fd0a4")
_BELLY = _rgb("f7e2b0")
_BELLY_SHADE = _rgb("e9b884")
_SPOT = _rgb("0f4650")
_CORAL = _rgb("ee6a3c")
_GOLD = _rgb("ffc04d")
_IVORY = _rgb("f4e8cf")
_UMBER = _rgb("6a4030")
_BLUSH = _rgb("f08a74")
_DARK = _rgb("15191c")

_EYE = np.array(EYE)
_GAZE = np.array([0.60, 0.10, 0.79]) / np.linalg.norm([0.60, 0.10, 0.79])


@dataclass(frozen=True)
class Textures:
    """The three textures, (H, W, 3) uint8: base colour (sRGB), occlusion-roughness-metalness, tangent-space normal."""

    base_color: NDArray[np.uint8]
    orm: NDArray[np.uint8]
    normal: NDArray[np.uint8]


def _step(low: float, high: float, value: Floats) -> Floats:
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _mix(a: Floats, b: Floats, share: Floats) -> Floats:
    return a + (b - a) * share[:, None]


class _Canvas:
    """What all brushes look at: places, folded onto the left side where a pattern is symmetric."""

    def __init__(self, field: Field, texels: Texels) -> None:
        self.points = texels.points
        self.folded = texels.points * np.where(texels.points[:, :1] < 0, [[-1.0, 1.0, 1.0]], [[1.0, 1.0, 1.0]])
        self.normals = texels.normals
        self.folded_normals = texels.normals * np.where(texels.points[:, :1] < 0, [[-1.0, 1.0, 1.0]], [[1.0, 1.0, 1.0]])
        self.region = dict(zip(field.regions, field.regions_at(texels.points).T, strict=True))

    def share(self, *names: str) -> Floats:
        """How much a texel belongs to some regions."""
        return sum((self.region[name] for name in names if name in self.region), np.zeros(len(self.points)))


def _underside(canvas: _Canvas) -> Floats:
    """1 on the belly, throat and under the tail, 0 on the back."""
    p = canvas.points
    axis_height = np.interp(
        p[:, 2], [-1.1, -0.76, -0.5, -0.3, 0.0, 0.2, 0.3, 0.45], [0.27, 0.205, 0.235, 0.27, 0.29, 0.36, 0.49, 0.545]
    )
    wobble = 0.012 * (fractal_noise(p * 22.0, 2, 5) - 0.5)
    down = -canvas.normals[:, 1]
    below = _step(0.035, -0.045, p[:, 1] - axis_height + wobble - 0.05 * down)
    front = _step(0.55, 0.85, canvas.normals[:, 2]) * _step(0.05, 0.2, p[:, 2]) * _step(0.56, 0.50, p[:, 1])
    body = canvas.share("trunk", "neck", "tail") * np.maximum(below * _step(-0.35, 0.25, down + 0.3), front)
    jaw = canvas.share("jaw") + canvas.share("muzzle", "head") * _step(0.25, 0.7, down)
    return np.clip(body + jaw, 0.0, 1.0)


def paint(field: Field, mesh: BodyMesh, occlusion: Floats) -> Textures:
    """Paint every texel.

    Parameters
    ----------
    field : Field
    mesh : BodyMesh
    occlusion : (V,) float64
        Share of the sky that each vertex sees, in [0, 1].
    """
    texels = locate_texels(mesh, SIZE)
    canvas = _Canvas(field, texels)
    p, up = canvas.points, canvas.normals[:, 1]
    noise = fractal_noise(p * 9.0, 3, 1)
    first, second, tone = cells(p / 0.0165, 3)
    edge = _step(0.02, 0.22, second - first)
    under = _underside(canvas)
    skin = canvas.share("trunk", "neck", "tail", "arm", "leg", "head", "lid", "muzzle", "jaw", "nostril")

    # Skin: deep teal above, lighter on the flanks and limbs, each scale its own tone.
    color = _mix(np.tile(_FLANK, (len(p), 1)), _BACK, _step(0.15, 0.95, up * 0.8 + 0.5 * noise))
    color = _mix(color, _LIGHT, 0.65 * _step(0.25, -0.5, up + 0.5 * (noise - 0.5)))
    color = _mix(color, _LIGHT, 0.45 * canvas.share("muzzle"))
    spot_first, _, spot_tone = cells(canvas.folded / 0.085 + 0.3 * noise[:, None], 11, 0.9)
    spots = _step(0.43, 0.35, spot_first + 0.16 * spot_tone) * _step(-0.25, 0.25, up) * (1.0 - under)
    spots *= canvas.share("trunk", "tail", "leg", "neck", "head") * _step(0.50, 0.40, p[:, 2])
    color = _mix(color, _SPOT, 0.75 * spots)
    color *= (0.90 + 0.20 * tone)[:, None] * (0.80 + 0.20 * edge)[:, None]

    skin_color = color

    # Belly: cream, with broad plates.
    along = np.where(canvas.share("neck", "head") > 0.5, p[:, 1] * 0.9 + p[:, 2] * 0.3, p[:, 2])
    phase = (along / 0.042) % 1.0
    groove = np.minimum(phase, 1.0 - phase) + 0.5 * canvas.share("jaw", "head", "muzzle")
    plates = _mix(np.tile(_BELLY, (len(p), 1)), _BELLY_SHADE, 0.55 * _step(0.14, 0.0, groove) + 0.35 * noise)
    color = _mix(color, plates, under)

    # Ears, wings, fin and crest: coral to gold.
    flame = canvas.share("ear", "wing", "fin", "crest")
    tip = np.clip(_tipness(canvas), 0, 1)
    color = _mix(
        color, _mix(np.tile(_CORAL, (len(p), 1)), _GOLD, tip) * (0.88 + 0.24 * noise)[:, None], _step(0.35, 0.75, flame)
    )

    inner = np.einsum("nk,k->n", canvas.folded_normals, np.array(EAR_THIN) / np.linalg.norm(EAR_THIN))
    back = canvas.share("ear") * _step(0.1, -0.5, inner) * _step(0.85, 0.35, tip)
    color = _mix(color, skin_color, back)
    blushing = _mix(np.tile(_BLUSH, (len(p), 1)), _BELLY, _step(0.25, 0.75, tip))
    color = _mix(color, blushing, 0.8 * canvas.share("ear") * _step(0.45, 0.85, inner) * _step(0.95, 0.55, tip))

    # Horns and claws.
    bone = canvas.share("horn", "claw")
    ring = 0.5 + 0.5 * np.sin(p[:, 1] * 420.0)
    ivory = _mix(
        np.tile(_IVORY, (len(p), 1)),
        _UMBER,
        0.55 * canvas.share("horn") * _step(0.845, 0.775, p[:, 1]) + 0.1 * ring * canvas.share("horn"),
    )
    color = _mix(color, ivory, _step(0.4, 0.7, bone))

    # Blush, nostrils, mouth.
    cheek = np.linalg.norm((canvas.folded - np.array([0.135, 0.585, 0.455])) / np.array([0.05, 0.03, 0.05]), axis=1)
    color = _mix(color, _BLUSH, 0.45 * _step(1.0, 0.2, cheek))
    color = _mix(color, _DARK, 0.85 * _step(0.25, 0.6, canvas.share("nostril")))
    mouth = _mouth_line(canvas)
    color = _mix(color, _rgb("5a2426"), 0.9 * mouth)

    color *= _brush(mesh, texels)[:, None]
    eye = _step(0.45, 0.55, canvas.share("eye"))
    color = _mix(color, _eye_color(canvas), eye)

    scale_height = 0.0011 * _step(0.0, 0.5, second - first) * (1.0 - 0.8 * under) * (1.0 - eye) * skin
    height = scale_height + 0.0016 * under * _step(0.0, 0.14, groove) * skin - 0.004 * mouth
    height += 0.00035 * fractal_noise(p * 150.0, 2, 9) * (1.0 - eye) * (1.0 - 0.5 * bone)

    rough = 0.56 + 0.14 * (noise - 0.5) - 0.10 * edge * skin + 0.08 * under
    rough = rough * (1.0 - bone) + 0.38 * bone
    rough = rough * (1.0 - eye) + 0.06 * eye
    seen = np.einsum("nk,nk->n", np.clip(texels.barycentric, 0, 1), occlusion[mesh.faces[texels.face]])
    seen = seen * (0.85 + 0.15 * np.where(skin > 0.5, edge, 1.0)) * (1.0 - 0.5 * mouth)
    orm = np.stack([seen, rough, np.zeros(len(p))], axis=1)
    normal = tangent_normals(mesh, texels, height, texels.normals)
    return Textures(
        _to_bytes(texels.spread(color)), _to_bytes(texels.spread(orm)), _to_bytes(texels.spread(0.5 + 0.5 * normal))
    )


def _brush(mesh: BodyMesh, texels: Texels) -> Floats:
    """Mottling laid on chart by chart, as by a painter who sees only the flat picture: it does not meet at seams."""
    chart = mesh.charts[texels.face].astype(float)
    place = np.stack([texels.x * (22.0 / texels.size), texels.y * (22.0 / texels.size), 7.31 * chart], axis=1)
    tone = 0.05 * np.sin(12.9898 * chart)
    return 1.0 + tone + 0.22 * (fractal_noise(place, 2, 31) - 0.5)


def _tipness(canvas: _Canvas) -> Floats:
    """0 at the root and 1 at the tip of ears, wings, fin and crest."""
    f = canvas.folded
    ear = np.linalg.norm(f - np.array([0.15, 0.71, 0.305]), axis=1) / 0.26
    wing = np.linalg.norm(f - np.array([0.08, 0.47, 0.05]), axis=1) / 0.38
    fin = np.linalg.norm(f - np.array([0.0, 0.31, -0.93]), axis=1) / 0.24
    parts = [canvas.share(name) for name in ("ear", "wing", "fin", "crest")]
    total = np.maximum(sum(parts), 1e-6)
    result: Floats = (parts[0] * ear + parts[1] * wing + parts[2] * fin + parts[3] * 0.45) / total
    return result


def _mouth_line(canvas: _Canvas) -> Floats:
    """A smile: dark along a curve around the muzzle."""
    f = canvas.folded
    curve = (
        0.570
        + 0.034 * _step(0.060, 0.125, f[:, 0])
        - 0.012 * _step(0.0, 0.045, f[:, 0])
        + 0.012
        + 0.012 * _step(0.095, 0.135, f[:, 0])
    )
    width = 0.0042 - 0.0018 * _step(0.09, 0.13, f[:, 0])
    near = np.abs(f[:, 1] - curve)
    front = _step(0.440, 0.462, f[:, 2])
    return _step(1.0, 0.45, near / width) * front * canvas.share("muzzle", "jaw", "head")


def _eye_color(canvas: _Canvas) -> Floats:
    outwards = canvas.folded - _EYE
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1), 1e-9)[:, None]
    angle = np.degrees(np.arccos(np.clip(outwards @ _GAZE, -1.0, 1.0)))
    above = outwards[:, 1] - _GAZE[1]
    across = np.cross([0.0, 1.0, 0.0], _GAZE)
    azimuth = np.arctan2(above, outwards @ across)
    color = np.tile(_rgb("f6efe2"), (len(angle), 1))
    ray = 0.5 + 0.5 * fractal_noise(np.stack([azimuth * 9.0, angle * 0.04, np.zeros(len(angle))], axis=1), 2, 21)
    iris = _mix(np.tile(_rgb("ffc23a"), (len(angle), 1)), _rgb("c4500e"), _step(-0.25, 0.55, above))
    iris *= (0.72 + 0.42 * ray)[:, None]
    color = _mix(color, iris, _step(56.0, 53.0, angle))
    color = _mix(color, _rgb("2c130c"), 0.9 * _step(47.0, 54.0, angle) * _step(59.0, 55.0, angle))
    color = _mix(
        color, _rgb("ffd873"), 0.5 * _step(40.0, 47.0, angle) * _step(50.0, 46.0, angle) * _step(0.1, -0.5, above)
    )
    color = _mix(color, _rgb("0d090c"), _step(36.0, 33.0, angle))
    for offset, size in (((-0.16, 0.36, 0.08), 14.0), ((0.16, -0.26, 0.0), 7.0)):
        towards = _GAZE + np.array(offset)
        spot = np.degrees(np.arccos(np.clip(outwards @ (towards / np.linalg.norm(towards)), -1.0, 1.0)))
        color = _mix(color, np.ones(3), 0.95 * _step(size, size - 3.0, spot))
    return color


def _to_bytes(image: Floats) -> NDArray[np.uint8]:
    return np.clip(np.rint(image * 255.0), 0, 255).astype(np.uint8)
