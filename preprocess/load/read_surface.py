"""The textured surface of a mesh file of any kind that is read."""

from __future__ import annotations

from pathlib import Path

from preprocess.errors import InputError
from preprocess.files.obj import read_obj
from preprocess.files.other_meshes import SUFFIXES, read_other
from preprocess.load.character_file import load_character
from preprocess.mesh.surface import TexturedSurface
from runtime.gltf.limits import LIMITS, Limits


def read_surface(path: Path, limits: Limits = LIMITS) -> TexturedSurface:
    """Read the textured surface of an OBJ, glTF, PLY, Collada, 3MF or OFF file.

    Parameters
    ----------
    path : Path
        `.obj`, `.gltf`, `.glb`, `.vrm`, or what trimesh reads (`other_meshes.SUFFIXES`).
    limits : Limits
        What a file may ask for.

    Returns
    -------
    TexturedSurface
        A glTF file's is the welded mesh of all its parts in bind pose with TEXCOORD_0.

    Raises
    ------
    InputError
        If the file is missing, of another kind, broken, or has no texture coordinates.
    """
    path = Path(path)
    if path.suffix.lower() == ".obj":
        return read_obj(path, limits)
    if path.suffix.lower() in SUFFIXES:
        return read_other(path)
    if path.suffix.lower() not in (".gltf", ".glb", ".vrm"):
        raise InputError(f"{path}: not a mesh that is read: give a .obj, .gltf, .glb, .vrm, {', '.join(SUFFIXES)} file")
    mesh = load_character(path, limits).mesh
    if not mesh.has_uvs:
        raise InputError(f"{path.name}: a part has no texture coordinates: build it whole (python -m preprocess MODEL)")
    return mesh.surface
