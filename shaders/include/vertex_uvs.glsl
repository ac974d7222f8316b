// A vertex's places in the atlas: its own uv, where it samples its material, and its canonical uv, where it fetches its
// geometry: the same bits for every copy of a surface point.
#ifndef VERTEX_UVS_GLSL
#define VERTEX_UVS_GLSL

// Uvs in 16 bits: UV_STEPS, CANONICAL_STEPS and NORMAL_UV are defined as the number of steps (runtime/gpu/vertex_layout.py).
vec2 uv_of_steps(uvec2 steps, int num_steps) {
    PRECISE vec2 uv = vec2(steps) / float(num_steps);
    return uv;
}

#ifdef UV_STEPS
in uvec2 in_uv_steps;

vec2 own_uv() {
    return uv_of_steps(in_uv_steps, UV_STEPS);
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
    return uv_of_steps(in_canonical_steps, CANONICAL_STEPS);
}
#else
in vec2 in_canonical_uv;

vec2 canonical_uv() {
    return in_canonical_uv;
}
#endif

#endif
