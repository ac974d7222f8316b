"""The ways to look at a character: which fragment shader, which overlay, what it writes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import moderngl

    from runtime.gpu.gl_state import Functions
    from runtime.scene.camera import CameraMatrices


@dataclass(frozen=True)
class View:
    """One way to look.

    Attributes
    ----------
    fragment : str
        File in shaders/, or empty for a caller's own text.
    defines : mapping
        Preprocessor definitions of all stages.
    uniforms : mapping
        Values of uniforms that this view sets.
    lines : "", "wireframe" or "seams"
        Drawn over the faces.
    blends : bool
        Whether blended materials are blended; a diagram draws them solid.
    is_lit : bool
        Whether smooth edges (multisampling) suit it: diagrams and comparable pictures have hard ones.
    writes_color : bool
    two_sided : bool
        Whether back faces are drawn whatever the material says.
    text, folder
        A caller's own fragment shader, and where its includes lie.
    """

    fragment: str
    defines: Mapping[str, str | int] = field(default_factory=dict)
    uniforms: Mapping[str, Any] = field(default_factory=dict)
    lines: str = ""
    blends: bool = False
    is_lit: bool = False
    writes_color: bool = True
    two_sided: bool = False
    text: str | None = None
    folder: Path | None = None


@dataclass(frozen=True)
class Frame:
    """What a renderer tells a thing that draws itself about the picture being drawn.

    Attributes
    ----------
    gl : Functions
        The state is saved already; drawing may change it.
    camera : CameraMatrices
    size_px : width and height of the picture
    threshold_px : float
        Largest error on the screen that a level of detail may have.
    level : int or None
        One level of detail for all, None to choose.
    view_name, view : the way to look
    uniforms : mapping
        Of a caller's own fragment shader.
    defines : mapping
        Preprocessor definitions of all programs.
    blend_prepass : bool
        Whether blended faces write the depth of what is nearly opaque in them first.
    """

    gl: Functions
    camera: CameraMatrices
    size_px: tuple[int, int]
    threshold_px: float
    level: int | None
    view_name: str
    view: View
    uniforms: Mapping[str, Any]
    defines: Mapping[str, str | int]
    blend_prepass: bool


class Drawable(ABC):
    """What a renderer can draw besides actors: a crowd."""

    ctx: moderngl.Context
    visible: bool

    @abstractmethod
    def draw_in(self, frame: Frame) -> None:
        """Draw into the picture."""


PAPER = (0.72, 0.70, 0.66)
VIEWS: dict[str, View] = {
    "lit": View("lit.frag", blends=True, is_lit=True),
    "base_color": View("base_color.frag"),
    "normal": View("normal.frag"),
    "position": View("position.frag"),
    "weights": View("weights.frag", defines={"SHOW_WEIGHTS": 1}, is_lit=True),
    "lod": View("lod.frag", is_lit=True),
    "wireframe": View("clay.frag", uniforms={"flat_color": PAPER}, lines="wireframe", is_lit=True),
    "seams": View("clay.frag", uniforms={"flat_color": PAPER}, lines="seams", is_lit=True),
    "mask": View("flat.frag", uniforms={"flat_color": (1.0, 1.0, 1.0)}),
    "facing": View("facing.frag", two_sided=True),
    "depth": View("depth.frag", writes_color=False),
}
LINES = View("flat.frag")
LINE_COLORS = {"wireframe": (0.10, 0.16, 0.24), "seams": (0.85, 0.10, 0.08)}
