"""Character files (glTF 2.0, GLB, VRM) into arrays."""
