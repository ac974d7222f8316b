"""Borders between colours along mesh edges, as the source paints them: palettes, lines (docs/method.md, section 3).

Both faces of an edge are asked for their base colour at the same points of it. Where the source's uvs run on, the
answers are equal; where they jump, as between two cells of a palette, they tell whether the colours were meant to
differ. In an atlas that is ours such an edge may lie inside a chart: there its two sides are kept apart like those of a
hard edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Bools, Floats
from preprocess.bake.materials import base_colors_at
from preprocess.load import Character
from preprocess.mesh.edges import MeshEdges, find_edges, next_corners
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import SkinnedMesh

NEAR_ENDS = 0.15  # where along an edge its ends are asked for: at a corner itself the source may mix three colours
BORDER = 12 / 255  # colours that differ by more, in any channel as stored, are a border


@dataclass(frozen=True)
class ColorBorders:
    """How much the base colour differs across the E edges of a mesh.

    Attributes
    ----------
    edges : MeshEdges
    gaps : (E, 3) float64
        Largest difference of a channel, sRGB-encoded, along the edge's first half-edge: near its start, in the middle
        and near its end; 0 where an edge has not two faces.
    """

    edges: MeshEdges
    gaps: Floats

    def half_edges(self) -> Bools:
        """Half-edges that have a border at their start, (3 F,) bool."""
        edges = self.edges
        result = np.zeros(edges.face_edges.size, bool)
        glued = edges.glued
        result[edges.halves[glued, 0]] = self.gaps[glued, 0] > BORDER
        result[edges.halves[glued, 1]] = self.gaps[glued, 2] > BORDER
        return result

    def along_seams(self, seams: Seams, faces: NDArray[np.integer]) -> Floats:
        """Largest gap of each seam, (S,)."""
        side = seams.faces[:, 0]
        corner = (faces[side] == seams.vertices[:, :1]).argmax(axis=1)
        after = faces[side, (corner + 1) % 3] == seams.vertices[:, 1]
        edge = self.edges.face_edges[side, np.where(after, corner, (corner + 2) % 3)]
        return np.asarray(self.gaps[edge].max(axis=1))


def find_color_borders(character: Character, mesh: SkinnedMesh, size_px: tuple[int, int]) -> ColorBorders:
    """Compare the base colour across every edge.

    Parameters
    ----------
    character : Character
    mesh : SkinnedMesh
        With the atlas as its uvs.
    size_px : (width, height)
        Of the base colour texture: its texels say over which area a colour is taken.

    Returns
    -------
    ColorBorders
    """
    edges = find_edges(mesh.surface.faces)
    glued = np.flatnonzero(edges.glued)
    shares = np.array([NEAR_ENDS, 0.5, 1.0 - NEAR_ENDS])

    def colors(halves: NDArray[np.integer], shares: Floats) -> Floats:
        barycentrics = np.zeros((len(halves), 3, 3))
        rows = np.arange(len(halves))
        for number, share in enumerate(shares):
            barycentrics[rows, number, halves % 3] = 1.0 - share
            barycentrics[rows, number, next_corners(halves) % 3] = share
        faces = np.repeat(halves // 3, 3)
        return base_colors_at(character.materials, mesh, faces, barycentrics.reshape(-1, 3), size_px)

    first = colors(edges.halves[glued, 0], shares)
    second = colors(edges.halves[glued, 1], 1.0 - shares)  # it runs the other way
    gaps = np.zeros((len(edges.vertices), 3))
    gaps[glued] = np.abs(first - second).max(axis=1).reshape(-1, 3)
    return ColorBorders(edges, gaps)
