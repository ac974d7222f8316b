"""The textured surface of a mesh file of any kind that is read."""

from __future__ import annotations

from pathlib import Path

from preprocess.errors import InputError
from preprocess.files.obj import read_obj
from preprocess.load.character_file import load_character
from preprocess.mesh.surface import TexturedSurface


def read_surface(path: Path) -> TexturedSurface:
    """Read the textured surface of an OBJ or glTF file.

    Parameters
    ----------
    path : Path
        `.obj`, `.gltf`, `.glb` or `.vrm`.

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
        return read_obj(path)
    if path.suffix.lower() not in (".gltf", ".glb", ".vrm"):
        raise InputError(f"{path}: neither OBJ nor glTF: give a .obj, .gltf, .glb or .vrm file")
    mesh = load_character(path).mesh
    if not mesh.has_uvs:
        raise InputError(f"{path.name}: a part has no texture coordinates: build it whole (python -m preprocess MODEL)")
    return mesh.surface
