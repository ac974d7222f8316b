"""Triangles as a file's own nodes and skins draw them, and as the character made of it does: they must agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from preprocess.load import Character, load_character
from preprocess.mesh.seams import find_seams
from runtime.animation.clip import read_clips
from runtime.animation.pose import global_transforms, sample, skinning_matrices
from runtime.animation.skeleton import Skeleton, read_skeleton
from runtime.gltf.document import Document, read_document


def whole_tree(document: Document) -> Skeleton:
    """Every node of the file as a joint with an identity bind."""
    count = len(document.items("nodes"))
    return read_skeleton(document, list(range(count)), np.tile(np.eye(4), (count, 1, 1)))


def source_triangles(document: Document, pose_of: Any) -> np.ndarray:
    """The slow twin: corners (F, 3, 3) of every triangle as glTF says to draw it, primitive by primitive."""
    tree = whole_tree(document)
    globals_ = np.empty((tree.num_nodes, 4, 4))
    globals_[tree.document_nodes] = global_transforms(tree, pose_of(tree))[0]
    drawn = []
    for index in scene_order(document):
        node = document.items("nodes")[index]
        if "mesh" not in node:
            continue
        for spec in document.items("meshes")[node["mesh"]]["primitives"]:
            attributes = spec["attributes"]
            points = document.accessor(attributes["POSITION"]).astype(np.float64)
            homogeneous = np.c_[points, np.ones(len(points))]
            if "skin" in node and "JOINTS_0" in attributes:
                skin = document.items("skins")[node["skin"]]
                inverse = document.accessor(skin["inverseBindMatrices"]).astype(np.float64)
                matrices = globals_[skin["joints"]] @ inverse
                weights = document.accessor(attributes["WEIGHTS_0"]).astype(np.float64)
                weights /= weights.sum(axis=1, keepdims=True)
                blended = np.einsum("nk,nkij->nij", weights, matrices[document.accessor(attributes["JOINTS_0"])])
            else:
                blended = np.broadcast_to(globals_[index], (len(points), 4, 4))
            moved = np.einsum("nij,nj->ni", blended, homogeneous)[:, :3]
            corners = document.accessor(spec["indices"]).astype(int) if "indices" in spec else np.arange(len(points))
            drawn.append(moved[corners.reshape(-1, 3)])
    return np.concatenate(drawn)


def scene_order(document: Document) -> list[int]:
    def below(index: int) -> list[int]:
        children = document.items("nodes")[index].get("children", [])
        return [index] + [found for child in children for found in below(child)]

    scene = document.items("scenes")[document.json.get("scene", 0)]
    return [found for root in scene["nodes"] for found in below(root)]


def drawn_triangles(character: Character, pose: Any) -> np.ndarray:
    mesh = character.mesh
    matrices = skinning_matrices(character.skeleton, pose)[0]
    blended = np.einsum("vk,vkij->vij", mesh.joint_weights, matrices[mesh.joint_indices])
    points = np.c_[mesh.surface.positions, np.ones(mesh.num_vertices)]
    return np.einsum("vij,vj->vi", blended, points)[:, :3][mesh.surface.faces]


def assert_same_triangles(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    """Equal in order, or turned over; the source may hold triangles without area that ours lacks."""
    if len(ours) != len(theirs):
        area = np.linalg.norm(np.cross(theirs[:, 1] - theirs[:, 0], theirs[:, 2] - theirs[:, 0]), axis=1)
        theirs = theirs[area > 1e-9]
    assert ours.shape == theirs.shape
    straight = np.abs(ours - theirs).max(axis=(1, 2))
    turned = np.abs(ours - theirs[:, [0, 2, 1]]).max(axis=(1, 2))
    assert np.minimum(straight, turned).max() <= tolerance


def assert_manifold(character: Character) -> None:
    """No edge with three faces, neighbours wind one way, one fan of faces a vertex."""
    faces = character.mesh.surface.faces.astype(np.int64)
    find_seams(character.mesh.surface)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    directed = start * (faces.max() + 1) + end
    assert len(np.unique(directed)) == len(directed)  # each directed edge once
    num_vertices = len(character.mesh.surface.positions)
    assert len(np.unique(faces)) == num_vertices
    # Around a manifold vertex, the faces form one chain: corners joined across edges are one group a vertex.
    group = np.arange(faces.size)
    reverse = {int(key): h for h, key in enumerate(end * (faces.max() + 1) + start)}

    def root(corner: int) -> int:
        while group[corner] != corner:
            corner = group[corner]
        return corner

    for h, key in enumerate(directed):
        mate = reverse.get(int(key))
        if mate is not None:
            here, there = root(h), root(mate // 3 * 3 + (mate % 3 + 1) % 3)
            group[here] = there
    assert len({root(corner) for corner in range(faces.size)}) == num_vertices


def check_against_source(path: Path, tolerance: float = 1e-6) -> Character:
    character, document = load_character(path), read_document(path)
    assert_manifold(character)
    clips = read_clips(document, whole_tree(document))
    for ours, theirs in zip(character.clips, clips):
        for moment in (0.0, 0.4, 1.0):
            assert_same_triangles(
                drawn_triangles(character, sample(ours, character.skeleton, moment)),
                source_triangles(document, lambda tree, clip=theirs, at=moment: sample(clip, tree, at)),
                tolerance,
            )
    return character
