// The sky behind everything (demos): drawn over the whole picture first.
#include "include/sky.glsl"

uniform mat4 world_from_clip;   // world: axes, origin at the eye
in vec2 picture_place;
out vec4 result;

void main() {
    vec4 far_point = world_from_clip * vec4(picture_place, 1.0, 1.0);
    vec3 color = sky_color(normalize(far_point.xyz / far_point.w));
    result = vec4(color + (place_noise(gl_FragCoord.xy) - 0.5) / 255.0, 1.0);
}
