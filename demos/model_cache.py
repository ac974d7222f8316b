"""Character files opened directly: each is built once, into a cache, and found there the next time.

The cache lies where the system keeps such things (SEAMSKIN_CACHE names another place). An entry is found by the file's
content, that of the files it names, and the version of the tools; the least recently used ones go.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from urllib.parse import unquote

from demos.errors import DemoError

MODEL_SUFFIXES = (".gltf", ".glb", ".vrm")
MOST_ENTRIES = 32


def cache_folder() -> Path:
    """Where built characters are kept."""
    named = os.environ.get("SEAMSKIN_CACHE")
    if named:
        return Path(named)
    from platformdirs import user_cache_path

    return user_cache_path("seamskin", appauthor=False)


def _key(model: Path) -> str:
    """A name for what a build of the file would make."""
    data = model.read_bytes()
    digest = hashlib.sha256(data)
    try:
        digest.update(version("seamskin").encode())
    except PackageNotFoundError:  # a checkout that was not installed
        digest.update(b"checkout")
    if model.suffix.lower() == ".gltf":
        try:
            root = json.loads(data)
            uris = [str(part.get("uri", "")) for kind in ("buffers", "images") for part in root.get(kind, [])]
        except (ValueError, AttributeError, TypeError):
            uris = []  # the build will say what is wrong with the file
        for uri in uris:
            path = model.parent / unquote(uri)
            if uri and not uri.startswith("data:") and path.is_file():
                state = path.stat()
                digest.update(f"{uri} {state.st_size} {state.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def _forget_old(folder: Path) -> None:
    """Keep the entries that were used last."""
    entries = sorted(folder.glob("*.seamless"), key=lambda path: path.stat().st_mtime, reverse=True)
    for entry in entries[MOST_ENTRIES:]:
        shutil.rmtree(entry, ignore_errors=True)


def built_folder(path: Path) -> Path:
    """The folder of a built character: the one that is named, or what the file that is named is built to.

    Raises
    ------
    DemoError
        If the file cannot be read or built; the message is one line.
    """
    if path.suffix.lower() not in MODEL_SUFFIXES or path.is_dir():
        return path
    try:
        from preprocess.errors import InputError
        from preprocess.files.output_folder import stops_as_interrupts
        from preprocess.numerics.compile_progress import compile_quickly

        name = f"{path.stem}-{_key(path)}.seamless"
    except OSError as error:
        raise DemoError(f"{path}: cannot be read ({error.strerror}): name a .gltf, .glb or .vrm file") from None
    destination = cache_folder() / name
    if (destination / "manifest.json").is_file():
        os.utime(destination)
        return destination
    compile_quickly()
    from preprocess.pipeline import build
    from preprocess.progress import Progress
    from preprocess.settings import Settings

    print(f"{path.name}: building it once, into {destination.parent}", file=sys.stderr, flush=True)
    try:
        destination.parent.mkdir(parents=True, exist_ok=True)
        with stops_as_interrupts():
            result = build(path, destination, Settings(), Progress())
    except InputError as error:
        raise DemoError(str(error)) from None
    except OSError as error:
        raise DemoError(f"{destination.parent}: cannot be written ({error.strerror}): set SEAMSKIN_CACHE") from None
    for warning in result.warnings:
        print(f"  note: {warning}", file=sys.stderr)
    _forget_old(destination.parent)
    return destination
