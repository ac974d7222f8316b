"""The shape as textures: positions and joint weights, and how levels of detail fetch them."""
