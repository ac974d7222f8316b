"""The pictures of `demos.gallery`, one function each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from demos.compare import Comparison, close_up, nearest_seam
from demos.headless import create_context, write_png
from demos.pictures import Pixels, label, side_by_side
from runtime.asset import load
from runtime.camera import Camera, framing

HERO_SIZE = (1600, 1100)
FOVY_DEG = 26.0
SEAM_PLACES = ((0.0, 0.13, 0.02), (0.0, 0.29, 0.28))  # the belly and the chest of the dragon, metres


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
    return comparison.studio.picture([actor], camera, HERO_SIZE, floor=floor, lod=0, tessellation="auto")


def levels(comparison: Comparison) -> Pixels:
    """Every level of detail, lit and as a wireframe."""
    actor = comparison.after.actor(clip="idle", time_s=0.0)
    size = (400, 350)
    camera = _camera(comparison, (0.9, 0.25, 1.0), size[0] / size[1])
    return side_by_side(comparison.levels(actor, comparison.studio.fit([actor], camera, size, 0.8), size))


def distance(comparison: Comparison) -> Pixels:
    """Levels chosen by distance: lit, and coloured by level."""
    actors = []
    for index, away in enumerate((0.0, 2.2, 6.0, 14.0, 34.0)):
        transform = np.eye(4)
        transform[:3, 3] = (-0.42 * away - 0.25 * bool(index), 0.0, -away)
        actors.append(comparison.after.actor(clip="walk", time_s=0.21 * index, transform=transform))
    size = (900, 620)
    camera = _camera(comparison, (0.75, 0.34, 1.0), size[0] / size[1], 3.0)
    camera = comparison.studio.fit(actors, camera, size, 0.90)
    lit = comparison.studio.picture(actors, camera, size)
    colored = comparison.studio.picture(actors, camera, size, view="lod")
    drawn = comparison.studio.renderer.last_drawn
    chosen = [drawn[actor].level for actor in actors]
    return side_by_side([[lit, label(colored, "levels, from near to far: " + ", ".join(map(str, chosen)), size_px=18)]])


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
        picture = comparison.studio.picture([actor], camera, size, floor=box, lod=0)
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
    """Two seams from close by, before and after: lit, and the base colour alone."""
    assert comparison.before_asset is not None
    rows = []
    for point in SEAM_PLACES:
        camera = close_up(comparison.asset, *nearest_seam(comparison.asset, point))
        row: list[Pixels] = []
        for view in ("lit", "base_color"):
            before, after = comparison.seam_pair(camera, (480, 440), view)
            row += [label(before, "as baked", size_px=18), label(after, "seams erased", size_px=18)]
        rows.append(row)
    return side_by_side(rows)


def views(comparison: Comparison) -> Pixels:
    """The signals that textures hold."""
    size = (470, 420)
    actor = comparison.after.actor()
    camera = comparison.studio.fit([actor], _camera(comparison, (0.8, 0.2, 1.0), size[0] / size[1]), size, 0.92)
    panels = [
        label(comparison.studio.picture([actor], camera, size, view=view, lod=0), view.replace("_", " "), size_px=18)
        for view in ("base_color", "normal", "position", "weights")
    ]
    return side_by_side([panels])


def wireframe(comparison: Comparison) -> Pixels:
    """Triangles of the finest level, and the seams of the atlas."""
    size = (940, 760)
    actor = comparison.after.actor()
    camera = comparison.studio.fit([actor], _camera(comparison, (0.7, 0.2, 1.0), size[0] / size[1]), size)
    return side_by_side(
        [[comparison.studio.picture([actor], camera, size, view=view, lod=0) for view in ("wireframe", "seams")]]
    )


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
