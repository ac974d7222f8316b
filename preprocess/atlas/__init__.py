"""One one-to-one texture atlas for a whole character."""
