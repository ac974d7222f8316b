"""The GL state that drawing touches, saved before and put back after, asked of the driver itself.

moderngl keeps no record of what other code did to the context, so this talks to GL directly: the same few functions
everywhere, found through the platform's own loader. Nothing here changes what moderngl believes about the context.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from runtime.errors import RenderError

# OpenGL's names for what is saved.
CULL_FACE, DEPTH_TEST, BLEND, POLYGON_OFFSET_FILL, PRIMITIVE_RESTART = 0x0B44, 0x0B71, 0x0BE2, 0x8037, 0x8F9D
POLYGON_OFFSET_LINE, SAMPLE_ALPHA_TO_COVERAGE, FRAMEBUFFER_SRGB, RASTERIZER_DISCARD = 0x2A02, 0x809E, 0x8DB9, 0x8C89
CAPABILITIES = (
    CULL_FACE, DEPTH_TEST, BLEND, POLYGON_OFFSET_FILL, POLYGON_OFFSET_LINE, SAMPLE_ALPHA_TO_COVERAGE, FRAMEBUFFER_SRGB,
    PRIMITIVE_RESTART,
)  # fmt: skip
CULL_FACE_MODE, FRONT_FACE, DEPTH_FUNC, DEPTH_WRITEMASK, POLYGON_MODE = 0x0B45, 0x0B46, 0x0B74, 0x0B72, 0x0B40
BLEND_DST_RGB, BLEND_SRC_RGB, BLEND_DST_ALPHA, BLEND_SRC_ALPHA = 0x80C8, 0x80C9, 0x80CA, 0x80CB
BLEND_EQUATION_RGB, BLEND_EQUATION_ALPHA = 0x8009, 0x883D
POLYGON_OFFSET_FACTOR, POLYGON_OFFSET_UNITS, LINE_WIDTH, COLOR_WRITEMASK = 0x8038, 0x2A00, 0x0B21, 0x0C23
CURRENT_PROGRAM, VERTEX_ARRAY_BINDING, ARRAY_BUFFER_BINDING, UNIFORM_BUFFER_BINDING = 0x8B8D, 0x85B5, 0x8894, 0x8A28
UNIFORM_BUFFER_START, UNIFORM_BUFFER_SIZE = 0x8A29, 0x8A2A
ACTIVE_TEXTURE, TEXTURE_BINDING_2D, SAMPLER_BINDING, TEXTURE0 = 0x84E0, 0x8069, 0x8919, 0x84C0
PATCH_VERTICES, UNPACK_ALIGNMENT, PIXEL_UNPACK_BUFFER_BINDING, VIEWPORT = 0x8E72, 0x0CF5, 0x88EF, 0x0BA2
UNPACK_SETTINGS = (0x0CF0, 0x0CF1, 0x0CF2, 0x0CF3, 0x0CF4, UNPACK_ALIGNMENT)
PIXEL_UNPACK_BUFFER, ARRAY_BUFFER, UNIFORM_BUFFER, TEXTURE_2D = 0x88EC, 0x8892, 0x8A11, 0x0DE1
FLOAT, UNSIGNED_BYTE = 0x1406, 0x1401
DRAW_FRAMEBUFFER, DRAW_FRAMEBUFFER_BINDING, READ_FRAMEBUFFER, READ_FRAMEBUFFER_BINDING = 0x8CA9, 0x8CA6, 0x8CA8, 0x8CAA
FRONT, BACK, FRONT_AND_BACK, CW, CCW, LINE, FILL = 0x0404, 0x0405, 0x0408, 0x0900, 0x0901, 0x1B01, 0x1B02
COLOR, DEPTH = 0x1800, 0x1801  # of what glClearBufferfv clears
LESS, LEQUAL, ZERO, ONE, SRC_ALPHA, ONE_MINUS_SRC_ALPHA, FUNC_ADD = 0x0201, 0x0203, 0, 1, 0x0302, 0x0303, 0x8006

_I, _U, _F, _B, _S = ctypes.c_int, ctypes.c_uint, ctypes.c_float, ctypes.c_ubyte, ctypes.c_ssize_t
_P = ctypes.c_void_p  # a ctypes reference, array or pointer, or None
_A = type("_Address", (ctypes.c_void_p,), {})  # an address as a plain number
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "glGetIntegerv": (None, _U, _P), "glGetInteger64v": (None, _U, _P), "glGetFloatv": (None, _U, _P),
    "glGetIntegeri_v": (None, _U, _U, _P), "glGetInteger64i_v": (None, _U, _U, _P),
    "glIsEnabled": (_B, _U), "glEnable": (None, _U), "glDisable": (None, _U),
    "glCullFace": (None, _U), "glFrontFace": (None, _U), "glDepthFunc": (None, _U), "glDepthMask": (None, _B),
    "glColorMask": (None, _B, _B, _B, _B),
    "glPolygonMode": (None, _U, _U), "glPolygonOffset": (None, _F, _F), "glLineWidth": (None, _F),
    "glBlendFuncSeparate": (None, _U, _U, _U, _U), "glBlendEquationSeparate": (None, _U, _U),
    "glUseProgram": (None, _U), "glBindVertexArray": (None, _U), "glBindBuffer": (None, _U, _U),
    "glBindBufferBase": (None, _U, _U, _U), "glBindBufferRange": (None, _U, _U, _U, _S, _S),
    "glActiveTexture": (None, _U), "glBindTexture": (None, _U, _U), "glBindSampler": (None, _U, _U),
    "glTexSubImage2D": (None, _U, _I, _I, _I, _I, _I, _U, _U, _A),
    "glTexImage2D": (None, _U, _I, _I, _I, _I, _I, _U, _U, _P), "glTexParameteri": (None, _U, _U, _I),
    "glGetTexLevelParameteriv": (None, _U, _I, _U, _P),
    "glPixelStorei": (None, _U, _I), "glPatchParameteri": (None, _U, _I),
    "glCreateShader": (_U, _U), "glShaderSource": (None, _U, _I, _P, _P), "glCompileShader": (None, _U),
    "glGetShaderiv": (None, _U, _U, _P), "glGetShaderInfoLog": (None, _U, _I, _P, _P), "glDeleteShader": (None, _U),
    "glViewport": (None, _I, _I, _I, _I),
    "glBindFramebuffer": (None, _U, _U), "glClearBufferfv": (None, _U, _I, _P),
    "glVertexAttribPointer": (None, _U, _I, _U, _B, _I, _P),
}  # fmt: skip
_Integers = ctypes.c_int * 16  # no state has more
_MUST_CONVERT = {_F, _S, _A}  # what ctypes passes otherwise unless told


def _function(address: int, result: Any, arguments: Sequence[Any]) -> Any:
    """A GL function to call. One of plain integers and pointers needs no declaration, and takes a third of the time."""
    if sys.platform == "win32":  # it has its own calling convention, whose functions count what they are given
        return ctypes.WINFUNCTYPE(result, *arguments)(address)
    declared = arguments if _MUST_CONVERT.intersection(arguments) else ()
    return ctypes.PYFUNCTYPE(result, *declared)(address)  # short calls keep Python's lock, which is a fifth quicker


class Functions:
    """GL functions by name, as plain calls: `functions().glEnable(flag)`."""

    def __init__(self) -> None:
        load = _loader()
        for name, (result, *arguments) in _SIGNATURES.items():
            address = load(name)
            if address:
                setattr(self, name, _function(address, result, arguments))
            elif name != "glPatchParameteri":
                raise RenderError(f"the OpenGL library has no {name}: update the graphics driver")

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)

    def integer(self, what: int) -> int:
        """One integer of the state."""
        return self.integers(what, 1)[0]

    def integers(self, what: int, count: int) -> list[int]:
        """Several integers of the state."""
        values = _Integers()
        self.glGetIntegerv(what, values)
        return values[:count]

    def number(self, what: int) -> float:
        """One float of the state."""
        value = (ctypes.c_float * 4)()
        self.glGetFloatv(what, value)
        return value[0]

    def switch(self, capability: int, on: bool) -> None:
        """Enable or disable."""
        (self.glEnable if on else self.glDisable)(capability)


def _loader() -> Any:
    """Function from a GL function's name to its address."""
    if sys.platform == "darwin":
        framework = ctypes.CDLL("/System/Library/Frameworks/OpenGL.framework/OpenGL")
        return lambda name: ctypes.cast(getattr(framework, name, None), _P).value
    if sys.platform == "win32":
        library = ctypes.WinDLL("opengl32")
        library.wglGetProcAddress.restype, library.wglGetProcAddress.argtypes = _P, [ctypes.c_char_p]

        def load(name: str) -> int | None:
            address = library.wglGetProcAddress(name.encode())
            if address:
                return int(address)
            function = getattr(library, name, None)
            return ctypes.cast(function, _P).value if function else None

        return load
    for library_name, entry in (("EGL", "eglGetProcAddress"), ("GL", "glXGetProcAddressARB")):
        path = ctypes.util.find_library(library_name)
        if path is None:
            continue
        function = getattr(ctypes.CDLL(path), entry, None)
        if function is not None:
            function.restype, function.argtypes = _P, [ctypes.c_char_p]
            return lambda name: function(name.encode())
    raise RenderError("neither libEGL nor libGL is found: install the system's OpenGL libraries")


@lru_cache(maxsize=1)
def functions() -> Functions:
    """GL's functions, looked up once."""
    return Functions()


TEXTURE_INTERNAL_FORMAT, TEXTURE_MAX_LEVEL = 0x1003, 0x813D
TEXEL_FORMATS = {1: 0x1903, 2: 0x8227, 3: 0x1907, 4: 0x1908}  # red to RGBA, by the number of channels
TEXEL_TYPES = {"uint8": UNSIGNED_BYTE, "uint16": 0x1403, "float16": 0x140B, "float32": FLOAT}


def allocate_mips(size: tuple[int, int], count: int) -> None:
    """Make room for further levels of the 2D texture that is bound: nothing is computed, as `glGenerateMipmap` would.

    Parameters
    ----------
    size : width and height of level 0, which must be there and hold no integers
    count : int
        Levels below it.
    """
    gl, form = functions(), ctypes.c_int()
    gl.glGetTexLevelParameteriv(TEXTURE_2D, 0, TEXTURE_INTERNAL_FORMAT, ctypes.byref(form))
    for level in range(1, count + 1):
        width, height = (max(1, side >> level) for side in size)
        gl.glTexImage2D(TEXTURE_2D, level, form.value, width, height, 0, TEXEL_FORMATS[4], UNSIGNED_BYTE, None)
    gl.glTexParameteri(TEXTURE_2D, TEXTURE_MAX_LEVEL, count)


def write_rows(texels: Any, level: int, first: int) -> None:
    """Write whole rows, a contiguous array (R, W, C), into a level of the 2D texture that is bound."""
    gl = functions()
    rows, width, channels = texels.shape
    gl.glPixelStorei(UNPACK_ALIGNMENT, 1)
    kind = TEXEL_TYPES[texels.dtype.name]
    gl.glTexSubImage2D(TEXTURE_2D, level, 0, first, width, rows, TEXEL_FORMATS[channels], kind, texels.ctypes.data)


SHADER_STAGES = {"vert": 0x8B31, "frag": 0x8B30, "geom": 0x8DD9, "tesc": 0x8E88, "tese": 0x8E87}
COMPILE_STATUS, INFO_LOG_LENGTH = 0x8B81, 0x8B84


def compile_shader(text: str, stage: str) -> tuple[bool, str]:
    """Compile one stage ("vert", "frag" ...) to see whether it can be: success, and all that the driver says."""
    gl = functions()
    shader = gl.glCreateShader(SHADER_STAGES[stage])
    source = ctypes.c_char_p(text.encode())
    gl.glShaderSource(shader, 1, ctypes.byref(source), None)
    gl.glCompileShader(shader)
    status, length = ctypes.c_int(), ctypes.c_int()
    gl.glGetShaderiv(shader, COMPILE_STATUS, ctypes.byref(status))
    gl.glGetShaderiv(shader, INFO_LOG_LENGTH, ctypes.byref(length))
    log = ctypes.create_string_buffer(max(length.value, 1))
    gl.glGetShaderInfoLog(shader, len(log), None, log)
    gl.glDeleteShader(shader)
    return bool(status.value), log.value.decode(errors="replace").strip()


def clear_bound(color: Sequence[float], depth: float) -> None:
    """Fill colour and depth of the framebuffer that is bound, whoever bound it; scissor and colour mask count."""
    gl = functions()
    gl.glDepthMask(1)
    gl.glClearBufferfv(COLOR, 0, (ctypes.c_float * 4)(*color))
    gl.glClearBufferfv(DEPTH, 0, (ctypes.c_float * 1)(depth))


_SWITCHES = len(CAPABILITIES)
# What is asked in one go, each with room for four integers.
_ASKED = (
    *CAPABILITIES, CULL_FACE_MODE, FRONT_FACE, DEPTH_FUNC, DEPTH_WRITEMASK, POLYGON_MODE, COLOR_WRITEMASK,
    BLEND_SRC_RGB, BLEND_DST_RGB, BLEND_SRC_ALPHA, BLEND_DST_ALPHA, BLEND_EQUATION_RGB, BLEND_EQUATION_ALPHA,
    CURRENT_PROGRAM, VERTEX_ARRAY_BINDING, ARRAY_BUFFER_BINDING, UNIFORM_BUFFER_BINDING, ACTIVE_TEXTURE,
    PIXEL_UNPACK_BUFFER_BINDING, *UNPACK_SETTINGS,
)  # fmt: skip
_COLOR_MASK = 4 * _ASKED.index(COLOR_WRITEMASK)


class _Page:
    """Memory that the driver writes answers to, with references to its places ready: they need not be made each time.

    Parameters
    ----------
    num_units, num_blocks : int
        Of texture units and of uniform buffer binding points.
    """

    def __init__(self, num_units: int, num_blocks: int) -> None:
        self.words = (ctypes.c_int * (4 * len(_ASKED)))()
        self.units = (ctypes.c_int * (2 * num_units))()
        self.buffers = (ctypes.c_int * max(num_blocks, 1))()
        self.ranges = (ctypes.c_int64 * (2 * max(num_blocks, 1)))()
        self.offset = (ctypes.c_float * 2)()
        self.patch_vertices = ctypes.c_int()
        self.asked = [(what, ctypes.byref(self.words, 16 * index)) for index, what in enumerate(_ASKED)]
        self.textures = [ctypes.byref(self.units, 8 * index) for index in range(num_units)]
        self.samplers = [ctypes.byref(self.units, 8 * index + 4) for index in range(num_units)]
        self.blocks = [
            (
                ctypes.byref(self.buffers, 4 * index),
                *(ctypes.byref(self.ranges, 16 * index + 8 * part) for part in (0, 1)),
            )
            for index in range(num_blocks)
        ]
        self.factor, self.units_offset = (ctypes.byref(self.offset, 4 * index) for index in (0, 1))
        self.patches = ctypes.byref(self.patch_vertices)


class saved_state:
    """Save what drawing and uploading touch, and put it back at the end, whatever happens in between.

    Gives the GL functions. May be used again and again, but not within itself.

    Parameters
    ----------
    texture_units : units whose 2D texture and sampler may be replaced
    uniform_bindings : uniform buffer binding points that may be replaced
    patches : bool
        Whether the context has patches (OpenGL 4.0).
    """

    def __init__(self, texture_units: Sequence[int], uniform_bindings: Sequence[int], patches: bool) -> None:
        self._units, self._bindings, self._patches = tuple(texture_units), tuple(uniform_bindings), patches
        self._unit_names = [TEXTURE0 + unit for unit in self._units]
        self._page = _Page(len(self._units), len(self._bindings))

    def __enter__(self) -> Functions:
        gl, page = functions(), self._page
        get, activate = gl.glGetIntegerv, gl.glActiveTexture
        for what, place in page.asked:
            get(what, place)
        gl.glGetFloatv(POLYGON_OFFSET_FACTOR, page.factor)
        gl.glGetFloatv(POLYGON_OFFSET_UNITS, page.units_offset)
        if self._patches:
            get(PATCH_VERTICES, page.patches)
        for name, texture_at, sampler_at in zip(self._unit_names, page.textures, page.samplers):
            activate(name)
            get(TEXTURE_BINDING_2D, texture_at)
            get(SAMPLER_BINDING, sampler_at)
        self._textures, samplers = page.units[::2], page.units[1::2]
        self._samplers = [(unit, sampler) for unit, sampler in zip(self._units, samplers) if sampler]
        for unit, _ in self._samplers:
            gl.glBindSampler(unit, 0)
        for binding, (buffer_at, start_at, size_at) in zip(self._bindings, page.blocks):
            gl.glGetIntegeri_v(UNIFORM_BUFFER_BINDING, binding, buffer_at)
            gl.glGetInteger64i_v(UNIFORM_BUFFER_START, binding, start_at)
            gl.glGetInteger64i_v(UNIFORM_BUFFER_SIZE, binding, size_at)
        self._values = page.words[::4]
        self._color_mask = page.words[_COLOR_MASK : _COLOR_MASK + 4]
        unpack_buffer, *unpack = self._values[-len(UNPACK_SETTINGS) - 1 :]
        if unpack_buffer:
            gl.glBindBuffer(PIXEL_UNPACK_BUFFER, 0)
        if any(unpack[:5]):
            for what in UNPACK_SETTINGS[:5]:
                gl.glPixelStorei(what, 0)
        return gl

    def __exit__(self, *error: object) -> None:
        gl, page, values = functions(), self._page, self._values
        enable, disable = gl.glEnable, gl.glDisable
        for flag, on in zip(CAPABILITIES, values):
            (enable if on else disable)(flag)
        (cull, front, depth_func, depth_mask, polygon_mode, _color_mask, source, destination, source_alpha,
         destination_alpha, equation, equation_alpha, program, vertex_array, array_buffer, uniform_buffer, active,
         unpack_buffer, *unpack) = values[_SWITCHES:]  # fmt: skip
        gl.glCullFace(cull)
        gl.glFrontFace(front)
        gl.glDepthFunc(depth_func)
        gl.glDepthMask(depth_mask)
        gl.glPolygonMode(FRONT_AND_BACK, polygon_mode)
        gl.glPolygonOffset(*page.offset)
        gl.glColorMask(*self._color_mask)
        gl.glBlendFuncSeparate(source, destination, source_alpha, destination_alpha)
        gl.glBlendEquationSeparate(equation, equation_alpha)
        if self._patches:
            gl.glPatchParameteri(PATCH_VERTICES, page.patch_vertices.value)
        activate, bind = gl.glActiveTexture, gl.glBindTexture
        for name, texture in zip(self._unit_names, self._textures):
            activate(name)
            bind(TEXTURE_2D, texture)
        for unit, sampler in self._samplers:
            gl.glBindSampler(unit, sampler)
        activate(active)
        for binding, buffer, start, size in zip(self._bindings, page.buffers, page.ranges[::2], page.ranges[1::2]):
            if size:
                gl.glBindBufferRange(UNIFORM_BUFFER, binding, buffer, start, size)
            else:
                gl.glBindBufferBase(UNIFORM_BUFFER, binding, buffer)
        gl.glBindBuffer(UNIFORM_BUFFER, uniform_buffer)
        gl.glUseProgram(program)
        gl.glBindVertexArray(vertex_array)
        gl.glBindBuffer(ARRAY_BUFFER, array_buffer)
        if any(unpack[:5]):
            for what, value in zip(UNPACK_SETTINGS, unpack[:5]):
                gl.glPixelStorei(what, value)
        gl.glPixelStorei(UNPACK_ALIGNMENT, unpack[5])
        if unpack_buffer:
            gl.glBindBuffer(PIXEL_UNPACK_BUFFER, unpack_buffer)
