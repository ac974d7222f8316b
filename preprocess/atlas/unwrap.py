"""Charts for faces that have none: small regions, laid flat, joined into as few charts as stay nearly isometric.

regions of similar normals (`segment`) > free maps (`flatten`) > charts joined while they stay sound (`merge`).
"""

from __future__ import annotations

import logging

import numpy as np

from preprocess.arrays import Bools, Floats, Ints
from preprocess.atlas.distortion import overlapping_charts, singular_values, turned_areas
from preprocess.atlas.flatten import flatten_free, local_triangles, project_charts
from preprocess.atlas.merge import MOST_STRETCH, merge_charts
from preprocess.atlas.segment import grow_regions
from preprocess.mesh.edges import MeshEdges, find_edges, label_corners, label_faces
from preprocess.mesh.face_geometry import face_frames

log = logging.getLogger(__name__)

FIRST_STEPS = 4  # of relaxing a region from its projection


def unwrap(positions: Floats, faces: Ints, groups: Ints) -> tuple[Ints, Floats]:
    """Lay out all faces in charts that are one-to-one.

    Parameters
    ----------
    positions : (V, 3) float64
    faces : (F, 3) int32
    groups : (F,) int32
        A chart keeps to one group: the faces of one material.

    Returns
    -------
    face_uvs : (F, 3) int32
        Each chart has texture vertices of its own.
    uvs : (T, 2) float64
        Each chart in a frame of its own, counter-clockwise, at the surface's scale.
    """
    edges = find_edges(faces)
    areas, normals, _ = face_frames(positions, faces)
    _, regions = grow_regions(edges.neighbors, normals, areas, groups)
    cut, corner_uvs = _lay_regions_flat(positions, faces, edges, regions)
    first, second = edges.halves[:, 0] // 3, edges.halves[:, 1] // 3
    cut, corner_uvs = merge_charts(positions, faces, edges, cut, corner_uvs, groups[first] != groups[second])
    count, face_uvs = label_corners(faces, edges, cut)
    uvs = np.zeros((count, 2))
    uvs[face_uvs] = corner_uvs
    log.info("unwrap: %d regions, %d charts", regions.max() + 1, label_faces(edges, cut)[0])
    return face_uvs, uvs


def _lay_regions_flat(positions: Floats, faces: Ints, edges: MeshEdges, regions: Ints) -> tuple[Bools, Floats]:
    """Cut edges (E,) and corners (F, 3, 2) of every region; what does not lie flat is cut into its faces."""
    flat = local_triangles(positions, faces)
    halves = edges.halves
    cut = ~edges.glued | (regions[halves[:, 0] // 3] != regions[halves[:, 1] // 3])
    num_charts, charts = label_faces(edges, cut)
    count, face_uvs = label_corners(faces, edges, cut)
    points = np.zeros((count, 3))
    points[face_uvs] = positions[faces]
    uvs = flatten_free(project_charts(points, face_uvs, charts, num_charts), flat, face_uvs, charts, FIRST_STEPS)
    corner_uvs = uvs[face_uvs]
    largest, smallest = singular_values(flat, corner_uvs)
    bad = (turned_areas(corner_uvs) <= 0) | (largest > MOST_STRETCH) | (smallest * MOST_STRETCH < 1.0)
    bad_charts = np.bincount(charts[bad], minlength=num_charts) > 0
    bad_charts |= overlapping_charts(corner_uvs, charts, num_charts)
    alone = bad_charts[charts]
    corner_uvs[alone] = flat[alone]
    return cut | alone[halves[:, 0] // 3], corner_uvs
