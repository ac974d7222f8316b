"""Seam erasure: textures whose bilinear samples agree across every uv seam."""
