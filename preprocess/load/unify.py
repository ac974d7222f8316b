"""The parts of a scene into one mesh, and the driver of everything that makes it sound.

stack parts -> weld -> drop faces without area and doubled ones -> split non-manifold places -> normals -> mesh.
"""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Indices
from preprocess.errors import InputError
from preprocess.load.character import Material
from preprocess.load.manifold import Manifold, make_manifold
from preprocess.load.primitives import Target
from preprocess.load.scene import Part, Scene
from preprocess.load.weld import (
    Soup,
    Welded,
    canonical_influences,
    faces_with_area,
    find_duplicates,
    weld_vertices,
)
from preprocess.mesh.corner_normals import CREASE_RAD, smooth_corner_normals
from preprocess.mesh.face_geometry import face_normals
from preprocess.mesh.grouping import group_rows
from preprocess.mesh.morphs import Morph, vertex_turns
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface

log = logging.getLogger(__name__)


def _stack_parts(parts: tuple[Part, ...], material_index: dict[int | None, int]) -> Soup:
    """All parts one after the other; missing values filled in: NaN normals, white colours, zero uvs."""
    counts = [len(part.positions) for part in parts]
    starts = np.cumsum([0, *counts[:-1]])
    num_texcoords = max(part.source.texcoords.shape[1] for part in parts)
    num_influences = max(part.joints.shape[1] for part in parts)

    def padded(values: NDArray[np.generic], width: int) -> NDArray[np.generic]:
        missing = [(0, 0)] * values.ndim
        missing[1] = (0, width - values.shape[1])
        return np.pad(values, missing)

    joints, weights = canonical_influences(
        np.concatenate([padded(part.joints, num_influences) for part in parts]),
        np.concatenate([padded(part.weights, num_influences) for part in parts]),
    )
    colors = None
    if any(part.source.colors is not None for part in parts):
        white = [np.ones((count, 4), np.float32) for count in counts]
        colors = np.concatenate(
            [part.source.colors if part.source.colors is not None else one for part, one in zip(parts, white)]
        )
    tangents = None
    if any(part.tangents is not None for part in parts):
        missing = [np.full((count, 4), np.nan) for count in counts]
        tangents = np.concatenate(
            [part.tangents if part.tangents is not None else none for part, none in zip(parts, missing)]
        )
    return Soup(
        positions=np.concatenate([part.positions for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        tangents=tangents,
        texcoords=np.concatenate([padded(part.source.texcoords, num_texcoords) for part in parts]),
        num_texcoords=np.repeat([part.source.texcoords.shape[1] for part in parts], counts),
        colors=colors,
        joints=joints,
        weights=weights,
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts)]),
        face_parts=np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]),
        face_materials=np.repeat(
            [material_index[part.source.material] for part in parts], [len(part.faces) for part in parts]
        ),
        targets=_stack_targets(parts, starts),
    )


def _stack_targets(parts: tuple[Part, ...], starts: NDArray[np.integer]) -> dict[str, Target]:
    """Targets of all parts, by morph."""
    found: dict[str, list[Target]] = {}
    for part, start in zip(parts, starts.tolist()):
        for name, target in zip(part.morph_names, part.targets):
            found.setdefault(name, []).append(dataclasses.replace(target, vertices=target.vertices + start))
    return {
        name: Target(
            np.concatenate([target.vertices for target in targets]),
            np.concatenate([target.shifts for target in targets]),
            np.concatenate([target.turns for target in targets]),
        )
        for name, targets in found.items()
    }


def _remove_duplicates(
    soup: Soup, welded: Welded, materials: tuple[Material, ...], diagonal_m: float, where: str, warnings: list[str]
) -> tuple[Soup, tuple[Material, ...]]:
    """The soup without faces that have no area or are drawn twice; a material more for fronts that lost their back."""
    positions = soup.positions[welded.vertex_firsts]
    solid = faces_with_area(positions, welded.vertex_of[soup.faces], diagonal_m)
    if not solid.all():
        warnings.append(f"{int((~solid).sum())} triangles without area removed")
    if not solid.any():
        raise InputError(f"{where} has no triangle with an area: export the file again")
    faces, face_materials = soup.faces[solid], soup.face_materials[solid]
    face_parts = soup.face_parts[solid]
    is_double_sided = np.array([material.double_sided for material in materials])
    found = find_duplicates(welded.vertex_of[faces], welded.uv_of[faces], face_materials, is_double_sided)
    if found.num_same:
        warnings.append(f"{found.num_same} duplicate triangles removed")
    if found.num_opposite:
        warnings.append(f"{found.num_opposite} triangles that were the back of another removed: drawn double-sided")
    for index in np.unique(face_materials[found.becomes_double_sided]):
        changed = found.becomes_double_sided & (face_materials == index)
        twin = dataclasses.replace(materials[index], name=f"{materials[index].name} (double-sided)", double_sided=True)
        face_materials = np.where(changed, len(materials), face_materials)
        materials = (*materials, twin)
    kept = dataclasses.replace(
        soup, faces=faces[found.keep], face_materials=face_materials[found.keep], face_parts=face_parts[found.keep]
    )
    return kept, materials


def _report_manifold(manifold: Manifold, warnings: list[str]) -> None:
    if manifold.num_split_edges:
        warnings.append(f"{manifold.num_split_edges} edges with three or more faces split")
    if manifold.num_split_vertices:
        warnings.append(f"{manifold.num_split_vertices} vertices added where surfaces met in a point or an edge")
    if manifold.num_turned:
        warnings.append(f"{manifold.num_turned} triangles turned over to face the same way as their neighbours")
    if manifold.num_unorientable:
        warnings.append(f"{manifold.num_unorientable} one-sided surfaces cut along a line")


def _corner_normals(
    soup: Soup, corner_sources: Indices, manifold: Manifold, positions: Floats, warnings: list[str]
) -> Floats:
    """The file's normals a corner; computed where it has none; turned where their face was."""
    corner: Floats = soup.normals[corner_sources]
    missing = np.logical_or.reduce(np.isnan(corner), axis=2)
    turned = (manifold.corners[:, 1] == 2)[:, None]
    if turned.any():
        facing = np.einsum("fkc,fc->fk", corner, face_normals(positions[manifold.faces]))
        corner = np.where((turned & (facing < 0))[:, :, None], -corner, corner)
    if missing.any():
        count, degrees = int(missing.any(axis=1).sum()), round(float(np.rad2deg(CREASE_RAD)))
        warnings.append(f"{count} triangles without normals: made smooth, edges over {degrees} degrees stay hard")
        smooth = smooth_corner_normals(positions, manifold.faces)
        corner = np.where(missing[:, :, None], smooth, corner)
    return corner


def _usable_tangents(own: Floats) -> Floats | None:
    """The file's tangents a corner (F, 3, 4) with whole handedness, NaN where unusable; None where all are."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(own[..., :3], axis=2)
    usable = np.logical_and.reduce(np.isfinite(own), axis=2) & (np.abs(lengths - 1) < 0.1)
    if not usable.any():
        return None
    handedness = np.where(own[..., 3:] < 0, -1.0, 1.0)
    return np.where(usable[..., None], np.concatenate([own[..., :3], handedness], axis=2), np.nan)


def _build_mesh(
    soup: Soup, welded: Welded, manifold: Manifold, defaults: dict[str, float], warnings: list[str]
) -> SkinnedMesh:
    """Arrays a corner and a vertex, in the order of the manifold."""
    corner_sources = np.take_along_axis(soup.faces, manifold.corners, axis=1)
    firsts = welded.vertex_firsts[manifold.vertex_origin]
    positions = soup.positions[firsts]
    corner_normals = _corner_normals(soup, corner_sources, manifold, positions, warnings)
    has_uvs = (soup.num_texcoords > 0)[corner_sources]
    if has_uvs.any():
        clusters = welded.uv_of[corner_sources].reshape(-1)
        face_uvs, uv_corners = group_rows(manifold.faces.reshape(-1), clusters)
        uvs = soup.texcoords[welded.uv_firsts[clusters[uv_corners]], 0]
    else:
        face_uvs, uvs = np.zeros(manifold.faces.size, np.int64), np.zeros((1, 2))
    if not has_uvs.all():
        count = int((~has_uvs).any(axis=1).sum())
        warnings.append(f"{count} of {len(has_uvs)} triangles have no texture coordinates")
    surface = TexturedSurface(
        positions=positions,
        faces=manifold.faces.astype(np.int32),
        uvs=uvs,
        face_uvs=face_uvs.reshape(-1, 3).astype(np.int32),
    )
    tangents = None
    if soup.tangents is not None:
        tangents = soup.tangents[corner_sources]
        tangents[manifold.corners[:, 1] == 2, :, 3] *= -1
    mesh = SkinnedMesh(
        surface=surface,
        corner_normals=corner_normals,
        corner_tangents=None if tangents is None else _usable_tangents(tangents),
        corner_texcoords=soup.texcoords[corner_sources],
        corner_colors=None if soup.colors is None else soup.colors[corner_sources],
        joint_indices=soup.joints[firsts].astype(np.int32),
        joint_weights=soup.weights[firsts],
        face_materials=soup.face_materials.astype(np.int32),
        face_parts=soup.face_parts.astype(np.int32),
        has_uvs=bool(has_uvs.all()),
        face_num_texcoords=soup.num_texcoords[soup.faces[:, 0]].astype(np.int32),
    )
    return dataclasses.replace(mesh, morphs=_build_morphs(soup, defaults, firsts, corner_sources, mesh))


def _kept_target(target: Target, used: Indices, renumber: Indices) -> Target:
    """A target of the vertices that are used, under their new numbers."""
    kept = np.isin(target.vertices, used)
    return Target(renumber[target.vertices[kept]], target.shifts[kept], target.turns[kept])


def _build_morphs(
    soup: Soup, defaults: dict[str, float], firsts: Indices, corner_sources: Indices, mesh: SkinnedMesh
) -> tuple[Morph, ...]:
    """Morphs of the mesh's vertices, whose source vertices are `firsts`, and its corners' `corner_sources`.

    Where the file has no normals they are made of the positions, and so are those of the morphed surface.
    """
    surface, morphs = mesh.surface, []
    faces = surface.faces.astype(np.int64)
    corner_vertices = faces.reshape(-1)
    sources = corner_sources.reshape(-1)
    normals = mesh.corner_normals.reshape(-1, 3)
    missing = np.isnan(soup.normals[sources]).any(axis=1)
    turned = (np.einsum("nc,nc->n", np.nan_to_num(soup.normals[sources]), normals) < 0)[:, None]
    for name, default in defaults.items():
        target = soup.targets.get(name, Target(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))))
        rows = np.zeros((len(soup.positions), 6))
        rows[target.vertices, :3], rows[target.vertices, 3:] = target.shifts, target.turns
        shifts = rows[firsts, :3]
        changes = np.where(turned, -rows[sources, 3:], rows[sources, 3:])
        if missing.any():
            moved = smooth_corner_normals(surface.positions + shifts, faces).reshape(-1, 3)
            changes[missing] = moved[missing] - normals[missing]
        is_touched = np.zeros(len(firsts), bool)
        is_touched[faces[np.asarray(np.abs(shifts[faces]).max(axis=(1, 2)) > 0)]] = True  # elsewhere turns are noise
        vertices = np.flatnonzero(is_touched)
        own = is_touched[corner_vertices]
        turns = vertex_turns(normals[own], changes[own], corner_vertices[own], vertices)
        morphs.append(Morph(name, default, vertices, shifts[vertices], turns))
    return tuple(morphs)


def _without_unused(soup: Soup, used: Indices) -> Soup:
    """The soup with only the vertices that faces use."""
    renumber = np.zeros(len(soup.positions), np.int64)
    renumber[used] = np.arange(len(used))
    return dataclasses.replace(
        soup,
        positions=soup.positions[used],
        normals=soup.normals[used],
        tangents=None if soup.tangents is None else soup.tangents[used],
        texcoords=soup.texcoords[used],
        num_texcoords=soup.num_texcoords[used],
        colors=None if soup.colors is None else soup.colors[used],
        joints=soup.joints[used],
        weights=soup.weights[used],
        faces=renumber[soup.faces],
        targets={name: _kept_target(target, used, renumber) for name, target in soup.targets.items()},
    )


def unify(
    scene: Scene,
    materials: tuple[Material, ...],
    material_index: dict[int | None, int],
    where: str,
    warnings: list[str],
) -> tuple[SkinnedMesh, tuple[Material, ...]]:
    """Weld the parts of a scene into one mesh.

    Parameters
    ----------
    scene : Scene
    materials : tuple of Material
    material_index : dict
        From a material index of the file (or None) into `materials`.
    where : str
        How messages name the file.
    warnings : list of str
        What is changed is added to it.

    Returns
    -------
    mesh : SkinnedMesh
    materials : tuple of Material
        Longer where fronts took over for their backs.
    """
    soup = _stack_parts(scene.parts, material_index)
    used = np.unique(soup.faces)
    diagonal_m = float(np.linalg.norm(np.ptp(soup.positions[used], axis=0)))
    soup = _without_unused(soup, used)
    welded = weld_vertices(soup, diagonal_m)
    log.info(
        "weld: %d source vertices -> %d points of the surface (%d coincide but move apart)",
        len(soup.positions),
        len(welded.vertex_firsts),
        welded.num_apart,
    )
    soup, materials = _remove_duplicates(soup, welded, materials, diagonal_m, where, warnings)
    manifold = make_manifold(
        welded.vertex_of[soup.faces],
        soup.positions[welded.vertex_firsts],
        soup.faces,
        welded.uv_of[soup.faces],
        soup.face_parts,
    )
    _report_manifold(manifold, warnings)
    return _build_mesh(soup, welded, manifold, scene.morphs, warnings), materials
