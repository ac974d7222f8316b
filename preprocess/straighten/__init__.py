"""Seam straightening: equal straight runs on both sides of every seam (paper, section 6)."""

from preprocess.straighten.driver import DEFAULT_TOLERANCE_REL, Straightened, straighten

__all__ = ["DEFAULT_TOLERANCE_REL", "Straightened", "straighten"]
