"""Files that another file names: regular files inside its own folder, and nothing else.

A name in a file from elsewhere may be an absolute path, climb out with `..`, follow a link, or stand for a device or a
pipe. All readers of such names (a glTF's buffers and images, a manifest's textures and model) ask here.
"""

from __future__ import annotations

import stat
from pathlib import Path

from runtime.errors import AssetError
from runtime.validation import describe


def find_local_file(folder: Path, name: str, what: str, advice: str) -> Path:
    """The regular file of that name inside a folder, links followed.

    Parameters
    ----------
    folder : Path
    name : str
        Relative to the folder, as a file says it.
    what : str
        What the file is, first in the message.
    advice : str
        What to do, last in the message.

    Raises
    ------
    AssetError
        If the name leads out of the folder, to nothing, or to something that is not a regular file.
    """
    try:
        root, path = folder.resolve(), (folder / name).resolve()
        inside = path.is_relative_to(root) and path != root
        mode = path.stat().st_mode if inside else 0
    except FileNotFoundError:
        raise AssetError(f"{what}: {folder / name} is missing: {advice}") from None
    except (OSError, ValueError, RuntimeError):  # too long, a zero byte, a circle of links
        raise AssetError(f"{what}: {describe(name)} is no name of a file: {advice}") from None
    if not inside:
        raise AssetError(f"{what}: {describe(name)} is outside of {folder}: {advice}")
    if not stat.S_ISREG(mode):
        raise AssetError(f"{what}: {describe(name)} is not a regular file: {advice}")
    return path
