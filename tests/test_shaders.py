"""Shaders: every program compiles without a word, errors name file and line, and the texel rule has one meaning."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import moderngl
import numpy as np
import pytest

from preprocess.mesh.texels import bilinear_stencil, sample_bilinear, uv_to_px
from runtime.asset.lod_mesh import UV_STEPS
from runtime.errors import RenderError
from runtime.gpu.frame_uniforms import FRAME
from runtime.gpu.gl_state import SHADER_STAGES, compile_shader, functions
from runtime.gpu.programs import assemble, build_program, require_version
from runtime.render.passes import PATCH_STAGES
from runtime.render.views import LINES, VIEWS

SHADERS = Path(__file__).resolve().parent.parent / "shaders"
BLOCK = {"JOINT_BLOCK_ROWS": 1020}
VARIANTS: dict[str, list[dict[str, str | int]]] = {
    "static.vert": [{}, {"MORPHS": 1}, {"SHOW_WEIGHTS": 1}, {"WITHOUT_CANONICAL_UVS": 1}, {"DUAL_QUATERNIONS": 1}],
    "patch.tese": [
        {},
        {"MORPHS": 1},
        {"SHOW_WEIGHTS": 1},
        {"WITHOUT_CANONICAL_UVS": 1},
        {"EQUAL_SPACING": 1},
        {"DUAL_QUATERNIONS": 1},
    ],
    "patch.tesc": [{}, {"MORPHS": 1}, {"DUAL_QUATERNIONS": 1}],
    "attributes.vert": [BLOCK],
    "layouts.vert": [{"LAYOUT_LISTS": 1, "LISTS": 2}, {"LAYOUT_DENSE": 1, "LAYERS": 14}],
    "crowd.vert": [{}, {"EIGHT_JOINTS": 1}, {"MORPHS": 1}, {"VERTEX_ANIMATION": 1}, {"SHOW_WEIGHTS": 1}],
}
NORMALS = {"NORMAL_UV": UV_STEPS}
STEPS, WIDE = {"UV_STEPS": UV_STEPS, "CANONICAL_STEPS": UV_STEPS, "POSITION_WORDS": 1}, {"WIDE_JOINTS": 1}
SOLID = {"NO_ALPHA_TEST": 1, "NO_BLEND": 1, "NO_EMISSION": 1}
LACKS = [
    {"NO_ALPHA_TEST": 1},
    {"UNLIT": 1, "NO_BLEND": 1},
    {**SOLID, "ONE_SIDED": 1, "FLOAT_NORMALS": 1},
    {**SOLID, "NO_ORM": 1, "ROUGHNESS_IN_COLOR": 1, "METALLIC_IN_NORMAL": 1, "NO_OCCLUSION": 1},
    {**SOLID, "NO_ORM": 1, "OCCLUSION_IN_NORMAL": 1, "NO_METAL": 1, "NO_FACTOR": 1, "NO_ROUGHNESS_FACTOR": 1},
    {**SOLID, "NO_ORM": 1, "NO_OCCLUSION": 1, "NO_METAL": 1, "NO_FACTOR": 1, "ONE_SIDED": 1},
]
STAGE_FILES = sorted(path.name for path in SHADERS.iterdir() if path.suffix[1:] in SHADER_STAGES)


@pytest.mark.parametrize("version_code", [330, 410])
@pytest.mark.parametrize("name", STAGE_FILES)
def test_every_stage_compiles_without_warnings(ctx: moderngl.Context, name: str, version_code: int) -> None:
    stage = name.rpartition(".")[2]
    if stage in ("tesc", "tese") and version_code < 410:
        pytest.skip("no tessellation below OpenGL 4.1")
    extra = [*LACKS, NORMALS] if stage == "frag" else [NORMALS, STEPS, WIDE]
    variants = VARIANTS.get(name, [{}])
    for defines in [*variants, *({**variants[0], **more} for more in extra)]:
        compiled, log = compile_shader(assemble(name, version_code, defines).text, stage)
        assert compiled, f"{name} {defines}: {log}"
        assert not log, f"{name} {defines}: {log}"


@pytest.mark.parametrize("view", [*VIEWS, "lines"])
@pytest.mark.parametrize("stages", [("static.vert",), PATCH_STAGES], ids=["static", "patches"])
def test_every_view_links(ctx: moderngl.Context, view: str, stages: tuple[str, ...]) -> None:
    chosen = LINES if view == "lines" else VIEWS[view]
    for defines in ({}, {**NORMALS, **STEPS}, LACKS[-1]):
        build_program(ctx, (*stages, chosen.fragment), {**chosen.defines, **defines}).release()


def test_no_stage_needs_more_than_4_1() -> None:
    for path in SHADERS.rglob("*.*"):
        if path.suffix in (".py", ".pyc"):
            continue
        text = re.sub(r"//.*", "", path.read_text())
        assert "#version" not in text, path.name
        assert not re.search(r"layout\s*\([^)]*\b(binding|location)\b", text), path.name
        assert not re.search(r"\bbuffer\s+\w+\s*\{|imageLoad|imageStore|#extension", text), path.name


def test_includes_are_nested_once_and_lines_are_true(ctx: moderngl.Context) -> None:
    source = assemble("lit.frag", 410)
    assert source.text.startswith("#version 410 core\n")
    assert {"lit.frag", "include/lighting.glsl", "include/surface.glsl", "include/frame.glsl"} <= set(source.files)
    broken = source.text.replace("vec3 decode_srgb(vec3 encoded) {", "vec3 decode_srgb(vec3 encoded) { nonsense;")
    line = (SHADERS / "include/surface.glsl").read_text().splitlines().index("vec3 decode_srgb(vec3 encoded) {") + 1
    compiled, log = compile_shader(broken, "frag")
    assert not compiled
    assert f"include/surface.glsl:{line}" in source.explain(log)


def test_a_broken_caller_shader_is_named_with_its_line(ctx: moderngl.Context) -> None:
    with pytest.raises(RenderError, match=r"caller\.frag.*(?s:.*)caller\.frag:3"):
        build_program(ctx, ("static.vert",), fragment_text="out vec4 c;\nvoid main() {\n  c = missing;\n}")


def test_unknown_and_endless_includes_are_named(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match=r"mine.*no shader file 'none.glsl'"):
        assemble("mine", 410, text='#include "none.glsl"\n')
    (tmp_path / "loop.glsl").write_text('#include "loop.glsl"\n')
    with pytest.raises(RenderError, match="include itself"):
        assemble("mine", 410, text='#include "loop.glsl"\n', folder=tmp_path)
    with pytest.raises(RenderError, match=r"no shader file 'gone.vert'"):
        assemble("gone.vert", 410)


class OldContext:
    version_code = 310


def test_contexts_that_are_too_old_are_refused() -> None:
    with pytest.raises(RenderError, match=r"OpenGL 3\.1.*3\.3"):
        require_version(OldContext())  # type: ignore[arg-type]


TEXEL_PROBE = """
#include "texels.glsl"
in vec2 uv;
uniform sampler2D image;
uniform ivec2 size;
out vec4 sampled;
out vec4 cell;
void main() {
    TexelCell found = texel_cell(uv, size);
    sampled = fetch_bilinear(image, uv);
    cell = vec4(vec2(found.corner), found.fraction);
    gl_Position = vec4(0.0);
}
"""


@pytest.mark.parametrize("size", [(1, 1), (7, 1), (1, 5), (8, 8), (13, 6)])
def test_the_texel_rule_is_the_same_on_both_processors(ctx: moderngl.Context, size: tuple[int, int]) -> None:
    width, height = size
    rng = np.random.default_rng(3)
    image = rng.random((height, width, 4)).astype(np.float32)
    centres = (np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2) + 0.5) / size
    uvs = np.concatenate([rng.uniform(-0.2, 1.2, (500, 2)), centres, [[0, 0], [1, 1], [0, 1]]]).astype(np.float32)
    program = ctx.program(
        vertex_shader=assemble("probe.vert", 410, text=TEXEL_PROBE).text, varyings=["sampled", "cell"]
    )
    texture = ctx.texture(size, 4, image.tobytes(), dtype="f4")
    buffer, out = ctx.buffer(uvs.tobytes()), ctx.buffer(reserve=32 * len(uvs))
    array = ctx.vertex_array(program, [(buffer, "2f", "uv")])
    texture.use(0)
    program["image"].value, program["size"].value = 0, size
    framebuffer = ctx.simple_framebuffer((1, 1))  # drawing of any kind wants one
    framebuffer.use()
    array.transform(out, mode=moderngl.POINTS)
    result = np.frombuffer(out.read(), np.float32).reshape(-1, 2, 4)
    corner, fraction = result[:, 1, :2].astype(np.int64), result[:, 1, 2:].astype(float)
    px = np.clip(uv_to_px(uvs, width, height), 0, (width - 1, height - 1))
    assert np.abs(corner + fraction - px).max() < 4e-6  # the very cell may differ right on a texel's centre
    texels, weights = bilinear_stencil(uvs, width, height)
    same = corner @ (1, width) == texels[:, 0]
    assert same.mean() > 0.9
    fx, fy = fraction.T
    expected = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    assert np.abs(expected - weights)[same].max() < 4e-6
    assert np.abs(result[:, 0] - sample_bilinear(image, uvs)).max() < 4e-6
    functions().glUseProgram(0)
    for thing in (
        program,
        array,
        out,
        buffer,
        texture,
        framebuffer,
        *framebuffer.color_attachments,
        framebuffer.depth_attachment,
    ):
        thing.release()


def test_unused_shader_files_do_not_exist() -> None:
    folders = ("runtime", "demos", "benchmarks", "shaders", "tests")
    suffixes = {".py", ".glsl", *(f".{stage}" for stage in SHADER_STAGES)}
    paths = [path for folder in folders for path in (SHADERS.parent / folder).rglob("*.*") if path.suffix in suffixes]
    sources = "".join(path.read_text() for path in paths)
    for path in (SHADERS / "include").iterdir():
        assert f'"{path.name}"' in sources or f'"include/{path.name}"' in sources, path.name
    for name in STAGE_FILES:
        assert f'"{name}"' in sources, name


STD140 = {"float": (4, 4), "vec2": (8, 8), "vec3": (16, 12), "mat4": (16, 64)}  # alignment and size, bytes


def test_the_frame_block_has_the_members_of_its_dtype() -> None:
    """Names in order, and offsets by the rules of std140 (OpenGL 4.1, section 2.11.4)."""
    block = re.search(r"uniform Frame \{(.*?)\};", (SHADERS / "include/frame.glsl").read_text(), re.S)
    assert block is not None
    members = re.findall(r"^\s*(\w+) (\w+);", block[1], re.M)
    end, offsets = 0, {}
    for kind, name in members:
        alignment, size = STD140[kind]
        offsets[name] = -(-end // alignment) * alignment
        end = offsets[name] + size
    assert FRAME.fields is not None and FRAME.names == tuple(offsets)
    assert {name: FRAME.fields[name][1] for name in offsets} == offsets
    assert FRAME.itemsize == -(-end // 16) * 16


def test_a_games_own_shaders_and_demos_break_nothing(tmp_path: Path) -> None:
    """They lie before ours on the way that Python looks for modules."""
    (tmp_path / "shaders.py").write_text("raise SystemExit('the shaders of a game')")
    (tmp_path / "demos").mkdir()
    (tmp_path / "demos" / "__init__.py").write_text("raise SystemExit('the demos of a game')")
    code = (
        f"import sys; sys.path[:0] = [{str(tmp_path)!r}]; sys.path.append({str(SHADERS.parent)!r})\n"
        "import runtime.crowd.crowd, runtime.render.renderer\n"
        "from runtime.gpu.programs import assemble; print(len(assemble('lit.frag', 410).files))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, env={}, capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 1, done.stderr


def test_shaders_lie_in_the_runtime_where_it_is_installed() -> None:
    """The wheel's layout, as setuptools is told it; every kind of file that there is goes along."""
    settings = tomllib.loads((SHADERS.parent / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert settings["package-dir"] == {"runtime.shaders": "shaders"} and "runtime.shaders" in settings["packages"]
    patterns = settings["package-data"]["runtime.shaders"]
    for path in (path for path in SHADERS.rglob("*.*") if "__pycache__" not in path.parts):  # of older checkouts
        assert any(path.relative_to(SHADERS).match(pattern) for pattern in patterns), path
    assert not list(SHADERS.rglob("*.py"))
