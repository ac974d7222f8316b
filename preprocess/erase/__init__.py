"""Seam erasure: textures whose bilinear samples agree on both sides of every seam."""

from preprocess.erase.eraser import (
    GLOBAL,
    LOCAL,
    Erased,
    EraseOptions,
    Eraser,
    Weights,
    erase,
    plan_erasure,
)
from preprocess.erase.mips import Level, erase_mips
from preprocess.erase.quantise import quantise
from preprocess.erase.strip import SeamMeasure, SeamStrip, build_strip, measure_seams

__all__ = [
    "GLOBAL",
    "LOCAL",
    "EraseOptions",
    "Erased",
    "Eraser",
    "Level",
    "SeamMeasure",
    "SeamStrip",
    "Weights",
    "build_strip",
    "erase",
    "erase_mips",
    "measure_seams",
    "plan_erasure",
    "quantise",
]
