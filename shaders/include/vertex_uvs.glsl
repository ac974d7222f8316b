// A vertex's places in the atlas: its own uv, where it samples its material, and its canonical uv, where it fetches its
// geometry: the same bits for every copy of a surface point.
#ifndef VERTEX_UVS_GLSL
#define VERTEX_UVS_GLSL

vec2 uv_of_steps(uvec2 steps) {
    PRECISE vec2 uv = vec2(steps) / 65535.0;
    return uv;
}

#ifdef UV_STEPS
in uvec2 in_uv_steps;

vec2 own_uv() {
    return uv_of_steps(in_uv_steps);
}
#else
in vec2 in_uv;

vec2 own_uv() {
    return in_uv;
}
#endif

#ifdef CANONICAL_STEPS
in uvec2 in_canonical_steps;

vec2 canonical_uv() {
    return uv_of_steps(in_canonical_steps);
}
#else
in vec2 in_canonical_uv;

vec2 canonical_uv() {
    return in_canonical_uv;
}
#endif

#endif
