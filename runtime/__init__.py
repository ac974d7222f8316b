"""Draws built characters: skeletons, clips, levels of detail and textures, in a context the caller owns.

model = runtime.Model(ctx, runtime.load("human.seamless"))
actor = model.actor(clip="walk")
renderer = runtime.Renderer(ctx)
actor.update(dt)
renderer.draw([actor], runtime.Camera(eye=(0, 1, 3), target=(0, 1, 0)))
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from runtime.errors import AssetError, RenderError

if TYPE_CHECKING:
    from runtime.animation.clip import Clip
    from runtime.asset.asset import Asset, load
    from runtime.crowd.crowd import Crowd
    from runtime.gpu.loading import Loading
    from runtime.gpu.model import Model
    from runtime.picking import Hit, pick
    from runtime.render.renderer import Renderer
    from runtime.scene.actor import Actor
    from runtime.scene.camera import Camera, MatrixCamera, framing
    from runtime.scene.lighting import Environment, Lighting
    from runtime.scene.lod_selection import Quality

__all__ = [
    "Actor",
    "Asset",
    "AssetError",
    "Camera",
    "Clip",
    "Crowd",
    "Environment",
    "Hit",
    "Lighting",
    "Loading",
    "MatrixCamera",
    "Model",
    "Quality",
    "RenderError",
    "Renderer",
    "framing",
    "load",
    "pick",
]

_HOMES = {
    "Actor": "scene.actor",
    "Asset": "asset.asset",
    "load": "asset.asset",
    "Camera": "scene.camera",
    "MatrixCamera": "scene.camera",
    "framing": "scene.camera",
    "Clip": "animation.clip",
    "Crowd": "crowd.crowd",
    "Environment": "scene.lighting",
    "Lighting": "scene.lighting",
    "Loading": "gpu.loading",
    "Model": "gpu.model",
    "Quality": "scene.lod_selection",
    "Hit": "picking",
    "pick": "picking",
    "Renderer": "render.renderer",
}


def __getattr__(name: str) -> Any:
    """Import the rest when it is first asked for: readers of files alone never load OpenGL."""
    if name not in _HOMES:
        raise AttributeError(f"module 'runtime' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"runtime.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """All public names, imported yet or not: for completion."""
    return sorted({*globals(), *__all__})
