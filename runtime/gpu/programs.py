"""GLSL programs from the files in shaders/: includes, defines, versions, and errors that name file and line.

A stage file and what it includes become one source. `#line` follows every seam between files, so that a driver's
message can be translated back to names. Mesa forgets the source string number in most of its messages, so the line
number carries the file as well: file 2, line 38 is line 20038. One text serves OpenGL 4.1
(with tessellation and `precise`) and 3.3 (without).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.errors import RenderError
from runtime.gpu.gl_state import compile_shader

if TYPE_CHECKING:
    import moderngl

MAX_INCLUDE_DEPTH = 16
LINES_PER_FILE = 10_000
MIN_VERSION_CODE = 330
TESSELLATION_VERSION_CODE = 410
STAGES = {
    "vert": "vertex_shader",
    "tesc": "tess_control_shader",
    "tese": "tess_evaluation_shader",
    "geom": "geometry_shader",
    "frag": "fragment_shader",
}
UNIFORM_BLOCKS = {"Frame": 0, "Joints": 1}  # binding points, set after linking: 4.1 has no layout(binding)

_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"\s*$')
_MESSAGE_PLACE = re.compile(r"(?m)^(\s*(?:ERROR: )?)(\d+)([:(])(\d+)")


@dataclass(frozen=True)
class ShaderSource:
    """A stage's full text, and the files that its `#line` numbers stand for."""

    text: str
    files: tuple[str, ...]

    def explain(self, message: str) -> str:
        """A driver's message with file numbers replaced by names."""

        def name(match: re.Match[str]) -> str:
            number, line = divmod(int(match[4]), LINES_PER_FILE)
            shown = self.files[number] if number < len(self.files) else match[2]
            return f"{match[1]}{shown}{match[3]}{line}"

        return _MESSAGE_PLACE.sub(name, message)


@lru_cache(maxsize=1)
def _shader_folder() -> Traversable:
    """Our GLSL files: inside the package where it was installed, beside it in a checkout."""
    inside = resources.files("runtime").joinpath("shaders")
    return inside if inside.is_dir() else Path(__file__).resolve().parents[2] / "shaders"


@lru_cache(maxsize=128)
def _read_own(name: str) -> str | None:
    """Text of a file in shaders/, None where there is none."""
    entry = _shader_folder().joinpath(name)
    return entry.read_text(encoding="utf-8") if entry.is_file() else None


def _find(name: str, beside: str, folder: Path | None) -> tuple[str, str]:
    """Name and text of a file: beside the including one, in shaders/ or shaders/include, or in a caller's folder."""
    parent = beside.rpartition("/")[0]
    for candidate in dict.fromkeys((f"{parent}/{name}" if parent else name, name, f"include/{name}")):
        if folder is not None and (folder / candidate).is_file():
            return candidate, (folder / candidate).read_text(encoding="utf-8")
        text = _read_own(candidate)
        if text is not None:
            return candidate, text
    raise RenderError(f"{beside}: no shader file {name!r} to include: check the name")


def _expand(name: str, text: str, files: list[str], depth: int, folder: Path | None) -> list[str]:
    """Lines of a file with its includes in their place."""
    if depth > MAX_INCLUDE_DEPTH:
        raise RenderError(f"{name}: includes are nested deeper than {MAX_INCLUDE_DEPTH}: does a file include itself?")
    if name not in files:
        files.append(name)
    number = files.index(name)
    start = number * LINES_PER_FILE
    lines = [f"#line {start + 1} {number}"]
    for line_number, line in enumerate(text.splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            lines.append(line)
            continue
        included, included_text = _find(match[1], name, folder)
        lines += _expand(included, included_text, files, depth + 1, folder)
        lines.append(f"#line {start + line_number + 1} {number}")
    return lines


def assemble(
    name: str,
    version_code: int,
    defines: Mapping[str, str | int] | None = None,
    text: str | None = None,
    folder: Path | None = None,
) -> ShaderSource:
    """One stage's source.

    Parameters
    ----------
    name : str
        A file of shaders/, or the name under which errors report `text`.
    version_code : int
        Of the context: 330, 410, 460 ...
    defines : mapping, optional
        Preprocessor definitions.
    text : str, optional
        A caller's own source; it may include the files of shaders/include.
    folder : Path, optional
        Where a caller's own includes are looked for first.

    Raises
    ------
    RenderError
        If a file does not exist, or files include each other endlessly.
    """
    if text is None:
        text = _read_own(name)
        if text is None:
            raise RenderError(f"no shader file {name!r}")
    modern = version_code >= TESSELLATION_VERSION_CODE
    head = ["#version 410 core" if modern else "#version 330 core"]
    head.append("#define PRECISE precise" if modern else "#define PRECISE")
    head += [f"#define {key} {value}" for key, value in (defines or {}).items()]
    files: list[str] = []
    body = _expand(name, text, files, 0, folder)
    return ShaderSource("\n".join([*head, *body]) + "\n", tuple(files))


def require_version(ctx: moderngl.Context) -> None:
    """Refuse a context that is too old.

    Raises
    ------
    RenderError
    """
    if ctx.version_code < MIN_VERSION_CODE:
        code = ctx.version_code
        raise RenderError(
            f"this context is OpenGL {code // 100}.{code // 10 % 10}, seamskin needs 3.3 (4.1 for tessellation): "
            "ask for a newer context or update the graphics driver"
        )


@dataclass
class _Members:
    """A program's uniforms, blocks and attributes by name, and the values that uniforms were given last.

    `prepared_for` is what a caller set all of them for, and asks first.
    """

    uniforms: dict[str, Any]
    held: dict[str, Any]
    prepared_for: Any = None


_PLAIN = (tuple, float, int)  # values that can be compared


def remember_members(program: moderngl.Program) -> None:
    """Let `set_uniforms` work on a program that was made elsewhere."""
    program.extra = _Members({name: program[name] for name in program}, {})


def build_program(
    ctx: moderngl.Context,
    stages: Sequence[str],
    defines: Mapping[str, str | int] | None = None,
    fragment_text: str | None = None,
    folder: Path | None = None,
) -> moderngl.Program:
    """Compile and link stage files into a program and tie its uniform blocks to their binding points.

    Parameters
    ----------
    ctx : moderngl.Context
    stages : names of files in shaders/, one a stage; the extension says which
    defines : mapping, optional
    fragment_text : str, optional
        Source of a caller's own fragment shader, in place of a file.
    folder : Path, optional
        Where the caller's includes lie.

    Raises
    ------
    RenderError
        If it does not compile or link: the message names file and line.
    """
    sources = {name: assemble(name, ctx.version_code, defines) for name in stages}
    if fragment_text is not None:
        own = sources["caller.frag"] = assemble("caller.frag", ctx.version_code, defines, fragment_text, folder)
        compiled, log = compile_shader(own.text, "frag")  # first alone: moderngl leaves objects behind when it fails
        if not compiled:
            raise RenderError(f"shader caller.frag does not compile:\n{own.explain(log)}")
    texts: dict[str, Any] = {STAGES[name.rpartition(".")[2]]: source.text for name, source in sources.items()}
    try:
        program = ctx.program(**texts)
    except Exception as error:  # moderngl raises its bare Error for every failure here
        raise RenderError(_explain_failure(str(error), sources)) from None
    remember_members(program)
    for block, binding in UNIFORM_BLOCKS.items():
        if block in program.extra.uniforms:
            program.extra.uniforms[block].binding = binding
    return program


def set_uniforms(program: moderngl.Program, values: Mapping[str, Any]) -> None:
    """Set those of the named uniforms that the program has, where they are not so already.

    The program must come from `build_program`, and these uniforms be set by nothing else.

    Raises
    ------
    RenderError
        If a uniform does not take its value.
    """
    uniforms, held = program.extra.uniforms, program.extra.held
    for name, value in values.items():
        is_plain = isinstance(value, _PLAIN)
        if name not in uniforms or (is_plain and name in held and held[name] == value):
            continue
        try:
            uniforms[name].value = value
        except (struct.error, TypeError, ValueError) as error:
            raise RenderError(f"the uniform {name!r} does not take {value!r:.80}: {error}") from None
        if is_plain:
            held[name] = value
        else:
            held.pop(name, None)


def _explain_failure(message: str, sources: Mapping[str, ShaderSource]) -> str:
    """The driver's message, with names for file numbers, of the stage that it is about."""
    stage_of = {
        "vertex": "vert",
        "tess_control": "tesc",
        "tess_evaluation": "tese",
        "geometry": "geom",
        "fragment": "frag",
    }
    for word, extension in stage_of.items():
        if re.search(rf"\b{word}_shader\b", message):
            for name, source in sources.items():
                if name.endswith("." + extension):
                    return f"shader {name} does not compile:\n{source.explain(message)}"
    return f"shaders {', '.join(sources)} do not link:\n{message}"
