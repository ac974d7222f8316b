// A quiet shading under the colours of a diagram.
#ifndef CLAY_GLSL
#define CLAY_GLSL

#include "surface.glsl"

vec3 clay(vec3 color) {
    encoded_base_color();  // cut-outs
    vec3 normal = shading_normal();
    float facing = abs(dot(normal, normalize(surface_position)));
    float light = 0.62 + 0.38 * (dot(normal, sun_direction) * 0.5 + 0.5);
    return encode_srgb(color * light * (0.55 + 0.45 * facing));
}

#endif
