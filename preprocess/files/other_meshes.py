"""Meshes with texture coordinates in other formats (PLY, Collada, 3MF, OFF, …), read by trimesh."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from preprocess.errors import InputError
from preprocess.files.obj import weld_texture_vertices
from preprocess.mesh.grouping import group_rows
from preprocess.mesh.surface import TexturedSurface

SUFFIXES = (".ply", ".dae", ".zae", ".3mf", ".off", ".stl")
log = logging.getLogger(__name__)


def read_other(path: Path) -> TexturedSurface:
    """Read the textured surface of a file that trimesh reads; all its meshes, where the scene places them, are one.

    Parameters
    ----------
    path : Path
        With one of `SUFFIXES`.

    Returns
    -------
    TexturedSurface
        Vertices at exactly the same place are one: these formats split them where texture coordinates differ.

    Raises
    ------
    InputError
        If the file is missing or damaged, a package for its format is missing, or a mesh has no texture coordinates.
    """
    try:
        import trimesh
    except ImportError:
        raise InputError(f'{path.suffix} files need trimesh: pip install "seamskin[preprocess]"') from None
    if not path.is_file():
        raise InputError(f"{path}: no such file: name an existing mesh")
    try:
        scene = trimesh.load_scene(path, process=False)
        meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
    except ImportError as error:
        raise InputError(
            f"{path.name}: trimesh reads {path.suffix} with another package: pip install {error.name}"
        ) from None
    except Exception as error:  # whatever a foreign reader raises on a damaged file is the file's fault
        log.debug("trimesh: %r", error)
        raise InputError(
            f"{path.name}: does not read as {path.suffix} ({type(error).__name__}): export it again"
        ) from None
    parts = [mesh for mesh in meshes if len(mesh.faces)]
    if not parts:
        raise InputError(f"{path.name}: no faces in it: give a mesh with at least one triangle")
    uvs = [getattr(mesh.visual, "uv", None) for mesh in parts]
    if any(uv is None or len(uv) != len(mesh.vertices) for uv, mesh in zip(uvs, parts, strict=True)):
        raise InputError(
            f"{path.name}: a mesh has no texture coordinates: unwrap it, or build it (python -m preprocess)"
        )
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in parts)])
    points = np.concatenate([np.asarray(mesh.vertices, np.float64) for mesh in parts])
    corner_uvs = np.concatenate([np.asarray(mesh.faces, np.int64) + first for mesh, first in zip(parts, counts)])
    flat = np.concatenate([np.asarray(uv, np.float64)[:, :2] for uv in uvs])
    if not (np.isfinite(points).all() and np.isfinite(flat).all()):
        raise InputError(f"{path.name}: it holds numbers that are not finite: export it again")
    groups, firsts = group_rows(*(points + 0.0).T)  # -0.0 and 0.0 are one place
    faces = groups[corner_uvs].astype(np.int32)
    welded, face_uvs = weld_texture_vertices(faces, np.stack([flat[:, 0], 1.0 - flat[:, 1]], axis=1), corner_uvs)
    surface = TexturedSurface(points[firsts], faces, welded, face_uvs)
    surface.validate()
    return surface
