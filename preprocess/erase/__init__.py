"""Seam erasure: textures whose bilinear samples agree on both sides of every seam."""

from preprocess.erase.eraser import Erased, Eraser
from preprocess.erase.mips import Level, erase_mips
from preprocess.erase.options import GLOBAL, LOCAL, EraseOptions, Weights
from preprocess.erase.prepare import erase, plan_erasure
from preprocess.erase.quantise import quantise
from preprocess.erase.seam_classification import Decision, choose_color_seams, choose_normal_seams, draw_decision
from preprocess.erase.seam_samples import SeamMeasure, SeamStrip, build_strip, measure_seams

__all__ = [
    "GLOBAL",
    "LOCAL",
    "Decision",
    "EraseOptions",
    "Erased",
    "Eraser",
    "Level",
    "SeamMeasure",
    "SeamStrip",
    "Weights",
    "build_strip",
    "choose_color_seams",
    "choose_normal_seams",
    "draw_decision",
    "erase",
    "erase_mips",
    "measure_seams",
    "plan_erasure",
    "quantise",
]
