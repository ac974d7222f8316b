"""`python -m preprocess check DIR`: measure a built character again, from its files alone.

Nothing is taken from the manifest but names and what it claims: files are hashed, seams are found on the stored
meshes, jumps are measured on the stored texels, and each claim that does not hold is named.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.bake.hard_edges import NormalUvs, bake_surface, move_seams
from preprocess.erase import measure_seams
from preprocess.errors import InputError
from preprocess.files.output_folder import MANIFEST, hash_file
from preprocess.fit.weight_quadtree import measure_jump
from preprocess.mesh.seams import Seams, find_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from preprocess.mesh.uv_overlap import find_overlap
from runtime.asset.asset import Asset, load
from runtime.asset.lod_mesh import LodMesh
from runtime.asset.weight_stack import unpack_weights
from runtime.errors import AssetError

log = logging.getLogger(__name__)

# A claim holds when the new measure is no worse than this: uvs are stored in 32 bits, so seams are found anew some
# ten-millionths of the atlas away, which next to a steep texel is a fraction of an 8-bit step.
SLACK_REL, SLACK_ABS = 1.1, 0.1 / 255


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder."""
    parser.add_argument("folder", type=Path, metavar="DIR")


def run(arguments: argparse.Namespace) -> int:
    """Print every measure; refuse the folder if a claim of its manifest does not hold.

    Raises
    ------
    InputError
        If the folder cannot be read, or a claim fails: one line with the first, and how many.
    """
    try:
        asset = load(arguments.folder)
    except AssetError as error:
        raise InputError(str(error)) from None
    _require_claims(asset)
    failures = []
    for label, text, holds in (*compare_files(asset), *measure_asset(asset)):
        print(f"{label:<24}{text}{'' if holds else '   DIFFERS'}")
        if not holds:
            failures.append(label)
    if failures:
        raise InputError(
            f"{arguments.folder}: {_counted(failures)} from the manifest (the first: {failures[0]}): "
            "build the character again"
        )
    return 0


def _counted(failures: list[str]) -> str:
    return "1 thing differs" if len(failures) == 1 else f"{len(failures)} things differ"


def _require_claims(asset: Asset) -> None:
    """Refuse a manifest that claims nothing to compare with: the runtime draws without these entries."""
    manifest = asset.manifest.json
    atlas = manifest.get("atlas")
    missing = [] if isinstance(atlas, dict) and isinstance(atlas.get("overlap"), int) else ["atlas.overlap"]
    for name, texture in asset.textures.items():
        entry = manifest["textures"][name]
        seam = entry.get("seam")
        stored = seam.get("stored") if isinstance(seam, dict) else None
        measures = stored if isinstance(stored, list) else []
        whole = all(isinstance(level, dict) and {"rms", "max"} <= level.keys() for level in measures)
        if not whole or len(measures) != len(texture.levels):
            missing.append(f"textures.{name}.seam.stored")
    if missing:
        raise InputError(f"{asset.path / MANIFEST} lacks {missing[0]}: nothing to check against; build it again")


def compare_files(asset: Asset) -> Iterator[tuple[str, str, bool]]:
    """Label, words and False for every file that is not as the build left it; one line where all are."""
    recorded = asset.manifest.json.get("files")
    if not isinstance(recorded, dict) or not recorded:
        yield "files", "not recorded by the build", True
        return
    changed = 0
    for name, digest in recorded.items():
        path = asset.path / name
        if not path.is_file():
            yield name, "missing", False
        elif hash_file(path) != digest:
            yield name, "changed since the build", False
        else:
            continue
        changed += 1
    if not changed:
        yield "files", f"{len(recorded)}, as the build left them", True


def measure_asset(asset: Asset) -> Iterator[tuple[str, str, bool]]:
    """Label, measure in words, and whether the manifest's claim holds, for everything that can be measured."""
    manifest = asset.manifest.json
    finest = surface_of(asset, asset.lods[0])
    seams = find_seams(finest)
    moved = normal_uvs_of(asset.lods[0])
    at_normal_uvs = (bake_surface(finest, moved), move_seams(seams, finest, moved)) if moved else (finest, seams)
    found = find_overlap(finest.uvs, finest.face_uvs)
    overlap = found.num_pairs + found.num_flat
    yield "overlapping faces", str(overlap), overlap <= manifest["atlas"]["overlap"]
    for name in asset.textures:
        entry = manifest["textures"][name]
        joined = None
        ground = at_normal_uvs if name == "normal" or entry.get("uvs") == "normal" else (finest, seams)
        for level, texels in enumerate(_levels(asset, name)):
            claim = entry["seam"]["stored"][level]
            if level == 0:
                joined = _joined(texels, *ground, entry["seam"].get("left", 0))
            if name == "weights":
                rms, largest = measure_jump(texels, asset.weight_details, *ground)
            else:
                rms, largest = _jump(texels, *ground, joined)
            holds = rms <= SLACK_REL * claim["rms"] + SLACK_ABS and largest <= SLACK_REL * claim["max"] + SLACK_ABS
            yield f"{name} level {level}", f"jump rms {rms:.3g} max {largest:.3g}", holds
    edges = _open_edges(finest)
    for index, (lod, entry) in enumerate(zip(asset.lods, manifest["lods"])):
        surface = surface_of(asset, lod)
        watertight = _open_edges(surface) <= edges
        yield (
            f"level of detail {index}",
            f"{len(lod.triangles)} faces, {len(surface.positions)} vertices, error {lod.error_m:.3g} m"
            f"{'' if watertight else ', not as closed as the full mesh'}",
            watertight and (len(lod.triangles), len(surface.positions)) == (entry.get("faces"), entry.get("vertices")),
        )


def surface_of(asset: Asset, lod: LodMesh) -> TexturedSurface:
    """A stored level as a mesh: copies with one canonical uv are one surface vertex."""
    canonical, vertex_of = np.unique(lod.canonical_uvs, axis=0, return_inverse=True)
    uvs, uv_of = np.unique(np.c_[vertex_of.reshape(-1), lod.uvs], axis=0, return_inverse=True)
    position = asset.textures["position"].levels[0]
    return TexturedSurface(
        sample_bilinear(position, canonical.astype(np.float64)),
        vertex_of.reshape(-1)[lod.triangles].astype(np.int32),
        uvs[:, 1:].astype(np.float64),
        uv_of.reshape(-1)[lod.triangles].astype(np.int32),
    )


def normal_uvs_of(lod: LodMesh) -> NormalUvs | None:
    """Where a stored level's corners sample the normal texture, if not at their uvs."""
    if lod.normal_uvs is None:
        return None
    return NormalUvs(lod.normal_uvs.astype(np.float64), lod.triangles.astype(np.int32), np.zeros((0, 3), bool))


def _levels(asset: Asset, name: str) -> Iterator[Floats]:
    """Mip levels as values: integers in [0, 1], weights a joint."""
    for texels in asset.textures[name].levels:
        if name == "weights":
            yield unpack_weights(texels, asset.weight_size, asset.skeleton.num_joints)
        elif texels.dtype.kind == "u":
            yield texels / float(np.iinfo(texels.dtype).max)
        else:
            yield texels.astype(np.float64)


def _joined(texels: Floats, surface: TexturedSurface, seams: Seams, left: int) -> NDArray[np.bool_] | None:
    """All seams but the `left` worst of the finest level: those were left on purpose. (S,) bool, or None for all."""
    if not left:
        return None
    per_seam = measure_seams(texels, surface, seams).seam_rms.max(axis=1)
    joined = np.ones(len(per_seam), bool)
    joined[np.argsort(per_seam)[-left:]] = False
    return joined


def _jump(
    texels: Floats, surface: TexturedSurface, seams: Seams, joined: NDArray[np.bool_] | None
) -> tuple[float, float]:
    """Jump rms and max over the joined seams."""
    result = measure_seams(texels, surface, seams, joined=joined)
    return float(np.sqrt(result.total.sum())), float(result.max.max(initial=0.0))


def _open_edges(surface: TexturedSurface) -> int:
    """Number of edges with one face."""
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int((counts == 1).sum())
