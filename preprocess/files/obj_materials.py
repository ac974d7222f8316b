"""What an OBJ file says of its faces beyond their shape: materials, and whether they are shaded smooth.

Tools that change a mesh's faces carry this along, so that what they write opens with its textures on.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Ints

# Material library lines that end in an image file, behind options such as "-s 1 1 1" or "-bm 0.5".
_IMAGE_LINE = re.compile(
    r"^(\s*(?:map_\w+|bump|disp|decal|norm|refl)\s+(?:-\w+\s+(?:(?:[-+.\d]\S*|on|off)\s+)*)*)(.+?)\s*$"
)


@dataclass(frozen=True)
class ObjLooks:
    """Materials of F faces.

    Attributes
    ----------
    libraries : tuple of Path
        Material libraries (.mtl), as the OBJ file names them, from its folder.
    names : tuple of str
        Materials in the order in which faces use them.
    face_materials : (F,) int32
        Into `names`; -1 for none.
    smooth : bool
        Shaded smooth: the file has normals or smoothing groups.
    """

    libraries: tuple[Path, ...]
    names: tuple[str, ...]
    face_materials: Ints
    smooth: bool

    def of(self, face_source: NDArray[np.integer]) -> ObjLooks:
        """The looks of faces that were made of these, (G,) of which one each."""
        return replace(self, face_materials=self.face_materials[face_source])

    def header(self, folder: Path) -> str:
        """First lines of an OBJ file in a folder."""
        lines = [f"mtllib {_relative(path, folder)}\n" for path in self.libraries]
        return "".join([*lines, "s 1\n" if self.smooth else ""])

    def runs(self) -> Iterator[tuple[str, int, int]]:
        """Runs of faces with one material: the line before them, the first face and the one behind the last."""
        borders = np.flatnonzero(np.diff(self.face_materials)) + 1
        ends = [0, *borders.tolist(), len(self.face_materials)]
        for first, last in itertools.pairwise(ends):
            material = int(self.face_materials[first]) if last > first else -1
            yield f"usemtl {self.names[material]}\n" if material >= 0 else "", first, last


def _relative(path: Path, folder: Path) -> str:
    """A path as seen from a folder, with forward slashes."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive of Windows
        return path.absolute().as_posix()


def move_library(text: str, source: Path, folder: Path, images: Collection[str]) -> str:
    """A material library's text for another folder.

    Parameters
    ----------
    text : str
    source : Path
        The folder it comes from.
    folder : Path
        The folder it goes to.
    images : collection of str
        Names of images that lie there: lines that name one of them name it there; others, where it lies now.
    """
    lines = []
    for line in text.splitlines():
        found = _IMAGE_LINE.match(line)
        if found:
            name = PureWindowsPath(found[2]).name  # takes both kinds of slashes
            place = name if name in images else _relative(source / found[2], folder)
            line = found[1] + place
        lines.append(line + "\n")
    return "".join(lines)
