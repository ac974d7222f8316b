"""The built-in character, made by code alone: a young fern dragon.

    python -m demos.creature -o dragon.glb

Rooms, in the order data flows: `skeleton` (where the joints are) > `field`, `anatomy` (the body as one implicit
surface) > `polygonise`, `remesh` (triangles) > `weights` (skin) > `unwrap`, `pack` (texture coordinates with curved
seams) > `paint` (colour, roughness, normal map) > `clips` (idle, walk, greet) > `write` (one ordinary `.glb`).
"""
