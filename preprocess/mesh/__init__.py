"""What every stage shares: the surface, its seams, its texels, and lookups on it."""
