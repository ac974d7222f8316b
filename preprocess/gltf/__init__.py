"""Character files (glTF 2.0, GLB, VRM) into arrays."""

from preprocess.gltf.character import Character, Material, TextureRef
from preprocess.gltf.load import load_character

__all__ = ["Character", "Material", "TextureRef", "load_character"]
