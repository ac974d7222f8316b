"""The source's signals into textures of the atlas."""
