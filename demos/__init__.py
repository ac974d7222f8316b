"""Windows and pictures: viewer, crowd, comparison, the built-in character."""
