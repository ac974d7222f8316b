// A lantern: a six-sided glass with a lid, made of numbers alone (demos).
uniform mat4 clip_from_world;    // world axes, origin at the eye
uniform vec3 lantern_position;   // of its handle, seen from the eye
uniform float lantern_size;

out float glow;

// Radius and height of the rings of the profile, from the handle down.
const vec2 PROFILE[5] = vec2[](vec2(0.02, 0.0), vec2(0.34, -0.30), vec2(0.26, -0.36), vec2(0.30, -0.90), vec2(0.05, -0.96));
const vec2 STEPS[6] = vec2[](vec2(0, 0), vec2(1, 0), vec2(0, 1), vec2(0, 1), vec2(1, 0), vec2(1, 1));

void main() {
    int quad = gl_VertexID / 6;
    vec2 step_ = STEPS[gl_VertexID % 6];
    int ring = quad / 6 + int(step_.y);
    float angle = (float(quad % 6) + step_.x) * 1.04719755;
    vec2 profile = PROFILE[ring];
    vec3 point = vec3(profile.x * cos(angle), profile.y, profile.x * sin(angle)) * lantern_size;
    glow = ring >= 2 && quad / 6 >= 2 ? 1.0 - 0.35 * abs(profile.y + 0.63) / 0.27 : 0.06;
    gl_Position = clip_from_world * vec4(lantern_position + point, 1.0);
}
