// One colour under quiet shading: the ground of the wireframe and seam views.
#include "include/clay.glsl"

uniform vec3 flat_color;
out vec4 result;

void main() {
    result = vec4(clay(flat_color), 1.0);
}
