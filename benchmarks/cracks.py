"""Cracks over whole characters: random frames of all clips, levels, tessellation factors and spacings.

A frame is drawn with front faces white and back faces red. From outside, a closed surface shows no red, from inside
nothing else: what shows otherwise is a crack, or the body turned inside out by its pose. To tell these apart every
static frame is drawn again with vertices that nothing can separate, one vertex a surface point; pixels that are wrong
with our drawing and right with that one are cracks. A tessellated frame has no such twin: its points are read back, and
those count that two triangles share and that are not the same bits, or that one triangle makes alone. What triangles
share to the bit no rasteriser of OpenGL may separate. The same frames without canonical uvs, and with one side of
every seam moved by a millionth of the size, are counted beside it.

Only closed parts of a character are drawn; what is open at its edges shows its inside rightly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from benchmarks._inputs import BUILT_HELP, built_characters, command_line
from benchmarks._points import MIN_VERSION_CODE, PointCapture, differing_points
from benchmarks._table import print_table
from demos.headless import Canvas, create_context
from demos.options import picture_size
from runtime.asset.asset import Asset, load
from runtime.asset.lod_mesh import DrawRange, LodMesh
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.scene.actor import Actor
from runtime.scene.camera import Camera

SHIFT_REL = 1e-6  # of the control: how far one side of every seam is moved, of the body's diagonal


def closed_parts(mesh: LodMesh) -> LodMesh:
    """The faces of those connected parts whose every edge has two faces."""
    _, point = np.unique(mesh.canonical_uvs, axis=0, return_inverse=True)
    corners = point.ravel()[mesh.triangles.astype(np.int64)]
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    keys = np.minimum(start, end) * (point.max() + 1) + np.maximum(start, end)
    _, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
    part = np.arange(point.max() + 1)
    while True:  # every point takes the smallest number among its faces' points, until nothing changes
        lowest = part[corners].min(axis=1)
        merged = part.copy()
        np.minimum.at(merged, corners.ravel(), np.repeat(lowest, 3))
        merged = merged[merged]
        if (merged == part).all():
            break
        part = merged
    is_open = np.zeros(len(part), bool)
    is_open[part[corners[(count[edge] != 2).reshape(-1, 3).any(axis=1)]]] = True
    keep = ~is_open[part[corners[:, 0]]]
    draws, first = [], 0
    for draw in mesh.draws:
        kept = int(keep[draw.first : draw.first + draw.count].sum())
        draws.append(DrawRange(first, kept, draw.material))
        first += kept
    return dataclasses.replace(mesh, triangles=mesh.triangles[keep], draws=tuple(draws))


def surface_points(mesh: LodMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first vertex of each surface point, and the point of each vertex."""
    _, first, point = np.unique(mesh.canonical_uvs, axis=0, return_index=True, return_inverse=True)
    return first, point.ravel()


def welded(mesh: LodMesh, *, at_canonical: bool) -> LodMesh:
    """The same faces with one vertex a surface point, which fetches at its canonical uv or at its first copy's."""
    first, point = surface_points(mesh)
    uvs = (mesh.canonical_uvs if at_canonical else mesh.uvs)[first]
    triangles = point[mesh.triangles.astype(np.int64)].astype(np.uint32)
    return dataclasses.replace(mesh, uvs=uvs, canonical_uvs=uvs, triangles=triangles, normal_uvs=None)


def moved_seams(mesh: LodMesh, shift_uv: float) -> LodMesh:
    """The canonical uv of every copy that lies elsewhere in the atlas than its point's first copy, moved."""
    first, point = surface_points(mesh)
    canonical = mesh.canonical_uvs.copy()
    canonical[(mesh.uvs != mesh.uvs[first[point]]).any(axis=1)] += np.float32(shift_uv)
    return dataclasses.replace(mesh, canonical_uvs=canonical)


def metres_per_uv(asset: Asset) -> float:
    """How far a step in the atlas leads over the body, the median of the finest level's edges."""
    from preprocess.mesh.texels import sample_bilinear

    mesh = asset.lods[0]
    positions = sample_bilinear(asset.textures["position"].levels[0][:, :, :3], mesh.canonical_uvs)
    a, b = mesh.triangles[:, 0], mesh.triangles[:, 1]
    uv = np.linalg.norm(mesh.uvs[a] - mesh.uvs[b], axis=1)
    length = np.linalg.norm(positions[a] - positions[b], axis=1)
    return float(np.median(length[uv > 0] / uv[uv > 0]))


@dataclasses.dataclass(frozen=True)
class Frame:
    """What is drawn, from where."""

    clip: int
    share: float
    camera: Camera
    inside: bool
    level: int
    tessellation: float | str
    equal_spacing: bool


def frames(asset: Asset, count: int, seed: int) -> Iterator[Frame]:
    """Random frames, every fourth from inside, half of them tessellated."""
    rng = np.random.default_rng(seed)
    low, high = asset.manifest.bind_bounds
    size = float(np.linalg.norm(high - low))
    for index in range(count):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        target = rng.uniform(low, high)
        inside = index % 4 == 3
        distance = size * (0.02 if inside else rng.uniform(0.55, 2.0))
        tessellated = index % 2 == 1
        level = int(rng.integers(len(asset.lods)))
        if tessellated:  # fine levels need no high factors
            level = max(level, len(asset.lods) - 3)
        factor: float | str = float(np.exp(rng.uniform(0, np.log(64))))
        yield Frame(
            clip=int(rng.integers(max(len(asset.clips), 1))),
            share=float(rng.uniform()),
            camera=Camera(
                tuple(target + direction * distance),
                tuple(target),
                fovy_deg=float(rng.uniform(15, 70)),
                near_m=size * (0.002 if inside else 0.05),
                far_m=size * 4,
            ),
            inside=inside,
            level=level,
            tessellation=("auto" if index % 10 == 1 else factor) if tessellated else "off",
            equal_spacing=bool(rng.integers(2)),
        )


def facing(canvas: Canvas) -> NDArray[np.int8]:
    """Of each pixel: 1 front face, -1 back face, 0 nothing. (H, W)"""
    pixels = canvas.pixels()
    return np.where(pixels[..., 3] == 0, 0, np.where(pixels[..., 1] > 0, 1, -1)).astype(np.int8)


class Drawer:
    """A character with one set of meshes, drawn one way."""

    def __init__(self, ctx: moderngl.Context, asset: Asset, defines: dict[str, int] | None = None) -> None:
        self.model = Model(ctx, asset)
        own = defines or {}
        self.captures: dict[bool, PointCapture] = {}
        self.defines = own
        self.renderers = {equal: Renderer(ctx, shader_defines={**own, **({"EQUAL_SPACING": 1} if equal else {})})
                          for equal in (False, True)}  # fmt: skip

    def actor(self, frame: Frame) -> Actor:
        """An actor in the frame's pose."""
        clips = self.model.asset.clips
        if not clips:
            return self.model.actor()
        return self.model.actor(clip=frame.clip, time_s=frame.share * clips[frame.clip].duration_s)

    def draw(self, canvas: Canvas, frame: Frame) -> NDArray[np.int8]:
        """A static frame's facing."""
        actor = self.actor(frame)
        with canvas.drawing():
            self.renderers[frame.equal_spacing].draw(
                [actor], frame.camera, view="facing", lod=frame.level, tessellation="off"
            )
        actor.release()
        return facing(canvas)

    def unlike_points(self, canvas: Canvas, frame: Frame) -> tuple[int, int]:
        """Points of a tessellated frame, and how many of those that triangles share are not the same bits."""
        equal = frame.equal_spacing
        if equal not in self.captures:
            spacing = {"EQUAL_SPACING": 1} if equal else {}
            self.captures[equal] = PointCapture(self.model, {**self.defines, **spacing})
        actor = self.actor(frame)
        with canvas.drawing():
            points = self.captures[equal].points(actor, frame.camera, frame.level, frame.tessellation)
        actor.release()
        return len(points), sum(differing_points(points)) if len(points) else 0


def cracks(seen: NDArray[np.int8], frame: Frame, twin: NDArray[np.int8]) -> int:
    """Pixels that show what a closed surface hides."""
    wanted = -1 if frame.inside else 1
    return int(((seen != wanted) & (twin == wanted)).sum())


def measure(ctx: moderngl.Context, folder: Path, count: int, size: tuple[int, int], seed: int) -> dict[str, Any]:
    """Cracks in random frames of one character."""
    asset = load(folder)
    closed = [closed_parts(mesh) for mesh in asset.lods]
    asset = dataclasses.replace(asset, lods=tuple(mesh for mesh in closed if len(mesh.triangles)))
    low, high = asset.manifest.bind_bounds
    shift_uv = SHIFT_REL * float(np.linalg.norm(high - low)) / metres_per_uv(asset)
    shifted = dataclasses.replace(asset, lods=tuple(moved_seams(mesh, shift_uv) for mesh in asset.lods))
    single, first = (
        dataclasses.replace(asset, lods=tuple(welded(mesh, at_canonical=at_canonical) for mesh in asset.lods))
        for at_canonical in (True, False)
    )
    ours, without = Drawer(ctx, asset), Drawer(ctx, asset, {"WITHOUT_CANONICAL_UVS": 1})
    moved, twin, first_twin = Drawer(ctx, shifted), Drawer(ctx, single), Drawer(ctx, first)
    canvas = Canvas(ctx, size, smooth=False)
    result = {"static cracks, px": 0, "without canonical uvs, px": 0, "moved by 1e-6, px": 0}
    bits = {"tessellated points": 0, "unlike bits": 0, "without canonical uvs, points": 0}
    for frame in frames(asset, count, seed):
        if frame.tessellation == "off":
            reference, own_reference = twin.draw(canvas, frame), first_twin.draw(canvas, frame)
            pairs = ((ours, reference), (without, own_reference), (moved, reference))
            for name, (drawer, sound) in zip(result, pairs):
                result[name] += cracks(drawer.draw(canvas, frame), frame, sound)
        elif ctx.version_code >= MIN_VERSION_CODE:
            made, unlike = ours.unlike_points(canvas, frame)
            bits["tessellated points"] += made
            bits["unlike bits"] += unlike
            bits["without canonical uvs, points"] += without.unlike_points(canvas, frame)[1]
    kept = len(asset.lods[0].triangles)
    return {"character": asset.name, "frames": count, "closed faces": kept, **result, **bits}


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print."""
    parser = command_line("cracks", __doc__)
    parser.add_argument("--built", type=Path, nargs="+", help=BUILT_HELP)
    parser.add_argument("--frames", type=int, default=500, help="in all (500)")
    parser.add_argument("--size", type=picture_size, default=(1024, 1024), metavar="WxH")
    options = parser.parse_args(argv)
    rows: list[dict[str, Any]] = []
    folders = built_characters(options.built)
    for seed, folder in enumerate(folders):
        ctx = create_context()
        if not rows:
            print(f"{ctx.info['GL_RENDERER']}, OpenGL {ctx.version_code / 100:.1f}", flush=True)
        rows.append(measure(ctx, folder, -(-options.frames // len(folders)), options.size, seed))
        ctx.release()
    print_table(rows)
    return rows
