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
    from runtime.actor import Actor
    from runtime.asset import Asset, load
    from runtime.camera import Camera, MatrixCamera, framing
    from runtime.clip import Clip
    from runtime.crowd import Crowd
    from runtime.environment import Environment, Lighting
    from runtime.gpu_asset import Model
    from runtime.loading import Loading
    from runtime.lod import Quality
    from runtime.picking import Hit, pick
    from runtime.renderer import Renderer

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
    "Actor": "actor",
    "Asset": "asset",
    "load": "asset",
    "Camera": "camera",
    "MatrixCamera": "camera",
    "framing": "camera",
    "Clip": "clip",
    "Crowd": "crowd",
    "Environment": "environment",
    "Lighting": "environment",
    "Loading": "loading",
    "Model": "gpu_asset",
    "Quality": "lod",
    "Hit": "picking",
    "pick": "picking",
    "Renderer": "renderer",
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
