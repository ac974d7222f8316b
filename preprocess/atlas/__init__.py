"""One one-to-one texture atlas for a whole character."""

from preprocess.atlas.build import MODES, Atlas, build_atlas

__all__ = ["MODES", "Atlas", "build_atlas"]
