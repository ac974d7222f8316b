// Base colour alone, in the encoding it is stored in: comparable pixel by pixel with another renderer.
#include "include/surface.glsl"

out vec4 result;

void main() {
    vec4 encoded = encoded_base_color();
    vec3 factor = color_factor();
    if (factor != vec3(1.0)) {
        encoded.rgb = encode_srgb(decode_srgb(encoded.rgb) * factor);
    }
    result = encoded;
}
