"""Seam erasure: textures whose bilinear samples agree on both sides of every seam."""

from preprocess.erase.eraser import (
    GLOBAL,
    LOCAL,
    EraseOptions,
    Erased,
    Eraser,
    Weights,
    erase,
    plan_erasure,
)

__all__ = ["GLOBAL", "LOCAL", "EraseOptions", "Erased", "Eraser", "Weights", "erase", "plan_erasure"]
