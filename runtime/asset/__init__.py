"""A built character's folder read into arrays, and the codecs of its files."""
