"""Character files (glTF 2.0, GLB, VRM) into arrays."""

from preprocess.load.character import Character, Material, TextureRef
from preprocess.load.character_file import load_character

__all__ = ["Character", "Material", "TextureRef", "load_character"]
