// World normals as colours, n * 0.5 + 0.5.
#include "include/surface.glsl"

out vec4 result;

void main() {
    encoded_base_color();  // cut-outs
    result = vec4(shading_normal() * 0.5 + 0.5, 1.0);
}
