"""One one-to-one texture atlas for a whole character."""

from preprocess.atlas.build import MODES, Atlas, build_atlas, default_floor

__all__ = ["MODES", "Atlas", "build_atlas", "default_floor"]
