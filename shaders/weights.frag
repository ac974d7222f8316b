// Joint weights: each joint a colour, blended as the matrices are.
#include "include/clay.glsl"

in vec3 surface_joint_color;
out vec4 result;

void main() {
    result = vec4(clay(decode_srgb(clamp(surface_joint_color, 0.0, 1.0))), 1.0);
}
