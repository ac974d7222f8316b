// The level of detail as a colour, from green (all detail) to violet.
#include "include/clay.glsl"

out vec4 result;

const vec3 LEVEL_COLORS[8] = vec3[8](
    vec3(0.18, 0.62, 0.30), vec3(0.16, 0.55, 0.80), vec3(0.95, 0.75, 0.20), vec3(0.90, 0.45, 0.15),
    vec3(0.80, 0.20, 0.25), vec3(0.62, 0.25, 0.70), vec3(0.40, 0.35, 0.85), vec3(0.55, 0.55, 0.55));

void main() {
    result = vec4(clay(decode_srgb(LEVEL_COLORS[min(surface_level, 7)])), 1.0);
}
