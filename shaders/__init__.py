"""GLSL sources, one file a stage; shared parts in include/."""
