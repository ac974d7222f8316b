"""Drawing from textures beside ordinary vertex-attribute skinning: the same triangles, shading, context and run.

Three questions: what a frame costs at equal triangles, for each way to store joint weights; what levels of detail save
for a character 200 pixels tall, shaded and without shading, alone and among others; and how many bytes it all takes.
Every time is the median over rounds in which the candidates take turns. CPU time counts all threads of the process:
with software OpenGL it is the work itself, whatever else the machine does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from benchmarks._inputs import command_line, one_built_character
from benchmarks._table import print_table
from benchmarks._tall import measure_tall
from demos.headless import Canvas, create_context
from demos.options import picture_size
from runtime.animation.pose import sample, skinning_rows
from runtime.asset.asset import Asset, load
from runtime.errors import RenderError
from runtime.gpu.gl_state import saved_state
from runtime.gpu.model import Model
from runtime.gpu.programs import build_program, set_uniforms
from runtime.gpu.textures import TEXTURE_UNITS
from runtime.gpu.vertex_layout import ACTOR_ATTRIBUTES, ACTOR_INSTANCE, Attribute, bind_buffer
from runtime.render.passes import set_material
from runtime.render.renderer import Renderer
from runtime.scene.camera import Camera, framing

JOINT_BLOCK_ROWS = 1020  # vec4 in the smallest uniform block that OpenGL promises, three a joint
DRAWS_PER_ROUND = 6  # before one waits for the end
# Bytes a vertex of the classic chain. As glTF has them: position 12, normal 12, tangent 16, uv 8, joints 4, weights 16;
# packed: position 12, normal 4, tangent 4, uv 8, joints 4, weights 4.
CLASSIC_VERTEX_BYTES = {"as glTF": 68, "packed": 36}
LAYOUT_PX, LIST_JOINTS = 384, 8  # of the layouts that records are compared with
EXTRA_UNITS = {"texel_joints": 10, "texel_weights": 11, "dense_weights": 12}


class Bench:
    """One character in one context, and ways to draw its finest level."""

    def __init__(self, ctx: moderngl.Context, asset: Asset) -> None:
        self.ctx, self.asset = ctx, asset
        self.model, self.renderer = Model(ctx, asset), Renderer(ctx)
        self.mesh = asset.lods[0]
        clip = asset.clips[min(1, len(asset.clips) - 1)]
        self.rows = skinning_rows(asset.skeleton, sample(clip, asset.skeleton, [clip.duration_s / 3]))[0].astype(
            np.float32
        )
        self.actor = self.model.actor(clip=clip.name, time_s=clip.duration_s / 3)
        self.textures: dict[str, moderngl.Texture] = {}
        self.arrays: dict[str, tuple[moderngl.VertexArray, moderngl.Program]] = {}
        self.instances = ctx.buffer(reserve=ACTOR_INSTANCE.itemsize)
        block = np.zeros((JOINT_BLOCK_ROWS, 4), np.float32)
        block[: 3 * len(self.rows)] = self.rows.reshape(-1, 4)
        self.joint_block = ctx.buffer(block.tobytes())

    def prepare(self, camera: Camera, size: tuple[int, int]) -> None:
        """Let the renderer fill frame and poses once, and copy the instance."""
        self.renderer.draw([self.actor], camera, lod=0, tessellation="off")
        matrices = camera.matrices(*size)
        record = np.zeros(1, ACTOR_INSTANCE)
        record["rows"] = np.eye(4)[:3]
        record["rows"][:, :, 3] = -matrices.eye
        record["tint"] = 1.0
        self.instances.write(record.tobytes())

    def add(self, name: str, vertex: str, buffer: moderngl.Buffer, attributes: Sequence[Attribute],
            defines: Mapping[str, str | int]) -> None:  # fmt: skip
        """A candidate: a vertex shader and its vertices."""
        lod = self.model.lods[0]
        part = lod.ranges[0]
        lacks = dict.fromkeys(part.defines, 1)
        program = build_program(
            self.ctx, (vertex, "lit.frag"), {"JOINT_BLOCK_ROWS": JOINT_BLOCK_ROWS, **lacks, **defines}
        )
        set_uniforms(program, {**TEXTURE_UNITS, **EXTRA_UNITS, **self.model.constants})
        if vertex == "layouts.vert":
            set_uniforms(program, {"weight_size": (LAYOUT_PX, LAYOUT_PX)})
        set_material(program, part.material, False)
        content = [
            bind_buffer(program, buffer, attributes),
            bind_buffer(program, self.instances, ACTOR_ATTRIBUTES, per_instance=True),
        ]
        array = self.ctx.vertex_array(program, content, lod.indices, index_element_size=lod.index_size)
        self.arrays[name] = array, program

    def bind(self) -> None:
        """Put textures and blocks where all candidates expect them."""
        for name, texture in self.model.textures.items():
            texture.use(TEXTURE_UNITS[name])
        for name, texture in self.textures.items():
            texture.use(EXTRA_UNITS[name])
        self.model.joint_texture(self.rows[None]).use(TEXTURE_UNITS["joint_texture"])
        self.renderer._frame.bind()
        self.joint_block.bind_to_uniform_block(1)


def attribute_vertices(asset: Asset) -> NDArray[Any]:
    """The finest level's vertices as attributes, sampled from the same textures: position, uv, four joints, weights."""
    from preprocess.fit.weight_quadtree import sample_weights
    from preprocess.mesh.texels import sample_bilinear
    from runtime.asset.weight_stack import unpack_weights

    mesh = asset.lods[0]
    positions = sample_bilinear(asset.textures["position"].levels[0][:, :, :3], mesh.canonical_uvs)
    stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
    weights = sample_weights(stored, asset.weight_details, mesh.canonical_uvs.astype(np.float64))
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    strongest = np.take_along_axis(weights, joints, axis=1)
    form = [("position", "<f4", 3), ("uv", "<f4", 2), ("joints", "u1", 4), ("weights", "u1", 4)]
    vertices = np.zeros(len(mesh.uvs), form)
    vertices["position"], vertices["uv"], vertices["joints"] = positions, mesh.uvs, joints
    vertices["weights"] = np.rint(strongest / strongest.sum(axis=1, keepdims=True) * 255)
    return vertices


def even_weights(asset: Asset) -> NDArray[np.uint8]:
    """All weights on an even map without details, (H, W, J) uint8, J a multiple of four: for simpler layouts."""
    from preprocess.fit.weight_quadtree import sample_weights
    from runtime.asset.weight_stack import unpack_weights

    stored = unpack_weights(asset.textures["weights"].levels[0], asset.weight_size, asset.num_joints)
    middles = (np.arange(LAYOUT_PX) + 0.5) / LAYOUT_PX
    u, v = np.meshgrid(middles, middles)
    weights = sample_weights(stored, asset.weight_details, np.stack([u.ravel(), v.ravel()], axis=1))
    dense = np.zeros((LAYOUT_PX, LAYOUT_PX, -(-asset.num_joints // 4) * 4), np.uint8)
    dense.reshape(LAYOUT_PX**2, -1)[:, : asset.num_joints] = np.rint(weights * 255)
    return dense


def plain_texture(ctx: moderngl.Context, texels: NDArray[Any], dtype: str) -> moderngl.Texture:
    """A texture that is only fetched."""
    height, width, channels = texels.shape
    texture = ctx.texture((width, height), channels, np.ascontiguousarray(texels).tobytes(), alignment=1, dtype=dtype)
    texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
    return texture


def add_layouts(bench: Bench) -> dict[str, int]:
    """The candidates; bytes of the weights of each."""
    asset, ctx = bench.asset, bench.ctx
    dense = even_weights(asset)
    width, height = LAYOUT_PX, LAYOUT_PX
    joints = np.argsort(-dense.astype(np.int16), axis=-1, kind="stable")[..., :LIST_JOINTS]
    weights = np.take_along_axis(dense, joints, axis=-1)
    lists, layers = LIST_JOINTS // 4, dense.shape[-1] // 4
    stacked = [
        array.reshape(height, width, lists, 4).transpose(2, 0, 1, 3).reshape(-1, width, 4)
        for array in (joints, weights)
    ]
    dense_stack = dense.reshape(height, width, layers, 4).transpose(2, 0, 1, 3).reshape(-1, width, 4)
    bench.textures = {
        "texel_joints": plain_texture(ctx, stacked[0].astype(np.uint16), "u2"),
        "texel_weights": plain_texture(ctx, stacked[1].astype(np.uint8), "f1"),
        "dense_weights": plain_texture(ctx, dense_stack, "f1"),
    }
    vertices = ctx.buffer(attribute_vertices(asset).tobytes())
    forms = {"in_position": "3f4", "in_uv": "2f4", "in_joints": "4u1", "in_weights": "4f1"}
    bench.add("vertex attributes", "attributes.vert", vertices, [Attribute(*one) for one in forms.items()], {})
    finest = bench.model.lods[0]
    own, both, defines = finest.vertices, finest.attributes, dict(finest.program_defines)
    defines.pop("NORMAL_UV", None)
    bench.add("textures: records per cell", "static.vert", own, both, defines)
    bench.add("textures: lists a texel", "layouts.vert", own, both, {**defines, "LAYOUT_LISTS": 1, "LISTS": lists})
    bench.add("textures: dense layers", "layouts.vert", own, both, {**defines, "LAYOUT_DENSE": 1, "LAYERS": layers})
    return {
        "vertex attributes": 8 * len(bench.mesh.uvs),
        "textures: records per cell": bench.model.weight_cells.nbytes,
        "textures: lists a texel": stacked[0].astype(np.uint8).nbytes + stacked[1].astype(np.uint8).nbytes,
        "textures: dense layers": dense_stack.nbytes,
    }


def take_turns(candidates: Mapping[str, Callable[[], None]], rounds: int) -> dict[str, tuple[float, float]]:
    """Median wall and CPU milliseconds of each, one after another in every round."""
    wall: dict[str, list[float]] = {name: [] for name in candidates}
    cpu: dict[str, list[float]] = {name: [] for name in candidates}
    for turn in range(rounds + 1):
        for name, work in candidates.items():
            start, start_cpu = time.perf_counter(), time.process_time()
            work()
            if turn:  # the first warms up
                wall[name].append(time.perf_counter() - start)
                cpu[name].append(time.process_time() - start_cpu)
    scale = 1e3 / DRAWS_PER_ROUND
    return {name: (float(np.median(wall[name])) * scale, float(np.median(cpu[name])) * scale) for name in candidates}


def measure_layouts(bench: Bench, canvas: Canvas, rounds: int) -> list[dict[str, Any]]:
    """Equal triangles: attributes beside the weight layouts."""
    camera = framing(bench.asset.manifest.bind_bounds, canvas.size[0] / canvas.size[1])
    canvas.framebuffer.use()
    bench.prepare(camera, canvas.size)
    weight_bytes = add_layouts(bench)
    bench.bind()
    bench.ctx.enable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)

    def draw(array: moderngl.VertexArray) -> Callable[[], None]:
        def work() -> None:
            for _ in range(DRAWS_PER_ROUND):
                canvas.framebuffer.clear(depth=1.0)
                array.render(instances=1)
            bench.ctx.finish()

        return work

    times = take_turns({name: draw(array) for name, (array, _) in bench.arrays.items()}, rounds)
    wall, cpu = times["vertex attributes"]
    pictures = {}
    for name, (array, _) in bench.arrays.items():
        canvas.framebuffer.clear(depth=1.0)
        array.render(instances=1)
        pictures[name] = canvas.pixels().astype(int)
    seconds = {name: times[name][0] / 1e3 for name in times}
    return [
        {
            "what": name,
            "wall ms": times[name][0],
            "x": times[name][0] / wall,
            "cpu ms": times[name][1],
            "x cpu": times[name][1] / cpu,
            "Mvertices/s": len(bench.mesh.uvs) / seconds[name] / 1e6,
            "weight bytes": weight_bytes[name],
            "pixels unlike the records'": int(
                (pictures[name] != pictures["textures: records per cell"]).any(axis=-1).sum()
            ),
        }
        for name in times
    ]


def measure_bytes(model: Model) -> list[dict[str, Any]]:
    """Memory for geometry, weights and all levels beside the classic chain of the same levels."""
    sizes = model.gpu_bytes
    ours = sizes["position"] + sizes["weights"] + sizes["levels"]
    vertices = sum(len(lod.mesh.uvs) for lod in model.lods)
    indices = sum(lod.indices.size for lod in model.lods)
    rows = [{"what": "ours", **{key: sizes[key] for key in ("position", "weights", "levels")}, "bytes": ours}]
    for name, per_vertex in CLASSIC_VERTEX_BYTES.items():
        classic = per_vertex * vertices + indices
        rows.append({"what": f"classic chain, {name}", "levels": classic, "bytes": classic, "ours x": ours / classic})
    return rows


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Measure and print; the rows of all tables."""
    parser = command_line("draw", __doc__)
    parser.add_argument("--built", type=Path, help="a built character (default: human's, or the first there is)")
    parser.add_argument("--rounds", type=int, default=30, help="in which the candidates take turns (30)")
    parser.add_argument("--size", type=picture_size, default=(512, 512), metavar="WxH")
    options = parser.parse_args(argv)
    asset = load(one_built_character(options.built))
    ctx = create_context()
    print(f"{ctx.info['GL_RENDERER']}, {options.size[0]} x {options.size[1]}")
    bench = Bench(ctx, asset)
    canvas = Canvas(ctx, options.size, smooth=False)
    rows: list[dict[str, Any]] = []
    try:
        turns = partial(take_turns, rounds=options.rounds)
        with saved_state(range(16), (0, 1), True):
            tables = [measure_layouts(bench, canvas, options.rounds)]
        tables += [measure_tall(bench.model, bench.actor, turns, DRAWS_PER_ROUND), measure_bytes(bench.model)]
        for table in tables:
            print_table(table)
            print()
            rows += table
    except RenderError as error:
        print(f"not measured: {error}")
    finally:
        ctx.release()
    return rows
