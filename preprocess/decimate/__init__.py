"""Seam-aware edge collapse: levels of detail that share one set of textures (paper, section 5)."""

from preprocess.decimate.chain import decimate, decimate_to, decimate_within, floor_faces
from preprocess.decimate.levels import Chain, DecimateOptions, Lod, Repairs, Strictness

__all__ = [
    "Chain",
    "DecimateOptions",
    "Lod",
    "Repairs",
    "Strictness",
    "decimate",
    "decimate_to",
    "decimate_within",
    "floor_faces",
]
