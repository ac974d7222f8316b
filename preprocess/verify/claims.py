"""What a folder's manifest claims, held to what its files are: everything that can be measured without the source.

Nothing is taken from the manifest but names and claims. Files are hashed; seams are found on the stored mesh and jumps
measured on the stored texels; boxes, levels and their errors are measured on what is drawn.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices
from preprocess.bake.hard_edges import NormalUvs, bake_surface, move_seams
from preprocess.erase import measure_seams
from preprocess.files.output_folder import hash_file
from preprocess.fit.weight_quadtree import measure_jump
from preprocess.mesh.closest_point import build_tree
from preprocess.mesh.seams import Seams, find_seams, unpack_seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.uv_overlap import find_overlap
from preprocess.verify.drawn import Drawn, positions_at, read_drawn
from preprocess.verify.goals import Finding
from preprocess.verify.measure import pose_rows, random_points, skinned
from runtime.animation.bounds import clip_bounds, joint_boxes, pose_bounds
from runtime.asset.asset import Asset
from runtime.asset.lod_mesh import LodMesh
from runtime.asset.weight_stack import unpack_weights

# A jump is what the manifest says when the new measure is no further from it than this, relative and absolute.
JUMP_REL, JUMP_ABS = 1.1, 0.1 / 255
BOX_REL = 2e-3  # of the diagonal: how far drawn vertices may leave a box, and a box of clips may be off
LOOSE_REL = 0.02  # of the diagonal: how far a joint's box may reach out of the whole character
HELD_WEIGHT = 0.1  # vertices that move with a joint at least so much lie in its box
# Errors of levels are measured at other points and in other poses than when they were built.
ERROR_REL, ERROR_ABS_REL = 1.5, 2e-3
LEVEL_POINTS = 2048
TEXTURE_STEMS = ("position", "normal", "weights", "weight_details", "base_color", "orm", "emissive")


def _is_number(value: Any) -> bool:
    """A real number as JSON has it."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_claims(asset: Asset) -> Iterator[Finding]:
    """Every claim with what was measured, as words and units."""
    yield from check_files(asset)
    lacking = _find_lacking(asset)
    if lacking:
        yield Finding("manifest", f"the manifest lacks {lacking}: nothing to check against", False)
        return
    yield from _check_seams(asset)
    yield from _check_boxes(asset)
    yield from _check_levels(asset)


def _find_lacking(asset: Asset) -> str:
    """The first claim that a manifest must have and this one has not, or nothing."""
    manifest = asset.manifest.json
    atlas = manifest.get("atlas")
    if not isinstance(atlas, dict) or type(atlas.get("overlap")) is not int:
        return "atlas.overlap"
    for name, texture in asset.textures.items():
        seam = manifest["textures"][name].get("seam")
        stored = seam.get("stored") if isinstance(seam, dict) else None
        if not isinstance(stored, list) or len(stored) != len(texture.levels):
            return f"textures.{name}.seam.stored"
        for level in stored:
            figures: list[Any] = [level.get("rms"), level.get("max")] if isinstance(level, dict) else [None]
            if not all(_is_number(figure) and 0 <= figure < 1e9 for figure in figures):
                return f"textures.{name}.seam.stored"
    return ""


def loaded_files(asset: Asset) -> list[str]:
    """Names of the files that the runtime reads."""
    entries = asset.manifest.entry.textures
    names = [asset.manifest.entry.model, entries.position.file, entries.weights.file]
    if entries.weights.details is not UNSET:
        names.append(entries.weights.details.file)
    for entry in entries.colors().values():
        names += [entry.file, *entry.mip_files]
    return names


def check_files(asset: Asset) -> Iterator[Finding]:
    """Files that are not as the build left them, one by one; one line where all are."""
    recorded = asset.manifest.entry.files
    if not recorded:
        yield Finding("files", "the manifest lists no files: nobody can say whether they are those of the build", False)
        return
    loaded = loaded_files(asset)
    faults = 0
    for name in [name for name in dict.fromkeys(loaded) if name not in recorded]:
        faults += 1
        yield Finding("files", f"{name} is read and not among the files that the build wrote", False)
    for name, digest in recorded.items():
        path = asset.path / name
        if not path.is_file() or not path.resolve().is_relative_to(asset.path.resolve()):
            fault = "is missing"
        elif hash_file(path) != digest:
            fault = "was changed since the build"
        elif _is_texture(name) and name not in loaded:
            fault = "is a texture that the manifest no longer names"
        else:
            continue
        faults += 1
        yield Finding("files", f"{name} {fault}", False)
    if not faults:
        yield Finding("files", f"{len(recorded)} files are as the build left them", True)


def _is_texture(name: str) -> bool:
    path = PurePosixPath(name)
    return path.suffix in (".png", ".exr") and path.name.split(".")[0] in TEXTURE_STEMS


def surface_of(asset: Asset, lod: LodMesh) -> TexturedSurface:
    """A stored level as a mesh: copies with one canonical uv are one surface vertex."""
    canonical, vertex_of = np.unique(lod.canonical_uvs, axis=0, return_inverse=True)
    uvs, uv_of = np.unique(np.c_[vertex_of.reshape(-1), lod.uvs], axis=0, return_inverse=True)
    return TexturedSurface(
        positions_at(asset, canonical.astype(np.float64)),
        vertex_of.reshape(-1)[lod.triangles].astype(np.int32),
        uvs[:, 1:].astype(np.float64),
        uv_of.reshape(-1)[lod.triangles].astype(np.int32),
    )


def _normal_uvs_of(lod: LodMesh) -> NormalUvs | None:
    """Where a stored level's corners sample the normal texture, if not at their uvs."""
    if lod.normal_uvs is None:
        return None
    return NormalUvs(lod.normal_uvs.astype(np.float64), lod.triangles.astype(np.int32), np.zeros((0, 3), bool))


def _values(asset: Asset, name: str) -> Iterator[Floats]:
    """Mip levels as values: integers in [0, 1], weights by joint."""
    for texels in asset.textures[name].levels:
        if name == "weights":
            yield unpack_weights(texels, asset.weight_size, asset.skeleton.num_joints)
        elif texels.dtype.kind == "u":
            yield texels / float(np.iinfo(texels.dtype).max)
        else:
            yield texels.astype(np.float64)


def _jump_words(name: str, rms: float, largest: float) -> str:
    """A jump in the unit of its texture."""
    if name == "position":
        return f"{1000 * rms:.3g} mm rms, {1000 * largest:.3g} mm at most"
    if name == "weights":
        return f"{rms:.3g} rms, {largest:.3g} at most of 1"
    return f"{255 * rms:.3g} rms, {255 * largest:.3g} at most of 255"


def _check_seams(asset: Asset) -> Iterator[Finding]:
    manifest = asset.manifest.json
    finest = surface_of(asset, asset.lods[0])
    found = find_overlap(finest.uvs, finest.face_uvs)
    overlap, claim = found.num_pairs + found.num_flat, manifest["atlas"]["overlap"]
    yield Finding(
        "overlap", f"{overlap} faces of the atlas overlap or are flat; the manifest says {claim}", overlap <= claim
    )
    seams = find_seams(finest, join_crowded=True)
    moved = _normal_uvs_of(asset.lods[0])
    at_normal_uvs = (bake_surface(finest, moved), move_seams(seams, finest, moved)) if moved else (finest, seams)
    for name in asset.textures:
        entry = manifest["textures"][name]
        ground = at_normal_uvs if name == "normal" or entry.get("uvs") == "normal" else (finest, seams)
        try:
            joined = _joined_seams(entry["seam"], finest, seams)
        except ValueError as error:
            yield Finding("seams", f"{name}: which seams were left cannot be told ({error})", False)
            continue
        for level, texels in enumerate(_values(asset, name)):
            if name == "weights":
                rms, largest = measure_jump(texels, asset.weight_details, *ground)
            else:
                rms, largest = _jump(texels, *ground, joined)
            stored = entry["seam"]["stored"][level]
            holds = all(_agree(*pair) for pair in ((rms, stored["rms"]), (largest, stored["max"])))
            words = f"{name} level {level}: seams jump by {_jump_words(name, rms, largest)}"
            if name == "weights":
                words += " (geometry is read on one side of a seam alone: this never opens)"
            if not holds:
                words += f"; the manifest says {_jump_words(name, stored['rms'], stored['max'])}"
            yield Finding("seams", words, holds)


def _agree(measured: float, claim: float) -> bool:
    return measured <= JUMP_REL * claim + JUMP_ABS and claim <= JUMP_REL * measured + JUMP_ABS


def _joined_seams(seam: dict[str, Any], surface: TexturedSurface, seams: Seams) -> NDArray[np.bool_] | None:
    """Seams that were joined, (S,) bool; None for all of them."""
    left = seam.get("left", 0)
    if not left:
        return None
    text = seam.get("left_seams")
    if not isinstance(text, str):
        raise ValueError("it is not stored")
    mask = unpack_seams(surface, seams, text)
    if int(mask.sum()) != left:
        raise ValueError(f"{int(mask.sum())} are marked, {left} are counted")
    return ~mask


def _jump(
    texels: Floats, surface: TexturedSurface, seams: Seams, joined: NDArray[np.bool_] | None
) -> tuple[float, float]:
    """Jump rms and max over the joined seams."""
    result = measure_seams(texels, surface, seams, joined=joined)
    return float(np.sqrt(result.total.sum())), float(result.max.max(initial=0.0))


def _check_boxes(asset: Asset) -> Iterator[Finding]:
    drawn = read_drawn(asset)
    manifest, slack_m = asset.manifest, BOX_REL * drawn.diagonal_m
    box = np.stack([drawn.positions.min(axis=0), drawn.positions.max(axis=0)])
    off = float(np.abs(box - manifest.bind_bounds).max())
    yield Finding("bounds", f"the box at rest is off by {1000 * off:.3g} mm", off <= slack_m)
    yield from _check_joint_boxes(drawn, slack_m)
    if any(box is not None for box in manifest.joint_bounds):
        boxes = np.stack(
            [np.array([[np.inf] * 3, [-np.inf] * 3]) if box is None else box for box in manifest.joint_bounds]
        )
        rows = pose_rows(asset.skeleton, asset.clips)
        posed = skinned(rows, drawn.weights, drawn.positions)
        around = pose_bounds(rows, boxes)
        out = max(float((around[:, 0] - posed.min(axis=1)).max()), float((posed.max(axis=1) - around[:, 1]).max()), 0.0)
        yield Finding(
            "bounds", f"posed vertices leave the boxes of their joints by {1000 * out:.3g} mm", out <= slack_m
        )
        for clip in asset.clips:
            expected = clip_bounds(asset.skeleton, clip, boxes)
            off = float(np.abs(expected - manifest.clip_bounds[clip.name]).max())
            holds = off <= BOX_REL * float(np.linalg.norm(expected[1] - expected[0]))
            if not holds or clip is asset.clips[-1]:
                yield Finding("bounds", f"the box of clip {clip.name!r} is off by {1000 * off:.3g} mm", holds)


def _check_joint_boxes(drawn: Drawn, slack_m: float) -> Iterator[Finding]:
    """Boxes hold what their joints move, and are none larger than the character."""
    num_joints = drawn.weights.shape[1]
    joints = np.broadcast_to(np.arange(num_joints), drawn.weights.shape)
    held = joint_boxes(drawn.positions, joints, np.where(drawn.weights >= HELD_WEIGHT, drawn.weights, 0.0), num_joints)
    outer = np.stack([drawn.positions.min(axis=0), drawn.positions.max(axis=0)])
    outer += np.array([[-1.0], [1.0]]) * LOOSE_REL * drawn.diagonal_m
    wrong = []
    for joint, box in enumerate(drawn.asset.joint_bounds):
        moves = bool(np.isfinite(held[joint]).all())
        if box is None:
            fits = not moves
        else:
            low, high = held[joint] if moves else box
            fits = bool((box[0] <= low + slack_m).all() and (box[1] >= high - slack_m).all())
            fits = fits and bool((box[0] >= outer[0]).all() and (box[1] <= outer[1]).all())
        if not fits:
            wrong.append(drawn.asset.joint_names[joint])
    if wrong:
        words = f"{len(wrong)} boxes of joints are not those of what they move, the first of {wrong[0]!r}"
        yield Finding("bounds", words, False)
    else:
        yield Finding("bounds", f"the boxes of {num_joints} joints hold what they move", True)


def _check_levels(asset: Asset) -> Iterator[Finding]:
    full = read_drawn(asset)
    edges = open_edges(surface_of(asset, asset.lods[0]))
    rows = pose_rows(asset.skeleton, asset.clips, most=4)
    reference = _Posed(full, rows)
    last = worst_m = 0.0
    exact = [entry.get("exact", True) for entry in asset.manifest.json["lods"]]
    for index, (lod, entry) in enumerate(zip(asset.lods, asset.manifest.entry.lods)):
        surface = surface_of(asset, lod)
        counts = (len(lod.triangles), len(surface.positions))
        faults = []
        if open_edges(surface) > edges:
            faults.append("not as closed as the full mesh")
        if counts != (entry.faces, entry.vertices):
            faults.append(f"the manifest says {entry.faces} and {entry.vertices}")
        error_m = reference.distance_m(read_drawn(asset, index)) if index else 0.0
        slack_m = ERROR_ABS_REL * full.diagonal_m
        worst_m = max(worst_m, error_m)
        # What colours shift at relaxed seams counts in an error, too: it is more than the distance.
        most_m = ERROR_REL * worst_m + slack_m if exact[index] else full.diagonal_m
        if not error_m <= ERROR_REL * lod.error_m + slack_m or lod.error_m > most_m:
            faults.append(f"its error is {1000 * error_m:.3g} mm, the manifest says {1000 * lod.error_m:.3g} mm")
        if lod.error_m < last:
            faults.append("its error is smaller than that of the finer level")
        last = lod.error_m
        words = (
            f"level of detail {index}: {counts[0]} faces, {counts[1]} vertices, {1000 * error_m:.3g} mm from level 0"
        )
        yield Finding("levels", "; ".join([words, *faults]), not faults)


class _Posed:
    """The finest level in a few poses, to measure others against."""

    def __init__(self, drawn: Drawn, rows: Floats) -> None:
        self.faces, self.rows = drawn.faces, rows
        self.positions = skinned(rows, drawn.weights, drawn.positions)
        self.samples = random_points(drawn.positions[drawn.faces], LEVEL_POINTS)
        self.trees = [build_tree(positions[drawn.faces]) for positions in self.positions]

    def distance_m(self, level: Drawn) -> float:
        """The largest distance, both ways, of vertices and points spread over the area, in all poses."""
        largest = 0.0
        posed = skinned(self.rows, level.weights, level.positions)
        on_level = random_points(level.positions[level.faces], LEVEL_POINTS)
        for positions, tree, full in zip(posed, self.trees, self.positions):
            there = tree.query(_points(positions, level.faces, on_level))[0].max()
            back = build_tree(positions[level.faces]).query(_points(full, self.faces, self.samples))[0].max()
            largest = max(largest, float(there), float(back))
        return largest


def _points(positions: Floats, faces: NDArray[np.integer], samples: tuple[Indices, Floats]) -> Floats:
    """Vertices, every so many of them, and points of faces."""
    on_faces = np.einsum("nk,nkc->nc", samples[1], positions[faces[samples[0]]])
    return np.concatenate([positions[:: max(1, len(positions) // LEVEL_POINTS)], on_faces])


def open_edges(surface: TexturedSurface) -> int:
    """Number of edges with one face."""
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int((counts == 1).sum())
