"""Textures closed, stored, and made right at the vertices of the levels that came out."""
