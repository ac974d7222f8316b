// One flat colour: masks and lines.
#include "include/surface.glsl"

uniform vec3 flat_color;
out vec4 result;

void main() {
    encoded_base_color();  // cut-outs
    result = vec4(flat_color, 1.0);
}
