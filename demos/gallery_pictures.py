"""The pictures of `demos.gallery`, one function each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from demos.compare import Comparison, close_up, nearest_seam
from demos.crowd import CrowdScene
from demos.headless import Canvas, create_context, write_png
from demos.options import Options
from demos.pictures import Pixels, label, side_by_side
from runtime.asset.asset import load
from runtime.scene.camera import Camera, framing

HERO_SIZE = (1600, 1100)
FOVY_DEG = 26.0
# Seams of the dragon to look at, metres, and how: the chest lit, the belly, which lies in its own shade, as painted.
SEAM_PLACES = (((0.0, 0.29, 0.28), "lit"), ((0.0, 0.13, 0.02), "base_color"))
NUM_IN_CROWD = 800


def draw_pictures(model: Path, built: Path, folder: Path) -> None:
    """Draw all pictures of a built character and write them.

    Parameters
    ----------
    model : Path
        The file it was built from.
    built : Path
    folder : Path
        Where the pictures go.
    """
    ctx = create_context()
    try:
        comparison = Comparison(ctx, load(built), model)
        painters: dict[str, Callable[[Comparison], Pixels]] = {
            "hero.png": hero,
            "levels.png": levels,
            "distance.png": distance,
            "crowd.png": crowd,
            "walk.png": walk,
            "greet.png": greet,
            "seam.png": seam,
            "views.png": views,
            "wireframe.png": wireframe,
            "atlas.png": atlas,
        }
        for name, painter in painters.items():
            write_png(folder / name, painter(comparison))
    finally:
        ctx.release()


def _camera(
    comparison: Comparison, direction: tuple[float, float, float], aspect: float, margin: float = 1.0
) -> Camera:
    return framing(comparison.asset.manifest.bind_bounds, aspect, FOVY_DEG, direction, margin)


def hero(comparison: Comparison) -> Pixels:
    """The character in a walking step, lit."""
    actor = comparison.after.actor(clip="walk", time_s=0.62)
    camera = _camera(comparison, (0.80, 0.22, 1.0), HERO_SIZE[0] / HERO_SIZE[1])
    camera = comparison.studio.fit([actor], camera, HERO_SIZE)
    floor = comparison.asset.manifest.bind_bounds
    return comparison.studio.picture([actor], camera, HERO_SIZE, floor=floor, lod=0, tessellation="auto", finer=2)


def levels(comparison: Comparison) -> Pixels:
    """Every level of detail, lit and as a wireframe."""
    actor = comparison.after.actor(clip="idle", time_s=0.0)
    size = (400, 350)
    camera = _camera(comparison, (0.9, 0.25, 1.0), size[0] / size[1])
    return side_by_side(comparison.levels(actor, comparison.studio.fit([actor], camera, size, 0.8), size))


def distance(comparison: Comparison) -> Pixels:
    """One character five times, ever farther away, each at the level of detail chosen for it: lit, and by level."""
    size = (1808, 760)
    low, high = comparison.asset.manifest.bind_bounds
    length = float(high[2] - low[2])
    actors, heads = [], []
    for index, away in enumerate((0.0, 0.95, 2.5, 5.6, 13.0)):
        transform = np.eye(4)
        transform[:3, 3] = (1.15 * length * away, 0.0, -length * away)
        heads.append(transform[:3, 3] + (0.0, 1.04 * high[1], 0.4 * high[2]))
        actors.append(comparison.after.actor(clip="walk", time_s=0.21 * index, transform=transform))
    box = np.stack([low - np.array([0.0, 0.0, 2.2]) * length, high + np.array([2.6, 0.0, 0.0]) * length])
    eye = np.array([-0.15, 0.66, 1.9]) * length
    camera = Camera(tuple(eye), tuple(eye + length * np.array([0.42, -0.20, -1.0])), fovy_deg=FOVY_DEG)
    lit = comparison.studio.picture(actors, camera, size, floor=box)
    drawn = comparison.studio.renderer.last_drawn
    matrices = camera.matrices(*size)
    for actor, place in zip(actors, heads, strict=True):
        clip = matrices.clip_from_world @ np.append(place - matrices.eye, 1.0)
        level = drawn[actor].level
        text = f"{comparison.asset.manifest.json['lods'][level]['faces']:,} faces"
        x, y = (0.5 + 0.5 * clip[0] / clip[3]) * size[0], (0.5 - 0.5 * clip[1] / clip[3]) * size[1]
        lit = label(lit, text, size_px=16, at=(x, max(y - 30.0, 4.0)))
    return lit


def crowd(comparison: Comparison) -> Pixels:
    """Hundreds of the character in one crowd, each in a moment of its own."""
    size = (1808, 860)
    ctx, folder = comparison.studio.ctx, comparison.asset.path
    scene = CrowdScene(ctx, folder, NUM_IN_CROWD, "walk")
    scene.crowd.update(0.0)
    unit, front = scene.unit_m, scene.front_m
    options = Options(
        folder=folder, headless=True, out=None, size=size, clip="walk", time_s=0.0, lod="auto", tessellation="off",
        eye=(0.4 * unit, 2.5 * unit, front + 3.6 * unit), target=(0.0, -0.7 * unit, front - 6.0 * unit),
        fovy_deg=30.0, view="lit", backdrop=True,
    )  # fmt: skip
    canvas = Canvas(ctx, size)
    scene.draw(canvas.framebuffer, scene.camera(options), options, options.view)
    pixels = canvas.pixels()[..., :3].copy()
    scene.release()
    canvas.release()
    return pixels


def _strip(
    comparison: Comparison,
    clip: str,
    times_s: list[float],
    direction: tuple[float, float, float],
    size: tuple[int, int],
) -> Pixels:
    """Moments of a clip, all seen by one camera that all of them fit into."""
    box = comparison.asset.manifest.bind_bounds
    actors = [comparison.after.actor(clip=clip, time_s=time_s) for time_s in times_s]
    camera = comparison.studio.fit(actors, _camera(comparison, direction, size[0] / size[1]), size, 0.9)
    panels = []
    for actor, time_s in zip(actors, times_s, strict=True):
        picture = comparison.studio.picture([actor], camera, size, floor=box, lod=0, finer=2)
        panels.append(label(picture, f"{time_s:.2f} s", size_px=16))
    half = -(-len(panels) // 2)
    return side_by_side([panels[:half], panels[half:]])


def walk(comparison: Comparison) -> Pixels:
    """Eight moments of the walk, from the side."""
    return _strip(comparison, "walk", [1.1 * k / 8 for k in range(8)], (1.0, 0.16, 0.45), (460, 340))


def greet(comparison: Comparison) -> Pixels:
    """Eight moments of the greeting, from the front."""
    return _strip(comparison, "greet", [0.0, 0.36, 0.7, 0.98, 1.3, 1.62, 2.2, 3.0], (0.5, 0.12, 1.0), (400, 460))


def seam(comparison: Comparison) -> Pixels:
    """Two seams from close by, before and after: one lit, one as painted."""
    assert comparison.before_asset is not None
    rows = []
    for point, view in SEAM_PLACES:
        camera = close_up(comparison.asset, *nearest_seam(comparison.asset, point))
        before, after = comparison.seam_pair(camera, (900, 520), view)
        shown = view.replace("_", " ")
        rows.append([label(before, f"as baked, {shown}", size_px=18), label(after, "seams erased", size_px=18)])
    return side_by_side(rows)


def views(comparison: Comparison) -> Pixels:
    """The signals that textures hold."""
    size = (470, 420)
    actor = comparison.after.actor()
    camera = comparison.studio.fit([actor], _camera(comparison, (0.8, 0.2, 1.0), size[0] / size[1]), size, 0.92)
    panels = [
        label(comparison.studio.picture([actor], camera, size, view=view, lod=0, finer=3), text, size_px=18)
        for view, text in (
            ("base_color", "base colour"),
            ("normal", "normal"),
            ("position", "position"),
            ("weights", "joint weights"),
        )
    ]
    return side_by_side([panels])


def wireframe(comparison: Comparison) -> Pixels:
    """Triangles of the finest level, and the seams of the atlas."""
    size = (940, 760)
    actor = comparison.after.actor()
    camera = comparison.studio.fit([actor], _camera(comparison, (0.7, 0.2, 1.0), size[0] / size[1]), size)
    panels = [
        label(comparison.studio.picture([actor], camera, size, view=view, lod=0, finer=2), text, size_px=18)
        for view, text in (("wireframe", f"{len(comparison.asset.lods[0].triangles):,} triangles"), ("seams", "seams"))
    ]
    return side_by_side([panels])


def atlas(comparison: Comparison) -> Pixels:
    """The stored base colour with chart outlines over it, beside the normals."""
    side = 1024
    asset = comparison.asset
    panels = []
    for name in ("base_color", "normal"):
        texels = asset.textures[name].levels[0][..., :3]
        shown = texels if texels.dtype == np.uint8 else (texels / 65535.0 * 255.0).astype(np.uint8)
        panels.append(np.asarray(Image.fromarray(np.ascontiguousarray(shown)).resize((side, side))))
    mesh = asset.lods[0]
    corners = mesh.triangles.astype(np.int64)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, first, count = np.unique(low * len(mesh.uvs) + high, return_index=True, return_counts=True)
    outline = first[count == 1]
    image = Image.fromarray(panels[0])
    pen = ImageDraw.Draw(image)
    for a, b in zip(mesh.uvs[start[outline]] * side, mesh.uvs[end[outline]] * side, strict=True):
        pen.line([tuple(a.tolist()), tuple(b.tolist())], fill=(255, 255, 255), width=2)
    return side_by_side([[np.asarray(image), panels[1]]])
