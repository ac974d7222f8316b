"""Draws built characters: skeletons, clips, levels of detail and textures, in a context the caller owns."""
