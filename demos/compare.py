"""Before and after, and the levels of detail side by side.

    python -m demos.compare human.seamless                                      a window
    python -m demos.compare human.seamless --headless --out sheet.png           one picture
    python -m demos.compare human.seamless --source human.glb --seam 2 ...      before and after at another seam

Above: a seam from close by as a plain bake leaves it, and erased and owned. The source file is looked for beside the
folder; without it only the levels are shown. Below: every level of detail, lit and as a wireframe.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from demos.errors import DemoError
from demos.extras import needs_packages
from demos.headless import create_context, write_png
from demos.model_cache import MODEL_SUFFIXES
from demos.options import Options, Parser, add_arguments, options_of, run
from demos.viewer import choose_camera, find_folder, make_actor
from runtime.asset.asset import Asset, load
from runtime.gpu.model import Model
from runtime.render.renderer import Renderer
from runtime.scene.actor import Actor
from runtime.scene.camera import Camera

with needs_packages(__name__, "compare"):
    from scipy.spatial import cKDTree

    from demos.before import find_source, without_erasure
    from demos.pictures import Pixels, Studio, label, side_by_side

CLOSE_REL = 0.055  # half height of a close-up, of the bounding diagonal


Place = tuple[NDArray[np.float64], NDArray[np.float64]]  # a point of the skin at rest, and its unit normal


def _seam_vertices(asset: Asset) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Vertices of the finest level that do not own their surface point, their points and unit normals at rest."""
    mesh = asset.lods[0]
    split = np.flatnonzero((mesh.uvs != mesh.canonical_uvs).any(axis=1))
    points = _sample(asset.textures["position"].levels[0].astype(np.float64), mesh.canonical_uvs[split])
    stored = asset.textures["normal"].levels[0]
    plain = stored.astype(np.float64) / 65535.0 * 2.0 - 1.0 if stored.dtype == np.uint16 else stored.astype(np.float64)
    normals = _sample(plain, mesh.canonical_uvs[split])
    return split, points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def nearest_seam(asset: Asset, point: tuple[float, float, float]) -> Place:
    """The place on a seam that is nearest to a point at rest.

    Raises
    ------
    DemoError
        If the character has no seams.
    """
    split, points, normals = _seam_vertices(asset)
    if not len(split):
        raise DemoError(f"{asset.name} has no seams")
    index = int(np.linalg.norm(points - np.array(point), axis=1).argmin())
    return points[index], normals[index]


def worst_seams(asset: Asset, before: Asset, count: int) -> list[Place]:
    """Places on the skin where the two sides of a seam differ most in tone, some close-ups apart from each other."""
    split, points, normals = _seam_vertices(asset)
    if not len(split):
        return []
    mesh, levels = asset.lods[0], before.textures["base_color"].levels
    level = levels[min(3, len(levels) - 1)]
    tone = level[..., :3].sum(axis=2, keepdims=True) / 765.0 + 0.02  # of a few texels: not their pattern
    jump = np.log(_sample(tone, mesh.uvs[split]) / _sample(tone, mesh.canonical_uvs[split]))[:, 0]
    diagonal = float(np.linalg.norm(np.ptp(asset.manifest.bind_bounds, axis=0)))
    # A step that goes the same way all along a stretch of seam is what an eye sees; a pattern that is off is not.
    around = cKDTree(points).query_ball_point(points, 0.5 * CLOSE_REL * diagonal)
    step = np.array([abs(jump[near].mean()) - 0.5 * jump[near].std() for near in around])
    places: list[Place] = []
    for index in np.argsort(-step, kind="stable"):
        if all(np.linalg.norm(points[index] - point) > 4.0 * CLOSE_REL * diagonal for point, _ in places):
            places.append((points[index], normals[index]))
        if len(places) == count:
            break
    return places


def _sample(texels: NDArray[np.float64], uvs: NDArray[np.float32]) -> NDArray[np.float64]:
    """Nearest texels."""
    height, width = texels.shape[:2]
    x = np.clip((uvs[:, 0] * width).astype(int), 0, width - 1)
    y = np.clip((uvs[:, 1] * height).astype(int), 0, height - 1)
    result: NDArray[np.float64] = texels[y, x]
    return result


def close_up(asset: Asset, point: NDArray[np.float64], normal: NDArray[np.float64]) -> Camera:
    """A camera in front of a point of the skin."""
    distance = 4.5 * CLOSE_REL * float(np.linalg.norm(np.ptp(asset.manifest.bind_bounds, axis=0)))
    eye = point + normal * distance
    up = (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (0.0, 0.0, 1.0)
    return Camera(tuple(eye), tuple(point), up=up, fovy_deg=25.0)  # type: ignore[arg-type]


class Comparison:
    """A character with and without its seams erased, in one context."""

    def __init__(self, ctx: moderngl.Context, asset: Asset, source: Path | None) -> None:
        self.asset = asset
        self.after = Model(ctx, asset)
        self.studio = Studio(ctx)
        self.before_asset = None if source is None else without_erasure(asset, source)
        self.before: Model | None = None
        if self.before_asset is not None:
            self.before = Model(ctx, self.before_asset, position_format="float32")
            self.plain = Studio(ctx, Renderer(ctx, shader_defines={"WITHOUT_CANONICAL_UVS": 1}))

    def seam_pair(self, camera: Camera, size: tuple[int, int], view: str = "lit") -> tuple[Pixels, Pixels]:
        """The same close-up before and after."""
        assert self.before is not None
        before = self.plain.picture([self.before.actor()], camera, size, view=view, lod=0)
        after = self.studio.picture([self.after.actor()], camera, size, view=view, lod=0)
        return before, after

    def levels(self, actor: Actor, camera: Camera, size: tuple[int, int], most: int = 6) -> list[list[Pixels]]:
        """All levels of detail, lit above and as wireframes below with their numbers of faces, `most` in a band."""
        lit, wires = [], []
        floor = self.asset.manifest.bind_bounds
        for level, mesh in enumerate(self.asset.lods):
            faces = f"{len(mesh.triangles):,} faces"
            text = faces if level == 0 else f"{faces}, error {1e3 * mesh.error_m:.1f} mm"
            lit.append(self.studio.picture([actor], camera, size, floor=floor, lod=level))
            wire = self.studio.picture([actor], camera, size, view="wireframe", lod=level)
            wires.append(label(wire, text, size_px=max(11, min(18, size[0] // 18))))
        columns = -(-len(lit) // -(-len(lit) // most))
        rows: list[list[Pixels]] = []
        for first in range(0, len(lit), columns):
            rows += [lit[first : first + columns], wires[first : first + columns]]
        return rows


def draw_sheet(options: Options, source: Path | None, seam: int) -> None:
    """One picture with everything."""
    asset = load(find_folder(options))
    ctx = create_context()
    try:
        comparison = Comparison(ctx, asset, source or find_source(asset))
        width, height = options.size
        rows: list[list[Pixels]] = []
        if comparison.before_asset is not None:
            places = worst_seams(asset, comparison.before_asset, seam + 1)
            if len(places) <= seam:
                raise DemoError(f"{asset.name} has {len(places)} places to show, counted from 0: choose another --seam")
            camera = close_up(asset, *places[seam])
            before, after = comparison.seam_pair(camera, (width // 2 - 4, height // 2))
            rows.append([label(before, "as baked"), label(after, "seams erased")])
        bands = -(-len(asset.lods) // 6)
        panel = width // -(-len(asset.lods) // bands) - 8
        below = (height - (height // 2 if rows else 0)) // (2 * bands) - 8
        actor = make_actor(comparison.after, options)
        camera = choose_camera(comparison.after, options)
        rows += comparison.levels(actor, camera, (max(panel, 16), max(below, 16)))
        assert options.out is not None
        write_png(options.out, side_by_side(rows))
    finally:
        ctx.release()


class _SplitView:
    """The window: before and after share the left half, the levels of detail the right one."""

    def __init__(self, window: Any, options: Options, source: Path | None) -> None:
        from demos.orbit import Orbit

        asset = load(find_folder(options))
        self.window = window
        self.comparison = Comparison(window.ctx, asset, source or find_source(asset))
        self.orbit = Orbit(choose_camera(self.comparison.after, options))
        self.actor = make_actor(self.comparison.after, options)
        window.on_drag, window.on_scroll = self._drag, lambda steps: self.orbit.zoom(steps)

    def _drag(self, dx_px: float, dy_px: float, move: bool) -> None:
        if move:
            self.orbit.move(dx_px, dy_px, self.window.size[1])
        else:
            self.orbit.turn(dx_px, dy_px)

    def frame(self, dt_s: float) -> None:
        """Draw all panels into the window."""
        self.actor.update(dt_s)
        target = self.window.framebuffer
        target.use()
        target.clear(0.95, 0.95, 0.96, 1.0, depth=1.0)
        width, height = self.window.size
        camera, comparison = self.orbit.camera(), self.comparison
        panels: list[tuple[Any, Actor, int]] = []
        if comparison.before is not None:
            panels.append((comparison.plain.renderer, comparison.before.actor(), 0))
        panels += [(comparison.studio.renderer, self.actor, level) for level in range(len(comparison.asset.lods))]
        columns = int(np.ceil(np.sqrt(len(panels))))
        rows = -(-len(panels) // columns)
        for index, (renderer, actor, level) in enumerate(panels):
            column, row = index % columns, index // columns
            target.viewport = (
                column * width // columns, height - (row + 1) * height // rows, width // columns, height // rows
            )  # fmt: skip
            renderer.draw([actor], camera, lod=level, tessellation="off")
        target.viewport = (0, 0, width, height)


def show_window(options: Options, source: Path | None) -> None:
    """Run the window until it is closed."""
    import time

    from demos.window import Window

    with Window("seamskin: before and after, levels of detail", options.size) as window:
        panels = _SplitView(window, options, source)
        last = time.perf_counter()
        while window.next_frame():
            now = time.perf_counter()
            panels.frame(now - last)
            last = now


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.compare`."""

    def work() -> None:
        parser = Parser("python -m demos.compare", description="Before and after, levels of detail side by side.")
        add_arguments(parser)
        parser.add_argument("--source", type=Path, metavar="MODEL", help="the file that DIR was built from")
        parser.add_argument("--seam", type=int, default=0, metavar="N", help="which seam to look at, 0 the worst")
        parsed = parser.parse_args(arguments)
        model = parsed.folder if parsed.folder and parsed.folder.suffix.lower() in MODEL_SUFFIXES else None
        options = options_of(parsed)
        parsed.source = parsed.source or model
        if parsed.seam < 0:
            raise DemoError(f"--seam counts from 0, not {parsed.seam}")
        if parsed.source is not None and not parsed.source.is_file():
            raise DemoError(f"{parsed.source}: no such file")
        if options.headless:
            draw_sheet(options, parsed.source, parsed.seam)
        else:
            show_window(options, parsed.source)

    return run("compare", work)


if __name__ == "__main__":
    sys.exit(main())
