"""One one-to-one texture atlas for a whole character."""

from preprocess.atlas.build import MODES, Atlas, build_atlas, character_atlas

__all__ = ["MODES", "Atlas", "build_atlas", "character_atlas"]
