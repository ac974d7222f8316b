// Rest positions as colours, the box of the character at rest from black to white.
#include "include/surface.glsl"

uniform vec3 box_min;
uniform vec3 box_size;
out vec4 result;

void main() {
    encoded_base_color();  // cut-outs
    result = vec4((surface_rest - box_min) / max(box_size, vec3(1e-9)), 1.0);
}
