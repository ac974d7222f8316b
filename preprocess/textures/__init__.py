"""Colours and normals as textures of the atlas: sampled from the source, seams erased, rounded."""
