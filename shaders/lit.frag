// The finished picture: metallic-roughness shading, tone mapped.
#include "include/lighting.glsl"

out vec4 result;

void main() {
#ifdef UNLIT
    vec4 encoded = encoded_base_color();
    result = vec4(encode_srgb(decode_srgb(encoded.rgb) * color_factor()), encoded.a);
#else
    Surface s = read_surface();
    result = vec4(tone_map(shade(s)), s.base_color.a);
#endif
}
