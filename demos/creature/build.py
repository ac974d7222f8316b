"""The dragon from clay to mesh: polygonise > remesh > mirror > cut > flatten > pack."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demos.creature.anatomy import build_body, edge_lengths
from demos.creature.charts import HEAD, assign_parts, cut_charts
from demos.creature.clips import build_clips
from demos.creature.field import Field
from demos.creature.motion import Motion
from demos.creature.pack import pack_charts
from demos.creature.paint import Textures, paint
from demos.creature.polygonise import mirror_half, polygonise_half
from demos.creature.remesh import remesh, smooth_seams
from demos.creature.skeleton import Joints, build_joints
from demos.creature.surface import Floats
from demos.creature.texels import BodyMesh, compute_tangents
from demos.creature.unwrap import flatten_charts, split_at_cuts
from demos.creature.weights import compute_weights
from demos.creature.write import write_creature

log = logging.getLogger(__name__)

_CELL_M = 0.0088  # of the grid that the body is polygonised on
_LOW, _HIGH = np.array([0.0, -0.02, -1.20]), np.array([0.46, 0.95, 0.72])
_HEAD_DENSITY = 1.2  # the face gets more texels


def build_mesh(field: Field) -> BodyMesh:
    """Mesh the body and lay out its texture coordinates.

    Raises
    ------
    ValueError
        If a chart does not lie flat or the charts do not fit.
    """
    points, faces = polygonise_half(field, _CELL_M, _LOW, _HIGH)
    log.info("polygonised: %d faces on one side", len(faces))
    points, faces = remesh(field, points, faces, edge_lengths(field, points))
    points, faces, _ = mirror_half(points, faces)
    log.info("remeshed: %d vertices, %d faces", len(points), len(faces))
    charts, cut = cut_charts(field, points, faces)
    points, faces, cut = smooth_seams(field, points, faces, cut)
    face_uvs, uv_to_vertex = split_at_cuts(faces, cut)
    flat = flatten_charts(points, face_uvs, uv_to_vertex, charts)
    is_head = assign_parts(field, points[faces].mean(axis=1)) == HEAD
    densities = np.array([_HEAD_DENSITY if is_head[charts == k].mean() > 0.5 else 1.0 for k in range(charts.max() + 1)])
    uvs = pack_charts(flat, face_uvs, charts, densities)
    uvs[:, 1] = 1.0 - uvs[:, 1]  # glTF's v points down
    log.info("unwrapped: %d charts", charts.max() + 1)
    normals = field.gradient(points)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    tangents = compute_tangents(points, normals, uvs, face_uvs, uv_to_vertex)
    return BodyMesh(points, normals, faces, uvs, face_uvs, uv_to_vertex, tangents, charts)


def ambient_occlusion(field: Field, mesh: BodyMesh) -> Floats:
    """Share of the surroundings that each vertex sees, (V,): how far the skin recedes along the normal."""
    seen = np.ones(len(mesh.points))
    for reach, strength in ((0.012, 0.25), (0.035, 0.35), (0.09, 0.40)):
        distance = field.distance(mesh.points + reach * mesh.normals)
        seen -= strength * np.clip(1.0 - distance / reach, 0.0, 1.0)
    return np.clip(seen, 0.0, 1.0)


@dataclass(frozen=True)
class Creature:
    """The whole dragon in memory. V surface vertices.

    Attributes
    ----------
    mesh : BodyMesh
    joints : Joints
    joint_indices : (V, 4) uint16
    joint_weights : (V, 4) float32
    textures : Textures
    clips : tuple of Motion
    """

    mesh: BodyMesh
    joints: Joints
    joint_indices: NDArray[np.uint16]
    joint_weights: NDArray[np.float32]
    textures: Textures
    clips: tuple[Motion, ...]


def model_creature() -> Creature:
    """Model, cut, skin, paint and animate the dragon."""
    field, joints = build_body(), build_joints()
    mesh = build_mesh(field)
    joint_indices, joint_weights = compute_weights(field, joints, mesh.points, mesh.faces)
    textures = paint(field, mesh, ambient_occlusion(field, mesh))
    return Creature(mesh, joints, joint_indices, joint_weights, textures, build_clips(joints))


def write(path: Path, creature: Creature) -> None:
    """Write the dragon as a .glb."""
    c = creature
    write_creature(path, c.mesh, c.joints, c.joint_indices, c.joint_weights, c.textures, c.clips)


def build_creature(path: Path) -> None:
    """Make the dragon and write it as a .glb."""
    write(path, model_creature())
