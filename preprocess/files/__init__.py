"""Files in and out: images, OBJ meshes, and output folders that appear whole or not at all."""
