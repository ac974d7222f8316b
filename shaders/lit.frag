// The finished picture: metallic-roughness shading, tone mapped.
#include "include/lighting.glsl"

out vec4 result;

void main() {
    Surface s = read_surface();
    vec3 radiance = shade(s);
    result = vec4(s.unlit ? encode_srgb(radiance) : tone_map(radiance), s.base_color.a);
}
