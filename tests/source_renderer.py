"""Plain full-resolution render of a glTF file, to compare with: CPU skinning in float64, ordinary vertex attributes.

It shares with the program only the reader of accessors: hierarchy, animation, skinning and materials are its own and
follow the glTF 2.0 specification as directly as possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from preprocess.files.images import read_image
from runtime.gltf.document import Document, read_document

VERTEX = """#version 330 core
uniform mat4 clip_from_object;
in vec3 in_position; in vec2 in_uv; in vec4 in_color;
out vec2 uv; out vec4 color;
void main() { uv = in_uv; color = in_color; gl_Position = clip_from_object * vec4(in_position, 1.0); }
"""
FRAGMENT = """#version 330 core
uniform sampler2D base_color; uniform bool has_texture; uniform vec4 factor; uniform float cutoff;
in vec2 uv; in vec4 color; out vec4 result;
vec3 encode(vec3 v) {
    return mix(v * 12.92, 1.055 * pow(max(v, 0.0031308), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v));
}
void main() {
    vec4 c = factor * color;
    if (has_texture) c *= texture(base_color, uv);
    if (c.a < cutoff) discard;
    result = vec4(encode(clamp(c.rgb, 0.0, 1.0)), 1.0);
}
"""


@dataclass(frozen=True)
class SourcePrimitive:
    """One primitive in object space at a moment of a clip."""

    positions: np.ndarray
    triangles: np.ndarray
    uvs: np.ndarray | None
    colors: np.ndarray | None
    material: int | None


def quaternion_matrix(q: np.ndarray) -> np.ndarray:
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def local_matrix(node: dict[str, Any], override: dict[str, np.ndarray]) -> np.ndarray:
    if "matrix" in node and not override:
        return np.array(node["matrix"], float).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = override.get("rotation", np.array(node.get("rotation", [0, 0, 0, 1]), float))
    scale = override.get("scale", np.array(node.get("scale", [1, 1, 1]), float))
    matrix[:3, :3] = quaternion_matrix(rotation) * scale
    matrix[:3, 3] = override.get("translation", np.array(node.get("translation", [0, 0, 0]), float))
    return matrix


def sample_track(times: np.ndarray, values: np.ndarray, kind: str, path: str, time: float) -> np.ndarray:
    """One channel at one time, as the specification's appendix C writes it."""
    times = times.astype(float)
    if kind == "CUBICSPLINE":
        values = values.reshape(len(times), 3, -1).astype(float)
    else:
        values = values.astype(float)
    if time <= times[0] or len(times) == 1:
        return values[0, 1] if kind == "CUBICSPLINE" else values[0]
    if time >= times[-1]:
        return values[-1, 1] if kind == "CUBICSPLINE" else values[-1]
    k = int(np.searchsorted(times, time, side="right")) - 1
    step = times[k + 1] - times[k]
    t = (time - times[k]) / step
    if kind == "STEP":
        return values[k]
    if kind == "CUBICSPLINE":
        a, b = values[k], values[k + 1]
        return (
            (2 * t**3 - 3 * t**2 + 1) * a[1]
            + step * (t**3 - 2 * t**2 + t) * a[2]
            + (-2 * t**3 + 3 * t**2) * b[1]
            + step * (t**3 - t**2) * b[0]
        )
    a, b = values[k], values[k + 1]
    if path != "rotation":
        return a + t * (b - a)
    cosine = float(a @ b)
    b = b if cosine >= 0 else -b
    angle = np.arccos(min(1.0, abs(cosine)))
    if angle < 1e-6:
        return a + t * (b - a)
    return (np.sin((1 - t) * angle) * a + np.sin(t * angle) * b) / np.sin(angle)


def node_matrices(document: Document, clip: int | None, time: float) -> np.ndarray:
    """Global matrices of all nodes, (N, 4, 4)."""
    nodes = document.json.get("nodes", [])
    overrides: list[dict[str, np.ndarray]] = [{} for _ in nodes]
    if clip is not None:
        animation = document.json["animations"][clip]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            target = channel["target"]
            if target.get("node") is None or target["path"] == "weights":
                continue
            overrides[target["node"]][target["path"]] = sample_track(
                document.accessor(sampler["input"]),
                document.accessor(sampler["output"]),
                sampler.get("interpolation", "LINEAR"),
                target["path"],
                time,
            )
    result = np.zeros((len(nodes), 4, 4))

    def visit(index: int, parent: np.ndarray) -> None:
        result[index] = parent @ local_matrix(nodes[index], overrides[index])
        for child in nodes[index].get("children", []):
            visit(child, result[index])

    for root in document.json["scenes"][document.json.get("scene", 0)]["nodes"]:
        visit(root, np.eye(4))
    return result


def source_primitives(path: Path, clip: int | None = None, time: float = 0.0) -> tuple[Document, list[SourcePrimitive]]:
    """Every drawn primitive of the default scene, skinned on the CPU in float64; clip None: the nodes' rest pose."""
    document = read_document(path)
    matrices = node_matrices(document, clip, time)
    primitives = []
    for index, node in enumerate(document.json["nodes"]):
        if "mesh" not in node or not np.any(matrices[index]):
            continue
        for primitive in document.json["meshes"][node["mesh"]]["primitives"]:
            attributes = primitive["attributes"]
            positions = document.accessor(attributes["POSITION"]).astype(float)
            homogeneous = np.c_[positions, np.ones(len(positions))]
            if "skin" in node:
                skin = document.json["skins"][node["skin"]]
                inverse_bind = document.accessor(skin["inverseBindMatrices"]).astype(float)
                joint_matrices = matrices[skin["joints"]] @ inverse_bind
                joints = document.accessor(attributes["JOINTS_0"]).astype(int)
                weights = document.accessor(attributes["WEIGHTS_0"]).astype(float)
                weights /= weights.sum(axis=1, keepdims=True)
                blended = np.einsum("nk,nkij->nij", weights, joint_matrices[joints])
                positions = np.einsum("nij,nj->ni", blended, homogeneous)[:, :3]
            else:
                positions = (homogeneous @ matrices[index].T)[:, :3]
            if "indices" in primitive:
                triangles = document.accessor(primitive["indices"]).astype(int).reshape(-1, 3)
            else:
                triangles = np.arange(len(positions)).reshape(-1, 3)
            uvs = document.accessor(attributes["TEXCOORD_0"]).astype(float) if "TEXCOORD_0" in attributes else None
            colors = None
            if "COLOR_0" in attributes:
                colors = document.accessor(attributes["COLOR_0"]).astype(float)
                colors = np.c_[colors, np.ones(len(colors))] if colors.shape[1] == 3 else colors
            primitives.append(SourcePrimitive(positions, triangles, uvs, colors, primitive.get("material")))
    return document, primitives


def render_source(
    ctx: moderngl.Context,
    path: Path,
    clip_from_object: np.ndarray,
    size: tuple[int, int],
    clip: int | None = None,
    time: float = 0.0,
) -> np.ndarray:
    """Unlit base colour, no tone mapping, alpha 1 where the character is.

    Parameters
    ----------
    clip_from_object : (4, 4) float, acting on columns

    Returns
    -------
    (H, W, 4) uint8, row 0 at the top
    """
    document, primitives = source_primitives(path, clip, time)
    program = ctx.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
    color, depth = ctx.texture(size, 4), ctx.depth_renderbuffer(size)
    framebuffer = ctx.framebuffer([color], depth)
    framebuffer.use()
    framebuffer.clear(0.0, 0.0, 0.0, 0.0)
    ctx.enable_only(moderngl.DEPTH_TEST)
    owned: list[Any] = [program, color, depth, framebuffer]
    for primitive in primitives:
        _draw(ctx, program, document, primitive, clip_from_object, owned)
    pixels = np.frombuffer(framebuffer.read(components=4, alignment=1), np.uint8).reshape(size[1], size[0], 4)
    for item in reversed(owned):
        item.release()
    return pixels[::-1].copy()


def _draw(
    ctx: moderngl.Context,
    program: moderngl.Program,
    document: Document,
    primitive: SourcePrimitive,
    clip_from_object: np.ndarray,
    owned: list[Any],
) -> None:
    material = {} if primitive.material is None else document.json["materials"][primitive.material]
    pbr = material.get("pbrMetallicRoughness", {})
    count = len(primitive.positions)
    uvs = np.zeros((count, 2)) if primitive.uvs is None else primitive.uvs
    colors = np.ones((count, 4)) if primitive.colors is None else primitive.colors
    vertices = ctx.buffer(np.hstack([primitive.positions, uvs, colors]).astype("f4").tobytes())
    indices = ctx.buffer(primitive.triangles.astype("i4").tobytes())
    array = ctx.vertex_array(program, [(vertices, "3f 2f 4f", "in_position", "in_uv", "in_color")], indices)
    owned += [vertices, indices, array]
    program["clip_from_object"].write(clip_from_object.T.astype("f4").tobytes())
    program["factor"].value = tuple(pbr.get("baseColorFactor", [1.0] * 4))
    program["cutoff"].value = material.get("alphaCutoff", 0.5) if material.get("alphaMode") == "MASK" else 0.0
    reference = pbr.get("baseColorTexture")
    program["has_texture"].value = reference is not None
    if reference is not None:
        texture_spec = document.json["textures"][reference["index"]]
        image = read_image(document.image_bytes(texture_spec["source"])).texels
        if image.shape[2] == 3:
            image = np.concatenate([image, np.ones_like(image[..., :1])], axis=2)
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
        linear[..., 3] = image[..., 3]
        texture = ctx.texture(image.shape[1::-1], 4, np.ascontiguousarray(linear, "f4").tobytes(), dtype="f4")
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        sampler = (
            document.json.get("samplers", [{}])[texture_spec.get("sampler", 0)] if "sampler" in texture_spec else {}
        )
        texture.repeat_x = sampler.get("wrapS", 10497) == 10497
        texture.repeat_y = sampler.get("wrapT", 10497) == 10497
        texture.use(0)
        program["base_color"].value = 0
        owned.append(texture)
    if material.get("doubleSided"):
        ctx.disable(moderngl.CULL_FACE)
    else:
        ctx.enable(moderngl.CULL_FACE)
    array.render()


def look_at(eye: np.ndarray, target: np.ndarray, fovy_deg: float, size: tuple[int, int]) -> np.ndarray:
    """Right-handed perspective camera with +Y up, (4, 4) acting on columns."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    view = np.eye(4)
    view[:3, :3] = [right, up, -forward]
    view[:3, 3] = -view[:3, :3] @ eye
    distance = np.linalg.norm(target - eye)
    near, far = distance * 0.01, distance * 100.0
    f = 1.0 / np.tan(np.radians(fovy_deg) / 2)
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = f * size[1] / size[0], f
    projection[2, 2], projection[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    projection[3, 2] = -1.0
    return projection @ view
