"""Ten thousand actors: ours beside ordinary instanced skinning, at full detail and with meshoptimizer's levels.

All of them run in one context in one run, with the same culling, the same baked poses and the same shaders; what
differs is the meshes and textures: (a) the source file's own mesh, (b) levels that meshoptimizer makes from it, ours
the built character's. (a) and (b) are skinned by vertex attributes; (b) is also given the ready-made poses that coarse
levels of ours have, and is chosen by the error that it reports or by its largest error in any pose, measured as ours
is. Pictures have eight samples per pixel; their error is measured against full detail with nine pixels for one and a
padded texture, so that neither edges nor bleeding mip levels are in the reference.

CPU time counts all threads of the process: in software OpenGL it is the work, whatever else the machine does.
"""

from __future__ import annotations

import argparse
import ctypes
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

import runtime
from benchmarks._inputs import ASSETS, MissingInput, command_line
from benchmarks._inputs import BUILT as BUILT_FOLDERS
from benchmarks._table import print_table
from demos.crowd import square
from demos.headless import Canvas, create_context, write_png
from demos.options import picture_size
from runtime.crowd.crowd import VERTEX_ANIMATION_BYTES
from runtime.crowd.lod_buffers import LevelMesh
from runtime.gltf.document import Document, read_document
from runtime.gpu.lod_buffers import MaterialRange

SOURCE, BUILT = ASSETS / "human.glb", BUILT_FOLDERS[0] / "human.seamless"
COARSEST_FACES = 48
UV_WEIGHT = 1.0  # of meshoptimizer's attribute metric; its documentation's own scale for unit-sized attributes
OVERSAMPLING = 3  # pixels of the reference along a pixel's side
THRESHOLDS_PX = (1.0, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.0)
MEASURED_POSES = 12
Chain = list[tuple[NDArray[np.uint32], float]]  # triangles and error, metres, of each level
BACKGROUND = (0.62, 0.66, 0.70, 1.0)


@dataclass(frozen=True)
class SourceMesh:
    """The file's own mesh: V vertices, F faces."""

    positions: NDArray[np.float32]
    uvs: NDArray[np.float32]
    joints: NDArray[np.uint16]
    weights: NDArray[np.float32]
    triangles: NDArray[np.uint32]


def read_source(document: Document) -> SourceMesh:
    """The first primitive of a file with one skinned mesh."""
    primitive = document.json["meshes"][0]["primitives"][0]
    attributes = {name: document.accessor(index) for name, index in primitive["attributes"].items()}
    weights = attributes["WEIGHTS_0"].astype(np.float32)
    return SourceMesh(
        positions=attributes["POSITION"].astype(np.float32),
        uvs=attributes["TEXCOORD_0"].astype(np.float32),
        joints=attributes["JOINTS_0"].astype(np.uint16),
        weights=weights / weights.sum(axis=1, keepdims=True),
        triangles=document.accessor(primitive["indices"]).astype(np.uint32).reshape(-1, 3),
    )


def meshoptimizer_levels(mesh: SourceMesh, with_uvs: bool) -> Chain:
    """Triangles and reported error, metres, of each level: half the faces of the one before."""
    import meshoptimizer

    positions = np.ascontiguousarray(mesh.positions)
    indices = np.ascontiguousarray(mesh.triangles.ravel())
    scale = float(meshoptimizer.simplify_scale(positions, len(positions), positions.strides[0]))
    levels = [(mesh.triangles, 0.0)]
    wanted = len(mesh.triangles) // 2
    while wanted >= COARSEST_FACES:
        result, error = np.zeros_like(indices), np.zeros(1, np.float32)
        options: dict[str, Any] = {"target_index_count": 3 * wanted, "target_error": 1e9, "result_error": error}
        if with_uvs:
            uvs = np.ascontiguousarray(mesh.uvs)
            sizes = (len(indices), len(positions), positions.strides[0], uvs.strides[0], 2)
            # The binding declares no argument types for this function: sizes and floats must be given as such.
            options |= {"target_index_count": ctypes.c_size_t(3 * wanted), "target_error": ctypes.c_float(1e9)}
            weights = np.full(2, UV_WEIGHT, np.float32)
            count = meshoptimizer.simplify_with_attributes(
                result, indices, positions, uvs, weights, *map(ctypes.c_size_t, sizes), **options
            )
        else:
            count = meshoptimizer.simplify(
                result, indices, positions, len(indices), len(positions), positions.strides[0], **options
            )
        triangles = result[:count].reshape(-1, 3).copy()
        if len(triangles) >= 0.95 * len(levels[-1][0]):
            break  # it does not get lower
        levels.append((triangles, float(error[0]) * scale))
        wanted //= 2
    return levels


def largest_errors(mesh: SourceMesh, chain: Chain, matrices: NDArray[np.float32]) -> Chain:
    """The same levels with their largest distance from the full mesh, either way, in poses spread over all clips."""
    from preprocess.decimate.measure import sample_mesh
    from preprocess.mesh.closest_point import build_tree

    points = np.concatenate([mesh.positions, np.ones((len(mesh.positions), 1))], axis=1).astype(np.float64)
    posed = []
    for rows in matrices[np.linspace(0, len(matrices) - 1, MEASURED_POSES).astype(int)].astype(np.float64):
        posed.append(np.einsum("vk,vkij,vj->vi", mesh.weights, rows[mesh.joints], points))
    full = mesh.triangles.astype(np.int32)
    trees = [build_tree(positions[full]) for positions in posed]
    from_full = [sample_mesh(positions, full, 2048).points(positions, full) for positions in posed]
    measured = []
    for triangles, error_m in chain:
        faces, largest = triangles.astype(np.int32), error_m and 0.0
        for positions, tree, samples in zip(posed, trees, from_full) if error_m else ():
            points_of = sample_mesh(positions, faces, 2048).points(positions, faces)
            largest = max(largest, tree.query(points_of)[0].max(), build_tree(positions[faces]).query(samples)[0].max())
        measured.append((triangles, float(largest)))
    return measured


class AttributeCrowd(runtime.Crowd):
    """The same crowd by ordinary vertex attributes, from other meshes and textures than the model's."""

    def __init__(
        self,
        ctx: moderngl.Context,
        model: runtime.Model,
        count: int,
        mesh: SourceMesh,
        levels: Chain,
        base_color: moderngl.Texture,
        vertex_animation_bytes: int,
    ) -> None:
        self._mesh, self._chain, self._base_color = mesh, levels, base_color
        super().__init__(ctx, model, count, vertex_animation_bytes=vertex_animation_bytes)

    @property
    def textures(self) -> Mapping[str, moderngl.Texture]:
        """The model's, with the file's own base colour."""
        return {**self.model.textures, "base_color_texture": self._base_color}

    def _meshes(self) -> list[LevelMesh]:
        own = self.model.lods[0].ranges[0]
        result = []
        for triangles, error_m in self._chain:
            used, corners = np.unique(triangles, return_inverse=True)
            indices = self.ctx.buffer(corners.astype("<u4").tobytes())
            self._owned.append(indices)
            mesh, ranges = self._mesh, (MaterialRange(0, len(triangles), own.material, own.defines),)
            attributes = (mesh.positions[used], mesh.uvs[used], mesh.joints[used].astype(np.int64), mesh.weights[used])
            result.append(LevelMesh(*attributes, indices, 4, ranges, error_m))
        return result

    def _seam_lines(self, level: int) -> moderngl.Buffer | None:
        return None


def source_base_color(ctx: moderngl.Context, document: Document, padded_for: SourceMesh | None) -> moderngl.Texture:
    """The file's own base colour with a box-filtered mip chain, as any viewer makes it.

    With `padded_for`, texels that the mesh does not use are filled first, so that no mip level bleeds: for the
    reference picture.
    """
    from preprocess.files.images import read_image
    from preprocess.mesh.raster import fill_outside, rasterise

    material = document.json["materials"][document.json["meshes"][0]["primitives"][0].get("material", 0)]
    texture = material["pbrMetallicRoughness"]["baseColorTexture"]["index"]
    image = read_image(document.image_bytes(document.json["textures"][texture]["source"]), "base colour")
    colors = np.clip(image.texels[:, :, :3].astype(np.float64), 0, 1)
    if padded_for is not None:
        faces = padded_for.triangles.astype(np.int32)
        covered = rasterise(padded_for.uvs.astype(np.float64), faces, colors.shape[1], colors.shape[0]).faces >= 0
        colors = fill_outside(colors, covered)
    texels = np.rint(colors * 255).astype(np.uint8)
    made = ctx.texture((texels.shape[1], texels.shape[0]), 3, texels.tobytes(), alignment=1)
    made.build_mipmaps()
    made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return made


def arrange(crowd: runtime.Crowd, height_m: float) -> None:
    """The same places, clips, phases and paces for every candidate."""
    places, headings = square(crowd.count, height_m)
    draw = np.random.default_rng(2)
    crowd.place_on_ground(places, headings)
    clips = draw.integers(0, len(crowd.clip_names) - 1, crowd.count)
    crowd.play(clips, phases_s=draw.uniform(0, 10, crowd.count), speeds=draw.uniform(0.85, 1.15, crowd.count))


def timed(ctx: moderngl.Context, draw: Callable[[], None], frames: int) -> tuple[float, float]:
    """Least wall and CPU time of a frame over some, milliseconds."""
    walls, works = [], []
    for _ in range(frames):
        ctx.finish()
        wall, work = time.perf_counter(), time.process_time()
        draw()
        ctx.finish()
        walls.append(time.perf_counter() - wall)
        works.append(time.process_time() - work)
    return 1e3 * min(walls), 1e3 * min(works)


def picture_error(picture: NDArray[np.uint8], reference: NDArray[np.uint8]) -> tuple[float, float]:
    """FLIP (mean; Andersson et al. 2020) and root mean square difference of 255."""
    import flip_evaluator

    pair = [np.ascontiguousarray(image[:, :, :3].astype(np.float32) / 255) for image in (reference, picture)]
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", inputsRGB=True, applyMagma=False)
    difference = picture[:, :, :3].astype(float) - reference[:, :, :3]
    return float(mean), float(np.sqrt((difference**2).mean()))


def cpu_share(crowd: runtime.Crowd, camera: runtime.Camera, size: tuple[int, int]) -> float:
    """CPU time of culling, choosing levels and filling the instance buffer, milliseconds."""
    matrices = camera.matrices(*size)
    spent = []
    for _ in range(15):
        start = time.process_time()
        crowd.update(0.0)  # the poses stay those of the pictures
        selection = crowd.state.select(matrices, size, crowd.errors_m, 1.0)
        crowd._passes.write(selection.records)
        spent.append(time.process_time() - start)
    return 1e3 * min(spent)


def build_character(model: Path, folder: Path) -> None:
    """Build the character the first time."""
    from preprocess.pipeline import build
    from preprocess.progress import Progress
    from preprocess.settings import Settings

    folder.parent.mkdir(parents=True, exist_ok=True)
    build(model, folder, Settings(), Progress())


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print."""
    parser = command_line("crowd", __doc__)
    parser.add_argument("--built", type=Path, default=BUILT, help="built character (built when missing)")
    parser.add_argument("--model", type=Path, default=SOURCE, help="the file it was built from (human)")
    parser.add_argument("--count", type=int, default=10_000, help="actors (10000)")
    parser.add_argument("--size", type=picture_size, default=(1920, 1080), metavar="WxH")
    parser.add_argument("--out", type=Path, help="folder for the pictures")
    options = parser.parse_args(argv)
    if not options.model.is_file():
        raise MissingInput(f"no such file: {options.model}: name one with --model FILE --built DIR")
    if not options.built.is_dir():
        build_character(options.model, options.built)
    ctx = create_context()
    rows = _measure(ctx, options)
    print(f"{ctx.info['GL_RENDERER']}, {options.count} actors, {options.size[0]}x{options.size[1]}, 1 px")
    print_table(rows)
    ctx.release()
    return rows


class _Bench:
    """One scene, its candidates and the picture that all are compared with."""

    def __init__(self, ctx: moderngl.Context, options: argparse.Namespace) -> None:
        self.ctx, self.options = ctx, options
        self.model, self.renderer = runtime.Model(ctx, runtime.load(options.built)), runtime.Renderer(ctx)
        box = self.model.asset.manifest.bind_bounds
        self.height_m = float(box[1, 1] - box[0, 1])
        front = float(square(options.count, self.height_m)[0][:, 2].max(initial=0.0)) + 3.2 * self.height_m
        eye, target = (1.5, 2.9 * self.height_m, front), (0, 0.7 * self.height_m, front - 10 * self.height_m)
        self.camera = runtime.Camera(eye, target, fovy_deg=35)
        self.sharp = Canvas(ctx, options.size, smooth=False)
        self.smooth = Canvas(ctx, options.size, smooth=True)
        self.document = read_document(options.model)
        self.mesh = read_source(self.document)
        self.full = [(self.mesh.triangles, 0.0)]
        self.rows: list[dict[str, Any]] = []
        self.reference = self._draw_reference()

    def _draw_reference(self) -> NDArray[np.uint8]:
        """Full detail, nine pixels for one, no bleeding mips."""
        color = source_base_color(self.ctx, self.document, self.mesh)
        crowd = self.attributes(self.full, color)
        width, height = self.options.size
        canvas = Canvas(self.ctx, (OVERSAMPLING * width, OVERSAMPLING * height), smooth=False)
        self.draw(crowd, canvas, 1.0)
        fine = canvas.pixels().astype(np.float32).reshape(height, OVERSAMPLING, width, OVERSAMPLING, 4)
        canvas.release()
        crowd.release()
        color.release()
        result: NDArray[np.uint8] = np.rint(fine.mean(axis=(1, 3))).astype(np.uint8)
        return result

    def attributes(self, chain: Chain, color: moderngl.Texture, animation_bytes: int = 0) -> AttributeCrowd:
        """A crowd of the source's own vertices."""
        crowd = AttributeCrowd(self.ctx, self.model, self.options.count, self.mesh, chain, color, animation_bytes)
        arrange(crowd, self.height_m)
        return crowd

    def draw(self, crowd: runtime.Crowd, canvas: Canvas, threshold_px: float) -> None:
        """One picture, its levels chosen without memory of the last one."""
        crowd.state.forget_levels()
        self.renderer.quality = runtime.Quality(threshold_px=threshold_px)
        with canvas.drawing(BACKGROUND):
            self.renderer.draw([crowd], self.camera, view="base_color")

    def picture(self, crowd: runtime.Crowd, threshold_px: float) -> NDArray[np.uint8]:
        """What is compared with the reference: eight samples per pixel."""
        self.draw(crowd, self.smooth, threshold_px)
        return self.smooth.pixels()

    def measure(self, name: str, crowd: runtime.Crowd, threshold_px: float = 1.0, frames: int = 5) -> dict[str, Any]:
        """Time and error of one candidate, as a row."""
        picture = self.picture(crowd, threshold_px)
        wall, work = timed(self.ctx, lambda: self.draw(crowd, self.sharp, threshold_px), frames)
        flip, rms = picture_error(picture, self.reference)
        faces = [sum(group.count for group in level.ranges) for level in crowd._levels]
        row = {
            "what": name,
            "threshold px": threshold_px,
            "frame ms": wall,
            "CPU ms": work,
            "times (a)": self.rows[0]["CPU ms"] / work if self.rows else 1.0,
            "triangles": int((crowd.last_counts * faces).sum()),
            "in view": int(crowd.last_counts.sum()),
            "coarsest": f"{faces[-1]} faces, {1e3 * crowd.errors_m[-1]:.0f} mm",
            "FLIP": flip,
            "rms/255": rms,
            "select ms": cpu_share(crowd, self.camera, self.options.size),
        }
        self.rows.append(row)
        if self.options.out is not None:
            self.options.out.mkdir(parents=True, exist_ok=True)
            write_png(self.options.out / f"crowd-{len(self.rows) - 1}.png", picture)
        return row

    def matching_threshold(self, crowd: runtime.Crowd, flip: float, rms: float) -> float:
        """The largest threshold, pixels, at which a crowd's picture is no worse than another's by either measure."""
        good = THRESHOLDS_PX[0]
        for threshold in THRESHOLDS_PX:
            found = picture_error(self.picture(crowd, threshold), self.reference)
            if found[0] > flip or found[1] > rms:
                break
            good = threshold
        return good


def runtime_matrices(bench: _Bench) -> NDArray[np.float32]:
    """Baked poses of the model's clips, (R, J, 3, 4)."""
    crowd = runtime.Crowd(bench.ctx, bench.model, 0)
    crowd.release()
    return crowd.baked.matrices


def _measure(ctx: moderngl.Context, options: argparse.Namespace) -> list[dict[str, Any]]:
    """All candidates, the full-detail one first."""
    bench = _Bench(ctx, options)
    color = source_base_color(ctx, bench.document, None)
    full = bench.attributes(bench.full, color)
    bench.measure("(a) instanced skinning, full detail", full, frames=1)
    full.release()
    rivals = []
    try:
        chains = {with_uvs: meshoptimizer_levels(bench.mesh, with_uvs) for with_uvs in (False, True)}
    except ImportError:
        print("(meshoptimizer is not installed: (b) is left out; pip install 'seamskin[bench]')")
        chains = {}
    if chains:
        measured = largest_errors(bench.mesh, chains[False], runtime_matrices(bench))
        for name, chain, animation_bytes in (
            ("(b) meshoptimizer levels", chains[False], 0),
            ("(b) the same, poses ready-made", chains[False], VERTEX_ANIMATION_BYTES),
            ("(b) and uvs weighted", chains[True], VERTEX_ANIMATION_BYTES),
            ("(b) by largest error, poses ready-made", measured, VERTEX_ANIMATION_BYTES),
        ):
            crowd = bench.attributes(chain, color, animation_bytes)
            rivals.append(bench.measure(name, crowd))
            crowd.release()
    ours = runtime.Crowd(ctx, bench.model, options.count)
    arrange(ours, bench.height_m)
    bench.measure("seamskin", ours)
    if rivals:
        by_report = rivals[:3]
        flip, rms = (min(row[name] for row in by_report) for name in ("FLIP", "rms/255"))
        bench.measure("seamskin at (b)'s error", ours, bench.matching_threshold(ours, flip, rms))
    if options.out is not None:
        write_png(options.out / "crowd-reference.png", bench.reference)
    return bench.rows
