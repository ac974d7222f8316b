"""Straighter boundary paths (placeholder: none yet)."""

from __future__ import annotations

from preprocess.atlas.topology import Bools, MeshEdges
from preprocess.mesh import TexturedSurface


def relax_paths(surface: TexturedSurface, edges: MeshEdges, cut: Bools) -> Bools:
    """Return the cut unchanged."""
    return cut
