"""The viewer's panel: clips, levels, views, light and frame times, in Dear ImGui (the package imgui-bundle)."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from demos.errors import DemoError
from demos.options import VIEW_NAMES
from demos.window import Window

if TYPE_CHECKING:
    from demos.viewer import Viewer

SHOWN_FRAMES = 120  # of the graph of frame times
WIDTH_PX = 360
KEYS = (
    ("drag, right drag, wheel", "turn, move, come nearer"),
    ("Space", "pause"),
    ("Left, Right", "another clip"),
    ("1 to 9", "another view"),
    ("L", "next level of detail"),
    ("T", "tessellation"),
    ("F", "frame the character"),
    ("P", "save a picture"),
    ("H", "hide or show this panel"),
    ("Esc", "close"),
)
TESSELLATIONS: tuple[str | float, ...] = ("auto", "off", 2.0, 4.0, 8.0)


def sun_angles(direction: tuple[float, float, float]) -> tuple[float, float]:
    """Heading from +Z about +Y and height above the horizon of a direction, degrees."""
    x, y, z = direction
    return math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, math.hypot(x, z)))


def sun_direction(heading_deg: float, height_deg: float) -> tuple[float, float, float]:
    """The unit vector of `sun_angles`."""
    heading, height = math.radians(heading_deg), math.radians(height_deg)
    return (math.cos(height) * math.sin(heading), math.sin(height), math.cos(height) * math.cos(heading))


class Panel:
    """Draws over the window's picture and passes on what is not meant for it.

    Raises
    ------
    DemoError
        If imgui-bundle or PyOpenGL is missing.
    """

    def __init__(self, window: Window) -> None:
        try:
            import glfw
            from imgui_bundle import imgui
            from imgui_bundle.python_backends.glfw_backend import GlfwRenderer
        except ImportError as error:
            raise DemoError(f'the panel needs {error.name}: pip install "seamskin[demos]"') from None
        from OpenGL import GL

        self._imgui = imgui
        self._activate_texture_unit: Callable[[int], None] = lambda unit: GL.glActiveTexture(GL.GL_TEXTURE0 + unit)
        self.is_shown = True
        self._context = imgui.create_context()
        imgui.get_io().set_ini_filename("")  # nothing is written beside the user's files
        self._backend = GlfwRenderer(window.handle, attach_callbacks=False)
        self._frame_times_ms: deque[float] = deque([0.0] * SHOWN_FRAMES, SHOWN_FRAMES)
        backend, io = self._backend, imgui.get_io()
        mouse, keys = (lambda: io.want_capture_mouse), (lambda: io.want_capture_keyboard)
        self._chain(glfw.set_key_callback, window.handle, backend.keyboard_callback, keys)
        self._chain(glfw.set_cursor_pos_callback, window.handle, backend.mouse_callback, mouse)
        self._chain(glfw.set_mouse_button_callback, window.handle, backend.mouse_button_callback, mouse)
        self._chain(glfw.set_scroll_callback, window.handle, backend.scroll_callback, mouse)
        self._chain(glfw.set_char_callback, window.handle, backend.char_callback, keys)
        self._chain(glfw.set_window_size_callback, window.handle, backend.resize_callback, lambda: False)

    @staticmethod
    def _chain(setter: Any, handle: Any, ours: Any, is_captured: Callable[[], bool]) -> None:
        """Let the panel see an event first; what it does not want goes where it went before."""
        before = setter(handle, None)

        def both(*event: Any) -> None:
            ours(*event)
            if before is not None and not is_captured():
                before(*event)

        setter(handle, both)

    def draw(self, viewer: Viewer, dt_s: float) -> None:
        """Draw the panel over what was drawn, and do what was chosen in it."""
        self._frame_times_ms.append(1e3 * dt_s)
        if not self.is_shown:
            return
        imgui = self._imgui
        imgui.set_current_context(self._context)
        self._backend.process_inputs()
        imgui.new_frame()
        imgui.set_next_window_pos(imgui.ImVec2(8, 8), imgui.Cond_.first_use_ever)
        imgui.set_next_window_size(imgui.ImVec2(WIDTH_PX, 0), imgui.Cond_.first_use_ever)
        imgui.begin(viewer.model.asset.name)
        self._clips(viewer)
        self._levels(viewer)
        self._light(viewer)
        self._times()
        if imgui.button("Save a picture"):
            viewer.wants_picture = True
        if imgui.collapsing_header("Keys"):
            for key, meaning in KEYS:
                imgui.text(f"{key}: {meaning}")
        imgui.end()
        imgui.render()
        # ImGui's renderer asks for what is bound at the active unit; moderngl leaves one active that has no 2D target.
        self._activate_texture_unit(0)
        self._backend.render(imgui.get_draw_data())

    def _clips(self, viewer: Viewer) -> None:
        imgui, clips = self._imgui, viewer.model.asset.clips
        if not clips:
            imgui.text("no clips: at rest")
            return
        changed, chosen = imgui.combo("clip", max(viewer.clip, 0), [clip.name for clip in clips])
        if changed:
            viewer.play(chosen)
        duration = clips[max(viewer.clip, 0)].duration_s
        if duration > 0 and viewer.clip >= 0:
            changed, time_s = imgui.slider_float("time, s", viewer.actor.time_s % duration, 0.0, duration)
            if changed:
                viewer.actor.time_s = time_s
        changed, viewer.speed = imgui.slider_float("speed", viewer.speed, 0.0, 3.0)
        if changed:
            viewer.actor.set_speed(viewer.speed)
        _, viewer.fade_s = imgui.slider_float("crossfade, s", viewer.fade_s, 0.0, 1.0)
        _, viewer.paused = imgui.checkbox("paused", viewer.paused)

    def _levels(self, viewer: Viewer) -> None:
        imgui = self._imgui
        changed, index = imgui.combo("view", VIEW_NAMES.index(viewer.view), list(VIEW_NAMES))
        if changed:
            viewer.view = VIEW_NAMES[index]
        levels: list[str | int] = ["auto", *range(len(viewer.model.lods))]
        names = ["auto"] + [
            f"{number}: {len(lod.triangles):,} faces, {1e3 * lod.error_m:.1f} mm"
            for number, lod in enumerate(viewer.model.asset.lods)
        ]
        changed, index = imgui.combo("level", levels.index(viewer.lod) if viewer.lod in levels else 0, names)
        if changed:
            viewer.lod = levels[index]
        quality = viewer.renderer.quality
        changed, threshold = imgui.slider_float("error allowed, px", quality.threshold_px, 0.25, 16.0)
        if changed:
            viewer.renderer.quality = dataclasses.replace(quality, threshold_px=max(threshold, 0.01))
        at = TESSELLATIONS.index(viewer.tessellation) if viewer.tessellation in TESSELLATIONS else 0
        changed, index = imgui.combo("tessellation", at, [str(choice) for choice in TESSELLATIONS])
        if changed and (viewer.renderer.has_tessellation or isinstance(TESSELLATIONS[index], str)):
            viewer.tessellation = TESSELLATIONS[index]
        drawn = viewer.renderer.last_drawn.get(viewer.actor)
        if drawn is not None and drawn.level >= 0:
            imgui.text(f"drawn: level {drawn.level}, {len(viewer.model.asset.lods[drawn.level].triangles):,} faces")

    def _light(self, viewer: Viewer) -> None:
        imgui, lighting = self._imgui, viewer.renderer.lighting
        heading, height = sun_angles(lighting.sun_direction)
        turned, heading = imgui.slider_float("sun heading, deg", heading, -180.0, 180.0)
        raised, height = imgui.slider_float("sun height, deg", height, -89.0, 89.0)
        exposed, exposure = imgui.slider_float("exposure", lighting.exposure, 0.0, 3.0)
        if turned or raised or exposed:
            viewer.renderer.lighting = dataclasses.replace(
                lighting, sun_direction=sun_direction(heading, height), exposure=max(exposure, 0.0)
            )

    def _times(self) -> None:
        times = np.array(self._frame_times_ms, np.float32)
        self._imgui.plot_lines(
            "frame", times, overlay_text=f"{times[-1]:.1f} ms", scale_min=0.0, scale_max=max(float(times.max()), 1.0)
        )

    def release(self) -> None:
        """Free its buffers and context."""
        self._imgui.set_current_context(self._context)
        self._backend.shutdown()
        self._imgui.destroy_context(self._context)
