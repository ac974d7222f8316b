"""Rigid parts that a clip turns inside out.

glTF turns the winding of a mesh whose node mirrors it (section 3.7.4), at every moment of a clip anew. Here all parts
are one skinned mesh, whose winding no joint changes. So faces of parts that a clip mirrors against their rest pose are
drawn from both sides: the outside stays outside, as its normal is turned towards the viewer.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from preprocess.load.character import Material
from preprocess.load.scene import Part
from preprocess.mesh.surface import SkinnedMesh
from runtime.animation.clip import Clip
from runtime.animation.skeleton import Skeleton


def find_mirrored_nodes(skeleton: Skeleton, clips: Iterable[Clip]) -> NDArray[np.bool_]:
    """Nodes of the skeleton that some clip mirrors against their rest pose, or something above them, (N,) bool."""
    at_rest = np.prod(skeleton.scale, axis=1) < 0
    mirrored = np.zeros(skeleton.num_nodes, bool)
    for clip in clips:
        for track in clip.tracks:
            if track.path == "scale":
                keys = track.values[:, 1] if track.values.ndim == 3 else track.values
                signs = np.prod(np.sign(keys), axis=1)
                mirrored[track.node] |= bool((signs == (1 if at_rest[track.node] else -1)).any())
    for node, parent in enumerate(skeleton.parents):  # parents come first
        mirrored[node] |= parent >= 0 and mirrored[parent]
    return mirrored


def show_both_sides(
    mesh: SkinnedMesh,
    materials: tuple[Material, ...],
    parts: tuple[Part, ...],
    skeleton: Skeleton,
    clips: Iterable[Clip],
    warnings: list[str],
) -> tuple[SkinnedMesh, tuple[Material, ...]]:
    """The mesh with double-sided materials on the faces of rigid parts that a clip mirrors.

    Parameters
    ----------
    mesh : SkinnedMesh
        Its `face_parts` point into `parts`.
    materials : tuple of Material
    parts : tuple of Part
    skeleton : Skeleton
    clips : iterable of Clip
    warnings : list of str
        Gets a line where there are such faces.

    Returns
    -------
    mesh : SkinnedMesh
    materials : tuple of Material
        Longer by the double-sided ones.
    """
    mirrored = find_mirrored_nodes(skeleton, clips)
    document_nodes = set(skeleton.document_nodes[mirrored].tolist())
    turned = np.array([part.skin is None and part.node in document_nodes for part in parts])
    one_sided = np.array([not material.double_sided for material in materials])
    faces = turned[mesh.face_parts] & one_sided[mesh.face_materials]
    if not faces.any():
        return mesh, materials
    face_materials = mesh.face_materials.copy()
    for index in np.unique(mesh.face_materials[faces]).tolist():
        twin = dataclasses.replace(materials[index], name=f"{materials[index].name} (double-sided)", double_sided=True)
        face_materials[faces & (mesh.face_materials == index)] = len(materials)
        materials = (*materials, twin)
    warnings.append(f"{int(faces.sum())} triangles of parts that a clip mirrors are drawn double-sided")
    return dataclasses.replace(mesh, face_materials=face_materials), materials
